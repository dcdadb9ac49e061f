"""The contact sheet, the camera path in space, and the side-by-side video of a clip."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.evaluation.galleries import HOLD_S, Strip, beside, write_mp4
from gcd_train.evaluation.galleries import write_sheet as write_rows
from gcd_train.look.clip import SKY_M, Bytes, Footage
from gcd_train.pictures import new_figure, save

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

Doubles = NDArray[np.float64]
_SOURCE_COLOUR, _TARGET_COLOUR, _POINT_COLOUR = "#12873f", "#1c4fd8", "#d42a2a"
_SHOWN = 6  # frusta along the path
_POINTS, _CELLS = 6000, 84
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


def _draw_trajectory(axes: "Axes3D", footage: Footage) -> None:
    """Fill 3D axes: source and target frusta, path, look-at point, and the input's points around them."""
    low, high = _box(footage)
    size = 0.085 * float((high - low)[:2].max())
    _points(axes, footage, low, high)
    for number in np.unique(np.linspace(0, footage.frames - 1, _SHOWN).round().astype(int)):
        strength = 0.35 + 0.65 * number / max(footage.frames - 1, 1)
        _frustum(axes, footage, footage.world_from_target[number], size, _TARGET_COLOUR, strength)
    _frustum(axes, footage, footage.world_from_source[0], size, _SOURCE_COLOUR, 1.0)
    x, y, z = footage.world_from_target[:, :3, 3].T
    axes.plot(x, y, z, color=_TARGET_COLOUR, linewidth=2.0, label=f"target, {footage.frames} frames", zorder=5)
    axes.scatter(*footage.world_from_target[-1, :3, 3], color=_TARGET_COLOUR, s=20, zorder=5)
    source = footage.world_from_source[0, :3, 3]
    axes.scatter(*source, color=_SOURCE_COLOUR, s=20, label=f"source ({footage.source_camera})", zorder=5)
    if footage.look_at is not None:
        x, y, z = footage.look_at
        label = f"look-at ({x:g}, {y:g}, {z:g}) m"
        point = np.array(footage.look_at)
        axes.scatter(*point, color=_POINT_COLOUR, marker="x", s=44, linewidths=2.0, label=label, zorder=6)
    _frame(axes, footage, low, high)


def _frustum(
    axes: "Axes3D", footage: Footage, world_from_camera: Doubles, size: float, colour: str, strength: float
) -> None:
    """A camera as a pyramid with a roof that says which edge is the upper one."""
    half_width = np.tan(np.radians(footage.hfov_deg) / 2)
    half_height = half_width * footage.source.shape[1] / footage.source.shape[2]
    scale = size / max(half_width, 1.0)  # wide lenses get no larger pyramids
    corners = np.column_stack([_CORNERS * (half_width, half_height), np.ones(4)])
    points = np.vstack([corners, [(0.0, -1.45 * half_height, 1.0)]]) * scale
    points = points @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
    told: dict[str, Any] = {"color": colour, "alpha": strength, "linewidth": 1.2, "zorder": 4}
    axes.plot(*points[[0, 1, 2, 3, 0]].T, **told)
    axes.plot(*points[[0, 4, 1]].T, **told)
    for corner in points[:4]:
        axes.plot(*np.stack([world_from_camera[:3, 3], corner]).T, **told)


def _points(axes: "Axes3D", footage: Footage, low: Doubles, high: Doubles) -> None:
    """Some of the first frame's points in their colours, those inside the axes."""
    depth, colour = footage.depth[0], footage.source[0]
    height, width = depth.shape
    focal = width / 2 / np.tan(np.radians(footage.hfov_deg) / 2)
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], axis=-1)
    pose = footage.world_from_source[0]
    world = (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    shown = (depth > 0) & (depth < SKY_M) & ((world >= low) & (world <= high)).all(-1)
    points, colours = world[shown], colour[shown] / 255.0
    cells = ((points - low) / (high - low).max() * _CELLS).astype(np.int64) @ (1, _CELLS, _CELLS**2)
    chosen = np.unique(cells, return_index=True)[1]  # one a cell, or near surfaces hide the rest
    chosen = chosen[np.random.default_rng(0).permutation(len(chosen))[:_POINTS]]
    axes.scatter(*points[chosen].T, c=colours[chosen], s=5, linewidths=0, alpha=0.75, depthshade=False, zorder=1)


def _box(footage: Footage) -> tuple[Doubles, Doubles]:
    """Lower and upper corner of what the axes hold: cameras, look-at point, what lies ahead, the ground."""
    points = [footage.world_from_target[:, :3, 3], footage.world_from_source[:1, :3, 3]]
    if footage.look_at is not None:
        points.append(np.array([footage.look_at]))
        way = np.linalg.norm(points[0][-1] - points[1][0])
        far = 1.25 * max(way, float(np.linalg.norm(points[2][0] - points[1][0])))
        points.append(points[1] + far * footage.world_from_source[:1, :3, 2] * (1, 1, 0))
    together = np.concatenate(points)
    low, high = together.min(0), together.max(0)
    side = max(float((high - low)[:2].max()), 2.0)
    missing = np.maximum(0.66 * side - (high - low), 0.0) / 2 + 0.05 * side
    low, high = low - missing, high + missing
    ground = min(0.0, float(together[:, 2].min()) - 0.05 * side)
    low[2], high[2] = ground, max(float(together[:, 2].max()) + 0.12 * side, ground + 0.35 * side)
    return low, high


def _frame(axes: "Axes3D", footage: Footage, low: Doubles, high: Doubles) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(tuple(high - low), zoom=1.12)  # pyright: ignore[reportArgumentType]  the stub takes whole zooms
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_zlabel("z [m]")
    axes.computed_zorder = False
    ahead = footage.world_from_source[0, :2, 2]  # looked at from behind the cameras and beside the path
    axes.view_init(elev=24, azim=float(np.degrees(np.arctan2(-ahead[1], -ahead[0]))) + 50.0)


_INK, _FAINT = "#1b2530", "#5c6875"
_UNKNOWN = (38, 38, 38)
"""Colour of depth that is not known, and of sky."""
_TURBO = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1].astype(np.uint8)
"""RGB of 256 steps from far to near."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Row:
    """One kind of picture. name, told: what it is. pictures: u8 [T, H, W, 3]."""

    name: str
    told: str
    pictures: Bytes


def _rows(footage: Footage) -> list[_Row]:
    """Everything there is to see of a clip, in the order of the sheet."""
    depth = _depth_colours(footage.depth, *footage.depth_range_m)
    rows = [
        _Row(name="input", told=footage.source_camera, pictures=footage.source),
        _Row(name="target", told=footage.target_is, pictures=footage.target),
        _Row(name="splat", told="points of the input", pictures=footage.splat),
        _Row(name="visibility", told="orange: never seen", pictures=footage.seen()),
        _Row(name="depth", told="near is red", pictures=depth),
    ]
    painted = footage.painted()
    if painted is not None:
        rows.insert(4, _Row(name=footage.kind_plural, told="of the input", pictures=painted))
    return rows


def _depth_colours(depth: NDArray[np.float32], near_m: float, far_m: float) -> Bytes:
    """Depth in metres [...] as RGB u8 [..., 3]: near is red, far is dark blue, in equal steps of the logarithm."""
    known = (depth > 0) & (depth < SKY_M)
    span = max(np.log(max(far_m, 1e-6) / max(near_m, 1e-6)), 1e-6)
    share = np.log(np.maximum(depth, 1e-6) / max(near_m, 1e-6)) / span
    coloured = _TURBO[(255 * (1 - share.clip(0, 1))).round().astype(np.uint8)]
    return np.where(known[..., None], coloured, np.array(_UNKNOWN, np.uint8))


def write_sheet(footage: Footage, out: Path) -> None:
    """All kinds of pictures, one below the other, as PNG. Raises RunError where it cannot be written."""
    write_rows([(row.told, [Strip.of(row.name, row.pictures)]) for row in _rows(footage)], out)


def write_trajectory(footage: Footage, out: Path) -> None:
    """The camera path alone, as PNG. Raises: RenderError without matplotlib, RunError."""
    figure = new_figure(7.2, 5.6)
    axes: Axes3D = figure.add_axes((0.03, 0.03, 0.93, 0.84), projection="3d")  # pyright: ignore[reportAssignmentType]
    _draw_trajectory(axes, footage)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    figure.text(0.03, 0.95, f"{footage.title}: camera path", fontsize=12, fontweight="bold", color=_INK)
    figure.text(0.03, 0.92, footage.path.replace(",\n", ", ").replace("\n", ", "), fontsize=8.5, color=_FAINT)
    figure.text(0.03, 0.89, footage.world, fontsize=8.5, color=_FAINT)
    save(figure, out)


def percent(share: float) -> str:
    """A share of 0 to 1 in words; what is there is never told as nothing."""
    return f"{100 * share:.1f} %" if share >= 0.0005 else "< 0.1 %"


def write_video(footage: Footage, out: Path) -> None:
    """The clip at its own speed, twice over, as MP4 (MPEG-4 part 2). Raises RunError if it cannot be written."""
    strips = [Strip.of(row.name, row.pictures) for row in _rows(footage)]
    moments = [*range(footage.frames), *[footage.frames - 1] * round(HOLD_S * footage.fps)] * 2
    write_mp4((_video_frame(footage, strips, moment) for moment in moments), footage.fps, out)


def _video_frame(footage: Footage, strips: Sequence[Strip], moment: int) -> Bytes:
    """Two lines of pictures with their names; below them the time, and how much the input camera saw."""
    upper, lower = beside(strips[:3], moment), beside(strips[3:], moment)
    missing = upper.shape[1] - lower.shape[1]
    page = np.concatenate([upper, np.pad(lower, ((0, 24), (0, missing), (0, 0)), constant_values=255)])
    seen, at = f"{100 * footage.seen_shares[moment]:.0f} % seen", (2, len(page) - 8)
    words = f"t = {footage.seconds[moment]:.2f} s, frame {footage.frame_numbers[moment]}, {seen}"
    cv2.putText(page, words, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
    return page
