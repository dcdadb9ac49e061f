"""Class ids of the tabletop world."""

from enum import IntEnum


class TabletopClass(IntEnum):
    """What a pixel shows. Everything that carries the arm is ROBOT_ARM; palm and fingers are GRIPPER."""

    SKY = 0
    FLOOR = 1
    WALL = 2
    TABLE = 3
    ROBOT_ARM = 4
    GRIPPER = 5
    OBJECT = 6
    CLUTTER = 7


CLASS_NAMES = ("sky", "floor", "wall", "table", "robot arm", "gripper", "object", "clutter")
"""By id, as metadata and ontologies write them."""
