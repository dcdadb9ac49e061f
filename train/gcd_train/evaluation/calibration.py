"""How much the deviation over samples can be trusted: how often the truth lies within the intervals that it gives.

A pixel's interval at a level such as 90 % is, for each of its colours,

    mean over samples ± z * scale * deviation,   z = 1.645 at 90 %: the normal quantile of (1 + level) / 2

with the one deviation that a view has for each pixel (`View.std`, the mean over the colours). About the mean, because
that is the best guess samples give, and the deviation is taken about it; a single sample lies farther from the truth.
The first frame is left out: there the target camera of a gradual path stands where the source camera does.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_train.baselines import Prediction, to_pictures
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.record import Region

LEVELS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Shares of pixels that intervals are meant to hold, 5 % to 95 %."""

FIRST_MEASURED = 1
"""Frames before this one, counted from 0, are not measured."""

Counts = NDArray[np.int64]
"""How many colours of pixels lie how many deviations from the truth: [_BINS], in equal steps of the logarithm."""

_LOWEST, _HIGHEST, _PER_OCTAVE = -20, 40, 48  # powers of two; what lies beyond stands in the first and the last bin
_BINS = (_HIGHEST - _LOWEST) * _PER_OCTAVE + 2
_HALVINGS = 60


class Reliability(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Intervals on some pixels.

    colours: how many values were compared, three a pixel. held: share of them within the interval of each of LEVELS,
    by the deviation as it is. held_scaled: the same with the scale. miscoverage, miscoverage_scaled: mean over LEVELS
    of how far the share is from the level.
    """

    colours: int
    held: tuple[float, ...]
    held_scaled: tuple[float, ...]
    miscoverage: float
    miscoverage_scaled: float


class Calibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What was found on held-out scenes.

    scale: what the deviation has to be multiplied with. fitted: scenes it was chosen on. reported: the other half, on
    which `regions` were measured; "visible" and "occluded" are missing where nobody knows what the source camera saw.
    """

    scale: float
    fitted: tuple[str, ...]
    reported: tuple[str, ...]
    levels: tuple[float, ...]
    regions: dict[Region, Reliability]


@dataclass(frozen=True, kw_only=True, slots=True)
class Distances:
    """One clip's counts, by region. scene: the clip's."""

    scene: str
    counts: Mapping[Region, Counts]


def distances(clip: HeldOutClip, prediction: Prediction) -> Distances:
    """How far a clip's truth lies from what was drawn of it.

    A target level stands for all colours that are rounded to it, so it is spread over them, always in the same way;
    else flat pixels would be hit exactly, or not at all.

    Raises: DataError for fewer than two draws, or draws without pictures.
    """
    drawn = _draws(prediction)[:, FIRST_MEASURED:]
    truth = to_pictures(clip.target)[FIRST_MEASURED:]
    spread = np.random.default_rng(zlib.crc32(clip.key.encode())).random(truth.shape, np.float32)
    truth = truth + (torch.from_numpy(spread) - 0.5) / 255.0
    far = (truth - drawn.mean(dim=0)).abs() / deviation(drawn)[:, None]  # [T-1, 3, H, W]; no deviation: infinitely far
    places = _places(far)
    counts: dict[Region, Counts] = {"all": _counted(places)}
    if clip.visible is not None:
        seen = torch.from_numpy(clip.visible[FIRST_MEASURED:])[:, None].expand_as(places)
        counts |= {"visible": _counted(places[seen]), "occluded": _counted(places[~seen])}
    return Distances(scene=clip.scene, counts=counts)


def deviation(draws: Tensor) -> Tensor:
    """As `View.std`: population standard deviation over draws [S, T, 3, H, W], channel mean: [T, H, W]."""
    return draws.std(dim=0, correction=0).mean(dim=1)


def coverage(counts: Counts, level: float, scale: float = 1.0) -> float:
    """Share of colours that lie within their interval. level: between 0 and 1. NaN where there is no pixel."""
    total = int(counts.sum())
    if not total:
        return float("nan")
    reach = NormalDist().inv_cdf((1 + level) / 2) * scale
    place = (np.log2(reach) - _LOWEST) * _PER_OCTAVE + 1  # of the interval's end among the edges of bins
    within = np.concatenate([[0], np.cumsum(counts)])
    return float(np.interp(place, np.arange(len(counts)), within[:-1])) / total


def miscoverage(counts: Counts, scale: float = 1.0) -> float:
    """Mean over LEVELS of how far the share that is held is from the level; 0 is ideal, 0.5 the worst."""
    return float(np.mean([abs(coverage(counts, level, scale) - level) for level in LEVELS]))


def best_scale(counts: Counts) -> float:
    """The scale at which intervals hold neither too much nor too little, on the mean over LEVELS; by bisection.

    Raises: DataError where no scale does, because most samples do not differ at all.
    """
    low, high = float(_LOWEST), float(_HIGHEST)  # powers of two
    if not _lacking(counts, 2.0**low) > 0 > _lacking(counts, 2.0**high):
        raise DataError(
            "no scale makes intervals of this deviation hold what they should: the samples are all the same; "
            "check that the model draws, and that --samples is 2 or more"
        )
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if _lacking(counts, 2.0**middle) > 0 else (low, middle)
    return float(2.0 ** ((low + high) / 2))


def calibrate(clips: Sequence[Distances]) -> Calibration:
    """Choose the scale on every other scene, and measure on those between.

    Raises: DataError for fewer than two scenes, or as `best_scale`.
    """
    scenes = sorted({clip.scene for clip in clips})
    if len(scenes) < 2:
        raise DataError(f"a scale is chosen on half of the scenes and tried on the others: 2 wanted, got {len(scenes)}")
    fitted, reported = tuple(scenes[::2]), tuple(scenes[1::2])
    scale = best_scale(_summed(clips, fitted, "all"))
    regions: dict[Region, Reliability] = {}
    for region in clips[0].counts:
        counts = _summed(clips, reported, region)
        if counts.any():
            regions[region] = _reliability(counts, scale)
    return Calibration(scale=scale, fitted=fitted, reported=reported, levels=LEVELS, regions=regions)


def _reliability(counts: Counts, scale: float) -> Reliability:
    return Reliability(
        colours=int(counts.sum()),
        held=tuple(coverage(counts, level) for level in LEVELS),
        held_scaled=tuple(coverage(counts, level, scale) for level in LEVELS),
        miscoverage=miscoverage(counts),
        miscoverage_scaled=miscoverage(counts, scale),
    )


def _draws(prediction: Prediction) -> Tensor:
    """[S, T, 3, H, W]."""
    videos = [draw.video for draw in prediction.draws if draw.video is not None]
    if len(videos) < 2:
        raise DataError(f"intervals want 2 or more draws of a picture, got {len(videos)}; give more --samples")
    return torch.stack(videos).float().cpu()


def _places(far: Tensor) -> Tensor:
    """The bin of each distance; the first and the last take what lies beyond, NaN (0 / 0) is no distance at all."""
    exact = (far.nan_to_num(nan=0.0, posinf=torch.inf).log2() - _LOWEST) * _PER_OCTAVE + 1
    return exact.clamp(0, _BINS - 1).floor().long()


def _counted(places: Tensor) -> Counts:
    return np.bincount(places.flatten().numpy(), minlength=_BINS).astype(np.int64)


def _lacking(counts: Counts, scale: float) -> float:
    """How much less is held than should be, on the mean over LEVELS; falls as the scale rises."""
    return float(np.mean([level - coverage(counts, level, scale) for level in LEVELS]))


def _summed(clips: Sequence[Distances], scenes: Sequence[str], region: Region) -> Counts:
    total = np.zeros(_BINS, np.int64)
    for clip in clips:
        if clip.scene in scenes and region in clip.counts:
            total += clip.counts[region]
    return total
