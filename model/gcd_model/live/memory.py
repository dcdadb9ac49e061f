"""What was seen before and stands still: surfels of earlier frames, as long as no newer frame speaks against them."""

import torch
from torch import Tensor

from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.live.splat import Surfels, inverse_depth, relative_slopes

_NEAREST_M = 0.1
"""What lies nearer to the source camera than this, or behind it, is outside its picture."""
_SAME_SURFACE = 0.05
"""Relative depth by which a surfel may lie behind what this frame sees and still be that surface, seen again."""


class SurfelMemory:
    """Static surfels of earlier frames, at most `capacity`, oldest first.

    A frame's own surfels join after it was drawn, so that the memory and the frame are splatted in one depth test:

        splat(fresh.joined(memory.surfels), ...)
        memory.update(depth, lens, world_from_camera, fresh.rows(static))

    or, to draw against what the frame has already corrected: forget(), splat(), add().
    """

    def __init__(
        self, capacity: int, *, oldest_frames: float = float("inf"), device: torch.device | str = "cpu"
    ) -> None:
        """oldest_frames: surfels older than this are dropped.

        Raises:
            OptionError: room for no surfel, or an age that is not positive.
        """
        if capacity < 1 or not oldest_frames > 0:
            raise OptionError(f"a memory needs capacity and an age above 0, got {capacity} and {oldest_frames}")
        self._capacity = capacity
        self._oldest_frames = oldest_frames
        self._device = device
        self._surfels = Surfels.empty(device)

    @property
    def surfels(self) -> Surfels:
        """What is remembered, in the order in which it was seen."""
        return self._surfels

    def reset(self) -> None:
        """Forget everything: another scene, or a jump of the camera."""
        self._surfels = Surfels.empty(self._device)

    @torch.no_grad()
    def update(
        self,
        depth: Tensor,
        lens: Intrinsics,
        world_from_camera: Tensor,
        fresh: Surfels,
        known: Tensor | None = None,
    ) -> None:
        """forget() by this frame, then add() its surfels."""
        self.forget(depth, lens, world_from_camera, known)
        self.add(fresh)

    @torch.no_grad()
    def forget(self, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor | None = None) -> None:
        """Drop what this frame sees again, and what it sees through; keep what is hidden from it or out of its sight.

        Args:
            depth: [H, W] metres, 0 or not finite where nothing is as far as the camera can see, as in the sky.
            world_from_camera: [4, 4] of the source camera, which took the depth.
            known: bool [H, W], false where the depth is a hole: it proves nothing. None: known everywhere.
        Raises:
            ShapeError: the depth or the mask and the lens differ in size.
        """
        size = (lens.height, lens.width)
        if depth.shape != size or (known is not None and known.shape != size):
            raise ShapeError(f"depth and mask must be {lens.height} x {lens.width}, got {list(depth.shape)}")
        if len(self._surfels):
            gone = _refuted(self._surfels.position, depth, lens, world_from_camera, known)
            self._surfels = self._surfels.rows(~gone)

    @torch.no_grad()
    def add(self, fresh: Surfels) -> None:
        """Remember these too; what is too old or beyond the capacity goes, oldest first."""
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
    newer, at = stamp > oldest, torch.nonzero(stamp == oldest)[:, 0]
    room = count - int(newer.sum())
    even = torch.arange(room, device=stamp.device) * len(at) // max(room, 1)
    newer[at[even]] = True
    return torch.nonzero(newer)[:, 0]


def _refuted(
    position: Tensor, depth: Tensor, lens: Intrinsics, world_from_camera: Tensor, known: Tensor | None
) -> Tensor:
    """Which points [N, 3] lie on, or before, what the camera sees in their direction: bool [N].

    What it sees is the plane of the pixel, not its middle alone: on a street the depth changes by half within a pixel.
    """
    camera_from_world = invert_rigid(world_from_camera.to("cpu", torch.float64)).to(position)
    x, y, z = torch.addmm(camera_from_world[:3, 3], position, camera_from_world[:3, :3].T).T
    u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
    inside = (z > _NEAREST_M) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    column, row = (torch.where(inside, each, 0.0).floor() for each in (u, v))
    pixel = (row * lens.width + column).long()
    inverse = inverse_depth(depth)
    right, down = relative_slopes(inverse).flatten(1)[:, pixel]
    plane = inverse.flatten()[pixel] * (1 + right * (u - column - 0.5) + down * (v - row - 0.5))
    refuted = inside & (z * plane <= 1 + _SAME_SURFACE)
    return refuted if known is None else refuted & known.flatten()[pixel]
