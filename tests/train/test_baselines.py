from dataclasses import replace

import pytest
import torch
from driving_plane import STAGE_SOURCE, plane_clip

from gcd_model.geometry import CameraMount, SphericalDelta, spherical_trajectory
from gcd_train.data.pairs import PairedClip
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import CameraPair, SourceClip, to_pictures
from gcd_train.evaluation.reprojection import GroundHomography, ground_grid

FRAMES, HEIGHT, WIDTH = 5, 64, 96


def cameras(mount: CameraMount | None = None) -> CameraPair:
    return CameraPair.driving(mount or CameraMount(), frames=FRAMES, height=HEIGHT, width=WIDTH)


def seen_by(pair: CameraPair, clip: PairedClip) -> SourceClip:
    """What a predictor gets of a clip."""
    return SourceClip(
        source=clip.source,
        source_depth=clip.source_depth,
        source_classes=clip.source_classes,
        cameras=pair,
        fps=10.0,
    )


def near_ground(clip: PairedClip) -> torch.Tensor:
    """Where the paint is coarse enough for the source picture to hold it, bool [T, H, W]."""
    return torch.from_numpy((clip.target_depth > 0) & (clip.target_depth < 25))


def agreement(video: torch.Tensor, target: torch.Tensor, seen: torch.Tensor) -> tuple[float, float]:
    """Share of pixels seen, and root mean square error on them."""
    error = ((video - target) ** 2).mean(dim=1)[seen].mean().sqrt()
    return float(seen.float().mean()), float(error)


@pytest.mark.parametrize("mount", [CameraMount(), CameraMount(height_m=1.2, tilt_deg=-3.0)])
def test_the_ground_homography_gives_the_picture_of_a_plane_drawn_by_rays(mount: CameraMount) -> None:
    clip = plane_clip(cameras(mount))
    made = GroundHomography().predict(seen_by(cameras(mount), clip))
    assert made.video is not None
    assert made.classes is not None
    there = ground_grid(cameras(mount))[1]
    assert not made.video[~there[:, None].expand_as(made.video)].any()
    assert (made.classes[~there] == NO_CLASS).all()
    seen = there & near_ground(clip)
    share, error = agreement(made.video, to_pictures(clip.target), seen)
    assert share > 0.15
    assert error < 0.03
    assert (made.classes == torch.from_numpy(clip.target_classes))[seen].float().mean() > 0.97


def turned(azimuth_deg: float, elevation_deg: float = 0.0, radius_m: float = 0.0) -> SphericalDelta:
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


@pytest.mark.parametrize("change", [turned(50.0), turned(-70.0, 20.0, -1.5), turned(0.0, -12.0, 2.0)])
def test_on_a_plane_that_a_camera_orbits_the_ground_homography_gives_what_rays_draw(change: SphericalDelta) -> None:
    path = spherical_trajectory(STAGE_SOURCE, change, frames=FRAMES, move_time=FRAMES - 1)
    pair = CameraPair.orbit(path, hfov_deg=53.13, height=HEIGHT, width=WIDTH)
    clip = plane_clip(pair)
    made = GroundHomography().predict(replace(seen_by(pair, clip), source_classes=None))
    assert made.classes is None
    assert made.video is not None
    seen = ground_grid(pair)[1] & near_ground(clip)
    share, error = agreement(made.video, to_pictures(clip.target), seen)
    assert share > 0.3
    assert error < 0.03
