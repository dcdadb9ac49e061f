"""How figures change with the angle, the views given, and from frame to frame; drawn with matplotlib, an extra."""

import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gcd_train.errors import RenderError
from gcd_train.evaluation.runs import EvaluatedSet, Method
from gcd_train.evaluation.statistics import FIRST_MEASURED, FigureName, Interval, Selection
from gcd_train.evaluation.store import ClipRecord, Region
from gcd_train.evaluation.tables import Cell, csv_text
from gcd_train.files import write_whole

if TYPE_CHECKING:
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


def save(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG, in one piece. Raises RunError if it cannot be written."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    write_whole(out, drawn.getvalue())


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

    @classmethod
    def of(cls, name: str, points: Iterable[Point]) -> "Curve":
        """Of the points whose figure is known."""
        return cls(name=name, points=tuple(point for point in points if point.y.known))


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


def all_plots(of: EvaluatedSet) -> tuple[Plot, ...]:
    """All that the records are enough for."""
    made = (error_by_angle(of), ssim_by_views(of), psnr_by_frame(of))
    return tuple(plot for plot in made if plot.curves)


def error_by_angle(of: EvaluatedSet) -> Plot:
    """PSNR of the last frame over the angle that the camera has turned by, |azimuth|; no curve on one path for all.

    Source: GCD, the study of angles in appendix B.2: error against the rotation about the scene.
    """
    curves, last = list[Curve](), Selection(frames="last")
    for method in of.methods:
        turned = [(record, abs(record.change[0])) for record in method.records if record.change is not None]
        groups: dict[float, list[ClipRecord]] = {}
        for (record, _), place in zip(turned, angle_bins([angle for _, angle in turned]), strict=True):
            groups.setdefault(place, []).append(record)
        sums = {place: of.sums(method, last, groups[place]) for place in sorted(groups)}
        points = [Point(x=x, y=each.interval("psnr_db"), clips=len(groups[x])) for x, each in sums.items()]
        curves.append(Curve.of(method.name, points))
    return Plot(
        name="psnr_by_angle",
        title="Last frame, all pixels",
        across="azimuth turned by, degrees",
        up="PSNR, dB",
        curves=tuple(curve for curve in curves if len(curve.points) > 1),
    )


def psnr_by_frame(of: EvaluatedSet) -> Plot:
    """PSNR of each frame from the second on, all pixels; mIoU where there are only class maps."""
    pictures = [method for method in of.methods if method.makes_pictures]
    name: FigureName = "psnr_db" if pictures else "miou_common"
    frames = range(FIRST_MEASURED + 1, of.note.frames + 1)
    curves = [
        Curve.of(method.name, (_point(of, method, Selection(frames=frame), name, frame) for frame in frames))
        for method in pictures or of.methods
    ]
    return Plot(
        name="by_frame",
        title="Each frame, all pixels",
        across="frame",
        up="PSNR, dB" if pictures else "mIoU",
        curves=tuple(curve for curve in curves if len(curve.points) > 1),
        counted=True,
    )


def ssim_by_views(of: EvaluatedSet) -> Plot:
    """SSIM over the number of views that HexPlane is given; every other method as a level. No curve without HexPlane.

    Source: GCD, section 5: how many input views a reconstruction needs to come near.
    """
    found = {method.name: _HEXPLANE.search(method.name) for method in of.methods}
    views = sorted((int(match[1]), name) for name, match in found.items() if match)
    regions: tuple[Region, ...] = ("all", "occluded")
    curves = [
        Curve.of(
            f"HexPlane, {region}",
            (_point(of, of.method(name), Selection(region=region), "ssim", x) for x, name in views),
        )
        for region in regions
    ]
    levels = [
        Curve(name=f"{method.name}, all", points=(_point(of, method, Selection(), "ssim", 0.0),))
        for method in of.methods
        if not found[method.name] and method.makes_pictures
    ]
    return Plot(
        name="ssim_by_views",
        title="HexPlane, frames 2 to the last",
        across="views given",
        up="SSIM",
        curves=tuple(curve for curve in curves if curve.points),
        levels=tuple(levels),
        counted=True,
    )


def _point(of: EvaluatedSet, method: Method, selection: Selection, name: FigureName, x: float) -> Point:
    return Point(x=x, y=of.sums(method, selection).interval(name), clips=len(method.records))


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


_SIZE_IN = (7.2, 4.4)
_MOST_TICKS = 16
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def draw(plot: Plot, out: Path) -> None:
    """One PNG: lines with 95 % intervals, levels dashed. Raises RenderError without matplotlib."""
    figure = new_figure(*_SIZE_IN)
    from matplotlib.ticker import FixedLocator, MaxNLocator

    axes = figure.add_subplot()
    for number, curve in enumerate(plot.curves):
        x, y = [point.x for point in curve.points], [point.y.value for point in curve.points]
        bounds = np.array([(each.value - each.low, each.high - each.value) for each in (p.y for p in curve.points)])
        yerr, mark = np.nan_to_num(bounds).clip(0.0).T, _MARKS[number % len(_MARKS)]
        style: dict[str, Any] = {"marker": mark, "color": f"C{number % 10}", "markersize": 4, "linewidth": 1.2}
        axes.errorbar(x, y, yerr=yerr, capsize=2, elinewidth=0.7, label=curve.name, **style)
    for number, level in enumerate(plot.levels, start=len(plot.curves)):
        axes.axhline(level.points[0].y.value, linestyle="--", linewidth=1.0, color=f"C{number % 10}", label=level.name)
    axes.set_title(plot.title, fontsize=10, loc="left")
    axes.set_xlabel(plot.across)
    axes.set_ylabel(plot.up)
    if plot.counted:
        places = sorted({point.x for curve in plot.curves for point in curve.points})
        few = len(places) <= _MOST_TICKS
        axes.xaxis.set_major_locator(FixedLocator(places) if few else MaxNLocator(integer=True))
        if len(places) == 1:
            axes.set_xlim(places[0] - 1, places[0] + 1)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    save(figure, out)
