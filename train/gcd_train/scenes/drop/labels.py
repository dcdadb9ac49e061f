"""Class ids of the drop world: things are told apart by instance, not by class."""

from enum import IntEnum


class DropLabel(IntEnum):
    """What a pixel shows."""

    BACKGROUND = 0
    OBJECT = 1
