"""A clip as it is shown: what is known of it, its contact sheet, the camera path in space, the side-by-side video."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.dataset4d import OntologyItem
from gcd_train.data.pictures import trained_picture
from gcd_train.data.sample import Bytes, SceneView
from gcd_train.data.splat import splat
from gcd_train.evaluation.clips import nearest_resized
from gcd_train.evaluation.galleries import HOLD_S, Strip, beside, write_mp4
from gcd_train.evaluation.galleries import write_sheet as write_rows
from gcd_train.evaluation.predictors import pixel_rays
from gcd_train.pictures import new_figure, save

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

Doubles = NDArray[np.float64]
Poses = NDArray[np.float64]
SKY_M = 250.0
"""Beyond this it is sky: everything that scenes have is nearer."""
UNSEEN = (255, 106, 0)
"""Colour of what the input camera did not see."""
_GOLDEN = 0.61803398875
_SOURCE_COLOUR, _TARGET_COLOUR, _POINT_COLOUR = "#12873f", "#1c4fd8", "#d42a2a"
_SHOWN = 6  # frusta along the path
_POINTS, _CELLS = 6000, 84
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


@dataclass(frozen=True, kw_only=True)
class Footage:
    """A clip of T frames, H x W each, from the source camera and from a camera on a path.

    title: layout and scene. folder, path, scene: in words. frame_numbers: of the scene. fps: of the clip. lens: of the
    pictures shown. views: of the source, of any size, and poses: f64 [T, 4, 4] of the target in their world.
    target: u8 [T, H, W, 3]. target_is: how it was made, in words. target_depth: f32 [T, H, W] metres, None for a target
    that was made from points. visible: bool [T, H, W], target pixels that the source camera saw. classes: of the
    labels, empty where those are instances. instances: their names, as far as known.
    world_from_source, world_from_target: f64 [T, 4, 4], as they are drawn. look_at: the point the path turns about or
    ends looking at, or None. world: what the axes x, y, z mean.
    """

    title: str
    folder: str
    path: str
    scene: str
    frame_numbers: tuple[int, ...]
    fps: float
    source_camera: str
    lens: Intrinsics
    views: list[SceneView]
    poses: Poses
    target: Bytes
    target_is: str
    target_depth: NDArray[np.float32] | None
    visible: NDArray[np.bool_]
    classes: tuple[OntologyItem, ...]
    instances: dict[int, str]
    world_from_source: Poses
    world_from_target: Poses
    look_at: tuple[float, float, float] | None
    world: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.lens.width, self.lens.height

    @cached_property
    def source(self) -> Bytes:
        """u8 [T, H, W, 3]."""
        return np.stack([trained_picture(view.rgb, *self.size) for view in self.views])

    @cached_property
    def depth(self) -> NDArray[np.float32]:
        """f32 [T, H, W] metres along the optical axis of the source, 0 where nothing is known."""
        return np.stack([nearest_resized(view.depth, *self.size) for view in self.views])

    @cached_property
    def splat(self) -> Bytes:
        """The source's points alone as the target camera sees them, black where there are none: u8 [T, H, W, 3]."""
        return np.stack([splat([v], at, self.lens).picture for v, at in zip(self.views, self.poses, strict=True)])

    @cached_property
    def labels(self) -> NDArray[np.int32] | None:
        """Ids in the source picture, i32 [T, H, W]; None without any."""
        ids = [view.classes if self.classes else view.instances for view in self.views]
        known = [nearest_resized(each, *self.size) for each in ids if each is not None]
        return np.stack(known).astype(np.int32) if len(known) == len(ids) else None

    @cached_property
    def names(self) -> dict[int, OntologyItem]:
        """Of the ids: all classes, or the instances that are seen; 0 is the background of these."""
        if self.classes or self.labels is None:
            return {item.id: item for item in self.classes}
        told = {0: "background"} | self.instances
        return {
            i: OntologyItem(id=i, name=told.get(i, f"instance {i}"), colour=_instance_colour(i))
            for i in np.unique(self.labels).tolist()
        }

    @property
    def kind_plural(self) -> str:
        """The labels in words: classes, instances."""
        return "classes" if self.classes else "instances"

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time of each frame since the first, f64 [T]."""
        return np.arange(len(self.views)) / self.fps

    @property
    def depth_range_m(self) -> tuple[float, float]:
        """Nearest and farthest depth but for a hundredth at either end; without sky."""
        known = self.depth[(self.depth > 0) & (self.depth < SKY_M)]
        if not known.size:
            return 0.0, 0.0
        near, far = np.percentile(known, (1, 99))
        return float(near), float(far)

    @property
    def surface(self) -> NDArray[np.bool_]:
        """Target pixels that show anything but sky, bool [T, H, W]; all where that is unknown."""
        depth = self.target_depth
        return np.ones_like(self.visible) if depth is None else (depth > 0) & (depth < SKY_M)

    @property
    def seen_shares(self) -> NDArray[np.float64]:
        """Of the target's surfaces, the share that the source camera saw: f64 [T]."""
        shown = np.maximum(self.surface.sum(axis=(1, 2)), 1)
        return (self.visible & self.surface).sum(axis=(1, 2)) / shown

    def painted(self) -> Bytes | None:
        """The labels in their colours, u8 [T, H, W, 3]; None without labels."""
        if self.labels is None:
            return None
        table = np.zeros((max(int(self.labels.max()), *self.names) + 1, 3), np.uint8)
        for item in self.names.values():
            table[item.id] = item.colour
        return table[self.labels]

    def seen(self) -> Bytes:
        """The target with what the source never saw in orange, u8 [T, H, W, 3]."""
        grey = self.target.mean(-1, keepdims=True)
        unseen = (0.35 * grey + 0.65 * np.array(UNSEEN)).astype(np.uint8)
        return np.where((self.visible | ~self.surface)[..., None], self.target, unseen)

    def facts(self) -> list[tuple[str, str]]:
        """Name and value with its unit, for the terminal; of labels the share of the source's pixels, largest first."""
        near, far = self.depth_range_m
        way = np.linalg.norm(np.diff(self.world_from_target[:, :3, 3], axis=0), axis=1).sum()
        seen, rule = self.seen_shares, "published rule" if self.target_depth is None else "depths agree within 2 %"
        facts = [
            ("folder", self.folder),
            ("scene", self.scene),
            (
                "clip",
                f"{len(self.views)} frames at {self.fps:g} fps, {self.frame_numbers[0]} to {self.frame_numbers[-1]}",
            ),
            ("pictures", f"{self.lens.width} x {self.lens.height} px, hfov {self.lens.hfov_deg:.1f}°"),
            ("path", self.path),
            ("path length", f"{way:.1f} m in {self.seconds[-1]:.2f} s"),
            ("depth", f"{near:.1f} to {far:.1f} m (1st to 99th percentile)"),
            ("seen", f"{100 * seen.mean():.0f} % of all surfaces, {100 * seen[-1]:.0f} % at the end ({rule})"),
            ("axes", self.world),
        ]
        if self.labels is None:
            return facts
        ids, counts = np.unique(self.labels, return_counts=True)
        shares = sorted(zip(counts / self.labels.size, ids.tolist(), strict=True), key=lambda each: -each[0])
        told = [f"{self.names[i].name if i in self.names else f'class {i}'} {_percent(share)}" for share, i in shares]
        return [*facts, (self.kind_plural, ", ".join(told))]


def _percent(share: float) -> str:
    """A share of 0 to 1 in words; what is there is never told as nothing."""
    return f"{100 * share:.1f} %" if share >= 0.0005 else "< 0.1 %"


def _instance_colour(number: int) -> tuple[int, int, int]:
    """A colour for an instance that its neighbours in number do not have; 0, the background, is light grey."""
    if number == 0:
        return (224, 224, 224)
    lightness = (0.5, 0.62, 0.4)[number % 3]
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN) % 1.0, lightness, 0.75)
    return round(255 * red), round(255 * green), round(255 * blue)


def _draw_trajectory(axes: "Axes3D", footage: Footage) -> None:
    """Fill 3D axes: source and target frusta, path, look-at point, and the input's points around them."""
    low, high = _box(footage)
    size = 0.085 * float((high - low)[:2].max())
    _points(axes, footage, low, high)
    for number in np.unique(np.linspace(0, len(footage.views) - 1, _SHOWN).round().astype(int)):
        strength = 0.35 + 0.65 * number / max(len(footage.views) - 1, 1)
        _frustum(axes, footage, footage.world_from_target[number], size, _TARGET_COLOUR, strength)
    _frustum(axes, footage, footage.world_from_source[0], size, _SOURCE_COLOUR, 1.0)
    x, y, z = footage.world_from_target[:, :3, 3].T
    axes.plot(x, y, z, color=_TARGET_COLOUR, linewidth=2.0, label=f"target, {len(footage.views)} frames", zorder=5)
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
    half_width, half_height = footage.lens.width / 2 / footage.lens.fx, footage.lens.height / 2 / footage.lens.fy
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
    depth, pose = footage.depth[0], footage.world_from_source[0]
    world = (pixel_rays(footage.lens).numpy() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    shown = (depth > 0) & (depth < SKY_M) & ((world >= low) & (world <= high)).all(-1)
    points, colours = world[shown], footage.source[0][shown] / 255.0
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


def _rows(footage: Footage) -> list[tuple[str, Strip]]:
    """Everything there is to see of a clip, in the order of the sheet, each with what it is."""
    rows = [
        (footage.source_camera, Strip.of("input", footage.source)),
        (footage.target_is, Strip.of("target", footage.target)),
        ("points of the input", Strip.of("splat", footage.splat)),
        ("orange: never seen", Strip.of("visibility", footage.seen())),
    ]
    painted = footage.painted()
    if painted is not None:
        rows.append(("of the input", Strip.of(footage.kind_plural, painted)))
    depth = _depth_colours(footage.depth, *footage.depth_range_m)
    return [*rows, ("near is red", Strip.of("depth", depth))]


def _depth_colours(depth: NDArray[np.float32], near_m: float, far_m: float) -> Bytes:
    """Depth in metres [...] as RGB u8 [..., 3]: near is red, far is dark blue, in equal steps of the logarithm."""
    known = (depth > 0) & (depth < SKY_M)
    span = max(np.log(max(far_m, 1e-6) / max(near_m, 1e-6)), 1e-6)
    share = np.log(np.maximum(depth, 1e-6) / max(near_m, 1e-6)) / span
    coloured = _TURBO[(255 * (1 - share.clip(0, 1))).round().astype(np.uint8)]
    return np.where(known[..., None], coloured, np.array(_UNKNOWN, np.uint8))


def write_sheet(footage: Footage, out: Path) -> None:
    """All kinds of pictures, one below the other, as PNG. Raises RunError where it cannot be written."""
    write_rows([(told, [strip]) for told, strip in _rows(footage)], out)


def write_trajectory(footage: Footage, out: Path) -> None:
    """The camera path alone, as PNG. Raises: RenderError without matplotlib, RunError."""
    figure = new_figure(7.2, 5.6)
    axes: Axes3D = figure.add_axes((0.03, 0.03, 0.93, 0.84), projection="3d")  # pyright: ignore[reportAssignmentType]
    _draw_trajectory(axes, footage)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    figure.text(0.03, 0.95, f"{footage.title}: camera path", fontsize=12, fontweight="bold", color=_INK)
    figure.text(0.03, 0.92, footage.path, fontsize=8.5, color=_FAINT)
    figure.text(0.03, 0.89, footage.world, fontsize=8.5, color=_FAINT)
    save(figure, out)


def write_video(footage: Footage, out: Path) -> None:
    """The clip at its own speed, twice over, as MP4 (MPEG-4 part 2). Raises RunError if it cannot be written."""
    strips = [strip for _, strip in _rows(footage)]
    moments = [*range(len(footage.views)), *[len(footage.views) - 1] * round(HOLD_S * footage.fps)] * 2
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
