"""Light and weather of a grown driving world: what the sun, the sky, the clouds and the fog do, and how wet it is."""

import math
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Colour, Light

_KINDS: tuple[tuple[str, float], ...] = (
    ("clear", 0.3), ("cloudy", 0.18), ("low sun", 0.12), ("overcast", 0.12), ("rain", 0.12), ("fog", 0.06),
    ("dusk", 0.06), ("night", 0.04),
)  # fmt: skip
WEATHERS = tuple(kind for kind, _ in _KINDS)


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
    shares = np.array([share for _, share in _KINDS])
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


def _light(kind: str, random: np.random.Generator) -> Light:
    azimuth = float(random.uniform(0, 2 * math.pi))
    exposure = float(random.uniform(0.9, 1.12))
    if kind in ("clear", "cloudy", "low sun"):
        return _sunny(kind, azimuth, exposure, random)
    if kind in ("dusk", "night"):
        return _dim(kind, azimuth, exposure)
    return _grey(kind, azimuth, exposure, random)


def _sun_to(height_deg: float, azimuth: float) -> tuple[float, float, float]:
    height = math.radians(height_deg)
    return math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)


def _sunny(kind: str, azimuth: float, exposure: float, random: np.random.Generator) -> Light:
    height = float(random.uniform(9, 17) if kind == "low sun" else random.uniform(24, 66))
    low = math.exp(-height / 18.0)  # how golden the light is
    strength = 2.5 if kind != "cloudy" else 1.9
    sun: Colour = (strength, strength * (1 - 0.3 * low), strength * (0.94 - 0.55 * low))
    blue = float(random.uniform(0.6, 1.0)) * (1.0 if kind != "cloudy" else 0.6)
    zenith: Colour = (0.5 - 0.42 * blue, 0.56 - 0.33 * blue, 0.68 + 0.02 * blue)
    return Light(
        sun_to=_sun_to(height, azimuth),
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
        sun_to=_sun_to(float(random.uniform(45, 75)), azimuth),
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
        sun_to=_sun_to(8.0, azimuth),
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
        sun_to=_sun_to(40.0, azimuth),
        sun=(0.035, 0.045, 0.07),
        sky=(0.06, 0.065, 0.095),
        ground=(0.03, 0.026, 0.022),
        horizon=(0.055, 0.05, 0.06),
        zenith=(0.008, 0.011, 0.026),
        fog_m=240.0,
        exposure=1.9 * exposure,
    )
