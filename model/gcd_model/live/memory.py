"""What the source camera has shown: this frame's points, and those of earlier frames that stand still, as long as no
newer frame speaks against them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid, require_rigid
from gcd_model.live.config import LiveConfig
from gcd_model.live.eyes import SeenFrame
from gcd_model.live.splat import Splat, Surfels, inverse_depth, relative_slopes, splat, true_at, unproject

_NEAREST_M = 0.1
"""What lies nearer to the source camera than this, or behind it, is outside its picture."""
_SAME_SURFACE = 0.05
"""Relative depth by which a surfel may lie behind what this frame sees and still be that surface, seen again."""


class SurfelMemory:
    """Static surfels of earlier frames, at most `capacity`, oldest first.

    A frame's own surfels join after it was drawn, so that the memory and the frame are splatted in one depth test:
    forget() by the frame, splat() both, add() what stands still of it.
    """

    def __init__(
        self, capacity: int, *, oldest_frames: float = float("inf"), device: torch.device | str = "cpu"
    ) -> None:
        """capacity: 0 remembers nothing. oldest_frames: surfels older than this are dropped."""
        self._capacity, self._oldest_frames, self._device = capacity, oldest_frames, device
        self._surfels = Surfels.empty(device)

    @property
    def surfels(self) -> Surfels:
        """What is remembered, in the order in which it was seen."""
        return self._surfels

    def reset(self) -> None:
        """Forget everything: another scene, or a jump of the camera."""
        self._surfels = Surfels.empty(self._device)

    @torch.no_grad()
    def forget(self, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor | None = None) -> None:
        """Drop what this frame sees again, and what it sees through; keep what is hidden from it or out of its sight.

        Args:
            depth: [H, W] metres, 0 or not finite where nothing is as far as the camera can see, as in the sky.
            world_from_camera: [4, 4] of the source camera, which took the depth.
            known: bool [H, W], false where the depth is a hole: it proves nothing. None: known everywhere.
        """
        if len(self._surfels):
            gone = _refuted(self._surfels.position, depth, lens, world_from_camera, known)
            self._surfels = self._surfels.rows(~gone)

    @torch.no_grad()
    def add(self, fresh: Surfels) -> None:
        """Remember these too; what is too old or beyond the capacity goes, oldest first."""
        if not self._capacity:
            return
        every = self._surfels.joined(fresh)
        if len(every):
            young = every.stamp >= every.stamp.max() - self._oldest_frames
            every = every if bool(young.all()) else every.rows(young)
        if len(every) > self._capacity:
            every = every.rows(_newest(every.stamp, self._capacity))
        self._surfels = every


def _newest(stamp: Tensor, count: int) -> Tensor:
    """Numbers of the newest, in their order; of the oldest frame that still has room an even share is kept."""
    oldest = stamp.kthvalue(len(stamp) - count + 1).values
    newer, at = stamp > oldest, true_at(stamp == oldest)
    room = count - int(newer.sum())
    even = torch.arange(room, device=stamp.device) * len(at) // max(room, 1)
    newer[at[even]] = True
    return true_at(newer)


def _refuted(
    position: Tensor, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor | None
) -> Tensor:
    """Which points [N, 3] lie on, or before, what the camera sees in their direction: bool [N].

    What it sees is the plane of the pixel, not its middle alone: on a street the depth changes by half within a pixel.
    """
    camera_from_world = invert_rigid(world_from_camera.to("cpu", torch.float64)).to(position)
    x, y, z = torch.addmm(camera_from_world[:3, 3:], camera_from_world[:3, :3], position.T)
    u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    inside = (z > _NEAREST_M) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    column, row = (torch.where(inside, each, 0.0).floor() for each in (u, v))
    pixel = (row * lens.width + column).long()
    inverse = inverse_depth(depth)
    here, right, down = (each.flatten().index_select(0, pixel) for each in (inverse, *relative_slopes(inverse)))
    plane = here * (1 + right * (u - column - 0.5) + down * (v - row - 0.5))
    refuted = inside & (z * plane <= 1 + _SAME_SURFACE)
    return refuted if known is None else refuted & known.flatten().index_select(0, pixel)


# --- all that the source camera has shown: this frame's points, and those of earlier frames that stand still ---------


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedFrame:
    """A seen frame and its views before anything is painted. targets: world_from_target [4, 4]. lens: of the views.
    splats: all that was seen, as each target shows it."""

    seen: SeenFrame
    targets: tuple[Tensor, ...]
    lens: Intrinsics
    splats: tuple[Splat, ...]


class SeenWorld:
    """Frame by frame: `look`, then `splat` from as many targets as there are. Poses refer to one world throughout."""

    def __init__(
        self, *, classes: int, capacity: int, oldest_frames: float, device: torch.device | str = "cpu"
    ) -> None:
        """classes: of the labels. capacity, oldest_frames: of the memory, see SurfelMemory; 0 for none."""
        self._classes, self._device = classes, device
        self._memory = SurfelMemory(capacity, oldest_frames=oldest_frames or float("inf"), device=device)
        self._fresh, self._static = Surfels.empty(device), Surfels.empty(device)
        self.now = 0.0
        """Stamp of the newest frame's points."""

    def reset(self) -> None:
        """Forget everything: another scene, or a camera that jumped."""
        self._fresh, self._static = Surfels.empty(self._device), Surfels.empty(self._device)
        self._memory.reset()

    @torch.inference_mode()
    def look(
        self,
        picture: Tensor,
        metres: Tensor,
        labels: Tensor,
        static: Tensor,
        lens: Intrinsics,
        world_from_source: Tensor,
    ) -> None:
        """Take in a frame.

        Args:
            picture: [3, H, W] in [-1, 1]. metres: [H, W], 0 for a hole. labels: uint8 [H, W]. static: bool [H, W], what
                may be remembered. world_from_source: [4, 4].
        """
        self.now += 1.0
        self._memory.add(self._static)
        self._memory.forget(metres, lens, world_from_source, metres > 0)
        self._fresh = unproject(metres, picture, labels, lens, world_from_source, self.now)
        self._static = self._fresh.rows(static.flatten()[(metres > 0).flatten()])

    @property
    def points(self) -> Surfels:
        """All of it: this frame's and the remembered ones."""
        return self._fresh.joined(self._memory.surfels)

    @torch.inference_mode()
    def place(self, frame: SeenFrame, poses: Sequence[Tensor], target_lens: Intrinsics | None = None) -> PlacedFrame:
        """Take in a frame, and splat all of it from every target.

        Args:
            poses: source_from_target [4, 4] of each view, metres. target_lens: of the views; None: the source's.
        Raises:
            PoseError.
        """
        if frame.begins:
            self.reset()
        seen, pose = frame.geometry, frame.world_from_source
        targets = tuple(pose @ require_rigid(each, "a target pose") for each in poses)
        self.look(frame.picture, seen.metres, seen.labels, seen.static, frame.lens, pose)
        lens, points = frame.lens if target_lens is None else target_lens, self.points
        splats = tuple(splat(points, each, lens, self._classes, self.now) for each in targets)
        return PlacedFrame(seen=frame, targets=targets, lens=lens, splats=splats)

    def splat(self, world_from_target: Tensor, lens: Intrinsics) -> Splat:
        """All of it as a target camera sees it, in one depth test."""
        return splat(self.points, world_from_target, lens, self._classes, self.now)


def seen_world(config: LiveConfig, device: torch.device) -> SeenWorld:
    """As the weights say."""
    return SeenWorld(
        classes=len(config.classes), capacity=config.memory, oldest_frames=config.memory_frames, device=device
    )
