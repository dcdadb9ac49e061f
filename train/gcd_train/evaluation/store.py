"""A run's folder: what it says of itself, one record for each method and clip, and the frames that are kept.

    run.json                         what all records have in common (RunNote)
    records/METHOD/KEY.json          one method on one clip (ClipRecord)
    views/METHOD/KEY/sample_0/0000.png
                                     frames that a method made; source/ and target/ beside. views/METHOD is a folder
                                     that `--predictions` reads.

Files appear whole or not at all, so a run that was killed goes on where it stopped.
"""

import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar, get_args

import msgspec

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import RunError
from gcd_train.files import only_writer, write_whole

Region: TypeAlias = Literal["all", "visible", "occluded"]
"""Which pixels of the target: all, those the source camera saw too, or the others."""

REGIONS: tuple[Region, ...] = get_args(Region)

FRAMES_IN, LPIPS = "frames in", "lpips"
"""In what a note says of a method: where another method's frames lie, and which LPIPS it was measured with."""

Box: TypeAlias = tuple[int, int, int, int]
"""A part of a picture: left and top edge, width and height, pixels."""

Frames: TypeAlias = tuple[float | None, ...]
"""A value of each frame, from the first; None where there is no pixel to measure."""

Counted: TypeAlias = tuple[tuple[int, int, int], ...]
"""Pixels of one frame as (true class, predicted class, how many), only what occurs; predicted 255 is no class."""


class RegionRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One method's figures on some pixels of one clip.

    pixels: share of the frame, or of the part of it that is measured, T. psnr_db, ssim: [S][T]. diversity: T, None for
    fewer than two draws. gradient, gradient_target: [S][T] and T, mean length of the gradient. confusion: [T], summed
    over draws; None where there are no classes. What is of the method's pictures is None where it makes none.
    """

    pixels: tuple[float, ...]
    psnr_db: tuple[Frames, ...] | None = None
    ssim: tuple[Frames, ...] | None = None
    diversity: Frames | None = None
    gradient: tuple[Frames, ...] | None = None
    gradient_target: Frames
    confusion: tuple[Counted, ...] | None = None


class ClipRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One method on one clip of T frames, in S draws.

    method: its name. privileged: whether it is given the exact depth, or further cameras. key: of the clip in its set.
    scene: the clip's; errors are over scenes. change: azimuth and elevation in degrees and radius in metres from source
    to goal; None for the fixed path of driving. fps: of the clip. seconds: that the method took. regions: by name;
    "visible" and "occluded" are missing where nobody knows what the source camera saw.
    lpips: [S][T], None where no weights were given. step, step_target: [S][T-1] and T-1, mean change from frame to
    frame; step is None where the method makes no pictures. crop: the part of the target that the method covers; all
    figures, the target's too, are of that part alone. None for all of it.
    """

    method: str
    privileged: bool
    key: str
    scene: str
    change: tuple[float, float, float] | None
    frames: int
    fps: float
    draws: int
    seconds: float
    regions: dict[Region, RegionRecord]
    lpips: tuple[Frames, ...] | None = None
    step: tuple[tuple[float, ...], ...] | None = None
    step_target: tuple[float, ...]
    crop: Box | None = None


class RunNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all records of a run have in common; `run.json`.

    command: the line that began it. made: UTC, ISO 8601. versions: of gcd-node, torch, python. data: folders.
    data_identity: digest of the clips. kind: "kubric", "driving", "orbit" or "anyview": which tables they belong to.
    modality: of the target pictures. protocol: "paper", "release", "pairs" or "anyviewbench". frames, height, width: of
    the longest clip and the largest, where they differ. clips: how many were to be measured. classes: names, empty for
    none. groups: of a benchmark: names of the clips of each split, by group. splits: of a benchmark: how many
    episodes each has.
    methods: name to what it is: a weight file's digest, steps, guidance, draws, seed, views; all as text.
    """

    command: str
    made: str
    versions: dict[str, str]
    data: tuple[str, ...]
    data_identity: str
    kind: Literal["kubric", "driving", "orbit", "anyview"]
    modality: Literal["rgb", "semantic"]
    protocol: Literal["paper", "release", "pairs", "anyviewbench"]
    frames: int
    height: int
    width: int
    seed: int
    clips: int = 0
    classes: tuple[str, ...] = ()
    groups: dict[str, dict[str, tuple[str, ...]]] = {}
    splits: dict[str, int] = {}
    methods: dict[str, dict[str, str]] = {}


Stored = TypeVar("Stored", RunNote, ClipRecord)

RUN_FILE = "run.json"
_MOST_BYTES = 1 << 24
COMPARABLE = ("kind", "modality", "protocol", "frames", "height", "width", "classes")
"""What the notes of two runs must have alike before any of their figures are compared."""
_SHOWN = 48  # letters of a value in a message


def folder_name(name: str) -> str:
    """A method's or a clip's name as the name of a folder or file: letters, digits, dots, underscores, hyphens."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_.") or "_"


@dataclass(frozen=True, slots=True)
class RunKeeper:
    """Keeps the records of one run in its folder."""

    folder: Path

    @contextmanager
    def in_use(self, note: RunNote) -> Generator[None]:
        """`begin`, and no other line measures in the folder until the block is left. Raises RunError where one does."""
        with only_writer(self.folder):
            self.begin(note)
            yield

    def begin(self, note: RunNote) -> RunNote:
        """Write `run.json`, or add this note's methods to the one that is there, whose command and time stay.

        A method without a record binds nobody: it is corrected, or dropped where this note does not name it, and a note
        of which no method is left is written anew.

        Returns: what now stands there.
        Raises:
            RunError: the folder holds records of another evaluation, two methods would share a folder, or nothing can
                be written.
        """
        path = self.folder / RUN_FILE
        if path.exists():
            found = _read(path, RunNote, "delete the run, or choose another folder")
            places = {name: self.folder / "records" / folder_name(name) for name in found.methods}
            kept = {name: found.methods[name] for name, place in places.items() if any(place.glob("*.json"))}
            note = _joined(self.folder, msgspec.structs.replace(found, methods=kept), note) if kept else note
        owners: dict[str, str] = {}
        for method in note.methods:
            other = owners.setdefault(folder_name(method), method)
            if other != method:
                raise RunError(
                    f"the methods {other!r} and {method!r} would share the folder {folder_name(method)}; rename one"
                )
        write_whole(path, msgspec.json.format(msgspec.json.encode(note), indent=1))
        return note

    def has(self, method: str, key: str) -> bool:
        """Whether there is a record."""
        return self._record(method, key).exists()

    def keep(self, record: ClipRecord) -> None:
        """Write a record; one that is there is replaced. Raises RunError if it cannot be written."""
        write_whole(self._record(record.method, record.key), msgspec.json.encode(record))

    def views(self, method: str, key: str) -> Path:
        """Where the frames of a method on a clip lie."""
        return self.folder / "views" / folder_name(method) / folder_name(key)

    def _record(self, method: str, key: str) -> Path:
        return self.folder / "records" / folder_name(method) / f"{folder_name(key)}.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """One run as it lies on the disk. folder: where its `run.json`, records and views are.

    records: method by method in the note's order, clips by name.
    """

    folder: Path
    note: RunNote
    records: tuple[ClipRecord, ...]

    @classmethod
    def read(cls, folder: Path) -> "Run":
        """Raises RunError where there is none, none of its clips is measured yet, or a file of it is damaged."""
        if not (folder / RUN_FILE).exists():
            raise RunError(f"{folder} holds no {RUN_FILE}; make a run with `gcd-train evaluate --out {folder}`")
        note = _read(folder / RUN_FILE, RunNote, "delete the run, or choose another folder")
        places = [folder / "records" / folder_name(method) for method in note.methods]
        cure = "delete it and evaluate again, the others are kept"
        records = [_read(path, ClipRecord, cure) for place in places for path in sorted(place.glob("*.json"))]
        if not records:
            raise RunError(f"{folder} holds no record yet; run `gcd-train evaluate --out {folder}` to its end")
        return cls(folder=folder, note=note, records=tuple(records))


def _read(path: Path, kind: type[Stored], cure: str) -> Stored:
    try:
        return read_json(path, kind, _MOST_BYTES)
    except FileError as error:
        raise RunError(f"{path} {error}; {cure}") from error


def _joined(folder: Path, found: RunNote, new: RunNote) -> RunNote:
    """The note that is there with the new methods. Raises RunError where records of both would not go together."""
    same = ("data_identity", *COMPARABLE, "seed")
    differ = {name: (getattr(found, name), getattr(new, name)) for name in same}
    differ["gcd-node"] = (found.versions.get("gcd-node"), new.versions.get("gcd-node"))
    for method in found.methods.keys() & new.methods.keys():
        was, now = found.methods[method], new.methods[method]
        names = dict.fromkeys([*was, *now])
        names.pop(FRAMES_IN, None)  # the digest says if frames are the same
        differ |= {f"{name} of {method}": (was.get(name, "not told"), now.get(name, "not told")) for name in names}
    told = [f"{name} was {_short(was)}, is {_short(now)}" for name, (was, now) in differ.items() if was != now]
    if told:
        raise RunError(
            f"{folder} holds records of another evaluation: {'; '.join(told)}. Choose another --out, or delete what is "
            f"to be measured anew: {folder / 'records'}/METHOD, or all"
        )
    methods = {**found.methods, **new.methods}
    return msgspec.structs.replace(found, methods=methods, clips=new.clips, splits=new.splits)


def _short(value: object) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
