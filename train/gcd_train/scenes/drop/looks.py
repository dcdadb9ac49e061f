"""How it looks: paints of things, the floor, what stands around it, and the light. All by chance, all finite.

Around the stage is a dome with a real distance, so that every pixel of a view is a point of the world and a point
cloud has no holes at the top; what is painted on it is seen alike from everywhere.
"""

import colorsys
import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from gcd_train.scenes.description import Colour, Light, Part, Pattern, Sheet


class DropLabel(IntEnum):
    """What a pixel shows."""

    BACKGROUND = 0
    OBJECT = 1


_WOODS: tuple[tuple[Colour, Colour], ...] = (
    ((0.78, 0.58, 0.36), (0.5, 0.31, 0.16)),
    ((0.62, 0.41, 0.24), (0.36, 0.2, 0.1)),
    ((0.86, 0.72, 0.52), (0.68, 0.5, 0.3)),
    ((0.45, 0.27, 0.18), (0.22, 0.12, 0.08)),
)
_STONES: tuple[tuple[Colour, Colour], ...] = (
    ((0.9, 0.89, 0.87), (0.45, 0.46, 0.5)),
    ((0.24, 0.27, 0.28), (0.7, 0.7, 0.66)),
    ((0.55, 0.66, 0.58), (0.2, 0.32, 0.27)),
    ((0.8, 0.66, 0.58), (0.5, 0.28, 0.22)),
)
_FAMILIES = (
    (Pattern.PLAIN, 0.26),
    (Pattern.CLOUDY, 0.1),
    (Pattern.WOOD, 0.17),
    (Pattern.MARBLE, 0.12),
    (Pattern.CHECKER, 0.1),
    (Pattern.STRIPES, 0.13),
    (Pattern.DOTS, 0.12),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Material:
    """A paint: see `Part`."""

    colour: Colour
    accent: Colour = (0.5, 0.5, 0.5)
    pattern: Pattern = Pattern.PLAIN
    grain_m: float = 0.5
    gloss: float = 0.2

    def on(self, part: Part) -> Part:
        """The part, painted."""
        return replace(
            part,
            colour=self.colour,
            accent=self.accent,
            pattern=self.pattern,
            grain_m=self.grain_m,
            gloss=self.gloss,
        )


def random_material(random: np.random.Generator, size_m: float) -> Material:
    """Any family; the pattern's spacing suits a thing of that size."""
    patterns, shares = zip(*_FAMILIES, strict=True)
    pattern = patterns[int(random.choice(len(patterns), p=shares))]
    gloss = 0.0 if random.random() < 0.35 else float(random.uniform(0.15, 0.8))
    if pattern in (Pattern.WOOD, Pattern.MARBLE):
        pairs = _WOODS if pattern is Pattern.WOOD else _STONES
        colour, accent = pairs[int(random.integers(len(pairs)))]
        grain = size_m * float(random.uniform(0.12, 0.3) if pattern is Pattern.WOOD else random.uniform(0.3, 0.7))
        return Material(colour=colour, accent=accent, pattern=pattern, grain_m=grain, gloss=0.5 * gloss)
    colour = random_colour(random)
    accent = (0.92, 0.9, 0.86) if random.random() < 0.4 else random_colour(random)
    grain = size_m * float(random.uniform(0.13, 0.32))
    return Material(colour=colour, accent=accent, pattern=pattern, grain_m=grain, gloss=gloss)


def random_colour(random: np.random.Generator) -> Colour:
    """A colour that a made thing may have: mostly clear, sometimes white, grey or black."""
    if random.random() < 0.18:
        grey = float(random.choice([0.08, 0.35, 0.62, 0.93]))
        return grey, grey, min(grey * 1.03, 1.0)
    hue, strength, bright = float(random.random()), float(random.uniform(0.45, 0.92)), float(random.uniform(0.4, 0.95))
    return colorsys.hsv_to_rgb(hue, strength, bright)


def shaded(colour: Colour, factor: float) -> Colour:
    """The colour, darker or brighter."""
    r, g, b = (min(max(channel * factor, 0.0), 1.0) for channel in colour)
    return r, g, b


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
