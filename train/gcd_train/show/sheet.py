"""The contact sheet: five moments of a clip row by row, the camera path, the facts, on one page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gcd_train.show.colours import UNKNOWN, depth_colours, depth_table, depth_ticks
from gcd_train.show.footage import UNSEEN, Footage
from gcd_train.show.matplotlib_door import new_figure, save
from gcd_train.show.trajectory import draw_trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure
    from mpl_toolkits.mplot3d import Axes3D

Bytes = NDArray[np.uint8]
_COLUMNS = 5
_LEGEND_ROWS = 14
INK, FAINT = "#1b2530", "#5c6875"


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """One kind of picture. name, told: what it is. pictures: u8 [T, H, W, 3]."""

    name: str
    told: str
    pictures: Bytes


def rows_of(footage: Footage) -> list[Row]:
    """Everything there is to see of a clip, in the order of the sheet."""
    near, far = footage.depth_range_m
    rows = [
        Row(name="input", told=f"{footage.source_camera}, colour", pictures=footage.source),
        Row(name="target", told=footage.target_is, pictures=footage.target),
        Row(name="splat", told="the input's points from\nthe target; black: none", pictures=footage.splat),
        Row(name="visibility", told="orange: surfaces\nthe input never saw", pictures=footage.seen()),
        Row(
            name="depth",
            told="of the input, along\nthe optical axis",
            pictures=depth_colours(footage.depth, near, far),
        ),
    ]
    painted = footage.painted()
    if painted is not None:
        rows.insert(4, Row(name=footage.kind_plural, told="of the input", pictures=painted))
    return rows


def write_sheet(footage: Footage, out: Path, facts: Sequence[tuple[str, str]]) -> None:
    """One page as PNG. Raises: RenderError without matplotlib, OSError where it cannot be written."""
    rows = rows_of(footage)
    height, width = footage.source.shape[1:3]
    tall = 1.84 * height / width
    figure = new_figure(15.2, 0.78 + len(rows) * (tall + 0.045))
    figure.text(0.012, 0.99, footage.title, fontsize=15, fontweight="bold", color=INK, va="top")
    parts = figure.add_gridspec(1, 2, width_ratios=[3.05, 1.0], wspace=0.0)
    _draw_rows(figure.add_subfigure(parts[0]), footage, rows)
    _draw_side(figure.add_subfigure(parts[1]), footage, facts)
    save(figure, out)


def write_trajectory(footage: Footage, out: Path) -> None:
    """The camera path alone, as PNG. Raises as `write_sheet`."""
    figure = new_figure(7.2, 5.6)
    axes: Axes3D = figure.add_axes((0.03, 0.03, 0.93, 0.84), projection="3d")  # pyright: ignore[reportAssignmentType]
    draw_trajectory(axes, footage)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    figure.text(0.03, 0.95, f"{footage.title}: camera path", fontsize=12, fontweight="bold", color=INK)
    figure.text(0.03, 0.92, footage.path.replace(",\n", ", ").replace("\n", ", "), fontsize=8.5, color=FAINT)
    figure.text(0.03, 0.89, footage.world, fontsize=8.5, color=FAINT)
    save(figure, out)


def _draw_rows(grid: "SubFigure", footage: Footage, rows: Sequence[Row]) -> None:
    """All pictures in one piece (thirty axes would take longer than all else), names and times around them.

    Always as wide as five moments, so that a shorter clip leaves white and no picture is stretched.
    """
    moments = np.unique(np.linspace(0, footage.frames - 1, _COLUMNS).round().astype(int))
    height, width = footage.source.shape[1:3]
    gap = round(width / 60)
    mosaic = np.full((len(rows) * (height + gap) - gap, _COLUMNS * (width + gap) - gap, 3), 255, np.uint8)
    axes: Axes = grid.add_axes((0.128, 0.012, 0.807, 0.906))
    axes.set_axis_off()
    for number, row in enumerate(rows):
        top = number * (height + gap)
        for column, moment in enumerate(moments):
            left = column * (width + gap)
            mosaic[top : top + height, left : left + width] = row.pictures[moment]
            if row.name == "visibility":
                _badge(axes, left, top + height, f"{100 * footage.seen_shares[moment]:.0f} % seen")
        _name_row(axes, -0.02 * width, top + 0.4 * height, 0.05 * height, row)
    for column, moment in enumerate(moments):
        time = f"t = {footage.seconds[moment]:.2f} s\nframe {footage.frame_numbers[moment]}"
        place = column * (width + gap) + width / 2
        axes.text(place, -0.04 * height, time, fontsize=9, color=FAINT, ha="center", va="bottom")
    axes.imshow(mosaic, interpolation="antialiased", aspect="auto")
    share = height / len(mosaic)
    depth_bar(axes.inset_axes((1.008, 0.02 * share, 0.012, 0.94 * share)), footage)


def _name_row(axes: "Axes", x: float, y: float, step: float, row: Row) -> None:
    axes.text(x, y, row.name, fontsize=11.5, fontweight="bold", color=INK, va="center", ha="right")
    axes.text(x, y + 2.3 * step, row.told, fontsize=7, color=FAINT, va="top", ha="right", linespacing=1.15)


def _badge(axes: "Axes", left: float, bottom: float, text: str) -> None:
    box = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    axes.annotate(text, (left, bottom), xytext=(5, 6), textcoords="offset points", fontsize=8, color=INK, bbox=box)


def depth_bar(bar: "Axes", footage: Footage) -> None:
    """Fill axes with the colours of depth, near at the bottom, ticks in metres."""
    near, far = footage.depth_range_m
    bar.set_xticks([])
    for edge in bar.spines.values():
        edge.set_visible(False)
    if far <= near:
        bar.set_yticks([])
        return
    bar.imshow(depth_table()[::-1][:, None], aspect="auto", origin="lower", extent=(0, 1, 0, 1))
    ticks = depth_ticks(near, far)
    bar.set_yticks([float(np.log(tick / near) / np.log(far / near)) for tick in ticks], [f"{t:g}" for t in ticks])
    bar.yaxis.tick_right()
    bar.tick_params(labelsize=7, length=2, colors=FAINT)
    bar.set_title("m", fontsize=8, color=FAINT, pad=2)


def _draw_side(side: "SubFigure", footage: Footage, facts: Sequence[tuple[str, str]]) -> None:
    axes: Axes3D = side.add_axes((0.02, 0.60, 0.96, 0.335), projection="3d")  # pyright: ignore[reportAssignmentType]
    draw_trajectory(axes, footage)
    axes.tick_params(labelsize=6.5, pad=-1)
    axes.legend(loc="upper left", bbox_to_anchor=(0.02, 1.18), fontsize=7.5, frameon=False, ncol=1)
    top = 0.575
    for name, value in facts:
        side.text(0.03, top, name, fontsize=8, color=FAINT, va="top")
        side.text(0.27, top, value, fontsize=8, color=INK, va="top", linespacing=1.2)
        top -= 0.0195 + 0.0165 * value.count("\n")
    _legend(side, footage, top - 0.015)


def _legend(side: "SubFigure", footage: Footage, top: float) -> None:
    """Names, colours and pixel shares of what is most seen, then the colours that have no bar."""
    shares = footage.shares()
    if shares:
        side.text(0.03, top, f"{footage.kind_plural}, share of the input's pixels", fontsize=8, color=FAINT, va="top")
        top -= 0.027
    for label, share in shares[:_LEGEND_ROWS]:
        _swatch(side, top, label.colour, f"{label.name}", percent(share))
        top -= 0.0195
    if len(shares) > _LEGEND_ROWS:
        rest = percent(sum(share for _, share in shares[_LEGEND_ROWS:]))
        side.text(0.09, top, f"and {len(shares) - _LEGEND_ROWS} more, {rest}", fontsize=7.5, color=FAINT, va="top")
        top -= 0.0195
    top -= 0.008
    _swatch(side, top, UNSEEN, "surfaces the input never saw", "")
    _swatch(side, top - 0.0195, UNKNOWN, "sky, or no depth", "")


def percent(share: float) -> str:
    """A share of 0 to 1 in words; what is there is never told as nothing."""
    return f"{100 * share:.1f} %" if share >= 0.0005 else "< 0.1 %"


def _swatch(side: "SubFigure", top: float, colour: tuple[int, int, int], name: str, value: str) -> None:
    face = tuple(channel / 255 for channel in colour)
    side.text(
        0.035, top, "      ", fontsize=6, va="top", bbox={"facecolor": face, "edgecolor": "#00000030", "pad": 1.2}
    )
    side.text(0.09, top, name, fontsize=7.5, color=INK, va="top")
    side.text(0.93, top, value, fontsize=7.5, color=INK, va="top", ha="right")
