"""Pictures with known cameras and moments, as rays and the colours that they should show."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.hexplane.rendering import Rays


@dataclass(frozen=True, kw_only=True, slots=True)
class Camera:
    """Where and when a picture is taken.

    world_from_camera: float [4, 4], metres. time: -1 for the first frame of the clip, 1 for the last.
    """

    lens: Intrinsics
    world_from_camera: Tensor
    time: float

    def rays(self) -> Rays:
        """Through the middle of every pixel, row by row, float32."""
        u = (torch.arange(self.lens.width) + 0.5 - self.lens.cx) / self.lens.fx
        v = (torch.arange(self.lens.height) + 0.5 - self.lens.cy) / self.lens.fy
        down, right = torch.meshgrid(v, u, indexing="ij")
        ahead = F.normalize(torch.stack([right, down, torch.ones_like(right)], dim=-1).view(-1, 3), dim=-1)
        pose = self.world_from_camera.float()
        return Rays(
            origins=pose[:3, 3].expand(len(ahead), 3),
            directions=ahead @ pose[:3, :3].T,
            times=ahead.new_full((len(ahead),), self.time),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class PosedPicture:
    """One picture. colours: float32 [3, H, W], RGB in [0, 1]; the camera's lens is in its pixels."""

    colours: Tensor
    camera: Camera

    def narrowed(self, width: int) -> "PosedPicture":
        """The same at most this wide, by averages over pixels, so that learning costs less."""
        lens = narrowed(self.camera.lens, width)
        if lens == self.camera.lens:
            return self
        colours = F.interpolate(self.colours[None], size=(lens.height, lens.width), mode="area")[0]
        camera = Camera(lens=lens, world_from_camera=self.camera.world_from_camera, time=self.camera.time)
        return PosedPicture(colours=colours, camera=camera)


def narrowed(lens: Intrinsics, width: int) -> Intrinsics:
    """The lens of the same picture at most this wide."""
    if lens.width <= width:
        return lens
    return lens.resized(width, max(1, round(lens.height * width / lens.width)))


@dataclass(frozen=True, kw_only=True, slots=True)
class RayTable:
    """All pixels of some pictures. rays: N of them. colours: [N, 3], what they should show."""

    rays: Rays
    colours: Tensor

    @classmethod
    def of(cls, pictures: Sequence[PosedPicture], device: torch.device) -> "RayTable":
        """Every pixel of every picture, of any sizes."""
        rays = [picture.camera.rays() for picture in pictures]
        return cls(
            rays=Rays(
                origins=torch.cat([each.origins for each in rays]),
                directions=torch.cat([each.directions for each in rays]),
                times=torch.cat([each.times for each in rays]),
            ).to(device),
            colours=torch.cat([picture.colours.flatten(1).T for picture in pictures]).to(device),
        )

    def drawn(self, count: int, generator: torch.Generator) -> "RayTable":
        """So many pixels, any of them equally likely, and more than once if it happens."""
        chosen = torch.randint(len(self.colours), (count,), generator=generator).to(self.colours.device)
        return RayTable(rays=taken(self.rays, chosen), colours=self.colours[chosen])


def taken(rays: Rays, chosen: Tensor | slice) -> Rays:
    """Some of the rays."""
    return Rays(origins=rays.origins[chosen], directions=rays.directions[chosen], times=rays.times[chosen])
