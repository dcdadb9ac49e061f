"""Conditioning: camera features, the micro-conditioning vector, guidance branches, frames that stay apart."""

import math

import pytest
import torch
from small_models import TINY, draw, random_clip, tiny_synthesizer
from torch import Tensor
from torch.testing import assert_close

from gcd_model.clip import Augmentation
from gcd_model.conditioning import (
    CameraEmbedder,
    relative_pose_features,
    spherical_features,
    with_unconditional,
)
from gcd_model.errors import ShapeError
from gcd_model.geometry import pose_trajectory


def test_angles_become_cosines_and_sines_of_one_two_and_four_times_in_radians_and_the_radius_stays() -> None:
    azimuth, elevation = math.radians(30.0), math.radians(-10.0)
    expected = [
        function(multiple * angle)
        for angle in (azimuth, elevation)
        for multiple in (1, 2, 4)
        for function in (math.cos, math.sin)
    ]
    features = spherical_features(torch.tensor([[30.0, -10.0, 1.5]], dtype=torch.float64))
    assert_close(features, torch.tensor([[*expected, 1.5]]))
    recorded = [0.866025, 0.5, 0.5, 0.866025, -0.5, 0.866025]  # worked out by hand for 30 degrees
    assert_close(features[0, :6], torch.tensor(recorded), atol=1e-6, rtol=0)


def test_relative_poses_become_their_top_three_rows_row_by_row() -> None:
    poses = torch.arange(32, dtype=torch.float64).reshape(2, 4, 4)
    expected = [list(range(12)), list(range(16, 28))]
    assert relative_pose_features(poses).tolist() == expected
    assert relative_pose_features(poses).dtype == torch.float32


def test_a_free_path_is_refused_by_spherical_control_with_the_way_out() -> None:
    free = pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(3, 1, 1))
    with pytest.raises(ShapeError):
        CameraEmbedder("spherical", 5)(free)


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("rows", [draw(3, 5), draw(3, 4, 2, 3)], ids=["tokens", "latents"])
def test_the_unconditional_branch_comes_first_and_sees_zeros_in_both_image_streams(rows: Tensor, views: int) -> None:
    both = with_unconditional(rows, views, True).unflatten(0, (2, views, 3))
    assert not both[0].any()
    assert torch.equal(both[1], rows.expand_as(both[1]))
    assert torch.equal(with_unconditional(rows, views, False), both[1].flatten(0, 1))


def test_condition_latents_are_the_posterior_mean_of_the_noised_frames_and_not_scaled() -> None:
    synthesizer, clip = tiny_synthesizer(), random_clip()
    noise = draw(*clip.video.shape, seed=7)
    features = synthesizer.encode(clip, Augmentation(strength=0.3, noise=noise))
    with torch.inference_mode():
        posterior = synthesizer.networks.condition_encoder(clip.video + 0.3 * noise)
    assert TINY.vae.scale == 0.18215
    assert_close(features.latents, posterior.mean)
    assert features.augmentation == 0.3


def test_the_image_tower_sees_the_frames_clean() -> None:
    synthesizer, clip = tiny_synthesizer(), random_clip()
    clean = synthesizer.encode(clip, Augmentation(strength=0.0))
    noisy = synthesizer.encode(clip, Augmentation(strength=0.5))
    assert clean.tokens is not None
    assert noisy.tokens is not None
    assert torch.equal(clean.tokens, noisy.tokens)
    assert not torch.allclose(clean.latents, noisy.latents)
