"""Which part of the world the planes cover, found from where the cameras stand and look."""

from dataclasses import dataclass

import torch
from torch import Tensor

_INNER = 0.5
"""Half a side of the box drawn to scale, as a share of the farthest camera's distance from its middle."""
_BEGIN = 0.3
"""Where rays begin, as a share of the nearest camera's distance from the middle. Pictures painted on the air in front
of each camera explain all inputs and no other view."""
_END = 0.5
"""Where rays end, in halves of the cube beyond the middle as the farthest camera sees it. What lies farther off is seen
by one camera only, and with many cameras around a scene each would paint its whole picture there."""
_PULL = 1e-3
"""Weight of a guess, against one camera's axis, for cameras that look along parallel lines."""
_GUESS_M = 10.0
"""How far ahead of cameras with parallel axes the guess lies."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneBounds:
    """A cube that is drawn to scale; all of space around it is squeezed into a shell of its own thickness.

    centre: float32 [3], world, metres. half_m: half a side of the cube. begin, reach: distances along a ray, in halves,
    between which there is something to see; beyond there is a background.
    """

    centre: Tensor
    half_m: float
    begin: float
    reach: float

    @classmethod
    def around(cls, world_from_camera: Tensor) -> "SceneBounds":
        """The cube where the cameras look.

        Args:
            world_from_camera: float [M, 4, 4], input and wanted cameras, metres.
        """
        poses = world_from_camera.double()
        centre = nearest_to_axes(poses)
        distances = (poses[:, :3, 3] - centre).norm(dim=-1)
        half_m = max(float(distances.max()) * _INNER, 1e-3)
        nearest, farthest = (float(distance) / half_m for distance in (distances.min(), distances.max()))
        return cls(centre=centre.float(), half_m=half_m, begin=nearest * _BEGIN, reach=farthest + _END)

    def to_planes(self, points: Tensor) -> Tensor:
        """World points [..., 3], metres, in the planes' coordinates, within [-1, 1].

            x within the cube, (2 - 1 / |x|) x / |x| outside, |x| the largest coordinate; then halved

        Source: Barron et al. 2022 (Mip-NeRF 360), equation 10, with the largest norm so that the result fills a cube.
        """
        scaled = (points - self.centre.to(points.device)) / self.half_m
        size = scaled.abs().amax(dim=-1, keepdim=True).clamp(min=1.0)
        return scaled * (2.0 - 1.0 / size) / size / 2.0

    def to_distance(self, place: Tensor) -> Tensor:
        """How far along a ray, metres, for places in [0, 1], evenly."""
        return (self.begin + (self.reach - self.begin) * place) * self.half_m


def nearest_to_axes(world_from_camera: Tensor) -> Tensor:
    """The point with the least summed squared distance to the optical axes, float64 [3].

    Args:
        world_from_camera: float64 [M, 4, 4]. Where all axes are parallel, the point on them 10 m ahead.
    """
    position, ahead = world_from_camera[:, :3, 3], world_from_camera[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - ahead[:, :, None] * ahead[:, None, :]  # [M, 3, 3]
    guess = (position + _GUESS_M * ahead).mean(dim=0)
    left = across.sum(dim=0) + _PULL * torch.eye(3, dtype=torch.float64)
    right = torch.einsum("mij,mj->i", across, position) + _PULL * guess
    return torch.linalg.solve(left, right)
