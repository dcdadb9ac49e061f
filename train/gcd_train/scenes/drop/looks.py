"""Where it happens: the floor, what stands around it, and the light. All by chance, all finite.

Around the stage is a dome with a real distance, so that every pixel of a view is a point of the world and a point
cloud has no holes at the top; what is painted on it is seen alike from everywhere.
"""

import math

import numpy as np

from gcd_train.scenes.description import Colour, Light, Part, Pattern, Sheet
from gcd_train.scenes.drop.labels import DropLabel
from gcd_train.scenes.drop.materials import shaded

DOME_M = 40.0
"""Radius of the dome. The farthest that a camera at 18 m sees is 58 m, below the 64 m at which splats are weighted
differently."""
_BACKDROPS = {"hills": Pattern.HILLS, "houses": Pattern.HOUSES, "hall": Pattern.HALL, "studio": Pattern.STUDIO}

_FLOORS: tuple[tuple[str, Pattern, Colour, Colour, float, float], ...] = (
    ("planks", Pattern.PLANKS, (0.66, 0.47, 0.3), (0.42, 0.28, 0.17), 0.55, 0.12),
    ("pale planks", Pattern.PLANKS, (0.8, 0.7, 0.56), (0.62, 0.5, 0.37), 0.7, 0.1),
    ("terrazzo", Pattern.TERRAZZO, (0.72, 0.7, 0.66), (0.5, 0.3, 0.22), 0.5, 0.15),
    ("checker", Pattern.CHECKER, (0.82, 0.8, 0.76), (0.3, 0.33, 0.36), 1.6, 0.12),
    ("marble", Pattern.MARBLE, (0.83, 0.81, 0.78), (0.62, 0.6, 0.58), 2.4, 0.15),
    ("grass", Pattern.CLOUDY, (0.4, 0.5, 0.2), (0.2, 0.3, 0.1), 0.25, 0.0),
    ("sand", Pattern.CLOUDY, (0.8, 0.68, 0.5), (0.66, 0.53, 0.36), 0.5, 0.0),
    ("concrete", Pattern.CLOUDY, (0.58, 0.57, 0.55), (0.46, 0.45, 0.44), 1.2, 0.0),
    ("asphalt", Pattern.CLOUDY, (0.3, 0.3, 0.32), (0.22, 0.22, 0.23), 0.25, 0.0),
    ("carpet", Pattern.STRIPES, (0.52, 0.2, 0.2), (0.62, 0.48, 0.34), 2.4, 0.0),
    ("dotted rug", Pattern.DOTS, (0.28, 0.36, 0.5), (0.7, 0.68, 0.6), 1.4, 0.0),
)
_FITTING = {
    "hills": ("grass", "sand", "concrete", "asphalt", "pale planks"),
    "houses": ("concrete", "asphalt", "checker", "grass", "terrazzo"),
    "hall": ("planks", "pale planks", "checker", "terrazzo", "marble", "carpet", "dotted rug"),
    "studio": ("planks", "marble", "carpet", "dotted rug", "concrete", "checker", "sand"),
}
_WALLS: tuple[tuple[Colour, Colour], ...] = (
    ((0.82, 0.78, 0.7), (0.5, 0.36, 0.24)),
    ((0.62, 0.7, 0.74), (0.36, 0.42, 0.47)),
    ((0.78, 0.62, 0.5), (0.44, 0.24, 0.18)),
    ((0.6, 0.68, 0.56), (0.3, 0.36, 0.26)),
    ((0.8, 0.8, 0.82), (0.42, 0.42, 0.48)),
)
_HILLS: tuple[Colour, Colour] = ((0.42, 0.5, 0.5), (0.2, 0.3, 0.14))


def random_surroundings(random: np.random.Generator) -> tuple[str, Part, Sheet]:
    """What they are called, the dome and the floor."""
    backdrop = str(random.choice(list(_BACKDROPS), p=[0.3, 0.25, 0.25, 0.2]))
    name = _FITTING[backdrop][int(random.integers(len(_FITTING[backdrop])))]
    floor = next(row for row in _FLOORS if row[0] == name)
    return f"{floor[0]}, {backdrop}", _dome(backdrop, random), _floor(floor, float(random.uniform(0.85, 1.12)))


def _dome(backdrop: str, random: np.random.Generator) -> Part:
    """Its inside must face the cameras, hence the negative side."""
    colour, accent = _HILLS if backdrop == "hills" else _WALLS[int(random.integers(len(_WALLS)))]
    side = 2 * DOME_M
    return Part(
        shape="sphere",
        centre=(0.0, 0.0, 0.0),
        size=(-side, side, side),
        colour=colour,
        accent=accent,
        pattern=_BACKDROPS[backdrop],
        label=DropLabel.BACKGROUND,
    )


def _floor(row: tuple[str, Pattern, Colour, Colour, float, float], bright: float) -> Sheet:
    _, pattern, colour, accent, grain_m, gloss = row
    edge = DOME_M + 1.0
    square = [(-edge, -edge, 0.0), (edge, -edge, 0.0), (edge, edge, 0.0), (-edge, edge, 0.0)]
    return Sheet(
        corners=np.array([[square[i] for i in half] for half in ((0, 1, 2), (0, 2, 3))], np.float32),
        colour=shaded(colour, bright),
        accent=shaded(accent, bright),
        pattern=pattern,
        grain_m=grain_m,
        gloss=gloss,
        label=DropLabel.BACKGROUND,
    )


def random_light(random: np.random.Generator) -> Light:
    """A sun at some height, warmer when low, or a bright overcast sky."""
    overcast = random.random() < 0.2
    height, round_ = float(random.uniform(math.radians(28), math.radians(72))), float(random.uniform(0, 2 * math.pi))
    warm = float(random.uniform(0, 1)) * (1.1 - math.sin(height))
    strength = 0.55 if overcast else float(random.uniform(1.3, 1.9))
    fill = 0.85 if overcast else float(random.uniform(0.45, 0.62))
    blue = 0.15 if overcast else float(random.uniform(0.4, 1.0))
    return Light(
        sun_to=(math.cos(height) * math.cos(round_), math.cos(height) * math.sin(round_), math.sin(height)),
        sun=(strength, strength * (1 - 0.3 * warm), strength * (0.95 - 0.6 * warm)),
        sky=(fill * (1 - 0.12 * blue), fill, fill * (1 + 0.12 * blue)),
        ground=(0.5 * fill, 0.46 * fill, 0.42 * fill),
        horizon=(0.74 + 0.12 * warm, 0.77, 0.8 - 0.1 * warm),
        zenith=(0.62 - 0.42 * blue, 0.68 - 0.32 * blue, 0.8 - 0.02 * blue),
        fog_m=float(random.uniform(70, 160)),
        cloud=float(random.uniform(0.2, 0.9)),
        exposure=float(random.uniform(1.35, 1.75)),
    )
