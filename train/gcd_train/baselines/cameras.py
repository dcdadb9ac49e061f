"""The source and the target camera of a clip, as the baselines that know them see them."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gcd_model.geometry import CameraMount, Intrinsics, Trajectory, driving_trajectory, to_pose
from gcd_train.errors import DataError


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraPair:
    """Both cameras of one clip.

    ground_from_source: pose of the source camera where z is up and the ground is z = 0, float64 [4, 4], metres: in the
        vehicle's frame, or on the stage that the camera orbits.
    source, target: their pinholes, in pixels of the pictures.
    trajectory: where the target camera is, frame by frame.
    mount: how the source camera is declared to sit on its vehicle; None where there is no vehicle.
    """

    ground_from_source: Tensor
    source: Intrinsics
    target: Intrinsics
    trajectory: Trajectory
    mount: CameraMount | None = None

    @classmethod
    def driving(cls, mount: CameraMount, *, frames: int, height: int, width: int, move_time: int | None = None) -> Self:
        """The fixed path from ParallelDomain-4D's forward camera to the view from above.

        move_time: the frame in which the goal is reached, the last if left out.
        """
        last = frames - 1 if move_time is None else move_time
        return cls(
            ground_from_source=mount.vehicle_from_camera,
            source=Intrinsics.from_hfov(mount.hfov_deg, width, height),
            target=Intrinsics.from_hfov(CameraMount().hfov_deg, width, height),
            trajectory=driving_trajectory(frames=frames, move_time=last, mount=mount),
            mount=mount,
        )

    @classmethod
    def orbit(cls, trajectory: Trajectory, *, hfov_deg: float, height: int, width: int) -> Self:
        """A path over the sphere, both cameras with the same lens.

        Raises: DataError if nobody says where the source camera stands.
        """
        if trajectory.source is None:
            raise DataError("a path over the sphere begins at a camera: its trajectory must say where the source is")
        lens = Intrinsics.from_hfov(hfov_deg, width, height)
        start = to_pose(trajectory.source)
        return cls(ground_from_source=start, source=lens, target=lens, trajectory=trajectory)

    @property
    def source_from_target(self) -> Tensor:
        """float64 [T, 4, 4], metres."""
        return self.trajectory.source_from_target


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
