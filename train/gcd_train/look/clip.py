"""A clip of a scene as it is shown, wherever it came from."""

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.data.dataset4d import OntologyItem

Bytes = NDArray[np.uint8]
Poses = NDArray[np.float64]

SKY_M = 250.0
"""Beyond this it is sky: everything that scenes have is nearer."""
UNSEEN = (255, 106, 0)
"""Colour of what the input camera did not see."""
_GOLDEN = 0.61803398875


def instance_colour(number: int) -> tuple[int, int, int]:
    """A colour for an instance that its neighbours in number do not have; 0, the background, is light grey."""
    if number == 0:
        return (224, 224, 224)
    lightness = (0.5, 0.62, 0.4)[number % 3]
    red, green, blue = colorsys.hls_to_rgb((number * _GOLDEN) % 1.0, lightness, 0.75)
    return round(255 * red), round(255 * green), round(255 * blue)


@dataclass(frozen=True, kw_only=True, slots=True)
class Footage:
    """A clip of T frames, H x W each, from the source camera and from a camera on a path.

    title: layout and scene. layout, path: in words. frame_numbers: of the scene. fps: of the clip. scene_frames,
    scene_fps: of the whole scene. cameras: their names. hfov_deg: of the pictures shown.
    source, target: u8 [T, H, W, 3]. target_is: how the target was made, in words. target_depth: f32 [T, H, W] metres,
    None for a target that was made from points. splat: u8 [T, H, W, 3], the source's points alone as the target camera
    sees them, black where there are none. visible: bool [T, H, W], target pixels that the source camera saw.
    labels: i32 [T, H, W] ids in the source picture, None without any. kind: of the labels, "class" or "instance".
    names: of the ids. depth: f32 [T, H, W] metres along the optical axis of the source, 0 where nothing is known.
    world_from_source, world_from_target: f64 [T, 4, 4]. look_at: the point the path turns about or ends looking at, or
    None. world: what the axes x, y, z mean.
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
    target_depth: NDArray[np.float32] | None
    splat: Bytes
    visible: NDArray[np.bool_]
    labels: NDArray[np.int32] | None
    kind: str
    names: tuple[OntologyItem, ...]
    depth: NDArray[np.float32]
    world_from_source: Poses
    world_from_target: Poses
    look_at: tuple[float, float, float] | None
    world: str

    @property
    def frames(self) -> int:
        """T."""
        return len(self.source)

    @property
    def kind_plural(self) -> str:
        """The labels in words: classes, instances."""
        return "classes" if self.kind == "class" else "instances"

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
    def surface(self) -> NDArray[np.bool_]:
        """Target pixels that show anything but sky, bool [T, H, W]; all where that is unknown."""
        depth = self.target_depth
        return np.ones_like(self.visible) if depth is None else (depth > 0) & (depth < SKY_M)

    @property
    def seen_shares(self) -> NDArray[np.float64]:
        """Of the target's surfaces, the share that the source camera saw: f64 [T]."""
        shown = np.maximum(self.surface.sum(axis=(1, 2)), 1)
        return (self.visible & self.surface).sum(axis=(1, 2)) / shown

    def shares(self) -> list[tuple[OntologyItem, float]]:
        """Share of the source's pixels that each class or instance has over the clip, largest first."""
        if self.labels is None:
            return []
        ids, counts = np.unique(self.labels, return_counts=True)
        names = {item.id: item for item in self.names}
        found = [
            (names.get(i, OntologyItem(id=i, name=f"{self.kind} {i}", colour=(0, 0, 0))), count / self.labels.size)
            for i, count in zip(ids.tolist(), counts.tolist(), strict=True)
        ]
        return sorted(found, key=lambda row: -row[1])

    def painted(self) -> Bytes | None:
        """The labels in their colours, u8 [T, H, W, 3]; None without labels."""
        if self.labels is None:
            return None
        table = np.zeros((max(int(self.labels.max()), *(item.id for item in self.names)) + 1, 3), np.uint8)
        for item in self.names:
            table[item.id] = item.colour
        return table[self.labels]

    def seen(self) -> Bytes:
        """The target with what the source never saw in orange, u8 [T, H, W, 3]."""
        grey = self.target.mean(-1, keepdims=True)
        unseen = (0.35 * grey + 0.65 * np.array(UNSEEN)).astype(np.uint8)
        return np.where((self.visible | ~self.surface)[..., None], self.target, unseen)

    def facts(self) -> list[tuple[str, str]]:
        """Name and value with its unit, for the sheet and the terminal."""
        near, far = self.depth_range_m
        way = np.linalg.norm(np.diff(self.world_from_target[:, :3, 3], axis=0), axis=1).sum()
        height, width = self.source.shape[1:3]
        seen, rule = self.seen_shares, "published rule" if self.target_depth is None else "depths agree within 2 %"
        return [
            ("scene", f"{self.scene_frames} frames at {self.scene_fps:g} fps, {len(self.cameras)} cameras"),
            ("clip", f"{self.frames} frames at {self.fps:g} fps, {self.frame_numbers[0]} to {self.frame_numbers[-1]}"),
            ("pictures", f"{width} x {height} px, hfov {self.hfov_deg:.1f}°"),
            ("path", self.path),
            ("path length", f"{way:.1f} m in {self.seconds[-1]:.2f} s"),
            ("depth", f"{near:.1f} to {far:.1f} m (1st to 99th percentile)"),
            ("seen", f"{100 * seen.mean():.0f} % of all surfaces, {100 * seen[-1]:.0f} % at the end\n({rule})"),
        ]
