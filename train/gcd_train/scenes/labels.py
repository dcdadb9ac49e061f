"""Class ids of the driving world.

The first thirteen are the ontology of the packaged model's class head (`gcd_model.DRIVING_CLASSES`), in its order; the
others tell apart what that one calls alike.
"""

from enum import IntEnum


class Label(IntEnum):
    """What a pixel shows."""

    SKY = 0
    ROAD = 1
    LANE_MARKING = 2
    PAVEMENT = 3
    TERRAIN = 4
    BUILDING = 5
    VEGETATION = 6
    POLE = 7
    CAR = 8
    TRUCK = 9
    CYCLIST = 10
    PERSON = 11
    OWN_CAR = 12
    BUS = 13
    MOTORCYCLIST = 14
    BICYCLE = 15
    MOTORCYCLE = 16
    TRAFFIC_LIGHT = 17
    TRAFFIC_SIGN = 18
    CROSSWALK = 19
    STOP_LINE = 20
    KERB = 21
    FENCE = 22
    STREET_FURNITURE = 23


_COARSE: dict[int, Label] = {
    Label.BUS: Label.TRUCK,
    Label.MOTORCYCLIST: Label.CYCLIST,
    Label.BICYCLE: Label.CYCLIST,
    Label.MOTORCYCLE: Label.CYCLIST,
    Label.TRAFFIC_LIGHT: Label.POLE,
    Label.TRAFFIC_SIGN: Label.POLE,
    Label.CROSSWALK: Label.LANE_MARKING,
    Label.STOP_LINE: Label.LANE_MARKING,
    Label.KERB: Label.PAVEMENT,
    Label.FENCE: Label.BUILDING,
    Label.STREET_FURNITURE: Label.POLE,
}


def coarse(label: int) -> int:
    """What the packaged model's class head calls a label; the thirteen that it knows stay."""
    return _COARSE.get(label, label)
