"""Light and weather of the driving world: sun, sky, clouds and fog, how wet it is, and what shines when it is dark.

The renderer has no lamps; lit ground is brighter paint just above the asphalt, below the lane marks.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Colour, Floats, Light, Paint, Part, Pattern, Sheet, pick, towards
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.ground import PATCH_M
from gcd_train.scenes.driving.roads import fan
from gcd_train.scenes.driving.roadside import Place
from gcd_train.scenes.driving.things import block

_SHARES = {
    "clear": 0.3, "cloudy": 0.18, "low sun": 0.12, "overcast": 0.12, "rain": 0.12, "fog": 0.06, "dusk": 0.06,
    "night": 0.04,
}  # fmt: skip
WEATHERS = tuple(_SHARES)
_WARM: tuple[Colour, ...] = ((0.95, 0.78, 0.45), (0.9, 0.7, 0.36), (0.85, 0.86, 0.8), (0.95, 0.85, 0.6))
_MOST_WINDOWS = 6
_POOL_STEPS, _POOLS_M = 7, 70.0
_BEAM_STEPS = 8
_FOCUS_AHEAD_M = 28.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Weather:
    """kind: one of WEATHERS. wetness: of the ground, 0..1. lamps: whether vehicles have theirs lit. dark: whether
    street lamps and windows are lit too.
    """

    kind: str
    light: Light
    wetness: float
    lamps: bool
    dark: bool


def random_weather(random: np.random.Generator) -> Weather:
    """Drawn at random; one in six is wet, one in ten dark."""
    shares = np.array(list(_SHARES.values()))
    kind = str(random.choice(WEATHERS, p=shares / shares.sum()))
    light = _light(kind, random)
    wet = {"rain": float(random.uniform(0.7, 1.0)), "dusk": 0.3, "night": float(random.choice([0.0, 0.7]))}
    return Weather(
        kind=kind,
        light=light,
        wetness=wet.get(kind, 0.0),
        lamps=kind in ("rain", "fog", "dusk", "night") or (kind == "overcast" and random.random() < 0.4),
        dark=kind in ("dusk", "night"),
    )


def shadow_focus(ego: Floats) -> Floats:
    """The point around which shadows fall, [T, 3], for a vehicle at x, y, z, yaw [T, 4]."""
    forward = np.stack([np.cos(ego[:, 3]), np.sin(ego[:, 3]), np.zeros(len(ego))], -1)
    return (ego[:, :3] + _FOCUS_AHEAD_M * forward).astype(np.float32)


def _light(kind: str, random: np.random.Generator) -> Light:
    azimuth = float(random.uniform(0, 2 * math.pi))
    exposure = float(random.uniform(0.9, 1.12))
    if kind in ("clear", "cloudy", "low sun"):
        return _sunny(kind, azimuth, exposure, random)
    if kind in ("dusk", "night"):
        return _dim(kind, azimuth, exposure)
    return _grey(kind, azimuth, exposure, random)


def _sunny(kind: str, azimuth: float, exposure: float, random: np.random.Generator) -> Light:
    height = float(random.uniform(9, 17) if kind == "low sun" else random.uniform(24, 66))
    low = math.exp(-height / 18.0)  # how golden the light is
    strength = 2.5 if kind != "cloudy" else 1.9
    sun: Colour = (strength, strength * (1 - 0.3 * low), strength * (0.94 - 0.55 * low))
    blue = float(random.uniform(0.6, 1.0)) * (1.0 if kind != "cloudy" else 0.6)
    zenith: Colour = (0.5 - 0.42 * blue, 0.56 - 0.33 * blue, 0.68 + 0.02 * blue)
    return Light(
        sun_to=towards(math.radians(height), azimuth),
        sun=sun,
        sky=(0.38 - 0.06 * blue, 0.42, 0.48 + 0.06 * blue),
        ground=(0.17, 0.16, 0.14),
        horizon=(0.64 - 0.12 * blue + 0.34 * low, 0.68 - 0.04 * blue + 0.02 * low, 0.8 - 0.3 * low),
        zenith=zenith,
        fog_m=float(random.uniform(320, 800)),
        cloud=float(random.uniform(0.7, 1.0)) if kind == "cloudy" else float(random.uniform(0, 0.45)),
        exposure=1.45 * exposure,
    )


def _grey(kind: str, azimuth: float, exposure: float, random: np.random.Generator) -> Light:
    far = {"overcast": random.uniform(220, 600), "rain": random.uniform(110, 220), "fog": random.uniform(38, 75)}
    grey = {"overcast": 0.72, "rain": 0.5, "fog": 0.66}[kind]
    sky: Colour = (grey * 0.96, grey * 0.99, grey * 1.03)
    return Light(
        sun_to=towards(math.radians(float(random.uniform(45, 75))), azimuth),
        sun=(0.12, 0.12, 0.11),
        sky=(0.86 * grey + 0.16, 0.88 * grey + 0.16, 0.92 * grey + 0.16),
        ground=(0.3 * grey, 0.29 * grey, 0.28 * grey),
        horizon=sky,
        zenith=(0.82 * sky[0], 0.85 * sky[1], 0.9 * sky[2]),
        fog_m=float(far[kind]),
        cloud=0.25 if kind == "rain" else 0.1,
        exposure=1.5 * exposure,
    )


def _dim(kind: str, azimuth: float, exposure: float) -> Light:
    dusk = Light(
        sun_to=towards(math.radians(8.0), azimuth),
        sun=(0.16, 0.08, 0.05),
        sky=(0.2, 0.2, 0.3),
        ground=(0.08, 0.07, 0.07),
        horizon=(0.62, 0.34, 0.26),
        zenith=(0.1, 0.13, 0.27),
        fog_m=420.0,
        cloud=0.0,
        exposure=1.5 * exposure,
    )
    if kind == "dusk":
        return dusk
    return replace(
        dusk,
        sun_to=towards(math.radians(40.0), azimuth),
        sun=(0.035, 0.045, 0.07),
        sky=(0.06, 0.065, 0.095),
        ground=(0.03, 0.026, 0.022),
        horizon=(0.055, 0.05, 0.06),
        zenith=(0.008, 0.011, 0.026),
        fog_m=240.0,
        exposure=1.9 * exposure,
    )


def lit_windows(house: Sequence[Part], random: np.random.Generator) -> list[Part]:
    """Some windows of a house's two long sides, bright; they lie where the shader paints the windows of that wall."""
    wall = house[0]
    if wall.paint.pattern != Pattern.WINDOWS:
        return []
    r, g, b = (round(255 * channel) / 255 for channel in wall.paint.colour)
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
            warm, share = pick(random, _WARM), float(random.uniform(0.35, 0.8))
            at = (float(x), float(y), (floor + 0.55) * high)
            parts.append(block(at, size, _mixed((0.0, 0.0, 0.0), share, warm), Label.BUILDING, lit=True, yaw=wall.yaw))
    return parts


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
        colour = _mixed(asphalt, strength * share**2, (0.92, 0.74, 0.5))
        sheets.append(Sheet(np.concatenate(pieces), Paint(colour), Label.ROAD))
    return sheets


def _mixed(colour: Colour, share: float, towards: Colour) -> Colour:
    r, g, b = (c + (t - c) * share for c, t in zip(colour, towards, strict=True))
    return r, g, b


def beams(asphalt: Colour, body: int) -> list[Part]:
    """The light of headlights on the road ahead of a vehicle, as very flat bodies that ride with it."""
    parts: list[Part] = []
    for step in range(_BEAM_STEPS):
        share = (step + 1) / _BEAM_STEPS
        size = (34.0 - 20.0 * share, 6.5 - 4.0 * share, 0.001)
        colour = _mixed(asphalt, 0.6 * share, (0.72, 0.7, 0.62))
        centre = (1.4 + size[0] / 2, 0.0, PATCH_M + 0.0006 * step)
        parts.append(block(centre, size, colour, Label.ROAD, shape="ball").of(instance=0, body=body))
    return parts
