"""Two runs, window by window: the same pixels, or how far apart they are; and what the two were made from."""

import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model import FileError, decode_toml, printable
from gcd_node.errors import DamagedRunError, OutputError, UsageError
from gcd_node.pictures.files import make_folder
from gcd_node.replay.run import (
    MANIFEST,
    Manifest,
    Pixels,
    RunFolder,
    WindowPixels,
    new_folder,
    open_run,
    read_windows,
)

MAP_NAMES = {"cls": "class map", "vis": "visibility", "depth": "depth"}
"""Of each kind of map, for people."""
ABSENT = "-"
"""Shown for what one of the runs does not have."""

_TOP = 255.0
_DEPTH_SLACK = 0.01  # ten times what f16 rounds away, a tenth of what depth networks err
_SECTIONS = ("strict", "source", "model", "view", "window")  # what a replay uses of a launch file


@dataclass(frozen=True, kw_only=True, slots=True)
class Tolerance:
    """How far apart two runs may be.

    min_psnr_db: what each frame of each view must reach; None demands identical pixels.
    max_class_share: of the pixels of each map of a view in a window, how many may be of another class or visibility, or
        have a depth more than 1 % away, 0 to 1.
    Raises UsageError for numbers out of range.
    """

    min_psnr_db: float | None = None
    max_class_share: float = 0.0

    def __post_init__(self) -> None:
        if self.min_psnr_db is not None and not 0 < self.min_psnr_db < math.inf:
            raise UsageError(f"the lowest PSNR must be a positive number of decibels, got {self.min_psnr_db}")
        if not 0 <= self.max_class_share <= 1:
            raise UsageError(f"the share of class pixels that may differ lies in 0 to 1, got {self.max_class_share}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Distance:
    """How far the pictures of one view of one window are apart.

    psnr_db: of all T frames together, infinite if they are identical. worst_frame, worst_psnr_db: of the frame that
    differs most. largest: difference of any level, 0 to 255. shares: of the pixels of each kind of map that there is,
    how many differ. worst_class_frame: where most of the class map's do.
    """

    psnr_db: float
    worst_frame: int
    worst_psnr_db: float
    largest: int
    shares: dict[str, float]
    worst_class_frame: int = 0

    @property
    def worst_share(self) -> float:
        """Of the map that differs most."""
        return max(self.shares.values(), default=0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewComparison:
    """One view of one window that is in both runs.

    facts: what must agree and does not: "stamps", "seqs", "epoch", "ood", "size", the name of a map. distance: None if
    the pictures have different sizes. same_input, same_seed: the model was given the same pictures, and the same seed.
    """

    window_id: int
    view_id: str
    facts: tuple[str, ...]
    same_input: bool
    same_seed: bool
    distance: Distance | None

    @property
    def identical(self) -> bool:
        """Whether nothing at all differs."""
        return self.within(Tolerance())

    def within(self, tolerance: Tolerance) -> bool:
        """Whether all that must agree does, and the pictures are near enough."""
        distance = self.distance
        if self.facts or distance is None:
            return False
        least_db = math.inf if tolerance.min_psnr_db is None else tolerance.min_psnr_db
        return distance.worst_psnr_db >= least_db and distance.worst_share <= tolerance.max_class_share


@dataclass(frozen=True, kw_only=True, slots=True)
class Missing:
    """A view of a window that only one of the runs has: "A" or "B"."""

    window_id: int
    view_id: str
    only_in: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Fact:
    """Something the runs A and B do not have in common. name: such as `config model.steps` or `weights sha256_12`."""

    name: str
    a: str
    b: str


@dataclass(frozen=True, kw_only=True, slots=True)
class RunComparison:
    """Two runs. facts: what they were made from, as far as it differs. views, missing: by window, then view."""

    a: Path
    b: Path
    facts: tuple[Fact, ...]
    views: tuple[ViewComparison, ...]
    missing: tuple[Missing, ...]

    @property
    def first_divergence(self) -> ViewComparison | Missing | None:
        """The first view of the first window that is not identical; None if all are."""
        return next(iter(self.failures(Tolerance())), None)

    def failures(self, tolerance: Tolerance) -> tuple[ViewComparison | Missing, ...]:
        """Everything that is not near enough, by window."""
        far = [*(view for view in self.views if not view.within(tolerance)), *self.missing]
        return tuple(sorted(far, key=lambda each: (each.window_id, each.view_id)))

    def worst(self, count: int) -> tuple[ViewComparison, ...]:
        """Views whose pictures differ, those first that differ most; at most so many."""
        apart = [(view, view.distance) for view in self.views if view.distance is not None]
        differing = [(view, d) for view, d in apart if d.largest or d.worst_share]
        differing.sort(key=lambda each: (each[1].worst_psnr_db, -each[1].worst_share, each[0].window_id))
        return tuple(view for view, _ in differing[:count])


def compare(a: RunFolder, b: RunFolder) -> RunComparison:
    """Compare two runs; every pixel of both is read and checked against its digest.

    Windows belong together by window_id.
    Raises:
        DamagedRunError: see read_windows(); or the configuration of a manifest is not TOML.
    """
    views: list[ViewComparison] = []
    missing: list[Missing] = []
    same_size = a.manifest.size == b.manifest.size
    for in_a, in_b in paired_windows(a, b):
        ids_a, ids_b = ({} if each is None else each.views for each in (in_a, in_b))
        one = in_a or in_b
        assert one is not None, "a pair has at least one window"
        for view_id in dict.fromkeys((*ids_a, *ids_b)):
            if in_a is not None and in_b is not None and view_id in ids_a and view_id in ids_b:
                views.append(_compare_view(view_id, in_a, in_b, same_size=same_size))
            else:
                only_in = "A" if view_id in ids_a else "B"
                missing.append(Missing(window_id=one.entry.window_id, view_id=view_id, only_in=only_in))
    facts = different_facts(a.manifest, b.manifest)
    return RunComparison(a=a.path, b=b.path, facts=facts, views=tuple(views), missing=tuple(missing))


def paired_windows(a: RunFolder, b: RunFolder) -> Iterator[tuple[WindowPixels | None, WindowPixels | None]]:
    """The windows of two runs by window_id; None where one has no such window."""
    rest_a, rest_b = read_windows(a), read_windows(b)
    window_a, window_b = next(rest_a, None), next(rest_b, None)
    while window_a is not None or window_b is not None:
        id_a = math.inf if window_a is None else window_a.entry.window_id
        id_b = math.inf if window_b is None else window_b.entry.window_id
        yield window_a if id_a <= id_b else None, window_b if id_b <= id_a else None
        if id_a <= id_b:
            window_a = next(rest_a, None)
        if id_b <= id_a:
            window_b = next(rest_b, None)


def psnr_db(squares: float, count: int) -> float:
    """Peak signal-to-noise ratio of u8 pictures from the sum of squared differences of `count` levels."""
    return math.inf if squares == 0 else 10 * math.log10(_TOP**2 * count / squares)


def _compare_view(view_id: str, a: WindowPixels, b: WindowPixels, *, same_size: bool) -> ViewComparison:
    entry_a, entry_b = a.entry.views[view_id], b.entry.views[view_id]
    pixels_a, pixels_b = a.views[view_id], b.views[view_id]
    facts = [name for name in ("stamps", "seqs", "epoch") if getattr(a.entry, name) != getattr(b.entry, name)]
    facts += ["ood"] if entry_a.ood != entry_b.ood else []
    facts += [] if same_size else ["size"]
    facts += [name for kind, name in MAP_NAMES.items() if (kind in pixels_a) != (kind in pixels_b)]
    return ViewComparison(
        window_id=a.entry.window_id,
        view_id=view_id,
        facts=tuple(facts),
        same_input=a.entry.input_sha256 == b.entry.input_sha256,
        same_seed=entry_a.seed == entry_b.seed,
        distance=_distance(pixels_a, pixels_b) if same_size else None,
    )


def _distance(a: dict[str, Pixels], b: dict[str, Pixels]) -> Distance:
    pairs = list(zip(a["win"], b["win"], strict=True))
    squares = [float(cv2.norm(one, other, cv2.NORM_L2SQR)) for one, other in pairs]
    worst = int(np.argmax(squares))
    shares = {kind: _shares(kind, a[kind], b[kind]) for kind in MAP_NAMES if kind in a and kind in b}
    return Distance(
        psnr_db=psnr_db(sum(squares), a["win"].size),
        worst_frame=worst,
        worst_psnr_db=psnr_db(squares[worst], a["win"][worst].size),
        largest=max(int(cv2.absdiff(one, other).max()) for one, other in pairs),
        shares={kind: float(frames.mean()) for kind, frames in shares.items()},
        worst_class_frame=int(np.argmax(shares["cls"])) if "cls" in shares else 0,
    )


def _shares(kind: str, a: Pixels, b: Pixels) -> NDArray[np.float64]:
    """Of each frame's pixels, how many differ: [T]. A frame whose depth differs by less than 1 % counts one pixel."""
    if kind != "depth":
        return (a != b).mean(axis=(1, 2))
    one, other = (np.ascontiguousarray(each).view("<f2").astype(np.float32) for each in (a, b))
    far = (np.abs(one - other) > _DEPTH_SLACK * np.maximum(one, other)).mean(axis=(1, 2))
    return np.maximum(far, (a != b).any(axis=(1, 2)) / one[0].size)


# What two runs were made from.


def different_facts(a: Manifest, b: Manifest) -> tuple[Fact, ...]:
    """Everything that differs: settings, weights, recording, versions, machine, size, totals, troubles; in this order.

    Raises:
        DamagedRunError: the configuration of a manifest is not TOML.
    """
    all_a, all_b = dict(_facts(a)), dict(_facts(b))
    pairs = ((name, all_a.get(name, ABSENT), all_b.get(name, ABSENT)) for name in all_a | all_b)
    return tuple(Fact(name=printable(name), a=printable(a), b=printable(b)) for name, a, b in pairs if a != b)


def _facts(manifest: Manifest) -> Iterator[tuple[str, str]]:
    config = _config(manifest.config)
    yield from _flat("config", {key: config[key] for key in _SECTIONS if key in config})
    yield from manifest.made_from.items()
    yield from _flat("size", {**msgspec.to_builtins(manifest.size), "fps": manifest.fps})
    yield from _flat("total", msgspec.to_builtins(manifest.totals))
    for trouble in manifest.troubles:
        yield f"trouble {trouble.code} in window {trouble.window_id}", trouble.detail


def _config(text: str) -> Mapping[str, object]:
    try:
        return decode_toml(text)
    except FileError as error:
        raise DamagedRunError(f"the config in {MANIFEST} {error}; replay the recording again") from error


def _flat(group: str, table: Mapping[str, object], place: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of all leaves, tables within tables joined by points."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(group, value, f"{place}{key}.")
        elif value is not None:
            yield f"{group} {place}{key}", value if isinstance(value, str) else msgspec.json.encode(value).decode()


# Golden runs.


def renew_golden(run: RunFolder, golden: Path) -> bool:
    """Make `golden` a copy of the run; whether anything changed. A golden that already says the same stays untouched.

    Raises:
        OutputError: `golden` is something else than a run, or cannot be written. DamagedRunError: see compare().
    """
    if golden.is_dir() and any(golden.iterdir()):
        if not (golden / MANIFEST).is_file():
            raise OutputError(f"{golden} is there and is no golden run (it has no {MANIFEST}); name another folder")
        if _says_the_same(run, golden):
            return False
        try:
            shutil.rmtree(golden)
        except OSError as error:
            raise OutputError(f"cannot replace {golden}: {error.strerror}; check its permissions") from error
    make_folder(golden.parent)
    with new_folder(golden) as folder:
        shutil.copytree(run.path, folder, dirs_exist_ok=True)
    return True


def _says_the_same(run: RunFolder, golden: Path) -> bool:
    """A damaged golden, or one of an earlier version, never does."""
    try:
        comparison = compare(open_run(golden), run)
    except DamagedRunError:
        return False
    return comparison.first_divergence is None and not comparison.facts
