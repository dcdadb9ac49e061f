"""How figures change with the angle, the views given, and from frame to frame; drawn with matplotlib, an extra."""

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gcd_train.errors import RenderError
from gcd_train.evaluation.runs import EvaluatedSet, MethodRecords
from gcd_train.evaluation.statistics import FIRST_MEASURED, FigureName, Interval
from gcd_train.evaluation.store import Region
from gcd_train.evaluation.tables import csv_text, numbers
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
class Plot:
    """name: of its files. title, across, up: what it shows. curves: points by the name of their line.

    levels: lines right across, of what has no x. counted: x are whole numbers, of frames or views.
    """

    name: str
    title: str
    across: str
    up: str
    curves: dict[str, list[Point]]
    levels: dict[str, Point] = field(default_factory=dict[str, Point])
    counted: bool = False


def all_plots(of: EvaluatedSet) -> tuple[Plot, ...]:
    """All that the records are enough for."""
    made = (error_by_angle(of), ssim_by_views(of), psnr_by_frame(of))
    return tuple(plot for plot in made if plot.curves)


def _curves(curves: Mapping[str, Iterable[Point]], least: int = 1) -> dict[str, list[Point]]:
    """Those of so many points or more whose figure is known, and these."""
    known = {name: [point for point in points if point.y.known] for name, points in curves.items()}
    return {name: points for name, points in known.items() if len(points) >= least}


def error_by_angle(of: EvaluatedSet) -> Plot:
    """PSNR of the last frame over the angle that the camera has turned by, |azimuth|; no curve on one path for all.

    Source: GCD, the study of angles in appendix B.2: error against the rotation about the scene.
    """
    curves: dict[str, list[Point]] = {}
    for method in of.methods:
        turned = {record.key: abs(record.change[0]) for record in method.records if record.change is not None}
        groups: dict[float, list[str]] = {}
        for key, place in zip(turned, angle_bins(list(turned.values())), strict=True):
            groups.setdefault(place, []).append(key)
        curves[method.name] = [
            Point(x=x, y=method.sums("last", keys=groups[x]).interval("psnr_db"), clips=len(groups[x]))
            for x in sorted(groups)
        ]
    return Plot(
        name="psnr_by_angle",
        title="Last frame, all pixels",
        across="azimuth turned by, degrees",
        up="PSNR, dB",
        curves=_curves(curves, least=2),
    )


def psnr_by_frame(of: EvaluatedSet) -> Plot:
    """PSNR of each frame from the second on, all pixels; mIoU where there are only class maps."""
    pictures = [method for method in of.methods if method.makes_pictures]
    figure: FigureName = "psnr_db" if pictures else "miou_common"
    frames = range(FIRST_MEASURED + 1, of.note.frames + 1)
    curves = {
        method.name: [
            Point(x=frame, y=method.sums(frame).interval(figure), clips=len(method.records)) for frame in frames
        ]
        for method in pictures or of.methods
    }
    return Plot(
        name="by_frame",
        title="Each frame, all pixels",
        across="frame",
        up="PSNR, dB" if pictures else "mIoU",
        curves=_curves(curves, least=2),
        counted=True,
    )


def ssim_by_views(of: EvaluatedSet) -> Plot:
    """SSIM over the number of views that HexPlane is given; every other method as a level. No curve without HexPlane.

    Source: GCD, section 5: how many input views a reconstruction needs to come near.
    """
    views = {method.name: int(m[1]) for method in of.methods if (m := _HEXPLANE.search(method.name))}
    given = sorted((method for method in of.methods if method.name in views), key=lambda m: (views[m.name], m.name))

    def point(method: MethodRecords, region: Region) -> Point:
        y = method.sums(region=region).interval("ssim")
        return Point(x=views.get(method.name, 0), y=y, clips=len(method.records))

    regions: tuple[Region, ...] = ("all", "occluded")
    return Plot(
        name="ssim_by_views",
        title="HexPlane, frames 2 to the last",
        across="views given",
        up="SSIM",
        curves=_curves({f"HexPlane, {region}": [point(method, region) for method in given] for region in regions}),
        levels={
            f"{method.name}, all": point(method, "all")
            for method in of.methods
            if method.name not in views and method.makes_pictures
        },
        counted=True,
    )


def curves_csv(plot: Plot) -> str:
    """One point a line; levels have no x."""
    points = [(name, f"{point.x:g}", point) for name, curve in plot.curves.items() for point in curve]
    points += [(name, "", point) for name, point in plot.levels.items()]
    lines = [[name, x, *numbers(point.y), str(point.clips)] for name, x, point in points]
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
    for number, (name, curve) in enumerate(plot.curves.items()):
        x, y = [point.x for point in curve], [point.y.value for point in curve]
        bounds = np.array([(each.value - each.low, each.high - each.value) for each in (point.y for point in curve)])
        yerr, mark = np.nan_to_num(bounds).clip(0.0).T, _MARKS[number % len(_MARKS)]
        style: dict[str, Any] = {"marker": mark, "color": f"C{number % 10}", "markersize": 4, "linewidth": 1.2}
        axes.errorbar(x, y, yerr=yerr, capsize=2, elinewidth=0.7, label=name, **style)
    for number, (name, level) in enumerate(plot.levels.items(), start=len(plot.curves)):
        axes.axhline(level.y.value, linestyle="--", linewidth=1.0, color=f"C{number % 10}", label=name)
    axes.set_title(plot.title, fontsize=10, loc="left")
    axes.set_xlabel(plot.across)
    axes.set_ylabel(plot.up)
    if plot.counted:
        places = sorted({point.x for curve in plot.curves.values() for point in curve})
        few = len(places) <= _MOST_TICKS
        axes.xaxis.set_major_locator(FixedLocator(places) if few else MaxNLocator(integer=True))
        if len(places) == 1:
            axes.set_xlim(places[0] - 1, places[0] + 1)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    save(figure, out)
