"""Density and colour of every point of a scene at every moment."""

import torch
from torch import Tensor, nn

from gcd_train.hexplane.bounds import SceneBounds
from gcd_train.hexplane.planes import HexPlanes
from gcd_train.hexplane.settings import HexPlaneSettings

_THIN = -1.0
"""Added to the density before it is made positive, so that space is a fog at first that lets half of the light pass."""
_HARMONICS = 9
_HEIGHT_WAVES = (2.0, 4.0, 8.0, 16.0)
"""Waves over the vertical part of a direction, in radians of phase, for a sharp horizon all around."""

_BACKGROUND_WIDTH = 32


class HexField(nn.Module):
    """Six planes and two small heads, before a background that stands still, smooth but for its horizon.

    Colour does not depend on the direction that it is seen from.
    bounds: the part of the world that the planes cover. frames: T of the clip, a row of the time planes each.
    generator: of the first weights, on the CPU.
    Source: Cao and Johnson 2023 (HexPlane), section 3.3; without view directions, which few views cannot settle.
    """

    def __init__(
        self, bounds: SceneBounds, frames: int, settings: HexPlaneSettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.bounds = bounds
        self.planes = HexPlanes(features=settings.features, side=settings.sides[0], moments=frames, generator=generator)
        self.trunk = _linear(self.planes.features, settings.hidden, generator)
        self.density_head = _linear(settings.hidden, 1, generator)
        self.colour_head = nn.Sequential(
            _linear(settings.hidden, settings.hidden, generator),
            nn.ReLU(),
            _linear(settings.hidden, 3, generator),
        )
        self.background_head = nn.Sequential(
            _linear(_HARMONICS + 2 * len(_HEIGHT_WAVES), _BACKGROUND_WIDTH, generator),
            nn.ReLU(),
            _linear(_BACKGROUND_WIDTH, 3, generator),
        )

    def forward(self, points: Tensor, times: Tensor) -> Tensor:
        """What the heads read. points: [P, 3], world, metres; times: [P], -1 first frame, 1 last -> [P, D]."""
        place = torch.cat([self.bounds.to_planes(points), times[:, None]], dim=-1)
        return self.trunk(self.planes(place)).relu()

    def density(self, features: Tensor) -> Tensor:
        """[P, D] -> [P], optical depth in a metre, 0 or more."""
        raw = self.density_head(features)[:, 0]
        return nn.functional.softplus(raw + _THIN) / self.bounds.half_m

    def colour(self, features: Tensor) -> Tensor:
        """[P, D] -> [P, 3], RGB in [0, 1]."""
        return self.colour_head(features).sigmoid()

    def background(self, directions: Tensor) -> Tensor:
        """RGB in [0, 1] of what lies behind everything, by the direction [P, 3] of length 1, z up in the world."""
        x, y, z = directions.unbind(dim=-1)
        harmonics = [torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
        heights = [wave(rate * z) for rate in _HEIGHT_WAVES for wave in (torch.sin, torch.cos)]
        return self.background_head(torch.stack([*harmonics, *heights], dim=-1)).sigmoid()


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer whose first weights depend on the generator alone."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
        layer.bias.zero_()
    return layer
