"""What is measured: a clip in, its target view out; and the predictors that copy, average or warp."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import CameraMount, Intrinsics, Trajectory, driving_trajectory, to_pose
from gcd_train.data.sample import Bytes, ClipSource, SceneView
from gcd_train.errors import DataError
from gcd_train.pointcloud.project import tangents


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
    right, down = torch.meshgrid(*map(torch.from_numpy, tangents(camera, 0.5)), indexing="xy")
    return torch.stack([right, down, torch.ones_like(right)], dim=-1)


def to_pixels(points: Tensor, camera: Intrinsics) -> Tensor:
    """Where points [..., 3] in the camera's axes lie in its picture, [..., 2]: u and v from the top left corner."""
    u = camera.fx * points[..., 0] / points[..., 2] + camera.cx
    v = camera.fy * points[..., 1] / points[..., 2] + camera.cy
    return torch.stack([u, v], dim=-1)


OtherViews = Callable[[int], Sequence[Sequence[SceneView]]]
"""The T views of each of so many further cameras of the scene. Raises DataError if it has fewer."""

SourcePoints = Callable[[], Sequence[SceneView]]
"""The T views of the source camera as the data set holds them. Raises DataError where one cannot be read."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceClip:
    """What a predictor may look at: the source side of a clip, and where it is to be seen from.

    source: uint8 [T, H, W, 3] RGB. source_depth: float32 [T, H, W], metres along the optical axis, 0 for the sky; for
    privileged predictors only. source_classes: uint8 [T, H, W]; None where the world has no ontology.
    cameras: of the clip, the source's as it is declared. fps: frames per second.
    key: names the clip in its set; frames that others have made are found by it.
    others: what further cameras of the scene saw, for predictors that are given them; None where there is one camera.
    points: the source views at their full size, for privileged predictors only, with ids as in `source_classes`; None
    where `source` is all there is.
    """

    source: Bytes
    source_depth: NDArray[np.float32]
    source_classes: Bytes | None
    cameras: CameraPair
    fps: float
    key: str = ""
    others: OtherViews | None = None
    points: SourcePoints | None = None


FAR_M = 1e4
"""What a depth of 0, the sky, stands for: so far away both cameras see the same of it."""


def own_views(source: Bytes, depth: NDArray[np.float32], classes: Bytes | None, lens: Intrinsics) -> list[SceneView]:
    """The T views of a source camera in its own axes; the sky is far."""
    far = np.where(depth > 0, depth, np.float32(FAR_M))
    labels = [None] * len(far) if classes is None else classes
    return [
        SceneView(rgb=rgb, depth=z, classes=ids, instances=None, world_from_camera=np.eye(4), lens=lens)
        for rgb, z, ids in zip(source, far, labels, strict=True)
    ]


@dataclass(frozen=True, kw_only=True, slots=True)
class Prediction:
    """A view as it is measured.

    video: float32 [T, 3, H, W] in [0, 1], or None. classes: uint8 [T, H, W], 255 for no class, or None. more: further
    draws of the same view, of methods that draw.
    """

    video: Tensor | None = None
    classes: Tensor | None = None
    more: "tuple[Prediction, ...]" = ()

    @property
    def draws(self) -> "tuple[Prediction, ...]":
        """All draws, this one first."""
        return (self, *self.more)


class Predictor(Protocol):
    """Makes the target view of a clip from its source alone, or, where `privileged`, from its exact depth too."""

    @property
    def name(self) -> str: ...
    @property
    def privileged(self) -> bool: ...
    def predict(self, clip: SourceClip) -> Prediction: ...


def to_pictures(frames: Bytes) -> Tensor:
    """uint8 [T, H, W, 3] -> float32 [T, 3, H, W] in [0, 1]."""
    return torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255.0


def to_labels(classes: Bytes | None) -> Tensor | None:
    """A class map as a tensor, uint8 [T, H, W]; None for none."""
    return None if classes is None else torch.from_numpy(np.ascontiguousarray(classes))


@dataclass(frozen=True, kw_only=True, slots=True)
class TargetStatistics:
    """Means over training targets, by pixel and frame number.

    mean: float32 [T, 3, H, W] in [0, 1]. majority: uint8 [T, H, W], the commonest class of each pixel; None where the
    world has no ontology.
    """

    mean: Tensor
    majority: Tensor | None = None

    @property
    def constant(self) -> "TargetStatistics":
        """The same without a place: each frame's mean colour and commonest class, everywhere in the frame."""
        colour = self.mean.mean(dim=(2, 3), keepdim=True).expand_as(self.mean)
        if self.majority is None:
            return replace(self, mean=colour)
        frames = [torch.full_like(frame, int(frame.flatten().mode().values)) for frame in self.majority]
        return replace(self, mean=colour, majority=torch.stack(frames))


def fit_statistics(clips: ClipSource, *, progress: Callable[[int, int], None] | None = None) -> TargetStatistics:
    """Mean picture and majority class of training targets.

    Args:
        clips: of one size and length, at least one.
        progress: called with (clips done, clips).
    Raises:
        DataError: there are no clips.
    """
    if len(clips) == 0:
        raise DataError("mean target and majority map want training clips, got an empty folder; generate some first")
    total = to_pictures(clips.rgb(0)[1]).double().zero_()  # [T, 3, H, W]
    votes = [np.zeros(clips.target_classes(0).shape, dtype=np.int32) for _ in clips.classes]  # K times [T, H, W]
    for index in range(len(clips)):
        total += to_pictures(clips.rgb(index)[1])
        labels = clips.target_classes(index) if votes else None
        for label, count in enumerate(votes):
            count += labels == label
        if progress is not None:
            progress(index + 1, len(clips))
    majority = torch.from_numpy(np.stack(votes).argmax(axis=0).astype(np.uint8)) if votes else None
    return TargetStatistics(mean=(total / len(clips)).float(), majority=majority)


@dataclass(frozen=True, kw_only=True, slots=True)
class CopySource:
    """The source picture and its class map, as if they were the target's."""

    name: str = "copy_source"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. The class map is the source's exact one."""
        return Prediction(video=to_pictures(clip.source), classes=to_labels(clip.source_classes))


@dataclass(frozen=True, kw_only=True, slots=True)
class Fixed:
    """The same of every clip: the mean training target, or the commonest class of each pixel."""

    name: str
    prediction: Prediction
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor."""
        del clip
        return self.prediction


_NEAREST_SOURCE_M = 0.1  # in front of the source camera


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundHomography:
    """The source picture and its class map as the target camera sees them if all of it lies on the ground.

    fill: what is shown where the target camera looks above the horizon or the source camera does not see the ground.
    """

    fill: TargetStatistics
    name: str = "ground_homography"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. The class map is warped from the source's exact one."""
        grid, seen = ground_grid(clip.cameras)
        video = F.grid_sample(to_pictures(clip.source), grid, padding_mode="border", align_corners=False)
        return Prediction(
            video=torch.where(seen[:, None], video, self.fill.mean),
            classes=self._classes(to_labels(clip.source_classes), grid, seen),
        )

    def _classes(self, labels: Tensor | None, grid: Tensor, seen: Tensor) -> Tensor | None:
        if labels is None or self.fill.majority is None:
            return None
        moved = F.grid_sample(labels[:, None].float(), grid, mode="nearest", padding_mode="border", align_corners=False)
        return torch.where(seen, moved[:, 0].to(torch.uint8), self.fill.majority)


def plane_homography(source_from_target: Tensor, normal: Tensor, distance_m: Tensor) -> Tensor:
    """Takes rays of the target camera to rays of the source camera that meet the same point of a plane.

        H = R + t n^T / d        for the plane n . x = d in the target camera's axes

    Args:
        source_from_target: [T, 4, 4], metres. normal: unit n, [T, 3]. distance_m: d, [T], not 0.
    Returns:
        [T, 3, 3]; H r is the point itself over the multiple of r at which r meets the plane.
    Source: Hartley and Zisserman 2004, result 13.1, with the opposite sign of d.
    """
    turn, step = source_from_target[:, :3, :3], source_from_target[:, :3, 3]
    return turn + step[:, :, None] * normal[:, None, :] / distance_m[:, None, None]


def ground_grid(cameras: CameraPair) -> tuple[Tensor, Tensor]:
    """Sampling grid float32 [T, H, W, 2] and where it is meant, bool [T, H, W]."""
    ground_from_target = cameras.ground_from_source @ cameras.source_from_target
    normal = -ground_from_target[:, 2, :3]  # downwards, in the target camera's axes
    height_m = ground_from_target[:, 2, 3]  # above the ground
    homography = plane_homography(cameras.source_from_target, normal, height_m)
    rays = pixel_rays(cameras.target)
    points = torch.einsum("tij,hwj->thwi", homography, rays)
    below = torch.einsum("ti,hwi->thw", normal, rays) / height_m[:, None, None]  # 1 / reach, positive on the ground
    ahead = points[..., 2] > _NEAREST_SOURCE_M * below.clamp(min=0.0)
    size = points.new_tensor([cameras.source.width, cameras.source.height])
    grid = to_pixels(points, cameras.source) * 2 / size - 1
    seen = (below > 0) & ahead & (grid.abs() <= 1).all(dim=-1)
    return grid.nan_to_num().clamp(-2.0, 2.0).float(), seen
