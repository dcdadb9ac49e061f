"""Curves drawn with matplotlib, which is an extra and is opened only here."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gcd_train.reports.curves import Curve, Plot
from gcd_train.show.matplotlib_door import new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
