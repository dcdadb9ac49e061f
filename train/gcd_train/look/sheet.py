"""A clip as it is shown: what is known of it, its contact sheet, the camera path in space, the side-by-side video."""

import colorsys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.dataset4d import Ontology
from gcd_train.data.pictures import nearest_resized, trained_picture
from gcd_train.data.sample import Bytes, Sample, SceneView
from gcd_train.data.splat import splat
from gcd_train.evaluation.galleries import HOLD_S, Strip, beside
from gcd_train.evaluation.galleries import write_sheet as write_rows
from gcd_train.evaluation.predictors import pixel_rays
from gcd_train.pictures import new_figure, save, write_mp4

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d import Axes3D

Poses = NDArray[np.float64]
SKY_M = 250.0
"""Beyond this it is sky: everything that scenes have is nearer."""
UNSEEN = (255, 106, 0)
"""Colour of what the input camera did not see."""
_GOLDEN = 0.61803398875
_SOURCE_COLOUR, _TARGET_COLOUR, _POINT_COLOUR = "#12873f", "#1c4fd8", "#d42a2a"
_FRUSTA, _POINTS = 6, 6000
_INK, _FAINT = "#1b2530", "#5c6875"
_UNKNOWN = (38, 38, 38)
"""Colour of depth that is not known, and of sky."""
_TURBO = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1].astype(np.uint8)
"""RGB of 256 steps from far to near."""


@dataclass(frozen=True, kw_only=True)
class Footage:
    """A clip of T frames, H x W each, from the source camera and from a camera on a path.

    title: layout and scene. path, scene: in words. source_camera: its name. lens: of the pictures shown. views: of the
    source, of any size, and poses: f64 [T, 4, 4] of the target in their world. sample: the clip's target, which of its
    pixels the source saw, its depth where it was drawn exactly. target_is: how it was made, in words. ontology: of the
    views' classes; None where instances are shown. look_at: the point the path turns about or ends looking at. world:
    what the axes x, y, z mean.
    """

    title: str
    path: str
    scene: str
    source_camera: str
    lens: Intrinsics
    views: list[SceneView]
    poses: Poses
    sample: Sample
    target_is: str
    ontology: Ontology | None
    look_at: tuple[float, float, float]
    world: str

    @cached_property
    def source(self) -> Bytes:
        """u8 [T, H, W, 3]."""
        return np.stack([trained_picture(view.rgb, self.lens.width, self.lens.height) for view in self.views])

    @cached_property
    def depth(self) -> NDArray[np.float32]:
        """f32 [T, H, W] metres along the optical axis of the source, 0 where nothing is known."""
        return np.stack([nearest_resized(view.depth, self.lens.width, self.lens.height) for view in self.views])

    @cached_property
    def splat(self) -> Bytes:
        """The source's points alone as the target camera sees them, black where there are none: u8 [T, H, W, 3]."""
        return np.stack([splat([v], at, self.lens).picture for v, at in zip(self.views, self.poses, strict=True)])

    @cached_property
    def labels(self) -> NDArray[np.int32] | None:
        """Ids in the source picture, i32 [T, H, W]; None without any."""
        ids = [view.instances if self.ontology is None else view.classes for view in self.views]
        known = [nearest_resized(each, self.lens.width, self.lens.height) for each in ids if each is not None]
        return np.stack(known).astype(np.int32) if len(known) == len(ids) else None

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Target pixels that the source camera saw, bool [T, H, W]; all where that is unknown."""
        seen = self.sample.visible
        return np.ones(self.sample.target.shape[:3], np.bool_) if seen is None else seen

    @property
    def depth_range_m(self) -> tuple[float, float]:
        """Nearest and farthest depth but for a hundredth at either end; without sky."""
        known = self.depth[(self.depth > 0) & (self.depth < SKY_M)]
        near, far = np.percentile(known, (1, 99)) if known.size else (0.0, 0.0)
        return float(near), float(far)

    @property
    def surface(self) -> NDArray[np.bool_]:
        """Target pixels that show anything but sky, bool [T, H, W]; all where that is unknown."""
        depth = self.sample.target_depth
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
        if self.ontology is not None:
            return self.ontology.palette[self.labels]
        colours = [_instance_colour(number) for number in range(int(self.labels.max()) + 1)]
        return np.array(colours, np.uint8)[self.labels]

    def seen(self) -> Bytes:
        """The target with what the source never saw in orange, u8 [T, H, W, 3]."""
        grey = self.sample.target.mean(-1, keepdims=True)
        unseen = (0.35 * grey + 0.65 * np.array(UNSEEN)).astype(np.uint8)
        return np.where((self.visible | ~self.surface)[..., None], self.sample.target, unseen)

    def facts(self) -> list[tuple[str, str]]:
        """Name and value with its unit; of classes the share of the source's pixels, largest first."""
        (near, far), numbers, seen = self.depth_range_m, self.sample.frame_numbers, self.seen_shares
        rule = "published rule" if self.sample.target_depth is None else "depths agree within 2 %"
        facts = [
            ("scene", self.scene),
            ("clip", f"{len(numbers)} frames at {self.sample.fps:g} fps, {numbers[0]} to {numbers[-1]}"),
            ("pictures", f"{self.lens.width} x {self.lens.height} px, hfov {self.lens.hfov_deg:.1f}°"),
            ("path", self.path),
            ("depth", f"{near:.1f} to {far:.1f} m (1st to 99th percentile)"),
            ("seen", f"{100 * seen.mean():.0f} % of all surfaces, {100 * seen[-1]:.0f} % at the end ({rule})"),
            ("axes", self.world),
        ]
        if self.ontology is not None and self.labels is not None:
            names = {item.id: item.name for item in self.ontology.items}
            ids, counts = np.unique(self.labels, return_counts=True)
            shares = sorted(zip(counts / self.labels.size, ids.tolist(), strict=True), key=lambda each: -each[0])
            facts.append(("classes", ", ".join(f"{names.get(i, i)} {100 * share:.1f} %" for share, i in shares)))
        return facts


def _instance_colour(number: int) -> tuple[int, int, int]:
    """A colour for an instance that its neighbours in number do not have; 0, the background, is light grey."""
    if number == 0:
        return (224, 224, 224)
    lightness = (0.5, 0.62, 0.4)[number % 3]
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN) % 1.0, lightness, 0.75)
    return round(255 * red), round(255 * green), round(255 * blue)


def _rows(footage: Footage) -> list[tuple[str, Strip]]:
    """Everything there is to see of a clip, in the order of the sheet, each with what it is."""
    rows = [
        (footage.source_camera, Strip.of("input", footage.source)),
        (footage.target_is, Strip.of("target", footage.sample.target)),
        ("points of the input", Strip.of("splat", footage.splat)),
        ("orange: never seen", Strip.of("visibility", footage.seen())),
    ]
    painted = footage.painted()
    if painted is not None:
        rows.append(("of the input", Strip.of("instances" if footage.ontology is None else "classes", painted)))
    near_m, far_m = (max(each, 1e-6) for each in footage.depth_range_m)
    span = max(np.log(far_m / near_m), 1e-6)  # far is dark blue, in equal steps of the logarithm
    share = np.log(np.maximum(footage.depth, 1e-6) / near_m) / span
    coloured = _TURBO[(255 * (1 - share.clip(0, 1))).round().astype(np.uint8)]
    known = ((footage.depth > 0) & (footage.depth < SKY_M))[..., None]
    depth = np.where(known, coloured, np.array(_UNKNOWN, np.uint8))
    return [*rows, ("near is red", Strip.of("depth", depth))]


def write_sheet(footage: Footage, out: Path) -> None:
    """All kinds of pictures, one below the other, as PNG. Raises RunError where it cannot be written."""
    write_rows([(told, [strip]) for told, strip in _rows(footage)], out)


def write_video(footage: Footage, out: Path) -> None:
    """The clip at its own speed, twice over, as MP4 (MPEG-4 part 2). Raises RunError if it cannot be written."""
    strips, fps, frames = [strip for _, strip in _rows(footage)], footage.sample.fps, len(footage.views)

    def shown(moment: int) -> Bytes:
        """Two lines of pictures with their names; below them the time, and how much the input camera saw."""
        upper, lower = beside(strips[:3], moment), beside(strips[3:], moment)
        missing = upper.shape[1] - lower.shape[1]
        page = np.concatenate([upper, np.pad(lower, ((0, 24), (0, missing), (0, 0)), constant_values=255)])
        seen = f"{100 * footage.seen_shares[moment]:.0f} % seen"
        words = f"t = {moment / fps:.2f} s, frame {footage.sample.frame_numbers[moment]}, {seen}"
        cv2.putText(page, words, (2, len(page) - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
        return page

    moments = [*range(frames), *[frames - 1] * round(HOLD_S * fps)] * 2
    write_mp4(map(shown, moments), fps, out)


def write_trajectory(footage: Footage, out: Path) -> None:
    """The camera path alone, as PNG. Raises: RenderError without matplotlib, RunError."""
    figure = new_figure(7.2, 5.6)
    axes: Axes3D = figure.add_axes((0.03, 0.03, 0.93, 0.84), projection="3d")  # pyright: ignore[reportAssignmentType]
    source, path, look_at = footage.views[0].world_from_camera, footage.poses, np.array(footage.look_at)
    marks = np.stack([source[:3, 3], look_at, *path[:, :3, 3]])
    half = 0.6 * max(float(np.ptp(marks, axis=0).max()), 3.0)  # of a cube about cameras and look-at point
    middle = (marks.min(axis=0) + marks.max(axis=0)) / 2
    middle[2] = max(middle[2], half)  # it stands on the ground
    _draw_points(axes, footage, middle - half, middle + half)
    for number in np.unique(np.linspace(0, len(path) - 1, _FRUSTA).round().astype(int)):
        _draw_frustum(axes, footage.lens, path[number], half / 6, _TARGET_COLOUR, 0.35 + 0.65 * number / len(path))
    _draw_frustum(axes, footage.lens, source, half / 6, _SOURCE_COLOUR, 1.0)
    axes.plot(*path[:, :3, 3].T, color=_TARGET_COLOUR, linewidth=2.0, label=f"target, {len(path)} frames", zorder=5)
    axes.scatter(*source[:3, 3], color=_SOURCE_COLOUR, s=20, label=f"source ({footage.source_camera})", zorder=5)
    label = "look-at ({:g}, {:g}, {:g}) m".format(*footage.look_at)
    axes.scatter(*look_at, color=_POINT_COLOUR, marker="x", s=44, linewidths=2.0, label=label, zorder=6)
    for axis, low, high, name in zip("xyz", middle - half, middle + half, ("x [m]", "y [m]", "z [m]"), strict=True):
        axes.set(**{f"{axis}lim": (low, high), f"{axis}label": name})
    axes.set_box_aspect((1, 1, 1))
    axes.computed_zorder = False
    ahead = source[:2, 2]  # looked at from behind the cameras and beside the path
    axes.view_init(elev=24, azim=float(np.degrees(np.arctan2(-ahead[1], -ahead[0]))) + 50.0)
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    figure.text(0.03, 0.95, f"{footage.title}: camera path", fontsize=12, fontweight="bold", color=_INK)
    figure.text(0.03, 0.89, f"{footage.path}\n{footage.world}", fontsize=8.5, color=_FAINT)
    save(figure, out)


def _draw_frustum(axes: "Axes3D", lens: Intrinsics, pose: Poses, size: float, colour: str, strength: float) -> None:
    """A camera as a pyramid with a roof that says which edge is the upper one."""
    x, y = lens.width / 2 / lens.fx, lens.height / 2 / lens.fy
    scale = size / max(x, 1.0)  # wide lenses get no larger pyramids
    corners = np.array([(-x, -y, 1), (x, -y, 1), (x, y, 1), (-x, y, 1), (0.0, -1.45 * y, 1.0), (0, 0, 0)]) * scale
    points = corners @ pose[:3, :3].T + pose[:3, 3]
    style: dict[str, Any] = {"color": colour, "alpha": strength, "linewidth": 1.2, "zorder": 4}
    for line in ([0, 1, 2, 3, 0, 4, 1], [0, 5, 1], [2, 5, 3]):
        axes.plot(*points[line].T, **style)


def _draw_points(axes: "Axes3D", footage: Footage, low: Poses, high: Poses) -> None:
    """Some of the first frame's points in their colours, those inside the axes."""
    depth, pose = footage.depth[0], footage.views[0].world_from_camera
    world = (pixel_rays(footage.lens).numpy() * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]
    shown = (depth > 0) & ((world >= low) & (world <= high)).all(-1)
    points, colours = world[shown], footage.source[0][shown] / 255.0
    chosen = np.random.default_rng(0).permutation(len(points))[:_POINTS]
    axes.scatter(*points[chosen].T, c=colours[chosen], s=5, linewidths=0, alpha=0.75, depthshade=False, zorder=1)
