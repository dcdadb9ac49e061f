"""A comparison of two runs in words, as tables and as JSON. Nothing here prints."""

import math
from typing import Any

from rich.table import Table

from gcd_node.replay.run_diff import MAP_NAMES, Distance, Missing, RunComparison, Tolerance, ViewComparison

_ROWS = 40
_LINES = 10


def verdict(comparison: RunComparison, tolerance: Tolerance) -> str:
    """How the comparison ends, in one line."""
    total = len(comparison.views) + len(comparison.missing)
    same = sum(view.identical for view in comparison.views)
    if same == total:
        return f"identical: all {total} views"
    far = len(comparison.failures(tolerance))
    if not far:
        return f"near enough: {same} of {total} views are identical, the others {_bounds(tolerance)}"
    return f"DIFFERENT: {far} of {total} views are not {_bounds(tolerance)}"


def divergence(comparison: RunComparison) -> str | None:
    """Where the runs first differ and what that says, in one line; None if they are identical."""
    first = comparison.first_divergence
    if first is None:
        return None
    cause = _cause(first) if isinstance(first, ViewComparison) else ""
    return f"first divergence: window {first.window_id}, view {first.view_id}: {describe(first)}{cause}"


def _cause(first: ViewComparison) -> str:
    if not first.same_input:
        return "; the model was given other pictures already: look at the recording and its decoder"
    if not first.same_seed:
        return "; the model was given the same pictures and another seed, as any other setting brings one"
    return "; the model was given the same pictures"


def describe(each: ViewComparison | Missing) -> str:
    """One view of one window in words."""
    if isinstance(each, Missing):
        return f"only in {each.only_in}"
    if each.identical:
        return "identical"
    parts = [] if each.distance is None else _apart(each.distance)
    return "; ".join(parts + [f"other {fact}" for fact in each.facts])


def report_text(comparison: RunComparison, tolerance: Tolerance) -> str:
    """The whole comparison for an assertion or a log: verdict, causes, first divergence, the worst views."""
    lines = [verdict(comparison, tolerance)]
    if comparison.facts:
        lines += ["what A and B were made from differs (A, B):"]
        lines += [f"  {fact.name}: {fact.a}, {fact.b}" for fact in comparison.facts]
    first, failures = divergence(comparison), comparison.failures(tolerance)
    lines += [] if first is None else [first]
    lines += [f"  window {each.window_id}, view {each.view_id}: {describe(each)}" for each in failures[:_LINES]]
    lines += [f"  and {len(failures) - _LINES} more"] if len(failures) > _LINES else []
    return "\n".join(lines)


def facts_table(comparison: RunComparison) -> Table:
    """What the runs were made from, as far as it differs."""
    table = Table("differs", "A", "B", title="What the runs were made from", title_style="dim")
    for fact in comparison.facts:
        table.add_row(fact.name, fact.a, fact.b)
    return table


def views_table(comparison: RunComparison, tolerance: Tolerance) -> Table:
    """Every view of every window; of a long comparison the first of those that differ."""
    rows = sorted((*comparison.views, *comparison.missing), key=lambda each: (each.window_id, each.view_id))
    if len(rows) > _ROWS:
        rows = [each for each in rows if isinstance(each, Missing) or not each.identical]
    table = Table(title="Views of windows", title_style="dim")
    for name in ("window", "view", "PSNR dB", "worst frame", "class pixels", "what"):
        table.add_column(name, justify="right" if name in ("window", "PSNR dB", "class pixels") else "left")
    failures = set(comparison.failures(tolerance))
    for each in rows[:_ROWS]:
        table.add_row(*_row(each), style="red" if each in failures else None)
    if len(rows) > _ROWS:
        table.caption = f"and {len(rows) - _ROWS} more that differ; --json has them all"
    return table


def to_plain(comparison: RunComparison, tolerance: Tolerance) -> dict[str, Any]:
    """Everything as plain values for JSON. The PSNR of identical pictures, which is infinite, is null."""
    first = comparison.first_divergence
    return {
        "a": str(comparison.a),
        "b": str(comparison.b),
        "passed": not comparison.failures(tolerance),
        "identical": first is None,
        "min_psnr_db": tolerance.min_psnr_db,
        "max_class_share": tolerance.max_class_share,
        "facts": [{"name": fact.name, "a": fact.a, "b": fact.b} for fact in comparison.facts],
        "first_divergence": None if first is None else {"window_id": first.window_id, "view": first.view_id},
        "views": [_plain_view(view, tolerance) for view in comparison.views],
        "missing": [
            {"window_id": each.window_id, "view": each.view_id, "only_in": each.only_in} for each in comparison.missing
        ],
    }


def _bounds(tolerance: Tolerance) -> str:
    least_db, share = tolerance.min_psnr_db, tolerance.max_class_share
    pictures = "identical" if least_db is None else f"within {least_db:g} dB in every frame"
    return pictures if share == 0 else f"{pictures} and {share:.2%} of the class pixels"


def _apart(distance: Distance) -> list[str]:
    parts: list[str] = []
    if distance.largest:
        parts.append(
            f"{distance.psnr_db:.2f} dB, frame {distance.worst_frame} {distance.worst_psnr_db:.2f} dB, "
            f"up to {distance.largest} levels"
        )
    names = {**MAP_NAMES, "cls": "class"}
    return parts + [f"{share:.3%} of the {names[kind]} pixels" for kind, share in distance.shares if share]


def _row(each: ViewComparison | Missing) -> tuple[str, ...]:
    distance = None if isinstance(each, Missing) else each.distance
    if distance is None:
        return str(each.window_id), each.view_id, "", "", "", describe(each)
    share = "" if distance.class_share is None else f"{distance.class_share:.3%}"
    if distance.largest == 0:
        return str(each.window_id), each.view_id, "identical", "", share, _facts(each)
    worst = f"{distance.worst_frame}: {distance.worst_psnr_db:.2f} dB"
    return str(each.window_id), each.view_id, f"{distance.psnr_db:.2f}", worst, share, _facts(each)


def _facts(each: ViewComparison | Missing) -> str:
    """What the other columns do not say."""
    if isinstance(each, Missing):
        return ""
    shares = () if each.distance is None else each.distance.shares
    maps = [f"{share:.3%} of {MAP_NAMES[kind]}" for kind, share in shares if share and kind != "cls"]
    return ", ".join([*maps, *(f"other {fact}" for fact in each.facts)])


def _plain_view(view: ViewComparison, tolerance: Tolerance) -> dict[str, Any]:
    distance = view.distance
    plain: dict[str, Any] = {
        "window_id": view.window_id,
        "view": view.view_id,
        "identical": view.identical,
        "passed": view.within(tolerance),
        "other": list(view.facts),
        "same_input": view.same_input,
        "same_seed": view.same_seed,
    }
    if distance is None:
        return plain
    return plain | {
        "psnr_db": _finite(distance.psnr_db),
        "worst_frame": distance.worst_frame,
        "worst_psnr_db": _finite(distance.worst_psnr_db),
        "largest": distance.largest,
        "class_share": distance.class_share,
        "shares": dict(distance.shares),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
