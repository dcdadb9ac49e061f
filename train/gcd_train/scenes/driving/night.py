"""What shines when it is dark: windows, and the light that lamps and headlights throw on the ground.

The renderer has no lamps; lit ground is brighter paint just above the asphalt, below the lane marks.
"""

from collections.abc import Sequence

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern, Point, Sheet
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.ground import PATCH_M
from gcd_train.scenes.driving.ribbon import fan
from gcd_train.scenes.driving.roadside import Place

_WARM: tuple[Colour, ...] = ((0.95, 0.78, 0.45), (0.9, 0.7, 0.36), (0.85, 0.86, 0.8), (0.95, 0.85, 0.6))
_MOST_WINDOWS = 6
_POOL_STEPS, _POOLS_M = 7, 70.0
_BEAM_STEPS = 8


def lit_windows(house: Sequence[Part], random: np.random.Generator) -> list[Part]:
    """Some windows of a house's two long sides, bright; they lie where the shader paints the windows of that wall."""
    wall = house[0]
    if wall.pattern != Pattern.WINDOWS:
        return []
    r, g, b = (round(255 * channel) / 255 for channel in wall.colour)
    wide, high = 2.2 + 2.0 * ((r * 37.0) % 1), 2.9 + 0.6 * ((g * 53.0) % 1)
    size = ((0.35 + 0.45 * ((b * 71.0) % 1)) * wide * 0.96, 0.06, 0.5 * high * 0.96)
    ahead = np.array([np.cos(wall.yaw), np.sin(wall.yaw)])
    parts: list[Part] = []
    for side in (-1.0, 1.0):
        face = np.array(wall.centre[:2]) + side * wall.size[1] / 2 * np.array([-ahead[1], ahead[0]])
        along = -side * ahead  # as the shader counts along a wall
        start = float(face @ along)
        columns = np.arange(np.ceil((start - wall.size[0] / 2) / wide), np.floor((start + wall.size[0] / 2) / wide))
        floors = np.arange(0, np.floor(wall.size[2] / high - 0.4))
        cells = [(float(c), float(f)) for c in columns for f in floors]
        count = min(_MOST_WINDOWS, len(cells) // 3)
        for index in random.choice(len(cells), count, replace=False) if count else []:
            column, floor = cells[int(index)]
            x, y = face + along * ((column + 0.5) * wide - start)
            shade = _dimmer(_WARM[int(random.integers(len(_WARM)))], float(random.uniform(0.35, 0.8)))
            parts.append(_window((float(x), float(y), (floor + 0.55) * high), size, wall.yaw, shade))
    return parts


def _window(centre: Point, size: Point, yaw: float, shade: Colour) -> Part:
    return Part(shape="box", centre=centre, size=size, yaw=yaw, colour=shade, label=Label.BUILDING, pattern=Pattern.LIT)


def _dimmer(colour: Colour, factor: float) -> Colour:
    r, g, b = (channel * factor for channel in colour)
    return r, g, b


def lamp_pools(lamps: Sequence[Place], asphalt: Colour, strength: float) -> list[Sheet]:
    """Light on the road below street lamps: discs one within the other, each a little brighter; strength: 0..1."""
    sheets: list[Sheet] = []
    turn = np.linspace(0, 2 * np.pi, 15)
    for step in range(_POOL_STEPS):
        radius, z = 6.5 * (1 - step / _POOL_STEPS), PATCH_M + 0.0008 * (1 + step)
        pieces = [np.zeros((0, 3, 3), np.float32)]
        for lamp in (lamp for lamp in lamps if abs(lamp.s) < _POOLS_M):
            x, y, heading = lamp.road.at(lamp.s, lamp.side * (lamp.away - 2.0))
            along, aside = radius * 1.25 * np.cos(turn), radius * np.sin(turn)
            rim = np.stack([x + along * np.cos(heading) - aside * np.sin(heading),
                            y + along * np.sin(heading) + aside * np.cos(heading), 0 * turn + z], -1)  # fmt: skip
            pieces.append(fan(np.array([x, y, z]), rim))
        share = (step + 1) / _POOL_STEPS
        colour = _lifted(asphalt, strength * share**2, (0.92, 0.74, 0.5))
        sheets.append(Sheet(corners=np.concatenate(pieces), colour=colour, label=Label.ROAD))
    return sheets


def _lifted(colour: Colour, share: float, towards: Colour) -> Colour:
    r, g, b = (c + (t - c) * share for c, t in zip(colour, towards, strict=True))
    return r, g, b


def beams(asphalt: Colour, body: int) -> list[Part]:
    """The light of headlights on the road ahead of a vehicle, as very flat bodies that ride with it."""
    parts: list[Part] = []
    for step in range(_BEAM_STEPS):
        share = (step + 1) / _BEAM_STEPS
        size = (34.0 - 20.0 * share, 6.5 - 4.0 * share, 0.001)
        colour = _lifted(asphalt, 0.6 * share, (0.72, 0.7, 0.62))
        centre = (1.4 + size[0] / 2, 0.0, PATCH_M + 0.0006 * step)
        parts.append(Part(shape="ball", centre=centre, size=size, colour=colour, label=Label.ROAD, body=body))
    return parts
