"""Figures, one file each: quality over angle and over views given, variants side by side, where a model fails."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, isnan, nan
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from gcd_train.errors import RunError
from gcd_train.evaluation.galleries import Pictures, Strip, beside, shown_clips, stacked_sheet, strips
from gcd_train.evaluation.metrics import EQUAL_DB
from gcd_train.evaluation.paper import is_model
from gcd_train.evaluation.runs import EvaluatedSet, MethodRecords, gather, on_the_same_goals
from gcd_train.evaluation.statistics import Interval
from gcd_train.evaluation.store import Region, Run
from gcd_train.evaluation.tables import counted
from gcd_train.files import write_whole
from gcd_train.pictures import new_figure, png, require_matplotlib, save

FigureKind: TypeAlias = Literal["angles", "views", "ablation", "failures"]


def make_figure(
    kind: FigureKind, folders: Sequence[Path], out: Path, *, methods: Sequence[str] = (), clips: int = 6
) -> None:
    """One PNG out of runs, as the paper has it; nothing is measured again.

    angles, views: the plots of `error_by_angle` and `ssim_by_views`. ablation: the last frame of some clips by every
    model, beside source and target. failures: the clips whose last frame a model misses most, worst first.

    Args:
        methods: only these; by default every method of a plot, every model of an ablation, the one model that fails.
        clips: how many are shown.
    Raises:
        RunError: the runs do not hold what the figure is of. RenderError: a plot is wanted without matplotlib.
    """
    sets = gather([Run.read(folder) for folder in folders])
    if kind != "views":  # last frames alone, which models of two paths share
        sets = on_the_same_goals(sets)[0] or sets
    known = dict.fromkeys(method.name for each in sets for method in each.methods)
    if unknown := [name for name in methods if name not in known]:
        raise RunError(f"no method is called {unknown[0]!r} in these runs; there are {', '.join(known)}")
    each = [replace(of, methods=_chosen(of, methods, models=kind in ("ablation", "failures"))) for of in sets]
    if kind in ("angles", "views"):
        require_matplotlib()
        plots = [plot for of in each if (plot := (error_by_angle if kind == "angles" else ssim_by_views)(of)).curves]
        if len(plots) != 1:
            what = "goals at several angles" if kind == "angles" else "HexPlane with several numbers of views"
            raise RunError(f"a figure of {kind} wants runs of one set of clips with {what}, got {len(plots)} such sets")
        draw(plots[0], out)
        return
    shown = [of for of in each if of.methods]
    if len(shown) != 1 or (kind == "failures" and len(shown[0].methods) != 1):
        wanted = "models, or named with --method," if kind == "ablation" else "one model, or named with --method,"
        raise RunError(
            f"a figure of {kind} is of {wanted} on one set of clips; these runs hold "
            f"{counted(len(sets), 'set')}, and {', '.join(known)}"
        )
    (of,) = shown
    keys = _worst(of.methods[0])[:clips] if kind == "failures" else _shown_by_all(of, clips)
    write_whole(out, png(stacked_sheet([_at_the_end(_told(of, key), key) for key in keys])))


def _worst(method: MethodRecords) -> list[str]:
    """Clips by the PSNR of their last frame, worst first; those without one are no pictures."""
    each = {key: method.sums("last", keys=[key]).value("psnr_db") for key in method.places}
    known = [key for key in each if not isnan(each[key])]
    if not known:
        raise RunError(f"{method.name} has no PSNR, so it has no worst clips; name another --method")
    return sorted(known, key=lambda key: each[key])


def _shown_by_all(of: EvaluatedSet, count: int) -> list[str]:
    """So many clips of which every method kept frames."""
    common = _common(of.methods)
    kept = [key for key in shown_clips(of, of.methods, len(of.clips)) if key in common]
    whole = [key for key in kept if {each.name for each in of.methods} <= {row.name for row in strips(of.methods, key)}]
    if not whole:
        raise RunError("no clip has frames of every method; evaluate with --views last")
    return whole[:count]


def _common(methods: Sequence[MethodRecords]) -> set[str]:
    """The clips that all of them were measured on."""
    return set.intersection(*(set(method.places) for method in methods)) if methods else set()


def _at_the_end(rows: Sequence[Strip], key: str) -> Pictures:
    """The last frame that all rows have."""
    moments = set.intersection(*(set(row.frames) for row in rows)) if rows else set[int]()
    if not moments:
        raise RunError(f"no frames were kept of {key}; evaluate with --views last")
    return beside(rows, max(moments))


def _chosen(of: EvaluatedSet, names: Sequence[str], *, models: bool) -> tuple[MethodRecords, ...]:
    named = tuple(method for name in names for method in of.methods if method.name == name)
    if names or not models:
        return named if names else of.methods
    return tuple(method for method in of.methods if is_model(method.name, method.details))


def _told(of: EvaluatedSet, key: str) -> list[Strip]:
    """Source, views and target of a clip; each view with its PSNR."""
    clip, names = of.clips[key], {method.name: method for method in of.methods}
    change = "" if clip.change is None else " {:+.0f}, {:+.0f} degrees".format(*clip.change)
    found: list[Strip] = []
    for row in strips(of.methods, key):
        name = f"{key}{change}" if row.name == "source" else row.name
        if row.name in names and key in names[row.name].places:
            psnr_db = names[row.name].sums("last", keys=[key]).value("psnr_db")
            name = name if isnan(psnr_db) else f"{names[row.name].starred} {psnr_db:.1f} dB"
        found.append(replace(row, name=name))
    return found


ANGLE_STEP_DEG = 15.0
_MOST_ANGLES = 20  # so many different ones are shown as they are
_BY_VIEWS = re.compile(r"(hexplane|4dgs)[ _-]?(\d+)", re.IGNORECASE)
_LABELS = {"hexplane": "HexPlane", "4dgs": "4D-GS"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Point:
    """x: where on the axis, NaN for a level right across. y: the figure there. clips: that it is of."""

    x: float
    y: Interval
    clips: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Plot:
    """name: of its files. title, across, up: what it shows. curves: points by the name of their line."""

    name: str
    title: str
    across: str
    up: str
    curves: dict[str, list[Point]]


def all_plots(of: EvaluatedSet) -> tuple[Plot, ...]:
    """All that the records are enough for."""
    return tuple(plot for plot in (error_by_angle(of), ssim_by_views(of)) if plot.curves)


def error_by_angle(of: EvaluatedSet) -> Plot:
    """PSNR of the last frame over the angle that the camera has turned by, |azimuth|; no curve on one path for all.

    Of the clips that all methods were measured on; methods that show a part of the target alone are left out.

    Source: GCD, the study of angles in appendix B.2: error against the rotation about the scene.
    """
    curves, methods, common, told = dict[str, list[Point]](), *_compared(of)
    for method in methods:
        records = [each for each in method.records if each.key in common]
        turned = {each.key: abs(each.change[0]) for each in records if each.change is not None}
        distinct, groups = len({round(angle, 1) for angle in turned.values()}), dict[float, list[str]]()
        many = distinct > _MOST_ANGLES or (of.scenes > 1 and 2 * distinct > len(turned))
        for key, angle in turned.items():  # as it is or, where many or nearly all differ, in the middle of its step
            middle = (min(angle, 179.999) // ANGLE_STEP_DEG + 0.5) * ANGLE_STEP_DEG
            groups.setdefault(middle if many else round(angle, 1), []).append(key)
        points = [
            Point(x=x, y=method.sums("last", keys=keys).interval("psnr_db"), clips=len(keys))
            for x, keys in sorted(groups.items())
        ]
        known = [point for point in points if point.y.known]
        curves |= {method.starred: known} if len(known) > 1 else {}
    across = "azimuth turned by, degrees"
    return Plot(
        name="psnr_by_angle", title=f"Last frame, all pixels{told}", across=across, up="PSNR, dB", curves=curves
    )


def ssim_by_views(of: EvaluatedSet) -> Plot:
    """SSIM over the number of views that HexPlane and 4D-GS are given; every other method as a level. No plot without
    one of the two.

    Of clips and methods as `error_by_angle`.

    Source: GCD, section 5: how many input views a reconstruction needs to come near.
    """
    methods, common, told = _compared(of)
    named = {method.name: m for method in methods if (m := _BY_VIEWS.search(method.name))}
    views = {name: int(m[2]) for name, m in named.items()}
    regions: tuple[Region, ...] = ("all", "occluded")
    curves: dict[str, list[Point]] = {}
    for region, method in product(regions, sorted(methods, key=lambda m: views.get(m.name, inf))):
        name = _LABELS[named[method.name][1].lower()] if method.name in views else method.starred
        y = method.sums(region=region, keys=common).interval("ssim")
        if y.known and views and (method.name in views or region == "all"):
            point = Point(x=views.get(method.name, nan), y=y, clips=len(common))
            curves.setdefault(f"{name}, {region}", []).append(point)
    if all(isnan(curve[0].x) for curve in curves.values()):  # levels alone
        curves = {}
    title = f"Frames 2 to the last{told}"
    return Plot(name="ssim_by_views", title=title, across="views given", up="SSIM", curves=curves)


def _compared(of: EvaluatedSet) -> tuple[list[MethodRecords], list[str], str]:
    """Methods that show whole frames, the clips that all of them were measured on, and what to say where some lack."""
    methods = [method for method in of.methods if method.crop is None]
    common = _common(methods)
    told = "" if len(common) == len(of.clips) else f", {len(common)} of {len(of.clips)} clips"
    return methods, [key for key in of.clips if key in common], told


_SIZE_IN = (7.2, 4.4)
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def draw(plot: Plot, out: Path) -> None:
    """One PNG: lines with 95 % intervals, levels dashed. Raises RenderError without matplotlib."""
    figure = new_figure(*_SIZE_IN)
    axes = figure.add_subplot()
    for number, (name, curve) in enumerate(plot.curves.items()):
        x, y, colour = [point.x for point in curve], [point.y.value for point in curve], f"C{number % 10}"
        if isnan(x[0]):
            axes.axhline(y[0], linestyle="--", linewidth=1.0, color=colour, label=name)
            continue
        bounds = np.array([(each.value - each.low, each.high - each.value) for each in (point.y for point in curve)])
        yerr, mark = np.nan_to_num(bounds).clip(0.0).T, _MARKS[number % len(_MARKS)]
        style: dict[str, Any] = {"marker": mark, "color": colour, "markersize": 4, "linewidth": 1.2}
        axes.errorbar(x, y, yerr=yerr, capsize=2, elinewidth=0.7, label=name, **style)
    heights, title = [point.y for curve in plot.curves.values() for point in curve], plot.title
    shown = [each for y in heights if y.value < EQUAL_DB - 1e-3 for each in (y.value, y.low, y.high) if not isnan(each)]
    if shown and any(y.value > EQUAL_DB - 1e-3 for y in heights):  # or all others would lie on one line
        axes.set_ylim(min(shown) - 1.0, max(shown) + 1.0)
        title = f"{title} (equal frames, {EQUAL_DB:g} dB, lie above)"
    axes.set_title(title, fontsize=10, loc="left")
    places = sorted({point.x for curve in plot.curves.values() for point in curve if not isnan(point.x)})
    axes.set(xlabel=plot.across, ylabel=plot.up, xticks=places, xlim=(places[0] - 1, places[-1] + 1))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    save(figure, out)
