"""How much the deviation over samples can be trusted: how often the truth lies within the intervals that it gives.

A pixel's interval at a level such as 90 % is, for each of its colours,

    mean over samples ± z * scale * deviation,   z = 1.645 at 90 %: the normal quantile of (1 + level) / 2

with the one deviation that a view has for each pixel (`View.std`, the mean over the colours). About the mean, because
that is the best guess samples give, and the deviation is taken about it; a single sample lies farther from the truth.
The first frame is left out: there the target camera of a gradual path stands where the source camera does.
"""

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import TypeAlias

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_train.errors import DataError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.metrics import pixel_deviation
from gcd_train.evaluation.predictors import Prediction, to_pictures
from gcd_train.evaluation.statistics import FEW_SCENES, FIRST_MEASURED
from gcd_train.evaluation.store import Region
from gcd_train.evaluation.tables import counted, markdown_rows
from gcd_train.files import write_whole
from gcd_train.pictures import new_figure, save

LEVELS = tuple(round(0.05 * step, 2) for step in range(1, 20))
"""Shares of pixels that intervals are meant to hold, 5 % to 95 %."""
STATED = (0.5, 0.9)
"""Levels that tables show."""

Counts = NDArray[np.int64]
"""How many colours of pixels lie how many deviations from the truth: [_BINS], in equal steps of the logarithm."""

_LOWEST, _HIGHEST, _PER_OCTAVE = -20, 40, 48  # powers of two; what lies beyond stands in the first and the last bin
_BINS = (_HIGHEST - _LOWEST) * _PER_OCTAVE + 2
_COLOURS: dict[Region, str] = {"all": "#1f4e9c", "visible": "#2c8a4b", "occluded": "#c0392b"}


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
    which `regions` were measured; "visible" and "occluded" are missing where it is unknown what the source camera saw.
    """

    scale: float
    fitted: tuple[str, ...]
    reported: tuple[str, ...]
    levels: tuple[float, ...]
    regions: dict[Region, Reliability]


class CalibrationNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a calibration holds for, and what it found; `calibration.json`.

    weights, sha256_12: of the model. data: folders. data_identity: digest of the clips. clips: measured. unreadable:
    clips that could not be read, with the reason. samples, steps, seed: of the sampler.
    """

    weights: str
    sha256_12: str
    data: tuple[str, ...]
    data_identity: str
    clips: int
    unreadable: tuple[str, ...]
    samples: int
    steps: int
    seed: int
    found: Calibration

    @property
    def scenes(self) -> int:
        """How many there were."""
        return len(self.found.fitted) + len(self.found.reported)

    @property
    def warning(self) -> str:
        """What the scale should not be trusted for; empty for nothing."""
        if self.scenes >= FEW_SCENES:
            return ""
        scenes = counted(self.scenes, "scene")
        return f"Measured on {scenes}: of fewer than {FEW_SCENES} no claim can rest on this scale."


Distances: TypeAlias = Mapping[Region, Counts]
"""One clip's counts, by region."""


def distances(clip: HeldOutClip, prediction: Prediction) -> Distances:
    """How far a clip's truth lies from what was drawn of it.

    A target level stands for all colours that are rounded to it, so it is spread over them, always in the same way;
    else flat pixels would be hit exactly, or not at all.
    """
    videos = [draw.video for draw in prediction.draws if draw.video is not None]  # two or more
    drawn = torch.stack(videos).float().cpu()[:, FIRST_MEASURED:]
    truth = to_pictures(clip.target)[FIRST_MEASURED:]
    spread = np.random.default_rng(zlib.crc32(clip.key.encode())).random(truth.shape, np.float32)
    truth = truth + (torch.from_numpy(spread) - 0.5) / 255.0
    far = (truth - drawn.mean(dim=0)).abs() / pixel_deviation(drawn)[:, None]  # [T-1, 3, H, W]; without any: infinite
    exact = (far.nan_to_num(nan=0.0, posinf=torch.inf).log2() - _LOWEST) * _PER_OCTAVE + 1
    places = exact.clamp(0, _BINS - 1).floor().long()  # NaN (0 / 0) is no distance at all
    parts: dict[Region, Tensor] = {"all": places}
    if clip.visible is not None:
        seen = torch.from_numpy(clip.visible[FIRST_MEASURED:])[:, None].expand_as(places)
        parts |= {"visible": places[seen], "occluded": places[~seen]}
    return {name: np.bincount(part.flatten().numpy(), minlength=_BINS).astype(np.int64) for name, part in parts.items()}


def coverage(counts: Counts, scale: float = 1.0) -> NDArray[np.float64]:
    """Share of colours that lie within the interval of each of LEVELS; NaN where there is no pixel."""
    reach = scale * np.array([NormalDist().inv_cdf((1 + level) / 2) for level in LEVELS])
    places = (np.log2(reach) - _LOWEST) * _PER_OCTAVE + 1  # of the intervals' ends among the edges of bins
    within = np.concatenate([[0], np.cumsum(counts)])
    with np.errstate(invalid="ignore"):
        return np.interp(places, np.arange(len(counts)), within[:-1]) / within[-1]


def miscoverage(counts: Counts, scale: float = 1.0) -> float:
    """Mean over LEVELS of how far the share that is held is from the level; 0 is ideal, 0.5 the worst."""
    return float(np.abs(coverage(counts, scale) - LEVELS).mean())


def best_scale(counts: Counts) -> float:
    """The scale at which intervals hold neither too much nor too little, on the mean over LEVELS.

    Raises: DataError where no scale does, because most samples do not differ at all.
    """

    def lacking(power: float) -> float:
        return float((LEVELS - coverage(counts, 2.0**power)).mean())

    if not lacking(_LOWEST) > 0 > lacking(_HIGHEST):
        raise DataError(
            "no scale makes intervals of this deviation hold what they should: the samples are all the same; "
            "check that the model draws, and that --samples is 2 or more"
        )
    low, high = float(_LOWEST), float(_HIGHEST)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if lacking(middle) > 0 else (low, middle)
    return float(2.0 ** ((low + high) / 2))


def calibrate(clips: Sequence[tuple[str, Distances]]) -> Calibration:
    """Choose the scale on every other scene, and measure on those between.

    Args:
        clips: each with its scene.
    Raises: DataError for fewer than two scenes, or as `best_scale`.
    """
    scenes = sorted({scene for scene, _ in clips})
    if len(scenes) < 2:
        raise DataError(f"a scale is chosen on half of the scenes and tried on the others: 2 wanted, got {len(scenes)}")

    def summed(chosen: Sequence[str], region: Region) -> Counts:
        each = [counts[region] for scene, counts in clips if scene in chosen and region in counts]
        return np.sum([np.zeros(_BINS, np.int64), *each], axis=0)

    fitted, reported = tuple(scenes[::2]), tuple(scenes[1::2])
    scale, regions = best_scale(summed(fitted, "all")), dict[Region, Reliability]()
    for region in clips[0][1]:
        counts = summed(reported, region)
        if counts.any():
            regions[region] = Reliability(
                colours=int(counts.sum()),
                held=tuple(coverage(counts).tolist()),
                held_scaled=tuple(coverage(counts, scale).tolist()),
                miscoverage=miscoverage(counts),
                miscoverage_scaled=miscoverage(counts, scale),
            )
    return Calibration(scale=scale, fitted=fitted, reported=reported, levels=LEVELS, regions=regions)


def write_calibration(note: CalibrationNote, folder: Path) -> str:
    """Write `calibration.json`, `calibration.md` and `reliability.png`; gives the text.

    Raises: RunError if they cannot be written, RenderError without matplotlib.
    """
    found, rows = note.found, list[list[str]]()
    shown = [LEVELS.index(level) for level in STATED]
    headings = [*(f"{100 * level:.0f} % interval holds" for level in STATED), "mean absolute miscoverage"]
    for region, of in found.regions.items():
        held = [f"{100 * share:.0f} %" for place in shown for share in (of.held[place], of.held_scaled[place])]
        rows.append([region, *held, f"{of.miscoverage:.3f}", f"{of.miscoverage_scaled:.3f}"])
    lines = [
        f"# Calibration of {note.weights}",
        "",
        f"Weights {note.sha256_12}, {note.samples} samples, steps {note.steps}, seed {note.seed}; {note.clips} clips "
        f"({note.data_identity}) of {counted(note.scenes, 'scene')} in {', '.join(note.data)}.",
        "",
        f"**Scale {found.scale:.3g}**, chosen on {counted(len(found.fitted), 'scene')}; the table is of the other "
        f"{len(found.reported)}.",
        "",
        *([f"{note.warning}\n"] if note.warning else []),
        *markdown_rows(["pixels", *(each for head in headings for each in (head, "with the scale"))], rows),
        *(f"\nNot read: {why}" for why in note.unreadable),
    ]
    text = "\n".join(lines) + "\n"
    write_whole(folder / "calibration.json", msgspec.json.format(msgspec.json.encode(note), indent=1))
    write_whole(folder / "calibration.md", text.encode())
    _write_plot(found, folder / "reliability.png")
    return text


def _write_plot(found: Calibration, out: Path) -> None:
    """What intervals hold over what they are meant to hold, with the scale and without."""
    figure = new_figure(6.0, 5.6)
    axes = figure.add_axes((0.12, 0.11, 0.84, 0.8))
    axes.plot([0, 100], [0, 100], color="#999999", linewidth=1)
    levels = [100 * level for level in found.levels]
    for region, of in found.regions.items():
        held, scaled = (100 * np.array(shares) for shares in (of.held, of.held_scaled))
        axes.plot(levels, held, "--", color=_COLOURS[region], linewidth=1, label=f"{region}, as drawn")
        label = f"{region}, times {found.scale:.3g}"
        axes.plot(levels, scaled, "o-", color=_COLOURS[region], markersize=3.5, label=label)
    axes.set(xlim=(0, 100), ylim=(0, 100), xlabel="interval is meant to hold, %", ylabel="held, % of colours")
    axes.set_title("How often the truth lies within the interval", fontsize=10.5)
    axes.grid(color="#eeeeee")
    axes.legend(fontsize=8, loc="upper left")
    save(figure, out)
