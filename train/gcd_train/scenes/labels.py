"""Class ids of the driving world, in the order of the class head's ontology (`gcd_model.DRIVING_CLASSES`)."""

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
