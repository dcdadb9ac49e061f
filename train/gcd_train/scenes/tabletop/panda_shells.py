"""Capsules in the shape of the Franka Panda: what is drawn of its links, whose meshes stay in their package.

Fitted once to points on the collision meshes of gymnasium-robotics 1.4.2 (Franka model by V. Kumar, Apache-2.0) by
gradient descent on the distance between the two surfaces, which is 2 to 6 mm on average.
"""

import math

from gcd_train.scenes.description import Colour, Quaternion
from gcd_train.scenes.tabletop.things import Solid

_LIGHT: Colour = (0.93, 0.93, 0.92)
_DARK: Colour = (0.24, 0.25, 0.27)
_CAPSULES: dict[str, tuple[tuple[float, ...], ...]] = {
    "panda0_link0": (
        (-0.105, 0.045, 0.026, -0.105, -0.043, 0.023, 0.035),
        (-0.005, 0.01, 0.045, -0.011, -0.001, 0.08, 0.073),
        (-0.073, -0.015, 0.053, -0.012, -0.046, 0.031, 0.049),
    ),
    "panda0_link1": (
        (0.001, 0.001, -0.146, -0.001, -0.015, -0.139, 0.059),
        (0.0, -0.029, 0.0, 0.0, -0.075, -0.003, 0.056),
        (-0.001, -0.045, -0.064, 0.001, -0.015, -0.081, 0.061),
    ),
    "panda0_link2": (
        (-0.001, -0.141, 0.017, 0.0, -0.147, 0.0, 0.059),
        (0.0, -0.001, 0.028, 0.0, -0.003, 0.074, 0.056),
        (-0.001, -0.081, 0.014, -0.001, -0.07, 0.044, 0.059),
    ),
    "panda0_link3": (
        (0.005, 0.001, -0.088, 0.067, 0.044, -0.018, 0.058),
        (0.082, 0.061, 0.001, 0.086, 0.031, -0.002, 0.053),
        (-0.001, 0.0, -0.056, 0.079, 0.027, 0.009, 0.047),
    ),
    "panda0_link4": (
        (-0.071, 0.047, 0.005, -0.088, 0.09, -0.002, 0.052),
        (-0.001, 0.001, 0.062, 0.0, -0.001, 0.029, 0.054),
        (-0.023, 0.025, 0.036, -0.062, 0.072, 0.01, 0.061),
    ),
    "panda0_link5": (
        (0.0, 0.043, 0.0, 0.0, 0.083, 0.003, 0.049),
        (0.0, 0.019, -0.215, 0.003, 0.0, -0.221, 0.054),
        (0.0, 0.08, -0.004, -0.001, 0.038, -0.18, 0.052),
        (-0.001, 0.0, -0.223, 0.002, 0.045, -0.034, 0.053),
    ),
    "panda0_link6": (
        (-0.003, -0.002, 0.013, 0.049, -0.014, 0.009, 0.045),
        (0.09, -0.017, 0.007, 0.09, -0.014, -0.007, 0.043),
        (0.005, 0.008, 0.013, 0.084, 0.041, 0.001, 0.045),
    ),
    "panda0_link7": (
        (0.047, 0.04, 0.08, 0.007, -0.021, 0.079, 0.029),
        (0.005, 0.034, 0.079, -0.021, -0.014, 0.078, 0.029),
        (-0.053, -0.057, 0.106, -0.055, -0.054, 0.155, 0.024),
        (-0.021, -0.023, 0.124, 0.048, 0.049, 0.134, 0.037),
    ),
}
"""Of each body: both ends of the axis in its frame, and the radius, metres."""


def panda_shells() -> dict[str, tuple[Solid, ...]]:
    """What is drawn of each body whose shape is a mesh; the hand is darker."""
    shells: dict[str, tuple[Solid, ...]] = {}
    for body, rows in _CAPSULES.items():
        hand = 2 if body == "panda0_link7" else len(rows)
        shells[body] = tuple(_capsule(row, _LIGHT if index < hand else _DARK) for index, row in enumerate(rows))
    return shells


def _capsule(row: tuple[float, ...], colour: Colour) -> Solid:
    ax, ay, az, bx, by, bz, radius = row
    half = math.dist((ax, ay, az), (bx, by, bz)) / 2
    return Solid(
        kind="capsule",
        size=(radius, half),
        centre=((ax + bx) / 2, (ay + by) / 2, (az + bz) / 2),
        turn=_turn_to((bx - ax) / (2 * half), (by - ay) / (2 * half), (bz - az) / (2 * half)),
        colour=colour,
        gloss=0.3,
    )


def _turn_to(x: float, y: float, z: float) -> Quaternion:
    """The turn that takes the z axis to this unit vector, or to its opposite."""
    if z < 0:
        x, y, z = -x, -y, -z
    half = math.sqrt(2 * (1 + z))
    return half / 2, -y / half, x / half, 0.0
