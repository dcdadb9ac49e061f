"""The driving world's classes: our ids, what the models' ontology calls them, and ParallelDomain-4D's."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Label(IntEnum):
    """What a pixel shows.

    The first thirteen are the models' ontology (`gcd_model.config.DRIVING_CLASSES`), in its order; the others tell
    apart what that one calls alike.
    """

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


@dataclass(frozen=True, slots=True)
class OntologyItem:
    """A class of ParallelDomain-4D.

    id: 0..254. name: as the data set spells it. colour: 8-bit RGB. label: our id. coarse: the label that the models'
    ontology has for it. is_thing: whether its instances are counted; road users are.
    """

    id: int
    name: str
    colour: tuple[int, int, int]
    label: Label
    coarse: Label
    is_thing: bool = False


ONTOLOGY = (
    OntologyItem(1, "Bicycle", (119, 11, 32), Label.BICYCLE, Label.CYCLIST, is_thing=True),
    OntologyItem(2, "Bicyclist", (64, 64, 64), Label.CYCLIST, Label.CYCLIST, is_thing=True),
    OntologyItem(3, "Building", (156, 110, 84), Label.BUILDING, Label.BUILDING),
    OntologyItem(4, "Bus", (0, 60, 100), Label.BUS, Label.TRUCK, is_thing=True),
    OntologyItem(5, "Car", (0, 0, 142), Label.CAR, Label.CAR, is_thing=True),
    OntologyItem(8, "CrossWalk", (255, 216, 128), Label.CROSSWALK, Label.LANE_MARKING),
    OntologyItem(9, "Fence", (196, 92, 44), Label.FENCE, Label.BUILDING),
    OntologyItem(11, "LaneMarking", (246, 240, 196), Label.LANE_MARKING, Label.LANE_MARKING),
    OntologyItem(12, "LimitLine", (204, 255, 255), Label.STOP_LINE, Label.LANE_MARKING),
    OntologyItem(13, "Motorcycle", (0, 0, 230), Label.MOTORCYCLE, Label.CYCLIST, is_thing=True),
    OntologyItem(14, "Motorcyclist", (128, 128, 128), Label.MOTORCYCLIST, Label.CYCLIST, is_thing=True),
    OntologyItem(16, "OtherFixedStructure", (92, 20, 140), Label.STREET_FURNITURE, Label.POLE),
    OntologyItem(20, "OwnCar(EgoCar)", (128, 230, 128), Label.OWN_CAR, Label.OWN_CAR, is_thing=True),
    OntologyItem(22, "Pedestrian", (220, 20, 60), Label.PERSON, Label.PERSON, is_thing=True),
    OntologyItem(24, "Road", (92, 88, 104), Label.ROAD, Label.ROAD),
    OntologyItem(26, "RoadBoundary(Curb)", (170, 84, 170), Label.KERB, Label.PAVEMENT),
    OntologyItem(28, "SideWalk", (214, 140, 190), Label.PAVEMENT, Label.PAVEMENT),
    OntologyItem(29, "Sky", (122, 176, 230), Label.SKY, Label.SKY),
    OntologyItem(31, "Terrain", (150, 196, 104), Label.TERRAIN, Label.TERRAIN),
    OntologyItem(33, "TrafficLight", (255, 112, 0), Label.TRAFFIC_LIGHT, Label.POLE),
    OntologyItem(34, "TrafficSign", (255, 255, 0), Label.TRAFFIC_SIGN, Label.POLE),
    OntologyItem(36, "Truck", (0, 0, 70), Label.TRUCK, Label.TRUCK, is_thing=True),
    OntologyItem(37, "Vegetation", (36, 112, 62), Label.VEGETATION, Label.VEGETATION),
    OntologyItem(38, "VerticalPole", (170, 170, 20), Label.POLE, Label.POLE),
)
"""In the order of their ids; each label has exactly one.

Ids and names are those of the public ParallelDomain SDK. The colours of people and vehicles are the ones by which the
paper's training finds these classes; all others are ours.
"""
_COARSE = {item.label: item.coarse for item in ONTOLOGY}


def coarse(label: int) -> int:
    """What the models' ontology calls a label; the thirteen that it knows stay."""
    return _COARSE[Label(label)]


def class_ids(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The data set's class ids of a map of our labels, [...] to [...]."""
    table = np.zeros(256, np.uint8)
    for item in ONTOLOGY:
        table[item.label] = item.id
    return table[labels]
