"""The camera path in space, drawn with matplotlib: frusta of the source and of the target, axes in metres."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.show.colours import SKY_M
from gcd_train.show.footage import Footage

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

Doubles = NDArray[np.float64]
SOURCE_COLOUR, TARGET_COLOUR, POINT_COLOUR = "#12873f", "#1c4fd8", "#d42a2a"
_SHOWN = 6  # frusta along the path
_POINTS, _CELLS = 6000, 84
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


def draw_trajectory(axes: "Axes3D", footage: Footage) -> None:
    """Fill 3D axes: source and target frusta, path, look-at point, and the input's points around them."""
    low, high = _box(footage)
    size = 0.085 * float((high - low)[:2].max())
    _points(axes, footage, low, high)
    for number in np.unique(np.linspace(0, footage.frames - 1, _SHOWN).round().astype(int)):
        strength = 0.35 + 0.65 * number / max(footage.frames - 1, 1)
        _frustum(axes, footage, footage.world_from_target[number], size, TARGET_COLOUR, strength)
    _frustum(axes, footage, footage.world_from_source[0], size, SOURCE_COLOUR, 1.0)
    x, y, z = footage.world_from_target[:, :3, 3].T
    axes.plot(x, y, z, color=TARGET_COLOUR, linewidth=2.0, label=f"target, {footage.frames} frames", zorder=5)
    axes.scatter(*footage.world_from_target[-1, :3, 3], color=TARGET_COLOUR, s=20, zorder=5)
    source = footage.world_from_source[0, :3, 3]
    axes.scatter(*source, color=SOURCE_COLOUR, s=20, label=f"source ({footage.source_camera})", zorder=5)
    if footage.look_at is not None:
        x, y, z = footage.look_at
        label = f"look-at ({x:g}, {y:g}, {z:g}) m"
        point = np.array(footage.look_at)
        axes.scatter(*point, color=POINT_COLOUR, marker="x", s=44, linewidths=2.0, label=label, zorder=6)
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
    axes.scatter(
        *points[chosen].T,
        c=colours[chosen],
        s=5,
        linewidths=0,
        alpha=0.75,
        depthshade=False,
        zorder=1,
    )


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
    axes.view_init(elev=24, azim=_across_the_path(footage))


def _across_the_path(footage: Footage) -> float:
    """Azimuth to look from, degrees: behind the cameras and beside the path."""
    ahead = footage.world_from_source[0, :2, 2]
    return float(np.degrees(np.arctan2(-ahead[1], -ahead[0]))) + 50.0
