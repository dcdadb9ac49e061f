"""Runs of evaluations put together: what was measured on the same clips stands in the same tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from gcd_train.baselines import FROM_EXACT_CLASSES
from gcd_train.errors import RunError
from gcd_train.evaluation.keeping import read_run
from gcd_train.evaluation.record import FRAMES_IN, LPIPS, REGIONS, ClipRecord, Region, RunNote

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
            if not _alike(other.details, method.details):
                raise RunError(
                    f"{method.name} is another method in {other.folder} than in {run.folder}: {other.details} and "
                    f"{method.details}; measure it alike in both, give one another name, or report the runs apart"
                )
    return EvaluatedSet(note=runs[0].note, runs=runs, methods=tuple(found.values()))


def _alike(first: Mapping[str, str], other: Mapping[str, str]) -> bool:
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
