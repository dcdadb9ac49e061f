"""The driving world: streets with traffic, seen from a vehicle; as pairs of clips and as whole drives."""

from gcd_train.scenes.driving.classes import ONTOLOGY, OntologyItem, class_ids
from gcd_train.scenes.driving.flow import FPS
from gcd_train.scenes.driving.world import EDITION, HFOV_DEG, driving_drive, driving_scene, looking, vehicle_from_camera

__all__ = [
    "EDITION",
    "FPS",
    "HFOV_DEG",
    "ONTOLOGY",
    "OntologyItem",
    "class_ids",
    "driving_drive",
    "driving_scene",
    "looking",
    "vehicle_from_camera",
]
