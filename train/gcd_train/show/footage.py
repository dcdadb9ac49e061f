"""What is shown of a scene, wherever it came from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_train.show.colours import SKY_M

Bytes = NDArray[np.uint8]


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
