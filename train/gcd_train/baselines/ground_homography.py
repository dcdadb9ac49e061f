"""The world as a painted plane."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_train.baselines.cameras import CameraPair, pixel_rays, to_pixels
from gcd_train.baselines.predictor import Prediction, SourceClip, to_labels, to_pictures
from gcd_train.baselines.target_statistics import TargetStatistics

_NEAREST_M = 0.1  # in front of the source camera


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
    ahead = points[..., 2] > _NEAREST_M * below.clamp(min=0.0)
    grid = _sampling(to_pixels(points, cameras.source), cameras.source)
    seen = (below > 0) & ahead & (grid.abs() <= 1).all(dim=-1)
    return grid.nan_to_num().clamp(-2.0, 2.0).float(), seen


def _sampling(pixels: Tensor, camera: Intrinsics) -> Tensor:
    return pixels * 2 / pixels.new_tensor([camera.width, camera.height]) - 1
