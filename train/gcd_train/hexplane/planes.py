"""Six planes of features that together fill space and time."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SPACE = ((0, 1), (0, 2), (1, 2))
"""Planes xy, xz and yz; each meets the plane of time below it."""
TIME = ((2, 3), (1, 3), (0, 3))
"""Planes zt, yt and xt."""


class HexPlanes(nn.Module):
    """Features at a point of space and time: bilinear in six planes, multiplied in pairs that share no axis.

        f(x, y, z, t) = [XY(x, y) ZT(z, t), XZ(x, z) YT(y, t), YZ(y, z) XT(x, t)]

    The linear layer that comes next sums over the pairs with weights of its own.
    space: [3, C, S, S], time: [3, C, T, S]; the second axis of a pair runs down the rows.
    Source: Cao and Johnson 2023 (HexPlane), equation 5 and section 3.3 (multiply, then concatenate).
    """

    def __init__(self, *, features: int, side: int, moments: int, generator: torch.Generator) -> None:
        super().__init__()
        space = 0.1 + 0.4 * torch.rand(3, features, side, side, generator=generator)
        self.space = nn.Parameter(space)
        self.time = nn.Parameter(torch.ones(3, features, moments, side))  # nothing moves until pictures say so

    @property
    def features(self) -> int:
        """Numbers at a point: three pairs of C."""
        return 3 * self.space.shape[1]

    def forward(self, points: Tensor) -> Tensor:
        """points: [P, 4], x y z t, each in [-1, 1] -> [P, 3 C]."""
        pairs = sampled(self.space, points[:, SPACE]) * sampled(self.time, points[:, TIME])  # [3, C, P]
        return pairs.flatten(0, 1).T

    def roughness(self) -> Tensor:
        """Mean squared difference between neighbouring cells, over both directions of all planes (total variation)."""
        return torch.stack(
            [
                (table.diff(dim=axis) ** 2).mean()
                for table in (self.space, self.time)
                for axis in (2, 3)
                if table.shape[axis] > 1
            ]
        ).sum()

    @torch.no_grad()
    def refine(self, side: int) -> None:
        """Give the planes more cells along the axes of space; what they hold between the old cells stays."""
        moments = self.time.shape[2]
        self.space = nn.Parameter(_resized(self.space, side, side))
        self.time = nn.Parameter(_resized(self.time, moments, side))


def sampled(planes: Tensor, at: Tensor) -> Tensor:
    """Bilinear values. planes: [3, C, rows, columns]; at: [P, 3, 2], column and row in [-1, 1] -> [3, C, P].

    -1 and 1 are the middles of the first and the last cell.
    """
    grid = at.transpose(0, 1)[:, None]  # [3, 1, P, 2]
    return F.grid_sample(planes, grid, align_corners=True, padding_mode="border")[:, :, 0]


def _resized(planes: Tensor, rows: int, columns: int) -> Tensor:
    return F.interpolate(planes, size=(rows, columns), mode="bilinear", align_corners=True)
