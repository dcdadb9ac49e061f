"""Two frozen judges of pictures that nobody can know, and how far apart what they see in views and in truths is.

One has learned to name the classes of true views and is in no loss; the other has random weights. Their features are
averaged over cells of 16 x 16 pixels: pictures need not agree pixel by pixel, but must be made of the same stuff.

    python -m gcd_train.live.judge --data DIR --out judge.safetensors
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from gcd_model.live.config import LIVE_CLASSES
from gcd_train.live.batches import to_video, training_paths
from gcd_train.live.clips import read_clip

CELL = 16
"""Pixels a side over which features are averaged."""
_FEATURES, _PATCH = 64, 8
_RANDOM_SEED, _TRAINING_SEED = 7, 11
_BATCH, _RATE = 16, 2e-3
_RIDGE = 1e-3
"""Added to every variance of features that vary by 1 in the truth."""


class JudgeNet(nn.Module):
    """A plain convolutional network of 0.3 M parameters; a feature looks at 43 pixels a side."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            *_layer(3, 32, 2), *_layer(32, 32, 1), *_layer(32, 64, 2), *_layer(64, 64, 1),
            *_layer(64, 128, 2), *_layer(128, 128, 1), nn.Conv2d(128, _FEATURES, 1), nn.SiLU(),
        )  # fmt: skip
        self.classes = nn.Conv2d(_FEATURES, len(LIVE_CLASSES), 1)

    def forward(self, video: Tensor) -> Tensor:
        """video: [N, 3, H, W] in [-1, 1] -> logits of the classes [N, K, H/8, W/8]."""
        return self.classes(self.features(video))

    @torch.no_grad()
    def cells(self, pictures: Tensor) -> Tensor:
        """pictures: [N, 3, H, W] in [0, 1] -> features of cells, [N, H/16, W/16, 64]."""
        return F.avg_pool2d(self.features(pictures * 2 - 1), CELL // _PATCH).permute(0, 2, 3, 1)


def _layer(in_channels: int, out_channels: int, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(in_channels, out_channels, 3, stride, 1), nn.GroupNorm(8, out_channels), nn.SiLU()


def random_judge() -> JudgeNet:
    """The judge that has learned nothing, always the same one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_RANDOM_SEED)
        return JudgeNet().eval()


def load_judge(path: Path) -> JudgeNet:
    """The judge that has learned."""
    net = JudgeNet()
    net.load_state_dict(load_file(path))
    return net.eval()


@dataclass(slots=True)
class Moments:
    """Count, sum and sum of outer products of feature vectors, float64."""

    count: int
    total: Tensor
    outer: Tensor

    @classmethod
    def none(cls) -> "Moments":
        """Of no vector at all."""
        zeros = torch.zeros(_FEATURES, dtype=torch.float64)
        return cls(count=0, total=zeros, outer=torch.diag(zeros))

    def add(self, vectors: Tensor) -> None:
        """vectors: [N, 64]."""
        vectors = vectors.double()
        self.count += len(vectors)
        self.total = self.total + vectors.sum(0)
        self.outer = self.outer + vectors.T @ vectors

    @property
    def gaussian(self) -> tuple[Tensor, Tensor]:
        """Mean [64] and covariance [64, 64]."""
        mean = self.total / self.count
        return mean, self.outer / self.count - torch.outer(mean, mean)


def frechet_distance(views: Moments, truths: Moments) -> float:
    """Between the two as Gaussians, in standard deviations of the truth's features; NaN for too few vectors.

        |m - m'|^2 + tr(C + C' - 2 (C^1/2 C' C^1/2)^1/2)

    Source: Dowson and Landau 1982; Heusel et al. 2017, with features of our own.
    """
    if min(views.count, truths.count) < 2 * _FEATURES:
        return float("nan")
    mean, covariance = views.gaussian
    true_mean, true_covariance = truths.gaussian
    scale = true_covariance.diagonal().clamp(min=1e-12).rsqrt()
    ridge = _RIDGE * torch.eye(_FEATURES, dtype=torch.float64)
    a, b = (c * scale[:, None] * scale + ridge for c in (covariance, true_covariance))
    root = torch.linalg.cholesky(a)
    shared = torch.linalg.eigvalsh(root.T @ b @ root).clamp(min=0).sqrt().sum()
    apart = ((mean - true_mean) * scale).square().sum() + a.trace() + b.trace() - 2 * shared
    return max(float(apart), 0.0)


def train_judge(data: Path, updates: int) -> JudgeNet:
    """A judge that names the classes of target views, each cell of 8 pixels by the shares of its pixels."""
    paths = training_paths(data)
    torch.manual_seed(_TRAINING_SEED)
    net = JudgeNet()
    net.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  torch's stubs leave this one out
    optimiser = torch.optim.AdamW(net.parameters(), lr=_RATE, weight_decay=0.01)
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = _RATE * min(1.0, (update + 1) / 50, 2 * (1 - update / updates))
        video, shares = _batch(paths, np.random.default_rng([_TRAINING_SEED, update]))
        loss = F.cross_entropy(net(video.to(memory_format=torch.channels_last)), shares)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return net.eval()


def _batch(paths: list[Path], random: np.random.Generator) -> tuple[Tensor, Tensor]:
    video, shares = [], []
    for _ in range(_BATCH):
        frame = int(random.integers(14))
        arrays = read_clip(paths[int(random.integers(len(paths)))], slice(frame, frame + 1)).arrays
        labels = F.one_hot(torch.from_numpy(arrays["target.labels"]).long(), len(LIVE_CLASSES))
        flip = [-1] if random.random() < 0.5 else []
        video.append(to_video(arrays["target.rgb"]).flip(flip))
        shares.append(F.avg_pool2d(labels.permute(0, 3, 1, 2).float(), _PATCH).flip(flip))
    return torch.cat(video), torch.cat(shares)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Train the judge network on target views of live clips.")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--updates", type=int, default=1200)
    options = parser.parse_args()
    state = train_judge(options.data, options.updates).state_dict()
    save_file({name: weight.contiguous() for name, weight in state.items()}, options.out)
