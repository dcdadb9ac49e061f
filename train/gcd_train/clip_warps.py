"""Plane warps along each clip's own camera path."""

from collections.abc import Sequence

import torch

from gcd_model import ModelConfig
from gcd_model.geometry import CameraMount, Trajectory
from gcd_model.plane_warp import PathWarps, WarpPictures, clip_warps
from gcd_train.datasets.clip_source import ClipSource


class ClipWarps:
    """The warps of clips, by number; where all clips share one path they are made once."""

    def __init__(self, clips: ClipSource, config: ModelConfig, device: torch.device) -> None:
        self._clips, self._config, self._device = clips, config, device
        self._shared: PathWarps | None = None

    @property
    def wanted(self) -> bool:
        """Whether the model warps at all."""
        return self._config.plane_warp is not None

    def of(self, number: int, frames: Sequence[int] | None = None) -> PathWarps:
        """The warps of a clip; of these frames alone, if they are given."""
        if self._clips.camera != "none":
            return self._made(self._clips.trajectory(number), None, frames)
        if self._shared is None:
            self._shared = self._made(self._clips.trajectory(number), self._clips.mount, None)
        return self._shared

    def pictures(self, number: int, source: torch.Tensor) -> WarpPictures | None:
        """What the condition of a whole clip is made of. source: [T, 3, H, W] in [-1, 1]. None without warps."""
        if not self.wanted:
            return None
        return self.of(number).pictures(source, torch.arange(source.shape[0], device=source.device))

    def _made(self, path: Trajectory, mount: CameraMount | None, frames: Sequence[int] | None) -> PathWarps:
        return clip_warps(self._config, path, mount, frames).to(self._device)
