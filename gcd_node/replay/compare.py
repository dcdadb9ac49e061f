"""Two runs, window by window: what differs, how far the pixels are apart, and what the two were made from."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np

from gcd_model import printable
from gcd_node.errors import UsageError
from gcd_node.replay.run import KeptKind, Manifest, Pixels, RunFolder, WindowEntry

_MAP_NAMES: dict[KeptKind, str] = {"cls": "class map", "vis": "visibility", "depth": "depth"}
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
class Difference:
    """One view of one window that is not the same in both runs.

    facts: what must agree and does not: "only in A", "stamps_ns", "seqs", "epoch", "ood", "size", the name of a map.
    worst_psnr_db, worst_frame: of the frame that differs most, infinite if none does. shares: of the pixels of each
    kind of map, how many differ. cause: what of the model's input was another already: "pictures", "seed", or "".
    """

    window_id: int
    view_id: str
    facts: tuple[str, ...] = ()
    worst_psnr_db: float = math.inf
    worst_frame: int = 0
    shares: dict[str, float] = field(default_factory=dict[str, float])
    cause: str = ""

    def within(self, tolerance: Tolerance) -> bool:
        """Whether all that must agree does, and the pictures are near enough."""
        least_db = math.inf if tolerance.min_psnr_db is None else tolerance.min_psnr_db
        share = max(self.shares.values(), default=0.0)
        return not self.facts and self.worst_psnr_db >= least_db and share <= tolerance.max_class_share

    def __str__(self) -> str:
        parts = [each if each.startswith("only in ") else f"other {each}" for each in self.facts]
        parts += [f"frame {self.worst_frame} {self.worst_psnr_db:.2f} dB"] if self.worst_psnr_db < math.inf else []
        parts += [f"{share:.3%} of the {kind}" for kind, share in self.shares.items() if share]
        return f"window {self.window_id}, view {self.view_id}: {'; '.join(parts)}"


@dataclass(frozen=True, kw_only=True, slots=True)
class RunComparison:
    """Two runs, a and b. facts: what they were made from, in A and in B, where it differs, by names such as
    `config model.steps` or `weights sha256_12`. views: how many, of all windows. differences: those that are not the
    same, by window. As JSON, the infinite PSNR of identical pictures is null."""

    a: str
    b: str
    facts: dict[str, tuple[str, str]]
    views: int
    differences: tuple[Difference, ...]

    def failures(self, tolerance: Tolerance) -> tuple[Difference, ...]:
        """Every view that is not near enough."""
        return tuple(each for each in self.differences if not each.within(tolerance))


def compare(a: RunFolder, b: RunFolder) -> RunComparison:
    """Compare two runs; every pixel of both is read and checked against its digest.

    Windows belong together by window_id.
    Raises:
        DamagedRunError: see RunFolder.read_view().
    """
    of_a, of_b = (
        {(window.window_id, view_id): window for window in run.manifest.windows for view_id in window.views}
        for run in (a, b)
    )
    views = sorted(of_a | of_b)
    compared = (_compare_view(a, b, view_id, of_a.get((w, view_id)), of_b.get((w, view_id))) for w, view_id in views)
    differences = tuple(each for each in compared if not each.within(Tolerance()))
    facts_a, facts_b = dict(_facts(a.manifest)), dict(_facts(b.manifest))
    pairs = {name: (facts_a.get(name, "-"), facts_b.get(name, "-")) for name in facts_a | facts_b}
    different = {printable(name): (printable(one), printable(two)) for name, (one, two) in pairs.items() if one != two}
    return RunComparison(a=str(a.path), b=str(b.path), facts=different, views=len(views), differences=differences)


def _compare_view(
    run_a: RunFolder, run_b: RunFolder, view_id: str, a: WindowEntry | None, b: WindowEntry | None
) -> Difference:
    if a is None or b is None:
        (only,) = (each for each in (a, b) if each is not None)
        return Difference(window_id=only.window_id, view_id=view_id, facts=("only in B" if a is None else "only in A",))
    pixels_a, pixels_b = run_a.read_view(a, view_id), run_b.read_view(b, view_id)
    facts = [name for name in ("stamps_ns", "seqs", "epoch", "ood") if getattr(a, name) != getattr(b, name)]
    facts += [name for kind, name in _MAP_NAMES.items() if (kind in pixels_a) != (kind in pixels_b)]
    both: list[KeptKind] = [kind for kind in pixels_a if kind in pixels_b]
    if any(pixels_a[kind].shape != pixels_b[kind].shape for kind in both):
        return Difference(window_id=a.window_id, view_id=view_id, facts=(*facts, "size"))
    psnr_db = [_psnr_db(*pair) for pair in zip(pixels_a["win"], pixels_b["win"], strict=True)]
    cause = "" if a.seed == b.seed else "seed"
    return Difference(
        window_id=a.window_id,
        view_id=view_id,
        facts=tuple(facts),
        worst_psnr_db=min(psnr_db),
        worst_frame=int(np.argmin(psnr_db)),
        shares={_MAP_NAMES[kind]: _share(kind, pixels_a[kind], pixels_b[kind]) for kind in both if kind != "win"},
        cause=cause if a.input_sha256 == b.input_sha256 else "pictures",
    )


def _psnr_db(a: Pixels, b: Pixels) -> float:
    """Peak signal-to-noise ratio of two pictures."""
    squares = float(cv2.norm(a, b, cv2.NORM_L2SQR))
    return math.inf if squares == 0 else 10 * math.log10(255**2 * a.size / squares)


def _share(kind: KeptKind, a: Pixels, b: Pixels) -> float:
    """Of the pixels, how many differ. A frame whose depth differs by less than 1 % counts one pixel."""
    if kind != "depth":
        return float((a != b).mean())
    one, other = (each.view("<f2").astype(np.float32) for each in (a, b))
    far = (np.abs(one - other) > _DEPTH_SLACK * np.maximum(one, other)).mean(axis=(1, 2))
    return float(np.maximum(far, (a != b).any(axis=(1, 2)) / one[0].size).mean())


def _facts(manifest: Manifest) -> Iterator[tuple[str, str]]:
    """What a run was made from: settings, weights, recording, versions, machine, totals, troubles; in this order."""
    yield from _flat("config", {key: manifest.config.get(key) for key in _SECTIONS})
    yield from manifest.made_from.items()
    totals = {"frames": manifest.frames, "windows": len(manifest.windows), "nan_windows": manifest.nan_windows}
    yield from _flat("total", {**totals, "rejected": manifest.rejected})
    yield from _flat("trouble", manifest.troubles)


def _flat(group: str, table: Mapping[str, object], place: str = "") -> Iterator[tuple[str, str]]:
    """Names and values of all leaves, tables within tables joined by points."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(group, value, f"{place}{key}.")
        elif value is not None:
            yield f"{group} {place}{key}", value if isinstance(value, str) else msgspec.json.encode(value).decode()


def report_text(comparison: RunComparison, tolerance: Tolerance) -> str:
    """The whole comparison in words: verdict, causes, first divergence, and the first views that are too far apart."""
    total, different, failures = comparison.views, comparison.differences, comparison.failures(tolerance)
    lines = [f"DIFFERENT: {len(failures)} of {total} views are not {tolerance}"]
    if not different:
        lines = [f"identical: all {total} views"]
    elif not failures:
        lines = [f"near enough: {total - len(different)} of {total} views are identical, the others {tolerance}"]
    if comparison.facts:
        lines += ["what A and B were made from differs (A, B):"]
        lines += [f"  {name}: {a}, {b}" for name, (a, b) in comparison.facts.items()]
    if different:
        causes = {
            "pictures": "; the model was given other pictures already: look at the recording and its decoder",
            "seed": "; the model was given the same pictures and another seed, as any other setting brings one",
        }
        same = "" if different[0].facts else "; the model was given the same pictures"
        lines.append(f"first divergence: {different[0]}{causes.get(different[0].cause, same)}")
    lines += [f"  {each}" for each in failures[:_LINES]]
    lines += [f"  and {len(failures) - _LINES} more"] if len(failures) > _LINES else []
    return "\n".join(lines)
