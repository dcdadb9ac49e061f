"""How sure a figure is: 95 % intervals from scenes drawn again and again, in pairs where two methods are compared."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.class_counts import ClassCounts
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.tallies import FigureName, Selection, Tallies, tallies

DRAWS, COVERAGE = 10_000, 0.95


@dataclass(frozen=True, kw_only=True, slots=True)
class Interval:
    """A figure and where it lies in 95 of 100 draws of scenes. NaN bounds for a single scene."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether there was anything to measure."""
        return not np.isnan(self.value)

    @property
    def off_zero(self) -> bool:
        """Whether zero lies outside; never for bounds that nobody knows."""
        return self.low > 0.0 or self.high < 0.0


_NOTHING = Interval(value=float("nan"), low=float("nan"), high=float("nan"))


@dataclass(frozen=True, kw_only=True, slots=True)
class Drawn:
    """A method's sums by scene, and the seed that scenes are drawn by: the same seed draws the same of as many."""

    scenes: Tallies
    seed: int = 0

    def value(self, name: FigureName) -> float:
        """One figure of all scenes."""
        part = self.scenes.part(name)
        return float(part.weighted(np.ones(len(part.means))).figure(name))

    def again(self, name: FigureName) -> NDArray[np.float64]:
        """The figure of scenes drawn with repetition, [DRAWS]; NaN for a single scene."""
        part, count = self.scenes.part(name), len(self.scenes.means)
        if count < 2:
            return np.full(DRAWS, np.nan)
        return part.weighted(scene_weights(count, seed=self.seed)).figure(name)

    def interval(self, name: FigureName) -> Interval:
        """One figure with its bounds."""
        value = self.value(name)
        return _NOTHING if np.isnan(value) else _interval(value, self.again(name))


def drawn(
    records: Sequence[ClipRecord],
    selection: Selection,
    *,
    classes: int = 0,
    seed: int = 0,
    counts: ClassCounts | None = None,
) -> Drawn:
    """Sums of one method, ready to be drawn from. counts: of these records, where they are known.

    Source: the percentile bootstrap, Efron 1979; scenes are drawn, not clips, as clips of one scene are alike.
    """
    clips = tallies(records, selection, classes=classes, counts=counts)
    return Drawn(scenes=clips.grouped([record.scene for record in records]), seed=seed)


@lru_cache(maxsize=4)
def scene_weights(count: int, *, draws: int = DRAWS, seed: int = 0) -> NDArray[np.float64]:
    """How often each of so many scenes is drawn: [draws, count], each row's sum is `count`."""
    random = np.random.default_rng(seed)
    return random.multinomial(count, np.full(count, 1.0 / count), size=draws).astype(np.float64)


def difference(first: Drawn, other: Drawn, name: FigureName) -> Interval:
    """How far `first` lies above `other`, both on the same clips: in each draw the same scenes of both."""
    value = first.value(name) - other.value(name)
    return _NOTHING if np.isnan(value) else _interval(value, first.again(name) - other.again(name))


def common_clips(
    first: Sequence[ClipRecord], other: Sequence[ClipRecord]
) -> tuple[tuple[ClipRecord, ...], tuple[ClipRecord, ...]]:
    """The records of the clips that both have, in one order."""
    of_first, of_other = ({record.key: record for record in records} for records in (first, other))
    both = [key for key in of_first if key in of_other]
    return tuple(of_first[key] for key in both), tuple(of_other[key] for key in both)


def _interval(value: float, again: NDArray[np.float64]) -> Interval:
    """The middle 95 % of what is not NaN."""
    known = again[~np.isnan(again)]
    if not known.size:
        return Interval(value=value, low=float("nan"), high=float("nan"))
    low, high = np.quantile(known, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return Interval(value=value, low=float(low), high=float(high))
