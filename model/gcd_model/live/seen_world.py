"""What the source camera has shown so far, as points: this frame's, and those of earlier frames that stand still."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, require_rigid
from gcd_model.live.config import LiveConfig
from gcd_model.live.eyes import SeenFrame
from gcd_model.live.memory import SurfelMemory
from gcd_model.live.splat import Splat, Surfels, splat, unproject


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
