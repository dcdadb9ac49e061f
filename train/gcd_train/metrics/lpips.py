"""Learned perceptual distance: how differently a network trained on photographs sees two pictures.

Source: Zhang et al. 2018, Eq. 1, as version 0.1 of its weights wants it: features of VGG16 or AlexNet (Krizhevsky 2014)
trained on ImageNet, and a learned weight for each channel. The weights are the user's own.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.errors import ShapeError
from gcd_train.metrics.lpips_weights import LpipsWeights, read_weights
from gcd_train.metrics.shapes import require_same_shape

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, RGB in [0, 1]
_LEAST_NORM = 1e-10


@dataclass(frozen=True, kw_only=True, slots=True)
class Lpips:
    """Distances by one network. See `open`.

    network: "vgg" or "alex"; figures of the two cannot be compared. identity: digest of the weights in use.
    """

    weights: LpipsWeights
    identity: str

    @classmethod
    def open(cls, folder: Path | str, *, device: str = "cpu") -> Self:
        """Read the weights that lie in a folder.

        The folder holds torchvision's `vgg16-*.pth` and the published linear weights `vgg.pth`, or `alexnet-*.pth` and
        `alex.pth`; of both pairs VGG16 is taken. Nothing but tensors is read from them.

        Raises:
            DataError: a file is missing, damaged or another one than wanted.
        """
        weights = read_weights(Path(folder), device)
        digest = hashlib.sha256()
        for tensor in weights.tensors:
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
        return cls(weights=weights, identity=f"{weights.network.name}-{digest.hexdigest()[:12]}")

    @property
    def network(self) -> str:
        return self.weights.network.name

    def __call__(self, views: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame, 0 for equal ones: [T, 3, H, W] each -> float32 [T].

        Raises:
            ShapeError: shapes differ, or pictures are too small for the network.
        """
        return self.of_draws(views[None], targets)[0]

    @torch.no_grad()
    def of_draws(self, draws: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame of several draws to one target, whose features are worked out once.

        Args:
            draws: [S, T, 3, H, W]. targets: [T, 3, H, W].
        Returns:
            float32 [S, T] on the CPU.
        """
        require_same_shape(draws[0], targets)
        least = self.weights.network.least_pixels
        if min(targets.shape[-2:]) < least:
            raise ShapeError(f"LPIPS wants pictures of at least {least} pixels a side, got {list(targets.shape[-2:])}")
        both = (torch.cat([draws[:, t], targets[t : t + 1]]) for t in range(len(targets)))
        return torch.stack([self._of_frame(pictures.float()).cpu() for pictures in both], dim=1)

    def _of_frame(self, pictures: Tensor) -> Tensor:
        """Distances of all pictures but the last to the last: [S+1, 3, H, W] -> [S]."""
        stages = zip(self._features(pictures), self.weights.heads, strict=True)
        return torch.stack([_apart(features, head) for features, head in stages]).sum(dim=0)

    def _features(self, pictures: Tensor) -> Iterator[Tensor]:
        """What the network makes of pictures [N, 3, H, W] at the end of each stage: [N, C, h, w]."""
        device = self.weights.heads[0].device
        x = (pictures.to(device) - _colour(_MEAN, device)) / _colour(_DEVIATION, device)
        for stage, filters in zip(self.weights.network.stages, self.weights.filters, strict=True):
            if stage.pool:
                x = F.max_pool2d(x, stage.pool, stride=2)
            for convolution, (weight, bias) in zip(stage.convolutions, filters, strict=True):
                x = F.conv2d(x, weight, bias, stride=convolution.stride, padding=convolution.padding).relu()
            yield x


def _apart(features: Tensor, head: Tensor) -> Tensor:
    """Weighted squared distance of unit vectors, mean over places, of all features but the last to the last."""
    unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + _LEAST_NORM)
    return F.conv2d((unit[:-1] - unit[-1:]).square(), head).mean(dim=(1, 2, 3))


def _colour(values: tuple[float, float, float], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device).view(1, 3, 1, 1)
