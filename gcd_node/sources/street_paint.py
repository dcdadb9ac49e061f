"""Colours of the drawn street: the ground with its lanes, and what is painted on boxes."""

import numpy as np
from numpy.typing import NDArray

from gcd_node.sources.street import KERB_M, LANE_M, PARKING_M, PAVEMENT_M, Box, Floats, Look

_ASPHALT = np.array([92, 93, 97], np.float32)
_PARKING = np.array([108, 107, 107], np.float32)
_KERB = np.array([168, 166, 160], np.float32)
_PAVEMENT = np.array([150, 146, 140], np.float32)
_JOINT = np.array([124, 120, 115], np.float32)
_GRASS = np.array([104, 124, 76], np.float32)
_PAINT = np.array([232, 232, 226], np.float32)
_GLASS = np.array([50, 60, 74], np.float32)


def ground_colour(x: Floats, left: Floats, pixel: Floats, pixel_along: Floats) -> Floats:
    """Colours [H, W, 3] of points on the ground.

    x, left: along the street and to the left of its middle, metres. pixel, pixel_along: what one pixel covers there
    across and along the view, metres; edges are softened by it.
    """
    across = np.abs(left)
    planes = np.broadcast_to(_GRASS[:, None, None], (3, *x.shape)).copy()
    for edge_m, paint in ((PAVEMENT_M, _PAVEMENT), (KERB_M, _KERB), (PARKING_M, _PARKING), (LANE_M, _ASPHALT)):
        _blend(planes, paint, _soft(edge_m - across, pixel))
    joint = _soft(np.abs((x % 1.5) - 0.75) - 0.72, pixel_along) * np.clip(1.0 - pixel_along * 6, 0.0, 1.0)
    _blend(planes, _JOINT, joint * ((across > KERB_M) & (across < PAVEMENT_M)))
    dash = _soft(1.5 - np.abs(x % 6.0 - 3.0), pixel_along)
    middle, edge = _soft(0.09 - across, pixel) * dash, _soft(0.07 - np.abs(across - (LANE_M - 0.12)), pixel)
    _blend(planes, _PAINT, np.maximum(middle, edge))
    return planes.transpose(1, 2, 0)


def _soft(inside_m: Floats, pixel_m: Floats) -> Floats:
    """How much of a pixel lies inside an edge, 0..1, for a signed distance to it."""
    return np.clip(inside_m / pixel_m + np.float32(0.5), 0.0, 1.0)


def _blend(planes: Floats, paint: Floats, amount: Floats) -> None:
    """Mixes a paint into [3, H, W] colour planes; amount is [H, W], 0..1."""
    for plane, level in zip(planes, paint, strict=True):
        plane += (level - plane) * amount


def box_colour(box: Box, face: NDArray[np.intp], outward: Floats, place: Floats) -> Floats:
    """[N, 3] colours at points of a box's surface; face 0, 1, 2 looks along x, y, z."""
    colour = np.broadcast_to(np.array(box.colour, np.float32), (len(face), 3)).copy()
    for paint, where in _details(box.look, box.size, face, outward, place):
        colour[where] = paint
    return colour


def _details(
    look: Look, size: tuple[float, float, float], face: NDArray[np.intp], outward: Floats, place: Floats
) -> list[tuple[Floats, NDArray[np.bool_]]]:
    """What is painted on a box: pairs of a colour and where."""
    along = np.where(face == 0, place[:, 1], place[:, 0])
    up = place[:, 2] + size[2] / 2
    side = face != 2
    if look == "house":
        frame = np.abs(along % 2.4 - 1.2) < 0.62
        rows = np.abs(up % 3.0 - 1.75) < 0.75
        return [
            (_GLASS * np.float32(1.5), side & frame & rows & (up < size[2] - 0.5)),
            (_KERB, side & (up > size[2] - 0.35)),
            (_GLASS, side & (up < 2.5) & (np.abs(along % 4.8 - 2.4) < 0.7)),
        ]
    if look == "body":
        lamp = (face == 0) & (np.abs(along) > 0.5) & (np.abs(up - 0.42) < 0.1)
        plate = (face == 0) & (np.abs(along) < 0.28) & (np.abs(up - 0.22) < 0.07)
        return [
            (np.array([150, 16, 16], np.float32), lamp & (outward < 0)),
            (np.array([250, 246, 224], np.float32), lamp & (outward > 0)),
            (_PAINT, plate),
            (_ASPHALT * np.float32(0.6), side & (up < 0.1)),
        ]
    if look == "cabin":
        pillar = np.abs(along) > np.where(face == 0, size[1], size[0]) / 2 - 0.1
        return [(_GLASS, side & ~pillar & (up < size[2] - 0.08))]
    return []
