"""Runs of evaluations put together: what was measured on the same clips stands in the same tables."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import msgspec

from gcd_train.errors import RunError
from gcd_train.evaluation.baselines import FROM_EXACT_CLASSES
from gcd_train.evaluation.statistics import Selection, Span
from gcd_train.evaluation.store import FRAMES_IN, LPIPS, REGIONS, ClipRecord, Counted, Frames, Region, RunNote, read_run

COMPARABLE = ("kind", "modality", "protocol", "frames", "height", "width", "fps", "classes")
"""What the notes of two runs must have alike before any of their figures are compared."""


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
    """Methods that were measured on the same clips, by one run or by several.

    note: of the first run. runs: all of them. methods: in the order of the runs.
    """

    note: RunNote
    runs: tuple[Run, ...]
    methods: tuple[Method, ...]

    @property
    def title(self) -> str:
        """What the clips are, in a few words."""
        names = ", ".join(dict.fromkeys("/".join(Path(folder).parts[-2:]) or folder for folder in self.note.data))
        return f"{_KINDS[self.note.kind]} ({names}), {_PROTOCOLS[self.note.protocol]}"

    @property
    def keys(self) -> tuple[str, ...]:
        """Of all clips that any method was measured on."""
        return tuple(dict.fromkeys(key for method in self.methods for key in method.keys))

    @property
    def scenes(self) -> int:
        """How many scenes these clips are of."""
        return len({record.scene for method in self.methods for record in method.records})

    @property
    def regions(self) -> tuple[Region, ...]:
        """All, and the others where somebody knows which they are."""
        records = [record for method in self.methods for record in method.records]
        return tuple(region for region in REGIONS if any(region in record.regions for record in records))

    def fps(self, key: str) -> float:
        """Frames per second of a clip."""
        return next(record.fps for method in self.methods for record in method.records if record.key == key)

    def method(self, name: str) -> Method:
        """Raises RunError where there is none of the name."""
        for each in self.methods:
            if each.name == name:
                return each
        known = ", ".join(each.name for each in self.methods)
        raise RunError(f"no method is called {name!r} in these runs; there are {known}")


_KINDS = {"kubric": "Kubric-4D layout", "driving": "Driving", "orbit": "Orbits"}
_PROTOCOLS = {"paper": "the paper's protocol", "released": "the released script's protocol", "pairs": "pairs of clips"}


def gather(runs: Sequence[Run]) -> tuple[EvaluatedSet, ...]:
    """Sets of clips, in the order of the runs; runs on the same clips make one set.

    Raises:
        RunError: two runs on the same clips were made in other ways, or name two different methods alike.
    """
    order = list(dict.fromkeys(run.note.data_identity for run in runs))
    alike = sorted(runs, key=lambda run: order.index(run.note.data_identity))
    groups = groupby(alike, key=lambda run: run.note.data_identity)
    return tuple(_set(tuple(members)) for _, members in groups)


def _set(runs: tuple[Run, ...]) -> EvaluatedSet:
    for run in runs[1:]:
        _require_comparable(runs[0], run)
    found: dict[str, Method] = {}
    for run in runs:
        for method in _methods(run):
            other = found.setdefault(method.name, method)
            if not _same_method(other.details, method.details):
                raise RunError(
                    f"{method.name} is another method in {other.folder} than in {run.folder}: {other.details} and "
                    f"{method.details}; measure it alike in both, give one another name, or report the runs apart"
                )
    return EvaluatedSet(note=runs[0].note, runs=runs, methods=tuple(found.values()))


def _same_method(first: Mapping[str, str], other: Mapping[str, str]) -> bool:
    """Whether two notes are of one method: frames from elsewhere are known by their content, wherever they lie, and
    LPIPS may have been left out of one of the two runs."""
    kept = [{name: value for name, value in each.items() if name != FRAMES_IN} for each in (first, other)]
    if any(LPIPS not in each for each in kept):
        kept = [{name: value for name, value in each.items() if name != LPIPS} for each in kept]
    return kept[0] == kept[1]


def _require_comparable(first: Run, other: Run) -> None:
    for name in COMPARABLE:
        was, now = getattr(first.note, name), getattr(other.note, name)
        if was != now:
            raise RunError(
                f"{other.folder} has {name} {now}, {first.folder} has {was}, on the same clips; report them apart"
            )


def _methods(run: Run) -> list[Method]:
    by_name: dict[str, list[ClipRecord]] = {}
    for record in run.records:
        by_name.setdefault(record.method, []).append(record)
    return [
        Method(name=name, details=run.note.methods.get(name, {}), folder=run.folder, records=tuple(records))
        for name, records in by_name.items()
    ]


_SAME_CHANGE = 0.01  # degrees and metres
_SAME_FIGURE = 1e-4  # of the larger one: two cameras at one goal see one picture, the next moment differs by 1e-3


@dataclass(frozen=True, kw_only=True, slots=True)
class Goal:
    """Where a clip's camera goes, and what is known of the target's pictures, whatever the method.

    change: azimuth, elevation, radius; None for the fixed path of driving. target: figures by name, frame by frame.
    """

    change: tuple[float, float, float] | None
    target: Mapping[str, Frames]

    @classmethod
    def of(cls, records: Sequence[ClipRecord]) -> "Goal":
        """Of one clip, from the records of any methods on it."""
        target: dict[str, Frames] = {}
        for record in records:
            for name, values in _of_target(record).items():
                target.setdefault(name, values)
        return cls(change=records[0].change, target=target)

    def apart_from(self, other: "Goal", frames: Span = "last") -> str:
        """Why the two targets are not the same in these frames, in words; empty where they are."""
        if not _same_change(self.change, other.change):
            return f"the camera goes {_told(self.change)} and {_told(other.change)}"
        chosen, known = Selection(frames=frames).frame_slice(), self.target.keys() & other.target.keys()
        if not known and self.change is None:
            return "nobody knows whether the targets are the same"
        same = all(_alike(self.target[name][chosen], other.target[name][chosen]) for name in known)
        return "" if same else "the target's pictures differ: other moments, or another path"


@dataclass(frozen=True, kw_only=True, slots=True)
class Joined:
    """sets: each put together from several whose clips end at the same goals. notes: what is not compared, and why."""

    sets: tuple[EvaluatedSet, ...]
    notes: tuple[str, ...]


def on_the_same_goals(sets: Sequence[EvaluatedSet]) -> Joined:
    """Sets with clips of one name that end at the same goal, put together, for figures of the last frame.

    A gradual and a direct path end at the same goal, so their last frames can be compared and no others. Clips of the
    same name that go elsewhere are left out. A method that several of the sets have is taken from the first.
    """
    groups: list[list[EvaluatedSet]] = []
    notes: list[str] = []
    for each in sets:
        _place(each, groups, notes)
    together = [group for group in groups if len(group) > 1]
    notes += [note for group in together for note in _renamed(group)]
    return Joined(sets=tuple(_put_together(group) for group in together), notes=tuple(notes))


def _place(each: EvaluatedSet, groups: list[list[EvaluatedSet]], notes: list[str]) -> None:
    """Into the first group that it has goals in common with, or into one of its own."""
    for group in groups:
        why = _compared(group[0], each)
        apart = {key: reason for key, reason in why.items() if reason}
        if apart:
            notes.append(_not_compared(group[0], each, apart, len(why)))
        if len(apart) < len(why):
            group.append(_only(each, [key for key, reason in why.items() if not reason]))
            return
    groups.append([each])


def _compared(first: EvaluatedSet, other: EvaluatedSet) -> dict[str, str]:
    """For each clip that both have by name why it is not the same; empty for sets that are made in other ways."""
    if any(getattr(first.note, name) != getattr(other.note, name) for name in COMPARABLE):
        return {}
    ours, theirs = _goals(first), _goals(other)
    return {key: goal.apart_from(theirs[key]) for key, goal in ours.items() if key in theirs}


def _goals(of: EvaluatedSet) -> dict[str, Goal]:
    by_key: dict[str, list[ClipRecord]] = {}
    for method in of.methods:
        for record in method.records:
            by_key.setdefault(record.key, []).append(record)
    return {key: Goal.of(records) for key, records in by_key.items()}


def _only(of: EvaluatedSet, keys: Sequence[str]) -> EvaluatedSet:
    """Of these clips alone; a method that has none of them is left out."""
    wanted = set(keys)
    kept = [replace(m, records=tuple(each for each in m.records if each.key in wanted)) for m in of.methods]
    return replace(of, methods=tuple(method for method in kept if method.records))


def _put_together(sets: Sequence[EvaluatedSet]) -> EvaluatedSet:
    methods: dict[str, Method] = {}
    for method in (method for each in sets for method in each.methods):
        methods.setdefault(method.name, method)
    data = tuple(folder for each in sets for folder in each.note.data)
    return EvaluatedSet(
        note=msgspec.structs.replace(sets[0].note, data=data),
        runs=tuple(run for each in sets for run in each.runs),
        methods=tuple(methods.values()),
    )


def _renamed(sets: Sequence[EvaluatedSet]) -> list[str]:
    """Methods that share a name and nothing else: only the first of each is shown."""
    first: dict[str, Method] = {}
    notes: list[str] = []
    for method in (method for each in sets for method in each.methods):
        other = first.setdefault(method.name, method)
        if other.details != method.details:
            notes.append(
                f"{method.name} is another method in {method.folder} than in {other.folder}, and only the latter "
                "stands in the table of both; rename one of the two to compare them"
            )
    return notes


def _not_compared(first: EvaluatedSet, other: EvaluatedSet, apart: Mapping[str, str], shared: int) -> str:
    key, reason = next(iter(apart.items()))
    return (
        f"{_named(first)} and {_named(other)}: of {shared} clips of the same names {len(apart)} do not end at the same "
        f"goal, so they are not compared. In {key} {reason}."
    )


def _named(of: EvaluatedSet) -> str:
    return ", ".join(str(folder) for folder in {run.folder: None for run in of.runs})


def _of_target(record: ClipRecord) -> dict[str, Frames]:
    """What a record tells of the target alone, by region: how much is of it, how sharp it is, its classes' mean id."""
    found: dict[str, Frames] = {}
    for name, region in record.regions.items():
        if name != "all":
            found[f"{name} share"] = region.pixels
        if region.gradient_target is not None:
            found[f"{name} gradient"] = region.gradient_target
        if region.confusion is not None:
            found[f"{name} classes"] = tuple(_mean_class(counted) for counted in region.confusion)
    return found


def _mean_class(counted: Counted) -> float | None:
    pixels = sum(count for _, _, count in counted)
    return sum(true * count for true, _, count in counted) / pixels if pixels else None


def _same_change(first: tuple[float, ...] | None, other: tuple[float, ...] | None) -> bool:
    if first is None or other is None:
        return first is other
    return all(abs(one - two) <= _SAME_CHANGE for one, two in zip(first, other, strict=True))


def _alike(first: Frames, other: Frames) -> bool:
    return len(first) == len(other) and all(_equal(one, two) for one, two in zip(first, other, strict=True))


def _equal(one: float | None, two: float | None) -> bool:
    if one is None or two is None:
        return one is two
    return math.isclose(one, two, rel_tol=_SAME_FIGURE, abs_tol=1e-9)


def _told(change: tuple[float, float, float] | None) -> str:
    if change is None:
        return "its fixed path"
    azimuth, elevation, radius = change
    return f"by azimuth {azimuth:+.1f}, elevation {elevation:+.1f}, radius {radius:+.1f}"
