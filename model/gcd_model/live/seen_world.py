"""What the source camera has shown so far, as points: this frame's, and those of earlier frames that stand still."""

import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_model.live.memory import SurfelMemory
from gcd_model.live.splat import Splat, Surfels, splat, unproject


class SeenWorld:
    """Frame by frame: `look`, then `splat` from as many targets as there are. Poses refer to one world throughout."""

    def __init__(
        self, *, classes: int, capacity: int, oldest_frames: float, device: torch.device | str = "cpu"
    ) -> None:
        """classes: of the labels. capacity, oldest_frames: of the memory, see SurfelMemory; 0 for none."""
        self._classes, self._device = classes, device
        self._memory = (
            SurfelMemory(capacity, oldest_frames=oldest_frames or float("inf"), device=device) if capacity else None
        )
        self._fresh, self._static = Surfels.empty(device), Surfels.empty(device)
        self.now = 0.0
        """Stamp of the newest frame's points."""

    def reset(self) -> None:
        """Forget everything: another scene, or a camera that jumped."""
        self._fresh, self._static = Surfels.empty(self._device), Surfels.empty(self._device)
        if self._memory is not None:
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
        if self._memory is not None:
            self._memory.add(self._static)
            self._memory.forget(metres, lens, world_from_source, metres > 0)
        self._fresh = unproject(metres, picture, labels, lens, world_from_source, self.now)
        if self._memory is not None:
            self._static = self._fresh.rows(static.flatten()[(metres > 0).flatten()])

    @property
    def points(self) -> Surfels:
        """All of it: this frame's and the remembered ones."""
        return self._fresh if self._memory is None else self._fresh.joined(self._memory.surfels)

    def splat(self, world_from_target: Tensor, lens: Intrinsics) -> Splat:
        """All of it as a target camera sees it, in one depth test."""
        return splat(self.points, world_from_target, lens, self._classes, self.now)
