"""The source and the target camera of a driving clip, as the baselines that know them see them."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gcd_model.geometry import CameraMount, Intrinsics, driving_trajectory


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPair:
    """mount: of the source camera, as it is declared. source, target: their pinholes, in pixels of the pictures.

    source_from_target: float64 [T, 4, 4], metres.
    """

    mount: CameraMount
    source: Intrinsics
    target: Intrinsics
    source_from_target: Tensor

    @classmethod
    def driving(cls, mount: CameraMount, *, frames: int, height: int, width: int) -> Self:
        """The fixed path from ParallelDomain-4D's forward camera to the view from above, over all of `frames`."""
        path = driving_trajectory(frames=frames, move_time=frames - 1, mount=mount)
        return cls(
            mount=mount,
            source=Intrinsics.from_hfov(mount.hfov_deg, width, height),
            target=Intrinsics.from_hfov(CameraMount().hfov_deg, width, height),
            source_from_target=path.source_from_target,
        )


def pixel_rays(camera: Intrinsics) -> Tensor:
    """Rays through the pixel centres in the camera's axes, 1 along the optical axis: float64 [H, W, 3]."""
    u = torch.arange(camera.width, dtype=torch.float64) + 0.5
    v = torch.arange(camera.height, dtype=torch.float64) + 0.5
    down, right = torch.meshgrid((v - camera.cy) / camera.fy, (u - camera.cx) / camera.fx, indexing="ij")
    return torch.stack([right, down, torch.ones_like(right)], dim=-1)


def to_pixels(points: Tensor, camera: Intrinsics) -> Tensor:
    """Where points [..., 3] in the camera's axes lie in its picture, [..., 2]: u and v from the top left corner."""
    u = camera.fx * points[..., 0] / points[..., 2] + camera.cx
    v = camera.fy * points[..., 1] / points[..., 2] + camera.cy
    return torch.stack([u, v], dim=-1)
