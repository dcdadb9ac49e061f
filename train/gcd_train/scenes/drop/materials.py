"""What things are painted with."""

import colorsys
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.scenes.description import Colour, Part, Pattern

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
