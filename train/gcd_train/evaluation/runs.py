"""Runs of evaluations put together: what was measured on the same clips stands in the same tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from gcd_train.errors import RunError
from gcd_train.evaluation.baselines import FROM_EXACT_CLASSES
from gcd_train.evaluation.statistics import (
    Array,
    ClassCounts,
    FigureName,
    Selection,
    Span,
    Sums,
    class_counts,
    clip_sums,
    scene_sums,
)
from gcd_train.evaluation.store import COMPARABLE, FRAMES_IN, LPIPS, REGIONS, ClipRecord, Region, RunNote, read_run


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """One run as it lies on the disk. folder: where its `run.json`, records and views are."""

    folder: Path
    note: RunNote
    records: tuple[ClipRecord, ...]

    @classmethod
    def read(cls, folder: Path) -> "Run":
        """Raises RunError where there is none, or none of its clips is measured yet."""
        note, records = read_run(folder)
        if not records:
            raise RunError(f"{folder} holds no record yet; run `gcd-train evaluate --out {folder}` to its end")
        return cls(folder=folder, note=note, records=records)


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """One method on the clips of a set.

    details: what the run's note says of it. folder: of the run that its views are in.
    """

    name: str
    details: dict[str, str]
    folder: Path
    records: tuple[ClipRecord, ...]

    @property
    def privileged(self) -> bool:
        """Whether it was given the exact depth, or further cameras."""
        return self.records[0].privileged

    @property
    def starred(self) -> str:
        """Its name, with a star where it was given more than the source video."""
        return f"{self.name} *" if self.privileged else self.name

    @property
    def copies_classes(self) -> bool:
        """Whether its class maps, and nothing else of it, are made from the source's exact ones."""
        return not self.privileged and self.details.get("baseline") in FROM_EXACT_CLASSES

    @property
    def keys(self) -> tuple[str, ...]:
        """Of the clips it was measured on."""
        return tuple(record.key for record in self.records)

    @property
    def makes_pictures(self) -> bool:
        """Whether it has PSNR, and not class maps alone."""
        return any(record.regions["all"].psnr_db is not None for record in self.records)

    @property
    def makes_classes(self) -> bool:
        """Whether it has class maps that were compared."""
        return any(record.regions["all"].confusion is not None for record in self.records)


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluatedSet:
    """Methods that were measured on the same clips, by one run or by several; their sums are worked out once.

    note: of the first run. runs: all of them. methods: in the order of the runs. rows: method to the row of the paper's
    tables that a user says it belongs in.
    """

    note: RunNote
    runs: tuple[Run, ...]
    methods: tuple[Method, ...]
    rows: Mapping[str, str] = field(default_factory=dict[str, str])
    _known: dict[object, Any] = field(default_factory=dict[object, Any], init=False, repr=False, compare=False)

    @property
    def title(self) -> str:
        """What the clips are, in a few words."""
        names = ", ".join(dict.fromkeys("/".join(Path(folder).parts[-2:]) or folder for folder in self.note.data))
        return f"{_KINDS[self.note.kind]} ({names}), {_PROTOCOLS[self.note.protocol]}"

    @property
    def clips(self) -> dict[str, ClipRecord]:
        """All clips that any method was measured on, each with its first record."""
        found: dict[str, ClipRecord] = {}
        for record in (record for method in self.methods for record in method.records):
            found.setdefault(record.key, record)
        return found

    @property
    def keys(self) -> tuple[str, ...]:
        """Of all clips."""
        return tuple(self.clips)

    @property
    def scenes(self) -> int:
        """How many scenes these clips are of."""
        return len({record.scene for record in self.clips.values()})

    @property
    def regions(self) -> tuple[Region, ...]:
        """All, and the others where somebody knows which they are."""
        return tuple(region for region in REGIONS if any(region in each.regions for each in self.clips.values()))

    def method(self, name: str) -> Method:
        """The one of this name, which there must be."""
        return next(each for each in self.methods if each.name == name)

    def sums(self, method: Method, selection: Selection, records: Sequence[ClipRecord] | None = None) -> Sums:
        """A method's sums by scene for some frames and pixels; of some of its records, or of all."""
        if records is not None and tuple(record.key for record in records) != method.keys:
            return scene_sums(records, selection, class_counts(records, len(self.note.classes)))
        at = (method.name, selection)
        if at not in self._known:
            self._known[at] = scene_sums(method.records, selection, self._counts(method))
        return self._known[at]

    def by_clip(self, method: Method, region: Region, name: FigureName) -> Array:
        """A figure of each clip of a method, [n], in frames 2 to the last."""
        return clip_sums(method.records, Selection(region=region), self._counts(method)).figure(name)

    def _counts(self, method: Method) -> ClassCounts:
        if method.name not in self._known:
            self._known[method.name] = class_counts(method.records, len(self.note.classes))
        return self._known[method.name]


_KINDS = {"kubric": "Kubric-4D layout", "driving": "Driving", "orbit": "Orbits"}
_PROTOCOLS = {"paper": "the paper's protocol", "release": "the released script's protocol", "pairs": "pairs of clips"}


def gather(runs: Sequence[Run], rows: Mapping[str, str] | None = None) -> tuple[EvaluatedSet, ...]:
    """Sets of clips, in the order of the runs; runs on the same clips make one set.

    Args:
        rows: see EvaluatedSet.
    Raises:
        RunError: two runs on the same clips were made in other ways, or name two different methods alike.
    """
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.note.data_identity, []).append(run)
    return tuple(_set(tuple(members), rows or {}) for members in groups.values())


def _set(runs: tuple[Run, ...], rows: Mapping[str, str]) -> EvaluatedSet:
    first = runs[0]
    for run, name in ((run, name) for run in runs[1:] for name in COMPARABLE):
        was, now = getattr(first.note, name), getattr(run.note, name)
        if was != now:
            raise RunError(
                f"{run.folder} has {name} {now}, {first.folder} has {was}, on the same clips; report them apart"
            )
    found: dict[str, Method] = {}
    for run in runs:
        records: dict[str, list[ClipRecord]] = {}
        for record in run.records:
            records.setdefault(record.method, []).append(record)
        for name, own in records.items():
            details = run.note.methods.get(name, {})
            method = Method(name=name, details=details, folder=run.folder, records=tuple(own))
            other = found.setdefault(name, method)
            if not _same_method(other.details, details):
                raise RunError(
                    f"{name} is another method in {other.folder} than in {run.folder}: {other.details} and "
                    f"{details}; measure it alike in both, give one another name, or report the runs apart"
                )
    return EvaluatedSet(note=first.note, runs=runs, methods=tuple(found.values()), rows=rows)


def _same_method(first: Mapping[str, str], other: Mapping[str, str]) -> bool:
    """Whether two notes are of one method: frames from elsewhere are known by their content, wherever they lie, and
    LPIPS may have been left out of one of the two runs."""
    left_out = {FRAMES_IN} if LPIPS in first and LPIPS in other else {FRAMES_IN, LPIPS}
    return all(first.get(name) == other.get(name) for name in (first.keys() | other.keys()) - left_out)


_SAME_CHANGE = 0.01  # degrees and metres
_SAME_FIGURE = 1e-4  # of the larger one: two cameras at one goal see one picture, the next moment differs by 1e-3


def targets_apart(one: ClipRecord, other: ClipRecord, frames: Span = "last") -> str:
    """Why two clips of one name do not have the same target in these frames, in words; empty where they have.

    Told by where the camera goes and how sharp the target is, frame by frame.
    """
    changes = [np.array(each.change if each.change is not None else (np.nan,) * 3) for each in (one, other)]
    if not np.allclose(*changes, rtol=0.0, atol=_SAME_CHANGE, equal_nan=True):
        return "the camera goes {} and {}".format(*(_told(each.change) for each in (one, other)))
    chosen = Selection(frames=frames).frame_slice()
    sharp = [np.array(each.regions["all"].gradient_target[chosen], np.float64) for each in (one, other)]
    if sharp[0].shape != sharp[1].shape or not np.allclose(*sharp, rtol=_SAME_FIGURE, atol=1e-9, equal_nan=True):
        return "the target's pictures differ: other moments, or another path"
    return ""


def _told(change: tuple[float, float, float] | None) -> str:
    if change is None:
        return "its fixed path"
    return "by azimuth {:+.1f}, elevation {:+.1f}, radius {:+.1f}".format(*change)


def on_the_same_goals(sets: Sequence[EvaluatedSet]) -> tuple[tuple[EvaluatedSet, ...], tuple[str, ...]]:
    """Sets with clips of one name that end at the same goal, put together, for figures of the last frame.

    A gradual and a direct path end at the same goal, so their last frames can be compared and no others. Clips of the
    same name that go elsewhere are left out. A method that several of the sets have is taken from the first.

    Returns: the sets, each put together from several; and what is not compared, and why, line by line.
    """
    groups: list[list[EvaluatedSet]] = []
    notes: list[str] = []
    for each in sets:
        _place(each, groups, notes)
    return tuple(_put_together(group, notes) for group in groups if len(group) > 1), tuple(notes)


def _place(each: EvaluatedSet, groups: list[list[EvaluatedSet]], notes: list[str]) -> None:
    """Into the first group that it has goals in common with, or into one of its own."""
    for group in groups:
        if any(getattr(group[0].note, name) != getattr(each.note, name) for name in COMPARABLE):
            continue
        ours, theirs = group[0].clips, each.clips
        why = {key: targets_apart(record, theirs[key]) for key, record in ours.items() if key in theirs}
        apart = {key: reason for key, reason in why.items() if reason}
        if apart:
            first, other = (", ".join(dict.fromkeys(str(run.folder) for run in of.runs)) for of in (group[0], each))
            key, reason = next(iter(apart.items()))
            notes.append(
                f"{first} and {other}: of {len(why)} clips of the same names {len(apart)} do not end at the same goal, "
                f"so they are not compared. In {key} {reason}."
            )
        if len(apart) < len(why):
            wanted = why.keys() - apart.keys()
            kept = [replace(m, records=tuple(r for r in m.records if r.key in wanted)) for m in each.methods]
            group.append(replace(each, methods=tuple(method for method in kept if method.records)))
            return
    groups.append([each])


def _put_together(sets: Sequence[EvaluatedSet], notes: list[str]) -> EvaluatedSet:
    """One set of all; methods that share a name and nothing else are noted, and only the first of each is kept."""
    methods: dict[str, Method] = {}
    for method in (method for each in sets for method in each.methods):
        other = methods.setdefault(method.name, method)
        if other.details != method.details:
            notes.append(
                f"{method.name} is another method in {method.folder} than in {other.folder}, and only the latter "
                "stands in the table of both; rename one of the two to compare them"
            )
    return EvaluatedSet(
        note=msgspec.structs.replace(sets[0].note, data=tuple(folder for each in sets for folder in each.note.data)),
        runs=tuple(run for each in sets for run in each.runs),
        methods=tuple(methods.values()),
        rows=sets[0].rows,
    )
