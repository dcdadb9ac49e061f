"""Runs of evaluations put together: what was measured on the same clips stands in the same tables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np

from gcd_train.errors import RunError
from gcd_train.evaluation.metrics import EQUAL_DB
from gcd_train.evaluation.statistics import FRAMES_OF, ClipTable, Span, Sums
from gcd_train.evaluation.store import (
    COMPARABLE,
    FRAMES_IN,
    LPIPS,
    REGIONS,
    Box,
    ClipRecord,
    Region,
    Run,
    RunNote,
    folder_name,
)


@dataclass(frozen=True, kw_only=True)
class MethodRecords:
    """One method on the clips of a set; its table is worked out once.

    details: what the run's note says of it. folder: of the run that its views are in. classes: how many there are.
    """

    name: str
    details: dict[str, str]
    folder: Path
    records: tuple[ClipRecord, ...]
    classes: int = 0

    @property
    def starred(self) -> str:
        """Its name, with a star where it was given more than the source video: exact depth, or further cameras; and a
        dagger where only a part of each frame was measured."""
        return self.name + " *" * self.records[0].privileged + " †" * (self.crop is not None)

    @property
    def crop(self) -> Box | None:
        """The part of each frame that was measured; None for all of it."""
        return self.records[0].crop

    @property
    def makes_pictures(self) -> bool:
        """Whether it has PSNR, and not class maps alone."""
        return any(record.regions["all"].psnr_db is not None for record in self.records)

    def repeats(self, frames: Span) -> bool:
        """Whether some of these frames equal the target."""
        each = (draw[FRAMES_OF[frames]] for record in self.records for draw in record.regions["all"].psnr_db or ())
        return any(value is not None and value > EQUAL_DB - 1e-3 for draw in each for value in draw)

    @property
    def makes_classes(self) -> bool:
        """Whether it has class maps that were compared."""
        return any(record.regions["all"].confusion is not None for record in self.records)

    @cached_property
    def places(self) -> dict[str, int]:
        """Of the clips it was measured on, by their names, among the records."""
        return {record.key: place for place, record in enumerate(self.records)}

    @cached_property
    def table(self) -> ClipTable:
        """All figures of the records."""
        return ClipTable.of(self.records, self.classes)

    def sums(self, frames: Span = "2-last", region: Region = "all", keys: Sequence[str] | None = None) -> Sums:
        """By scene, for some frames and pixels; of the clips of these names, or of all."""
        return self.table.scene_sums(frames, region, None if keys is None else [self.places[key] for key in keys])

    def common_keys(self, other: "MethodRecords") -> tuple[str, ...]:
        """The clips that both were measured on, in this one's order."""
        return tuple(key for key in self.places if key in other.places)


@dataclass(frozen=True, kw_only=True)
class EvaluatedSet:
    """Methods that were measured on the same clips, by one run or by several.

    note: of the first run. methods: in the order of the runs.
    """

    note: RunNote
    methods: tuple[MethodRecords, ...]

    @property
    def title(self) -> str:
        """What the clips are, in a few words."""
        names = ", ".join(dict.fromkeys("/".join(Path(folder).parts[-2:]) or folder for folder in self.note.data))
        return f"{_KINDS[self.note.kind]} ({names}), {_PROTOCOLS[self.note.protocol]}"

    @cached_property
    def clips(self) -> dict[str, ClipRecord]:
        """All clips that any method was measured on by name, each with its first record, of whole frames if there is
        one."""
        found: dict[str, ClipRecord] = {}
        whole_first = sorted(self.methods, key=lambda method: method.crop is not None)
        for record in (record for method in whole_first for record in method.records):
            found.setdefault(record.key, record)
        return found

    @property
    def wanted(self) -> int:
        """How many clips were to be measured; more than `clips` where some have no record of any method."""
        return max(self.note.clips, len(self.clips))

    @property
    def scenes(self) -> int:
        """How many scenes these clips are of."""
        return len({record.scene for record in self.clips.values()})

    @property
    def regions(self) -> tuple[Region, ...]:
        """All, and the others where somebody knows which they are."""
        return tuple(region for region in REGIONS if any(region in each.regions for each in self.clips.values()))

    @property
    def folders(self) -> str:
        """Of all runs that its methods are from, in one line."""
        return ", ".join(dict.fromkeys(str(method.folder) for method in self.methods))

    def method(self, name: str) -> MethodRecords:
        """The one of this name, which there must be."""
        return next(each for each in self.methods if each.name == name)


_KINDS = {"kubric": "Kubric-4D layout", "driving": "Driving", "orbit": "Orbits", "anyview": "Episodes"}
_PROTOCOLS = {
    "paper": "the paper's protocol",
    "release": "the released script's protocol",
    "pairs": "pairs of clips",
    "anyviewbench": "AnyViewBench's protocol",
}


def gather(runs: Sequence[Run]) -> tuple[EvaluatedSet, ...]:
    """Sets of clips, in the order of the runs; runs on the same clips make one set.

    Raises RunError where two runs name two different methods alike.
    """
    notes, sets = dict[str, RunNote](), dict[str, dict[str, MethodRecords]]()
    for run in runs:
        notes.setdefault(run.note.data_identity, run.note)
        found = sets.setdefault(run.note.data_identity, {})
        for name in dict.fromkeys(record.method for record in run.records):
            method = MethodRecords(
                name=name,
                details=run.note.methods.get(name, {}),
                folder=run.folder,
                records=tuple(record for record in run.records if record.method == name),
                classes=len(run.note.classes),
            )
            other = found.get(name, method)
            more = max(other, method, key=lambda each: len(each.records))
            views = Path("views", folder_name(name))  # those of one run
            kept = (each.folder for each in (more, other, method) if (each.folder / views).is_dir())
            found[name] = replace(more, folder=next(kept, more.folder))
            # frames from elsewhere are known by their content, and LPIPS may have been left out of one of the two
            left_out = {FRAMES_IN} if LPIPS in other.details and LPIPS in method.details else {FRAMES_IN, LPIPS}
            keys = (other.details.keys() | method.details.keys()) - left_out
            if any(other.details.get(key) != method.details.get(key) for key in keys):
                raise RunError(
                    f"{name} is another method in {other.folder} than in {run.folder}: {other.details} and "
                    f"{method.details}; measure it alike in both, give one another name, or report the runs apart"
                )
    return tuple(EvaluatedSet(note=note, methods=tuple(sets[key].values())) for key, note in notes.items())


_SAME_CHANGE = 0.01  # degrees and metres
_SAME_FIGURE = 1e-4  # of the larger one: two cameras at one goal see one picture, the next moment differs by 1e-3


def targets_apart(one: ClipRecord, other: ClipRecord, frames: Span = "last") -> str:
    """Why two clips of one name do not have the same target in these frames, in words; empty where they have.

    Known by where the camera goes and how sharp the target is, frame by frame.
    """
    if one.crop != other.crop:
        return "one is measured on a part of each frame, the other on another part or all of it"
    changes = [np.array(each.change if each.change is not None else (np.nan,) * 3) for each in (one, other)]
    if not np.allclose(*changes, rtol=0.0, atol=_SAME_CHANGE, equal_nan=True):
        ways = [
            "its fixed path"
            if each.change is None
            else "by azimuth {:+.1f}, elevation {:+.1f}, radius {:+.1f}".format(*each.change)
            for each in (one, other)
        ]
        return f"the camera goes {ways[0]} and {ways[1]}"
    chosen = FRAMES_OF[frames]
    sharp = [np.array(each.regions["all"].gradient_target[chosen], np.float64) for each in (one, other)]
    if sharp[0].shape != sharp[1].shape or not np.allclose(*sharp, rtol=_SAME_FIGURE, atol=1e-9, equal_nan=True):
        return "the target's pictures differ: other moments, or another path"
    return ""


def on_the_same_goals(sets: Sequence[EvaluatedSet]) -> tuple[tuple[EvaluatedSet, ...], tuple[str, ...]]:
    """Methods of several sets together, as far as clips of the same names end at the same goals.

    Gradual and direct models see other clips, but their last frames show the same: these can be compared. Clips of the
    same name that go elsewhere are left out. A method that several of the sets have is taken from the first.

    Returns: the sets, each put together from several; and what is not compared, and why, line by line.
    """
    groups, grown, notes = list[EvaluatedSet](), set[int](), list[str]()
    for each in sets:
        for place, group in enumerate(groups):
            if any(getattr(group.note, name) != getattr(each.note, name) for name in COMPARABLE):
                continue
            shared = group.clips.keys() & each.clips.keys()
            why = {key: targets_apart(group.clips[key], each.clips[key]) for key in group.clips if key in shared}
            apart = [key for key, reason in why.items() if reason]
            if apart:
                notes.append(
                    f"{group.folders} and {each.folders}: of {len(why)} clips of the same names {len(apart)} do not "
                    f"end at the same goal, so they are not compared. In {apart[0]} {why[apart[0]]}."
                )
            if len(apart) < len(why):
                groups[place] = _joined(group, each, shared.difference(apart), notes)
                grown.add(place)
                break
        else:
            groups.append(each)
    return tuple(groups[place] for place in sorted(grown)), tuple(notes)


def _joined(first: EvaluatedSet, other: EvaluatedSet, keys: set[str], notes: list[str]) -> EvaluatedSet:
    """The first with the other's methods on these clips; of two methods of one name the first's is kept, and noted."""
    methods = {method.name: method for method in first.methods}
    for method in other.methods:
        records = tuple(record for record in method.records if record.key in keys)
        known = methods.setdefault(method.name, replace(method, records=records)) if records else method
        if known.details != method.details:
            notes.append(
                f"{method.name} is another method in {method.folder} than in {known.folder}, and only the latter "
                "stands in the table of both; rename one of the two to compare them"
            )
    note = msgspec.structs.replace(first.note, data=(*first.note.data, *other.note.data))
    return replace(first, note=note, methods=tuple(methods.values()))
