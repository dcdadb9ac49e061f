"""How figures change with the angle, the views given, and from frame to frame; drawn with matplotlib, an extra."""

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError
from gcd_train.evaluation.statistics import FIRST_MEASURED, FigureName, Interval, Selection, bootstrap
from gcd_train.evaluation.store import ClipRecord, Region
from gcd_train.evaluation.tables import Cell, Measured, csv_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DPI = 110


def require_matplotlib() -> None:
    """Raises RenderError, naming the extra, where matplotlib is not installed."""
    try:
        import_module("matplotlib.figure")
    except ImportError as error:
        raise RenderError(
            f"figures need matplotlib ({error}); install it with pip install 'gcd-node[train]'"
        ) from error


def new_figure(width_in: float, height_in: float) -> "Figure":
    """An empty white figure, drawn by Agg, sizes in inches at 110 pixels. Raises RenderError without matplotlib."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def to_pixels(figure: "Figure") -> NDArray[np.uint8]:
    """A drawn figure as u8 [H, W, 3]."""
    canvas = figure.canvas
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])  # pyright: ignore[reportAttributeAccessIssue]


def save(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG, in one piece."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(drawn.getvalue())


ANGLE_STEP_DEG = 15.0
_MOST_ANGLES = 13  # so many different ones are shown as they are
_HEXPLANE = re.compile(r"hexplane[ _-]?(\d+)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True, slots=True)
class Point:
    """x: where on the axis. y: the figure there. clips: that it is of."""

    x: float
    y: Interval
    clips: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Curve:
    """One line of a plot."""

    name: str
    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Plot:
    """name: of its files. title, across, up: what it shows. levels: lines right across, of what has no x.

    counted: x are whole numbers, of frames or views.
    """

    name: str
    title: str
    across: str
    up: str
    curves: tuple[Curve, ...]
    levels: tuple[Curve, ...] = ()
    counted: bool = False


def all_plots(measured: Measured) -> tuple[Plot, ...]:
    """All that the records are enough for."""
    made = (error_by_angle(measured), ssim_by_views(measured), psnr_by_frame(measured))
    return tuple(plot for plot in made if plot is not None)


def error_by_angle(measured: Measured) -> Plot | None:
    """PSNR of the last frame over the angle that the camera has turned by, |azimuth|; None on one path for all.

    Source: GCD, the study of angles in section 5: error against the rotation about the scene.
    """
    curves = [
        Curve(name=method.name, points=_angle_points(measured, method.records))
        for method in measured.of.methods
        if method.makes_pictures
    ]
    return _plot("psnr_by_angle", "Last frame, all pixels", "azimuth turned by, degrees", "PSNR, dB", curves, least=2)


def psnr_by_frame(measured: Measured) -> Plot | None:
    """PSNR of each frame from the second on, all pixels; mIoU where there are only class maps."""
    pictures = [method for method in measured.of.methods if method.makes_pictures]
    name: FigureName = "psnr_db" if pictures else "miou_common"
    curves: list[Curve] = []
    for method in pictures or measured.of.methods:
        found = [
            Point(x=frame, y=measured.sums(method, Selection(frames=frame)).interval(name), clips=len(method.records))
            for frame in range(FIRST_MEASURED + 1, measured.of.note.frames + 1)
        ]
        curves.append(Curve(name=method.name, points=tuple(point for point in found if point.y.known)))
    up = "PSNR, dB" if pictures else "mIoU"
    return _plot("by_frame", "Each frame, all pixels", "frame", up, curves, least=2, counted=True)


def ssim_by_views(measured: Measured) -> Plot | None:
    """SSIM against the number of views that HexPlane is given; every other method as a level. None without HexPlane.

    Source: GCD, section 5: how many input views a reconstruction needs to come near.
    """
    hexplanes = {method.name: match for method in measured.of.methods if (match := _HEXPLANE.search(method.name))}
    if not hexplanes:
        return None
    curves = [_views_curve(measured, hexplanes, region) for region in ("all", "occluded")]
    levels = [
        Curve(name=f"{method.name}, all", points=(_whole(measured, method.name, "all", 0.0),))
        for method in measured.of.methods
        if method.name not in hexplanes and method.makes_pictures
    ]
    plot = _plot(
        "ssim_by_views", "HexPlane, frames 2 to the last", "views given", "SSIM", curves, least=1, counted=True
    )
    return None if plot is None else replace(plot, levels=tuple(levels))


def curves_csv(plot: Plot) -> str:
    """One point a line; levels have no x."""
    lines = [
        [curve.name, "" if curve in plot.levels else f"{point.x:g}", *Cell(figure=point.y).numbers(), str(point.clips)]
        for curve in (*plot.curves, *plot.levels)
        for point in curve.points
    ]
    return csv_text(["method", plot.across, plot.up, "low", "high", "clips"], lines)


def angle_bins(angles: Sequence[float]) -> list[float]:
    """Where each angle, in degrees, stands on the axis: as it is, or, where many differ, in the middle of its step."""
    rounded = [round(angle, 1) for angle in angles]
    if len(set(rounded)) <= _MOST_ANGLES:
        return rounded
    return [(np.floor(min(angle, 179.999) / ANGLE_STEP_DEG) + 0.5) * ANGLE_STEP_DEG for angle in angles]


def _angle_points(measured: Measured, records: Sequence[ClipRecord]) -> tuple[Point, ...]:
    turned = [(record, abs(record.change[0])) for record in records if record.change is not None]
    groups: dict[float, list[ClipRecord]] = {}
    for (record, _), place in zip(turned, angle_bins([angle for _, angle in turned]), strict=True):
        groups.setdefault(place, []).append(record)
    found = [
        Point(
            x=place,
            y=bootstrap(groups[place], Selection(frames="last"), seed=measured.seed).interval("psnr_db"),
            clips=len(groups[place]),
        )
        for place in sorted(groups)
    ]
    return tuple(point for point in found if point.y.known)


def _views_curve(measured: Measured, hexplanes: Mapping[str, re.Match[str]], region: Region) -> Curve:
    by_views = sorted((int(match[1]), name) for name, match in hexplanes.items())
    found = [_whole(measured, name, region, float(views)) for views, name in by_views]
    return Curve(name=f"HexPlane, {region}", points=tuple(point for point in found if point.y.known))


def _whole(measured: Measured, name: str, region: Region, x: float) -> Point:
    method = measured.of.method(name)
    return Point(x=x, y=measured.sums(method, Selection(region=region)).interval("ssim"), clips=len(method.records))


def _plot(
    name: str, title: str, across: str, up: str, curves: Sequence[Curve], *, least: int, counted: bool = False
) -> Plot | None:
    """None where no curve has so many points."""
    shown = tuple(curve for curve in curves if len(curve.points) >= least)
    if not shown:
        return None
    return Plot(name=name, title=title, across=across, up=up, curves=shown, counted=counted)


_SIZE_IN = (7.2, 4.4)
_MOST_TICKS = 16
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def draw(plot: Plot, out: Path) -> None:
    """One PNG: lines with 95 % intervals, levels dashed. Raises RenderError without matplotlib."""
    figure = new_figure(*_SIZE_IN)
    axes = figure.add_subplot()
    for number, curve in enumerate(plot.curves):
        low, high = _bars(curve)
        x, y = [point.x for point in curve.points], [point.y.value for point in curve.points]
        mark = _MARKS[number % len(_MARKS)]
        axes.errorbar(
            x, y, yerr=(low, high), marker=mark, color=_colour(number), markersize=4, capsize=2, linewidth=1.2,
            elinewidth=0.7, label=curve.name,
        )  # fmt: skip
    for number, level in enumerate(plot.levels, start=len(plot.curves)):
        axes.axhline(level.points[0].y.value, linestyle="--", linewidth=1.0, color=_colour(number), label=level.name)
    axes.set_title(plot.title, fontsize=10, loc="left")
    axes.set_xlabel(plot.across)
    axes.set_ylabel(plot.up)
    if plot.counted:
        _whole_ticks(axes, [point.x for curve in plot.curves for point in curve.points])
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    save(figure, out)


def _whole_ticks(axes: "Axes", places: Sequence[float]) -> None:
    """Ticks at whole numbers: where the points are, or, of many, at some between the first and the last."""
    from matplotlib.ticker import FixedLocator, MaxNLocator

    each = sorted(set(places))
    axes.xaxis.set_major_locator(FixedLocator(each) if len(each) <= _MOST_TICKS else MaxNLocator(integer=True))
    if len(each) == 1:
        axes.set_xlim(each[0] - 1, each[0] + 1)


def _bars(curve: Curve) -> tuple[list[float], list[float]]:
    """How far the bounds lie below and above each point; nothing where nobody knows."""
    low = [max(0.0, point.y.value - point.y.low) if point.y.low == point.y.low else 0.0 for point in curve.points]
    high = [max(0.0, point.y.high - point.y.value) if point.y.high == point.y.high else 0.0 for point in curve.points]
    return low, high


def _colour(number: int) -> str:
    """A colour of matplotlib's cycle of ten, over and over."""
    return f"C{number % 10}"
