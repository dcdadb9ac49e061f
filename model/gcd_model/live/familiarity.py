"""How unlike its training a picture looks to the depth network: classes it is unsure of, features it never had."""

import torch
from torch import Tensor, nn

_LEAST_SHARE = 1e-3
"""Of the mean variance of standardised features: less counts as this, or noise would decide."""


def summary_of(features: Tensor) -> Tensor:
    """Means and standard deviations over the picture: [N, C, h, w] -> float32 [N, 2 C]."""
    flat = features.float().flatten(2)
    return torch.cat([flat.mean(dim=2), flat.std(dim=2, correction=0)], dim=1)


class Familiarity(nn.Module):
    """A Gaussian of the training's summaries. Mahalanobis distance of features: Lee et al. 2018."""

    mean: Tensor
    whiten: Tensor

    def __init__(self, channels: int) -> None:
        """channels: C of `summary_of`. Until `fit`, mean 0 and variance 1."""
        super().__init__()
        self.register_buffer("mean", torch.zeros(2 * channels))
        self.register_buffer("whiten", torch.eye(2 * channels))

    def fit(self, summaries: Tensor) -> None:
        """summaries: [N, 2 C] of pictures of the training."""
        wide = summaries.double()
        spread = wide.std(dim=0).clamp(min=1e-6)
        values, vectors = torch.linalg.eigh(torch.cov(((wide - wide.mean(dim=0)) / spread).T))
        scale = values.clamp(min=_LEAST_SHARE).rsqrt()
        self.mean.copy_(wide.mean(dim=0))
        self.whiten.copy_(vectors * scale / spread[:, None])

    def score(self, summaries: Tensor, entropy: Tensor) -> Tensor:
        """0 to 1, low where the training was. summaries: [N, 2 C]. entropy: [N], of the classes, 0 to 1; -> [N]."""
        distance = ((summaries - self.mean.float()) @ self.whiten.float()).square().mean(dim=1)
        return 1 - torch.exp(-entropy * distance)
