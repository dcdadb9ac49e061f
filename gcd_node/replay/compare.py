"""Two runs, window by window: the same pixels or how far apart, and what the two were made from; in words and as
JSON."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import cv2
import msgspec
import numpy as np

from gcd_model import FileError, decode_toml, printable
from gcd_node.errors import DamagedRunError, UsageError
from gcd_node.replay.run import MANIFEST, Manifest, Pixels, RunFolder, ViewPixels, WindowEntry, read_windows

_MAP_NAMES = {"cls": "class map", "vis": "visibility", "depth": "depth"}
_ABSENT = "-"  # shown for what one of the runs does not have
_TOP = 255.0
_DEPTH_SLACK = 0.01  # ten times what f16 rounds away, a tenth of what depth networks err
_SECTIONS = ("strict", "source", "model", "view", "window")  # what a replay uses of a launch file
_LINES = 10


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

    def __str__(self) -> str:
        pictures = "identical" if self.min_psnr_db is None else f"within {self.min_psnr_db:g} dB in every frame"
        return pictures + (f" and {self.max_class_share:.2%} of the class pixels" if self.max_class_share else "")


@dataclass(frozen=True, kw_only=True, slots=True)
class Distance:
    """How far the pictures of one view of one window are apart.

    psnr_db: of all T frames together, infinite if they are identical. worst_frame, worst_psnr_db: of the frame that
    differs most. largest: difference of any level, 0 to 255. shares: of the pixels of each kind of map that there is,
    how many differ.
    """

    psnr_db: float
    worst_frame: int
    worst_psnr_db: float
    largest: int
    shares: dict[str, float]


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewComparison:
    """One view of one window.

    only_in: the run that has it, if the other has not. facts: what must agree and does not: "stamps", "seqs", "epoch",
    "ood", "size", the name of a map. distance: None if there are no two pictures of one size. same_input, same_seed:
    the model was given the same pictures, and the same seed.
    """

    window_id: int
    view_id: str
    only_in: Literal["A", "B"] | None = None
    facts: tuple[str, ...] = ()
    same_input: bool = True
    same_seed: bool = True
    distance: Distance | None = None

    def within(self, tolerance: Tolerance) -> bool:
        """Whether all that must agree does, and the pictures are near enough."""
        if self.facts or self.distance is None:
            return False
        least_db = math.inf if tolerance.min_psnr_db is None else tolerance.min_psnr_db
        share = max(self.distance.shares.values(), default=0.0)
        return self.distance.worst_psnr_db >= least_db and share <= tolerance.max_class_share

    def __str__(self) -> str:
        parts = [f"window {self.window_id}, view {self.view_id}: "]
        parts += [f"only in {self.only_in}; "] if self.only_in else []
        if (far := self.distance) is not None:
            worst = f"frame {far.worst_frame} {far.worst_psnr_db:.2f} dB"
            parts += [f"{far.psnr_db:.2f} dB, {worst}, up to {far.largest} levels; "] if far.largest else []
            parts += [f"{share:.3%} of the {_MAP_NAMES[kind]}; " for kind, share in far.shares.items() if share]
        return "".join(parts + [f"other {fact}; " for fact in self.facts]).removesuffix("; ")


@dataclass(frozen=True, kw_only=True, slots=True)
class RunComparison:
    """Two runs. facts: what they were made from, in A and in B, where it differs, by names such as `config model.steps`
    or `weights sha256_12`. views: by window, those that only one has too."""

    a: RunFolder
    b: RunFolder
    facts: dict[str, tuple[str, str]]
    views: tuple[ViewComparison, ...]

    def failures(self, tolerance: Tolerance | None = None) -> tuple[ViewComparison, ...]:
        """Every view that is not near enough; without a tolerance, that is not identical."""
        return tuple(view for view in self.views if not view.within(tolerance or Tolerance()))


def compare(a: RunFolder, b: RunFolder) -> RunComparison:
    """Compare two runs; every pixel of both is read and checked against its digest.

    Windows belong together by window_id.
    Raises:
        DamagedRunError: see read_windows(); or the configuration of a manifest is not TOML.
    """
    views: list[ViewComparison] = []
    rest_a, rest_b = read_windows(a), read_windows(b)
    ids_a, ids_b = ({window.window_id for window in run.manifest.windows} for run in (a, b))
    for window_id in sorted(ids_a | ids_b):
        window_a, views_a = next(rest_a) if window_id in ids_a else (None, {})
        window_b, views_b = next(rest_b) if window_id in ids_b else (None, {})
        for view_id in dict.fromkeys((*views_a, *views_b)):
            pixels_a, pixels_b = views_a.get(view_id), views_b.get(view_id)
            if window_a is None or window_b is None or pixels_a is None or pixels_b is None:
                only_in = "B" if pixels_a is None else "A"
                views.append(ViewComparison(window_id=window_id, view_id=view_id, only_in=only_in))
            else:
                same_size = a.manifest.size == b.manifest.size
                distance = _distance(pixels_a, pixels_b) if same_size else None
                facts = [] if same_size else ["size"]
                facts += [name for kind, name in _MAP_NAMES.items() if (kind in pixels_a) != (kind in pixels_b)]
                views.append(_compare_view(view_id, window_a, window_b, facts, distance))
    for rest in (rest_a, rest_b):
        next(rest, None)  # to look at their ends
    facts_a, facts_b = dict(_facts(a.manifest)), dict(_facts(b.manifest))
    pairs = {name: (facts_a.get(name, _ABSENT), facts_b.get(name, _ABSENT)) for name in facts_a | facts_b}
    different = {printable(name): (printable(one), printable(two)) for name, (one, two) in pairs.items() if one != two}
    return RunComparison(a=a, b=b, facts=different, views=tuple(views))


def _compare_view(
    view_id: str, a: WindowEntry, b: WindowEntry, facts: list[str], distance: Distance | None
) -> ViewComparison:
    moments = [name for name in ("stamps", "seqs", "epoch") if getattr(a, name) != getattr(b, name)]
    moments += ["ood"] if a.views[view_id].ood != b.views[view_id].ood else []
    return ViewComparison(
        window_id=a.window_id,
        view_id=view_id,
        facts=(*moments, *facts),
        same_input=a.input_sha256 == b.input_sha256,
        same_seed=a.views[view_id].seed == b.views[view_id].seed,
        distance=distance,
    )


def _distance(a: ViewPixels, b: ViewPixels) -> Distance:
    pairs = list(zip(a["win"], b["win"], strict=True))
    squares = [float(cv2.norm(one, other, cv2.NORM_L2SQR)) for one, other in pairs]
    worst = int(np.argmax(squares))
    return Distance(
        psnr_db=_psnr_db(sum(squares), a["win"].size),
        worst_frame=worst,
        worst_psnr_db=_psnr_db(squares[worst], a["win"][worst].size),
        largest=max(int(cv2.absdiff(one, other).max()) for one, other in pairs),
        shares={kind: _share(kind, a[kind], b[kind]) for kind in _MAP_NAMES if kind in a and kind in b},
    )


def _psnr_db(squares: float, count: int) -> float:
    """Peak signal-to-noise ratio of u8 pictures from the sum of squared differences of `count` levels."""
    return math.inf if squares == 0 else 10 * math.log10(_TOP**2 * count / squares)


def _share(kind: str, a: Pixels, b: Pixels) -> float:
    """Of the pixels, how many differ. A frame whose depth differs by less than 1 % counts one pixel."""
    if kind != "depth":
        return float((a != b).mean())
    one, other = (np.ascontiguousarray(each).view("<f2").astype(np.float32) for each in (a, b))
    far = (np.abs(one - other) > _DEPTH_SLACK * np.maximum(one, other)).mean(axis=(1, 2))
    return float(np.maximum(far, (a != b).any(axis=(1, 2)) / one[0].size).mean())


def _facts(manifest: Manifest) -> Iterator[tuple[str, str]]:
    """What a run was made from: settings, weights, recording, versions, machine, size, totals, troubles; in this
    order."""
    try:
        config = decode_toml(manifest.config)
    except FileError as error:
        raise DamagedRunError(f"the config in {MANIFEST} {error}; replay the recording again") from error
    yield from _flat("config", {key: config[key] for key in _SECTIONS if key in config})
    yield from manifest.made_from.items()
    yield from _flat("size", {**msgspec.to_builtins(manifest.size), "fps": manifest.fps})
    yield from _flat("total", msgspec.to_builtins(manifest.totals))
    for trouble in manifest.troubles:
        yield f"trouble {trouble.code} in window {trouble.window_id}", trouble.detail


def _flat(group: str, table: Mapping[str, object], place: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of all leaves, tables within tables joined by points."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(group, value, f"{place}{key}.")
        elif value is not None:
            yield f"{group} {place}{key}", value if isinstance(value, str) else msgspec.json.encode(value).decode()


def report_text(comparison: RunComparison, tolerance: Tolerance) -> str:
    """The whole comparison in words: verdict, causes, first divergence, and the first views that are too far apart."""
    total, different, failures = len(comparison.views), comparison.failures(), comparison.failures(tolerance)
    lines = [f"DIFFERENT: {len(failures)} of {total} views are not {tolerance}"]
    if not different:
        lines = [f"identical: all {total} views"]
    elif not failures:
        lines = [f"near enough: {total - len(different)} of {total} views are identical, the others {tolerance}"]
    if comparison.facts:
        lines += ["what A and B were made from differs (A, B):"]
        lines += [f"  {name}: {a}, {b}" for name, (a, b) in comparison.facts.items()]
    if different:
        first = different[0]
        cause = "" if first.only_in else "; the model was given the same pictures"
        if not first.same_input:
            cause = "; the model was given other pictures already: look at the recording and its decoder"
        elif not first.same_seed:
            cause += " and another seed, as any other setting brings one"
        lines.append(f"first divergence: {first}{cause}")
    lines += [f"  {each}" for each in failures[:_LINES]]
    lines += [f"  and {len(failures) - _LINES} more"] if len(failures) > _LINES else []
    return "\n".join(lines)


def to_plain(comparison: RunComparison, tolerance: Tolerance) -> dict[str, Any]:
    """Everything as plain values for JSON, which has null for the PSNR of identical pictures, infinite here."""
    different = comparison.failures()
    first = {"window_id": different[0].window_id, "view_id": different[0].view_id} if different else None
    return {
        "a": str(comparison.a.path),
        "b": str(comparison.b.path),
        "passed": not comparison.failures(tolerance),
        "identical": not different,
        **asdict(tolerance),
        "facts": [{"name": name, "a": a, "b": b} for name, (a, b) in comparison.facts.items()],
        "first_divergence": first,
        "views": [
            {**asdict(view), "identical": view.within(Tolerance()), "passed": view.within(tolerance)}
            for view in comparison.views
        ],
    }
