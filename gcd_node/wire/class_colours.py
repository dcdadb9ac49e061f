"""Class maps in colour. Standard library and numpy only, Python 3.10 syntax: planners import this."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import MessageError
from gcd_node.wire.header import ClassRecord


def paint(numbers: NDArray[np.uint8], classes: Sequence[ClassRecord]) -> NDArray[np.uint8]:
    """A class map as a picture: class numbers u8 [...] to u8 RGB [..., 3], read-only.

    Raises:
        MessageError: a number that `classes` do not name.
    """
    known = np.zeros(256, np.bool_)
    palette = np.zeros((256, 3), np.uint8)
    for each in classes:
        known[each.id], palette[each.id] = True, each.colour
    if not known[numbers].all():
        foreign = int(numbers[~known[numbers]][0])
        raise MessageError(f"a class map must hold the {len(classes)} class numbers of its ontology, got {foreign}")
    painted = palette[numbers]
    painted.flags.writeable = False
    return painted
