"""How figures change with something: with the angle that the camera turns, with views given, from frame to frame."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gcd_train.evaluation.record import ClipRecord, Region
from gcd_train.evaluation.tallies import FIRST_MEASURED, FigureName, Selection
from gcd_train.reports.figure_tables import Measured
from gcd_train.reports.intervals import Interval, drawn
from gcd_train.reports.table import Cell, csv_text

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
            y=drawn(groups[place], Selection(frames="last"), seed=measured.seed).interval("psnr_db"),
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
