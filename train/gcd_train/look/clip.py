"""A clip of a scene as it is shown, wherever it came from."""

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import SceneView
from gcd_train.pointcloud import splat

Bytes = NDArray[np.uint8]

SKY_M = 250.0
"""Beyond this it is sky: everything that scenes have is nearer."""
UNKNOWN = (38, 38, 38)
"""Colour of depth that is not known, and of sky."""
_GOLDEN = 0.61803398875


def depth_colours(depth: NDArray[np.float32], near_m: float, far_m: float) -> Bytes:
    """Depth in metres [...] as RGB u8 [..., 3]: near is red, far is dark blue, in equal steps of the logarithm."""
    known = (depth > 0) & (depth < SKY_M)
    span = max(np.log(max(far_m, 1e-6) / max(near_m, 1e-6)), 1e-6)
    share = np.log(np.maximum(depth, 1e-6) / max(near_m, 1e-6)) / span
    table = depth_table()
    coloured = table[(255 * (1 - share.clip(0, 1))).round().astype(np.uint8)]
    return np.where(known[..., None], coloured, np.array(UNKNOWN, np.uint8))


def depth_table() -> Bytes:
    """RGB of 256 steps from far to near, u8 [256, 3]."""
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)[:, 0, ::-1], np.uint8)


def depth_ticks(near_m: float, far_m: float) -> list[float]:
    """Round numbers of metres between two depths, at most eight; in a narrow range evenly spaced."""
    rounds = [digit * 10.0**power for power in range(-2, 5) for digit in (1, 2, 3, 5, 7)]
    ticks = [number for number in rounds if near_m <= number <= far_m]
    if len(ticks) > 8:
        return [tick for tick in ticks if f"{tick:e}"[0] in "125"]
    if len(ticks) >= 3 or far_m <= near_m:
        return ticks
    step = next(number for number in rounds if number >= (far_m - near_m) / 5)
    return [round(number * step, 3) for number in range(int(near_m / step) + 1, int(far_m / step) + 1)]


def instance_colour(number: int) -> tuple[int, int, int]:
    """A colour for an instance that its neighbours in number do not have; 0, the background, is light grey."""
    if number == 0:
        return (224, 224, 224)
    lightness = (0.5, 0.62, 0.4)[number % 3]
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN) % 1.0, lightness, 0.75)
    return round(255 * red), round(255 * green), round(255 * blue)


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelName:
    """One class or instance. colour: RGB, 0..255."""

    id: int
    name: str
    colour: tuple[int, int, int]


@dataclass(frozen=True, kw_only=True, slots=True)
class Footage:
    """A clip of T frames, H x W each, from the source camera and from a camera on a path.

    title: layout and scene. layout, path: in words. frame_numbers: of the scene. fps: of the clip. scene_frames,
    scene_fps: of the whole scene. cameras: their names. hfov_deg: of the pictures shown.
    source, target: u8 [T, H, W, 3]. target_is: how the target was made, in words. splat: u8 [T, H, W, 3], the source's
    points alone as the target camera sees them, black where there are none. visible: bool [T, H, W], target pixels
    that the source camera saw; surface: bool [T, H, W], those that show anything but sky, all where that is unknown;
    visible_is: by which rule, in words.
    labels: i32 [T, H, W] ids in the source picture, None without any. kind: of the labels. depth: f32 [T, H, W] metres
    along the optical axis of the source, 0 where nothing is known.
    world_from_source, world_from_target: f64 [T, 4, 4]. look_at: the point the path turns about or ends looking at, or
    None. world: what the axes x, y, z mean. bytes_read: of files.
    """

    title: str
    layout: str
    path: str
    frame_numbers: tuple[int, ...]
    fps: float
    scene_frames: int
    scene_fps: float
    cameras: tuple[str, ...]
    source_camera: str
    hfov_deg: float
    source: Bytes
    target: Bytes
    target_is: str
    splat: Bytes
    visible: NDArray[np.bool_]
    visible_is: str
    surface: NDArray[np.bool_]
    labels: NDArray[np.int32] | None
    kind: str
    names: tuple[LabelName, ...]
    depth: NDArray[np.float32]
    world_from_source: NDArray[np.float64]
    world_from_target: NDArray[np.float64]
    look_at: tuple[float, float, float] | None
    world: str
    bytes_read: int = 0

    @property
    def frames(self) -> int:
        """T."""
        return len(self.source)

    @property
    def kind_plural(self) -> str:
        """The labels in words: classes, instances."""
        return f"{self.kind}es" if self.kind.endswith("s") else f"{self.kind}s"

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time of each frame since the first, f64 [T]."""
        return np.arange(self.frames) / self.fps

    @property
    def depth_range_m(self) -> tuple[float, float]:
        """Nearest and farthest depth but for a hundredth at either end; without sky."""
        known = self.depth[(self.depth > 0) & (self.depth < SKY_M)]
        if not known.size:
            return 0.0, 0.0
        near, far = np.percentile(known, (1, 99))
        return float(near), float(far)

    @property
    def seen_shares(self) -> NDArray[np.float64]:
        """Of the target's surfaces, the share that the source camera saw: f64 [T]."""
        shown = np.maximum(self.surface.sum(axis=(1, 2)), 1)
        return (self.visible & self.surface).sum(axis=(1, 2)) / shown

    def shares(self) -> list[tuple[LabelName, float]]:
        """Share of the source's pixels that each class or instance has over the clip, largest first."""
        if self.labels is None:
            return []
        ids, counts = np.unique(self.labels, return_counts=True)
        names = {name.id: name for name in self.names}
        found = [
            (names.get(int(i), LabelName(id=int(i), name=f"{self.kind} {i}", colour=(0, 0, 0))), count)
            for i, count in zip(ids, counts, strict=True)
        ]
        return sorted(((name, float(count / self.labels.size)) for name, count in found), key=lambda row: -row[1])

    def painted(self) -> Bytes | None:
        """The labels in their colours, u8 [T, H, W, 3]; None without labels."""
        if self.labels is None:
            return None
        table = np.zeros((int(self.labels.max()) + 1, 3), np.uint8)
        for name in self.names:
            if name.id < len(table):
                table[name.id] = name.colour
        return table[self.labels]

    def seen(self) -> Bytes:
        """The target with what the source never saw in orange, u8 [T, H, W, 3]."""
        grey = self.target.mean(-1, keepdims=True)
        unseen = (0.35 * grey + 0.65 * np.array(UNSEEN)).astype(np.uint8)
        return np.where((self.visible | ~self.surface)[..., None], self.target, unseen)


UNSEEN = (255, 106, 0)
"""Colour of what the input camera did not see."""


def splatted(view: SceneView, world_from_camera: NDArray[np.float64], lens: Intrinsics) -> Bytes:
    """A view's points alone from another camera, u8 [H, W, 3]."""
    return (splat([view], world_from_camera, lens).colour * 255).round().byte().cpu().numpy()


def facts_of(footage: Footage) -> list[tuple[str, str]]:
    """Name and value with its unit, for the sheet and the terminal."""
    near, far = footage.depth_range_m
    first, last = footage.frame_numbers[0], footage.frame_numbers[-1]
    way = np.linalg.norm(np.diff(footage.world_from_target[:, :3, 3], axis=0), axis=1).sum()
    height, width = footage.source.shape[1:3]
    seen = footage.seen_shares
    rows = [
        ("scene", f"{footage.scene_frames} frames at {footage.scene_fps:g} fps, {len(footage.cameras)} cameras"),
        ("clip", f"{footage.frames} frames at {footage.fps:g} fps, {first} to {last}"),
        ("pictures", f"{width} x {height} px, hfov {footage.hfov_deg:.1f}°"),
        ("path", footage.path),
        ("path length", f"{way:.1f} m in {footage.seconds[-1]:.2f} s"),
        ("depth", f"{near:.1f} to {far:.1f} m (1st to 99th percentile)"),
        (
            "seen",
            f"{100 * seen.mean():.0f} % of all surfaces, {100 * seen[-1]:.0f} % at the end\n({footage.visible_is})",
        ),
    ]
    if footage.bytes_read:
        rows.append(("read", f"{footage.bytes_read / 1e6:.1f} MB"))
    return rows
