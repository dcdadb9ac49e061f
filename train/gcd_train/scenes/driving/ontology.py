"""The driving world's classes as ParallelDomain-4D counts and names them.

Ids and names are those of the public ParallelDomain SDK. The colours of people and vehicles are the ones by which the
paper's training finds these classes; all others are ours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.scenes.labels import Label


@dataclass(frozen=True, kw_only=True, slots=True)
class OntologyItem:
    """One class. id: 0..254. name: as the data set spells it. colour: 8-bit RGB. label: our own id for it."""

    id: int
    name: str
    colour: tuple[int, int, int]
    label: Label

    @property
    def is_thing(self) -> bool:
        """Whether its instances are counted: road users are."""
        return self.label in _ROAD_USERS


_ROAD_USERS = {
    Label.BICYCLE,
    Label.BUS,
    Label.CAR,
    Label.CYCLIST,
    Label.MOTORCYCLE,
    Label.MOTORCYCLIST,
    Label.OWN_CAR,
    Label.PERSON,
    Label.TRUCK,
}


def _item(number: int, name: str, colour: tuple[int, int, int], label: Label) -> OntologyItem:
    return OntologyItem(id=number, name=name, colour=colour, label=label)


ONTOLOGY: tuple[OntologyItem, ...] = (
    _item(1, "Bicycle", (119, 11, 32), Label.BICYCLE),
    _item(2, "Bicyclist", (64, 64, 64), Label.CYCLIST),
    _item(3, "Building", (156, 110, 84), Label.BUILDING),
    _item(4, "Bus", (0, 60, 100), Label.BUS),
    _item(5, "Car", (0, 0, 142), Label.CAR),
    _item(8, "CrossWalk", (255, 216, 128), Label.CROSSWALK),
    _item(9, "Fence", (196, 92, 44), Label.FENCE),
    _item(11, "LaneMarking", (246, 240, 196), Label.LANE_MARKING),
    _item(12, "LimitLine", (204, 255, 255), Label.STOP_LINE),
    _item(13, "Motorcycle", (0, 0, 230), Label.MOTORCYCLE),
    _item(14, "Motorcyclist", (128, 128, 128), Label.MOTORCYCLIST),
    _item(16, "OtherFixedStructure", (92, 20, 140), Label.STREET_FURNITURE),
    _item(20, "OwnCar(EgoCar)", (128, 230, 128), Label.OWN_CAR),
    _item(22, "Pedestrian", (220, 20, 60), Label.PERSON),
    _item(24, "Road", (92, 88, 104), Label.ROAD),
    _item(26, "RoadBoundary(Curb)", (170, 84, 170), Label.KERB),
    _item(28, "SideWalk", (214, 140, 190), Label.PAVEMENT),
    _item(29, "Sky", (122, 176, 230), Label.SKY),
    _item(31, "Terrain", (150, 196, 104), Label.TERRAIN),
    _item(33, "TrafficLight", (255, 112, 0), Label.TRAFFIC_LIGHT),
    _item(34, "TrafficSign", (255, 255, 0), Label.TRAFFIC_SIGN),
    _item(36, "Truck", (0, 0, 70), Label.TRUCK),
    _item(37, "Vegetation", (36, 112, 62), Label.VEGETATION),
    _item(38, "VerticalPole", (170, 170, 20), Label.POLE),
)
"""In the order of their ids; each label has exactly one."""


def class_ids(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The data set's class ids of a map of our labels, [...] to [...]."""
    table = np.zeros(256, np.uint8)
    for item in ONTOLOGY:
        table[item.label] = item.id
    return table[labels]
