"""What the source camera has shown: this frame's points, and those of earlier frames that stand still, as long as no
newer frame speaks against them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.config import LiveConfig
from gcd_model.live.eyes import SeenFrame
from gcd_model.live.splat import Splat, Surfels, inverse_depth, relative_slopes, splat, true_at, unproject

_NEAREST_M = 0.1
"""What lies nearer to the source camera than this, or behind it, is outside its picture."""
_SAME_SURFACE = 0.05
"""Relative depth by which a surfel may lie behind what this frame sees and still be that surface, seen again."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlacedFrame:
    """A seen frame and its views before anything is painted. targets: world_from_target [4, 4]. lens: of the views.
    splats: all that was seen, as each target shows it."""

    seen: SeenFrame
    targets: tuple[Tensor, ...]
    lens: Intrinsics
    splats: tuple[Splat, ...]


class SeenWorld:
    """Frame by frame: `look`, then `splat` from as many targets as there are. Poses refer to one world throughout.

    A frame's own surfels are remembered after it was drawn, so that all are splatted in one depth test.
    """

    def __init__(self, config: LiveConfig, device: torch.device | str = "cpu") -> None:
        self._config, self._device = config, device
        self._now = 0.0  # stamp of the newest frame's points
        self.reset()

    def reset(self) -> None:
        """Forget everything: another scene, or a camera that jumped."""
        self._fresh = self._static = self._memory = Surfels.empty(self._device)

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
        self._now += 1.0
        config, known = self._config, metres > 0
        kept = remembered(self._memory, self._static, config.memory, config.memory_frames)
        self._memory = unrefuted(kept, metres, lens, world_from_source, known)
        self._fresh = unproject(metres, picture, labels, lens, world_from_source, self._now)
        self._static = self._fresh.rows(static.flatten()[known.flatten()])

    @torch.inference_mode()
    def place(self, frame: SeenFrame, poses: Sequence[Tensor], target_lens: Intrinsics | None = None) -> PlacedFrame:
        """Take in a frame, and splat all of it from every target.

        poses: source_from_target [4, 4] of each view, metres. target_lens: of the views; None: the source's.
        """
        if frame.begins:
            self.reset()
        seen, pose, lens = frame.geometry, frame.world_from_source, target_lens or frame.lens
        self.look(frame.picture, seen.metres, seen.labels, seen.static, frame.lens, pose)
        targets = tuple(pose @ each for each in poses)
        points = self._fresh.joined(self._memory)
        splats = tuple(splat(points, each, lens, len(self._config.classes), self._now) for each in targets)
        return PlacedFrame(seen=frame, targets=targets, lens=lens, splats=splats)

    def splat(self, world_from_target: Tensor, lens: Intrinsics) -> Splat:
        """All of it as a target camera sees it, in one depth test."""
        points = self._fresh.joined(self._memory)
        return splat(points, world_from_target, lens, len(self._config.classes), self._now)


def remembered(memory: Surfels, fresh: Surfels, capacity: int, oldest_frames: int) -> Surfels:
    """Both; what is beyond the capacity, or older than so many frames (0: no limit), goes, oldest first."""
    every = memory.joined(fresh)
    if not capacity or not len(every):
        return memory
    young = every.stamp >= every.stamp.max() - (oldest_frames or float("inf"))
    every = every if bool(young.all()) else every.rows(young)
    if len(every) <= capacity:
        return every
    oldest = every.stamp.kthvalue(len(every) - capacity + 1).values
    newer, at = every.stamp > oldest, true_at(every.stamp == oldest)
    room = capacity - int(newer.sum())  # of the oldest frame that still has some an even share is kept
    newer[at[torch.arange(room, device=at.device) * len(at) // max(room, 1)]] = True
    return every.rows(newer)


def unrefuted(memory: Surfels, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor) -> Surfels:
    """Without what a frame sees again or sees through; what is hidden from it, or out of its sight, stays.

    What it sees is the plane of a pixel, not its middle alone: on a street the depth changes by half within a pixel.

    Args:
        depth: [H, W] metres, 0 or not finite where nothing is as far as the camera can see, as in the sky.
        world_from_camera: [4, 4] of the source camera, which took the depth.
        known: bool [H, W], false where the depth is a hole: it proves nothing.
    """
    if not len(memory):
        return memory
    position = memory.position
    camera_from_world = invert_rigid(world_from_camera.to("cpu", torch.float64)).to(position)
    x, y, z = torch.addmm(camera_from_world[:3, 3:], camera_from_world[:3, :3], position.T)
    u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    inside = (z > _NEAREST_M) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    column, row = (torch.where(inside, each, 0.0).floor() for each in (u, v))
    pixel = (row * lens.width + column).long()
    inverse = inverse_depth(depth)
    here, right, down = (each.flatten().index_select(0, pixel) for each in (inverse, *relative_slopes(inverse)))
    plane = here * (1 + right * (u - column - 0.5) + down * (v - row - 0.5))
    refuted = inside & (z * plane <= 1 + _SAME_SURFACE) & known.flatten().index_select(0, pixel)
    return memory.rows(~refuted)
