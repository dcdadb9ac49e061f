"""Whether clips of one name, of two sets, end at the same goal: only then can what methods made of them be compared."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import msgspec

from gcd_train.evaluation.record import ClipRecord, Counted, Frames
from gcd_train.evaluation.tallies import Selection, Span
from gcd_train.reports.material import COMPARABLE, EvaluatedSet, Method

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
