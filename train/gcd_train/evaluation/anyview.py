"""AnyViewBench: its episodes as clips, its grid, and its means by episode, split and group.

    frame -> episode -> split -> group -> mean over the groups, each an unweighted mean

Source: PROTOCOL page and README of TRI-ML/AnyView-DVS; Van Hoorick et al. 2026, "AnyView: Synthesizing Any Novel
View in Dynamic Scenes". Not said there, and assumed: sizes between the two stages of the grid are not rounded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import torch

from gcd_model.geometry import pose_trajectory, relative_pose
from gcd_train.data.anyview import FETCH, SKEW, SOURCE, SPLITS, TARGET, Episode, find_episodes, read_groups
from gcd_train.data.encodings import pillow
from gcd_train.data.files import Skips
from gcd_train.data.sample import Bytes
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import EvaluationSet, HeldOutClip
from gcd_train.evaluation.paper import PICTURE_COLUMNS
from gcd_train.evaluation.predictors import CameraPair, SourceClip
from gcd_train.evaluation.runs import EvaluatedSet, MethodRecords
from gcd_train.evaluation.statistics import Interval
from gcd_train.evaluation.tables import NO_WEIGHTS, NOTHING, Cell, Row, Table, counted

LONGEST, STEP = 41, 4
"""Frames of the longest clip of the benchmark; all have 1 + 4 k."""
_STAGES, _SNAP = (384, 576), 16


def grid_size(height: int, width: int) -> tuple[int, int]:
    """Height and width that pictures are measured at: the long side 384, then 576, both sides each time the nearest
    multiple of 16, of two the lower; 16:9 becomes 304 x 576, 4:3 432 x 576."""
    for long in _STAGES:
        most = max(height, width)
        # ceil(side long / (16 most) - 1/2), in whole numbers, so that ties are ties
        height, width = (
            _SNAP * max(1, -((_SNAP * most - 2 * side * long) // (2 * _SNAP * most))) for side in (height, width)
        )
    return height, width


def on_grid(pictures: Sequence[Bytes], height: int, width: int) -> Bytes:
    """u8 [T, height, width, 3], resized once by Lanczos. Raises RenderError without Pillow, of the extra `scenes`."""
    image = pillow()
    return np.stack([np.asarray(image.fromarray(each).resize((width, height), image.LANCZOS)) for each in pictures])


@dataclass(frozen=True, kw_only=True)
class EpisodeSet(EvaluationSet):
    """Episodes by name: `droid_OOD_LR.EPISODE`, the split and the folder.

    episodes: and of each how many frames are measured, the first ones. frames, height, width: of the longest and the
    largest; they differ. groups: names of the clips of each split by group; none of a split that was left out.
    splits: how many episodes each has. pair: input and target camera.
    """

    episodes: Mapping[str, tuple[Episode, int]]
    groups: dict[str, dict[str, tuple[str, ...]]]
    splits: dict[str, int]
    pair: tuple[str, str]

    @classmethod
    def open(
        cls,
        root: Path,
        *,
        frames: int | None = None,
        split: str | None = None,
        limit: int | None = None,
        pair: tuple[str, str] | None = None,
    ) -> tuple[Self, tuple[str, ...]]:
        """The set, without an identity; and what was left out, line by line.

        Args:
            frames: T of all clips; None for the most that the benchmark takes of each. split: only this one, or this
                group. limit: only the first so many episodes of each split. pair: input and target camera, other than
                the benchmark's; a folder without splits.json, as Kubric-5D's, is one split then.
        Raises:
            DataError, FileFault: it is no benchmark, an episode has fewer frames or lacks a camera, or nothing is left.
            RecipeError: no such split. RenderError: Pillow is missing.
        """
        pillow()  # what is not installed is said now, not clip by clip
        whole = pair is not None and not (root / SPLITS).exists()
        groups = {root.name: (root.name,)} if whole else read_groups(root)
        chosen = [(group, name) for group, splits in groups.items() for name in splits]
        found, notes = find_episodes(root, [name for _, name in chosen]), Skips(logged=False)
        if split is not None:
            known = ", ".join(name for _, name in chosen)
            chosen = [(group, name) for group, name in chosen if split in (group, name)]
            if not chosen:
                raise RecipeError(f"{root / SPLITS} has no split or group {split!r}; there are {known}")
        episodes, kept = dict[str, tuple[Episode, int]](), dict[str, dict[str, tuple[str, ...]]]()
        for group, name in chosen:
            several = list(found[name].items())[:limit]
            opened = {key: Episode.open(folder, pair or (SOURCE, TARGET)) for key, folder in several}
            there = {f"{name}.{key}": each for key, each in opened.items() if each is not None}
            if not opened:
                notes.add(name, str(root), "has no folder for this split")
            elif len(there) < len(opened):
                missing = len(opened) - len(there)
                notes.add(
                    name, str(root), f"{missing} of {len(opened)} episodes have no pixels: rebuild them by {FETCH}"
                )
            kept.setdefault(group, {})[name] = tuple(there)
            episodes |= {key: (each, _length(each, frames)) for key, each in there.items()}
        if not episodes:
            raise DataError(f"no episode of {root} can be measured: {'; '.join(notes.lines()) or 'none is there'}")
        sizes = [grid_size(each.height, each.width) for each, _ in episodes.values()]
        made = cls(
            episodes=episodes,
            groups=kept,
            splits={name: len(each) for name, each in found.items()},
            pair=pair or (SOURCE, TARGET),
            frames=max(length for _, length in episodes.values()),
            height=max(height for height, _ in sizes),
            width=max(width for _, width in sizes),
            kind="anyview",
            identity="",
            geometry=False,
        )
        return made, tuple(notes.lines())

    @property
    def keys(self) -> tuple[str, ...]:
        """See EvaluationSet; split by split."""
        return tuple(self.episodes)

    def length(self, key: str, /) -> int:
        """See EvaluationSet."""
        return self.episodes[key][1]

    def clip(self, key: str, /) -> HeldOutClip:
        """See EvaluationSet. Frames whose target is wholly black do not count."""
        episode, frames = self.episodes[key]
        source, target = (episode.read(camera, frames) for camera in self.pair)
        height, width = grid_size(episode.height, episode.width)
        poses = [torch.from_numpy(each.poses) for each in (source, target)]
        seen, true = (on_grid(each.pictures, height, width) for each in (source, target))
        counted = np.array([frame.any() for frame in true])
        cameras = CameraPair(
            ground_from_source=poses[0],
            source=source.lenses[0].resized(width, height),
            target=target.lenses[0].resized(width, height),
            trajectory=pose_trajectory(relative_pose(*poses)),
            zooms=any(
                float((lens.matrix - each.lenses[0].matrix).abs().max()) > SKEW * lens.fx
                for each in (source, target)
                for lens in each.lenses
            ),
        )
        return HeldOutClip(
            key=key,
            scene=key,
            seen=SourceClip(
                source=seen,
                source_depth=np.zeros((frames, 0, 0), np.float32),
                source_classes=None,
                cameras=cameras,
                fps=episode.fps,
                key=key,
            ),
            target=true,
            counted=None if counted.all() else counted,
        )


def _length(episode: Episode, frames: int | None) -> int:
    """How many frames of an episode are measured. Raises DataError where it has too few."""
    usual = min(LONGEST, 1 + STEP * ((episode.frames - 1) // STEP))
    if episode.frames < (frames or 1 + STEP):
        wanted = f"the clips are to have {frames}" if frames else f"a clip has {1 + STEP} or more"
        raise DataError(f"{episode.folder} has {episode.frames} frames, {wanted}; give --frames, or another --split")
    return frames or usual


# --- the benchmark's own table, and what is published ----------------------------------------------------------------

_COLUMNS = PICTURE_COLUMNS[:3]
_HEADINGS = ("PSNR", "SSIM", "LPIPS")
_MEAN = "mean over groups"


def benchmark_table(of: EvaluatedSet) -> Table:
    """Each method's figures: the mean over the groups, and below it groups and splits."""
    groups = {group: {s: keys for s, keys in splits.items() if keys} for group, splits in of.note.groups.items()}
    groups = {group: splits for group, splits in groups.items() if splits}
    places = [(_MEAN, groups)]
    for group, splits in groups.items():
        places += [(group, {group: splits}), *((f"{group}: {s}", {group: {s: keys}}) for s, keys in splits.items())]
    rows = [_row(method, label, part) for label, part in places for method in of.methods]
    kept = {name: len(keys) for splits in of.note.groups.values() for name, keys in splits.items()}
    every = {name: of.note.splits.get(name, count) for name, count in kept.items()}
    lacking = [name for name, count in kept.items() if count < max(1, every[name])]
    out = [f"{name} ({every[name] - kept[name]} of {every[name]})" for name in lacking]
    lengths = ", ".join(map(str, sorted({record.frames for each in of.methods for record in each.records})))
    means = f"Unweighted means over frames, episodes, splits, {counted(len(groups), 'group')}"
    notes = [f"{means}: of all, or not known; black targets do not count. Clips of {lengths} frames."]
    parts = [each.name for each in of.methods if any(record.crop is not None for record in each.records)]
    notes += [f"†, a part of each frame alone, which is not the protocol's: {', '.join(parts)}."] if parts else []
    notes += [f"Episodes left out, without pixels, not there or beyond --limit: {', '.join(out)}."] if out else []
    title = "Means over groups, of a group and of a split"
    return Table(name="anyviewbench", title=title, headings=_HEADINGS, rows=tuple(rows), notes=tuple(notes))


def _row(method: MethodRecords, label: str, groups: Mapping[str, Mapping[str, Sequence[str]]]) -> Row:
    """A method's mean over groups of splits of episodes; not known as soon as one episode was not measured."""
    sums, cells = method.table.clip_sums("all"), list[Cell]()
    for column in _COLUMNS:
        by_clip = sums.figure(column.figure)
        splits = [[_mean(by_clip, method.places, keys) for keys in each.values()] for each in groups.values()]
        value = float(np.mean([np.mean(each) for each in splits]))
        note = NO_WEIGHTS if column.figure == "lpips" and np.isnan(by_clip).all() else NOTHING
        cells.append(Cell(figure=Interval(value=value), digits=column.digits, note=note))
    measured = [key in method.places for each in groups.values() for split in each.values() for key in split]
    clips = f"{sum(measured)} of {len(measured)}"
    return Row(label=label, method=method.starred, clips=clips, cells=tuple(cells))


def _mean(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], places: Mapping[str, int], keys: Sequence[str]
) -> float:
    """Of a split whose episodes were all measured; one that is black throughout has no figure and does not count."""
    known = values[[places[key] for key in keys]] if all(key in places for key in keys) else values[:0]
    known = known[~np.isnan(known)]
    return float(known.mean()) if known.size else float("nan")


_PUBLISHED: Mapping[str, tuple[int, tuple[float, ...], tuple[float, ...]]] = {
    "Argoverse 2": (64, (11.89, 0.389, 0.657), (11.87, 0.388, 0.645)),
    "AssemblyHands": (64, (10.52, 0.283, 0.717), (10.39, 0.275, 0.711)),
    "DDAD": (64, (10.58, 0.304, 0.581), (10.63, 0.314, 0.568)),
    "DROID, held-out labs": (64, (11.91, 0.397, 0.613), (11.98, 0.399, 0.603)),
    "DROID: droid_OOD_LR": (32, (11.15, 0.333, 0.642), ()),
    "Ego-Exo4D, held-out": (64, (12.97, 0.273, 0.588), (13.02, 0.281, 0.578)),
    _MEAN: (320, (11.57, 0.329, 0.631), (11.58, 0.331, 0.621)),
}
"""Episodes, and PSNR, SSIM and LPIPS of AnyView on the zero-shot archive: of the released weights, and in the paper."""


def published_table() -> Table:
    """What AnyView's README prints; nothing of it was measured here."""
    rows: list[Row] = []
    for label, (episodes, *both) in _PUBLISHED.items():
        for method, figures in zip(("AnyView, released, 35 steps", "AnyView, paper"), both, strict=True):
            digits = [column.digits for column in _COLUMNS]
            cells = [Cell(figure=Interval(value=v), digits=d) for v, d in zip(figures, digits, strict=False)]
            rows += [Row(label=label, method=method, clips=str(episodes), cells=tuple(cells))] if cells else []
    notes = (
        "Whole clips of 13, 29 or 41 frames. The paper's own pictures were resized twice and saved as JPEG between.",
    )
    title = "Published, not measured here: AnyViewBench, zero-shot archive"
    return Table(name="published", title=title, headings=_HEADINGS, rows=tuple(rows), notes=notes)
