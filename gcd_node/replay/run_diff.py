"""Two runs, window by window: the same pixels, or how far apart they are."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import UsageError
from gcd_node.replay.manifest import ViewEntry, WindowEntry
from gcd_node.replay.pixel_file import Pixels
from gcd_node.replay.run_facts import Fact, different_facts
from gcd_node.replay.run_folder import RunFolder, WindowPixels, read_windows

MAP_NAMES = {"cls": "class map", "vis": "visibility", "depth": "depth"}
"""Of each kind of map, for people."""

_TOP = 255.0
_DEPTH_SLACK = 0.01  # ten times what f16 rounds away, a tenth of what depth networks err


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
    shares: tuple[tuple[str, float], ...] = ()
    worst_class_frame: int = 0

    @property
    def class_share(self) -> float | None:
        """Of the class map's pixels, how many differ; None if there is none."""
        return dict(self.shares).get("cls")

    @property
    def worst_share(self) -> float:
        """Of the map that differs most."""
        return max((share for _, share in self.shares), default=0.0)


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
        different = [*(view for view in self.views if not view.identical), *self.missing]
        return min(different, key=lambda each: each.window_id, default=None)

    def failures(self, tolerance: Tolerance) -> tuple[ViewComparison | Missing, ...]:
        """Everything that is not near enough, by window."""
        far = [*(view for view in self.views if not view.within(tolerance)), *self.missing]
        return tuple(sorted(far, key=lambda each: (each.window_id, each.view_id)))

    def worst(self, count: int) -> tuple[ViewComparison, ...]:
        """Views whose pictures differ, those first that differ most; at most so many."""
        differing = [view for view in self.views if view.distance is not None and not _same(view.distance)]
        return tuple(sorted(differing, key=_badness)[:count])


def compare(a: RunFolder, b: RunFolder) -> RunComparison:
    """Compare two runs; every pixel of both is read and checked against its digest.

    Windows belong together by window_id.
    Raises:
        DamagedRunError: see read_windows().
    """
    views: list[ViewComparison] = []
    missing: list[Missing] = []
    same_size = a.manifest.size == b.manifest.size
    for in_a, in_b in paired_windows(a, b):
        views_a = {} if in_a is None else in_a.entry.views
        views_b = {} if in_b is None else in_b.entry.views
        one = in_a or in_b
        assert one is not None, "a pair has at least one window"
        for view_id in dict.fromkeys((*views_a, *views_b)):
            if in_a is not None and in_b is not None and view_id in views_a and view_id in views_b:
                views.append(_compare_view(view_id, in_a, in_b, same_size=same_size))
            else:
                only_in = "A" if view_id in views_a else "B"
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
    facts = [*_different(a.entry, b.entry, ("stamps", "seqs", "epoch")), *_different(entry_a, entry_b, ("ood",))]
    maps = a.maps[view_id], b.maps[view_id]
    facts += [] if same_size else ["size"]
    facts += [MAP_NAMES[kind] for kind in MAP_NAMES if (kind in maps[0]) != (kind in maps[1])]
    return ViewComparison(
        window_id=a.entry.window_id,
        view_id=view_id,
        facts=tuple(facts),
        same_input=a.entry.input_sha256 == b.entry.input_sha256,
        same_seed=entry_a.seed == entry_b.seed,
        distance=_distance(a.pictures[view_id], b.pictures[view_id], maps) if same_size else None,
    )


def _different(a: WindowEntry | ViewEntry, b: WindowEntry | ViewEntry, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if getattr(a, name) != getattr(b, name)]


def _distance(a: Pixels, b: Pixels, maps: tuple[dict[str, Pixels], dict[str, Pixels]]) -> Distance:
    squares = [float(cv2.norm(one, other, cv2.NORM_L2SQR)) for one, other in zip(a, b, strict=True)]
    worst = int(np.argmax(squares))
    shares = {kind: _shares(kind, maps[0][kind], maps[1][kind]) for kind in MAP_NAMES if all(kind in m for m in maps)}
    return Distance(
        psnr_db=psnr_db(sum(squares), a.size),
        worst_frame=worst,
        worst_psnr_db=psnr_db(squares[worst], a[worst].size),
        largest=max(int(cv2.absdiff(one, other).max()) for one, other in zip(a, b, strict=True)),
        shares=tuple((kind, float(frames.mean())) for kind, frames in shares.items()),
        worst_class_frame=int(np.argmax(shares["cls"])) if "cls" in shares else 0,
    )


def _shares(kind: str, a: Pixels, b: Pixels) -> NDArray[np.float64]:
    """Of each frame's pixels, how many differ: [T]. A frame whose depth differs by less than 1 % counts one pixel."""
    if kind != "depth":
        return (a != b).mean(axis=(1, 2))
    one, other = (np.ascontiguousarray(each).view("<f2").astype(np.float32) for each in (a, b))
    far = (np.abs(one - other) > _DEPTH_SLACK * np.maximum(one, other)).mean(axis=(1, 2))
    return np.maximum(far, (a != b).any(axis=(1, 2)) / one[0].size)


def _same(distance: Distance) -> bool:
    return distance.largest == 0 and distance.worst_share == 0


def _badness(view: ViewComparison) -> tuple[float, float, int]:
    distance = view.distance
    assert distance is not None, "only views with pictures of one size are put in order"
    return distance.worst_psnr_db, -distance.worst_share, view.window_id
