"""Baselines: the flat ground against rays, the published reprojections, Stable Video Diffusion; all by their names."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from driving_plane import STAGE_SOURCE, PlaneClips, plane_clip, seen_of
from fake_model import FakeModel
from msgspec import structs
from test_start import given, write

from gcd_model import CheckpointError, RenderOptions, load_synthesizer
from gcd_model.conditioning import SourceFeatures
from gcd_model.config import SamplingConfig
from gcd_model.geometry import CameraMount, SphericalDelta, spherical_trajectory
from gcd_train.data.visibility import visibility
from gcd_train.errors import RecipeError
from gcd_train.evaluation.baselines import (
    GroundHomography,
    ReprojectRgbd,
    ReprojectSemd,
    ground_grid,
    source_views,
)
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.methods import EvaluateOptions, baselines
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import CameraPair, Predictor, SourceClip, pixel_rays, to_pictures, to_pixels
from gcd_train.evaluation.synthesized import VanillaSVD

FRAMES, HEIGHT, WIDTH = 3, 64, 96

# --- the flat ground ------------------------------------------------------------------------------------------------


def cameras(mount: CameraMount | None = None) -> CameraPair:
    return CameraPair.driving(mount or CameraMount(), frames=FRAMES, height=HEIGHT, width=WIDTH)


@pytest.mark.parametrize("mount", [CameraMount(), CameraMount(height_m=1.2, tilt_deg=-3.0)])
def test_the_ground_homography_gives_the_picture_of_a_plane_drawn_by_rays(mount: CameraMount) -> None:
    clip = plane_clip(cameras(mount))
    made = GroundHomography().predict(seen_of(clip, cameras(mount)))
    there = ground_grid(cameras(mount))[1]
    assert not made.video[~there[:, None].expand_as(made.video)].any()
    assert (made.classes[~there] == NO_CLASS).all()
    near = (clip.target_depth > 0) & (clip.target_depth < 25)  # where the source picture holds the paint's detail
    seen = there & torch.from_numpy(near)
    assert seen.float().mean() > 0.15
    assert ((made.video - to_pictures(clip.target)) ** 2).mean(dim=1)[seen].mean().sqrt() < 0.03
    assert (made.classes == torch.from_numpy(clip.target_classes))[seen].float().mean() > 0.97


@pytest.mark.parametrize("change", [(50.0, 0.0, 0.0), (-70.0, 20.0, -1.5), (0.0, -12.0, 2.0)])
def test_the_ground_homography_is_exact_for_a_plane(change: tuple[float, float, float]) -> None:
    """Each target pixel's point on z = 0, found by its ray, lies in the source picture where the grid says."""
    delta = SphericalDelta(azimuth_deg=change[0], elevation_deg=change[1], radius_m=change[2])
    path = spherical_trajectory(STAGE_SOURCE, delta, frames=FRAMES, move_time=FRAMES - 1)
    pair = CameraPair.orbit(path, hfov_deg=53.13, height=HEIGHT, width=WIDTH)
    grid, seen = ground_grid(pair)
    ground_from_target = pair.ground_from_source @ pair.source_from_target
    rays = torch.einsum("tij,hwj->thwi", ground_from_target[:, :3, :3], pixel_rays(pair.target))
    eyes = ground_from_target[:, None, None, :3, 3]
    points = eyes - rays * eyes[..., 2:] / rays[..., 2:]
    local = (points - pair.ground_from_source[:3, 3]) @ pair.ground_from_source[:3, :3]
    there = to_pixels(local, pair.source)
    assert seen.float().mean() > 0.3
    wanted = (there / torch.tensor([WIDTH, HEIGHT]) * 2 - 1)[seen]
    torch.testing.assert_close(grid[seen].double(), wanted, atol=1e-6, rtol=0)


# --- the published reprojections ------------------------------------------------------------------------------------

CLASSES = PlaneClips.make(1).classes
PAIR = CameraPair.driving(CameraMount(), frames=FRAMES, height=HEIGHT, width=WIDTH)
CLIP = plane_clip(PAIR)
SEEN = seen_of(CLIP, PAIR, key="plane-0")


@cache
def picture() -> torch.Tensor:
    return picture_of(SEEN)


def picture_of(clip: SourceClip) -> torch.Tensor:
    made = ReprojectRgbd().predict(clip)
    assert made.classes is None
    return made.video


def classes(clip: SourceClip = SEEN) -> torch.Tensor:
    made = ReprojectSemd(classes=CLASSES).predict(clip)
    assert made.video is None
    return made.classes


def shown(video: torch.Tensor) -> torch.Tensor:
    return video.sum(dim=1) > 1e-7


def test_what_it_shows_is_what_the_published_rule_calls_visible() -> None:
    for t, view in enumerate(source_views(SEEN)):
        pose = PAIR.source_from_target[t].numpy()
        rule = visibility(view, pose, PAIR.target, (WIDTH, HEIGHT))
        assert np.array_equal(shown(picture())[t].numpy(), rule)


def test_classes_are_read_back_from_the_nearest_colour_and_holes_are_of_no_class() -> None:
    made, target = classes(), torch.from_numpy(CLIP.target_classes)
    there = shown(picture())
    near = torch.from_numpy((CLIP.target_depth > 0) & (CLIP.target_depth < 15))
    assert (made == target)[there & near].float().mean() > 0.9
    assert (~there).any()
    assert (made[~there] == NO_CLASS).all()
    assert (made[there] == NO_CLASS).float().mean() < 0.05  # edges that points cover to less than half


def test_points_of_the_data_sets_own_views_are_drawn_instead_where_there_are_some() -> None:
    large = CameraPair.driving(CameraMount(), frames=FRAMES, height=2 * HEIGHT, width=2 * WIDTH)
    own, moved = plane_clip(large), np.eye(4)
    moved[:3, 3] = [40.0, -7.0, 3.0]  # another world: only the relative pose counts

    seen = seen_of(own, large)
    finer = replace(SEEN, points=[replace(view, world_from_camera=moved) for view in source_views(seen)])
    made, usual = picture_of(finer), picture()
    both = shown(made) & shown(usual)
    assert made.shape == (FRAMES, 3, HEIGHT, WIDTH)
    assert shown(made)[-1].sum() >= shown(usual)[-1].sum()
    off = (made - usual).abs().mean(dim=1)[both]
    assert 0.0 < float(off.mean()) < 0.05
    assert (classes(finer) == classes())[both].float().mean() > 0.9


# --- Stable Video Diffusion: the first frame alone, at the size of its training, several draws --------------------

SIZE = (16, 32)
"""As small as the networks can halve."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    networks, sampling = given("none"), SamplingConfig(guidance=(1.0, 2.5))
    networks.config = structs.replace(networks.config, frames=14, height=576, width=1024, sampling=sampling)
    return write(tmp_path_factory.mktemp("weights") / "blob.safetensors", networks)


@pytest.fixture(scope="module")
def opened(weights: Path) -> VanillaSVD:
    """With so few steps as show what it does."""
    model = load_synthesizer(weights, family="svd", device="cpu")
    return VanillaSVD(weights=lambda: model, size=SIZE, steps=2)


def first_of(frames: int = 4, key: str = "plane-0") -> SourceClip:
    return seen_of(PlaneClips.make(1, frames=frames)[0], source_classes=None, fps=7.0, key=key)


def by_the_seed(features: SourceFeatures, options: RenderOptions) -> torch.Tensor:
    """Noise, and the mean of what was given: [1, T, 3, 8, 12]."""
    noise = torch.rand(1, features.frames, 3, 8, 12, generator=torch.Generator().manual_seed(options.seed)) / 2
    return noise + (features.latents.mean() + 1) / 4


@pytest.fixture
def told(opened: VanillaSVD) -> FakeModel:
    return FakeModel(opened.weights().traits, by_the_seed)


def video(baseline: VanillaSVD, clip: SourceClip) -> torch.Tensor:
    return baseline.predict(clip).video


def test_the_published_layout_gives_a_video_of_the_clips_size_and_length(opened: VanillaSVD) -> None:
    prediction = opened.predict(first_of())
    made = prediction.video
    assert prediction.crop == (0, 4, 48, 24)  # the networks' shape is twice as wide as high
    assert made.shape == (4, 3, 24, 48)
    assert made.dtype == torch.float32
    assert 0.0 <= float(made.min()) < float(made.max()) <= 1.0
    assert (opened.name, opened.privileged) == ("vanilla_svd", False)


def test_it_looks_at_the_first_frame_alone(told: FakeModel) -> None:
    clip, baseline = first_of(), VanillaSVD(weights=lambda: told, size=SIZE)
    others = clip.source.copy()
    others[1:] = 255 - others[1:]
    blind = replace(clip, source=others, source_depth=clip.source_depth * 0)
    assert torch.equal(video(baseline, clip), video(baseline, blind))
    others[0] = 255 - others[0]
    assert not torch.equal(video(baseline, clip), video(baseline, blind))


def test_it_looks_at_the_middle_alone_that_has_the_shape_of_its_training(told: FakeModel) -> None:
    clip, baseline = first_of(), VanillaSVD(weights=lambda: told, size=SIZE)
    edges = clip.source.copy()
    edges[:, :4], edges[:, -4:] = 0, 255
    assert torch.equal(video(baseline, clip), video(baseline, replace(clip, source=edges)))
    assert baseline.predict(first_of()).crop is not None
    assert replace(baseline, size=(32, 48)).predict(clip).crop is None


def test_draws_differ_and_come_again_with_the_seed(told: FakeModel) -> None:
    baseline = VanillaSVD(weights=lambda: told, size=SIZE)
    several = replace(baseline, samples=3)
    draws = [draw.video for draw in several.predict(first_of()).draws if draw.video is not None]
    again = [draw.video for draw in several.predict(first_of()).draws if draw.video is not None]
    assert len(draws) == len(again) == 3
    assert len(told.clips) == 2  # encoded once for all draws
    assert all(torch.equal(one, two) for one, two in zip(draws, again, strict=True))
    assert not torch.equal(draws[0], draws[1])
    assert torch.equal(draws[0], video(baseline, first_of()))
    assert not torch.equal(draws[0], video(replace(baseline, seed=1), first_of()))
    assert not torch.equal(draws[0], video(baseline, first_of(key="plane-1")))


def test_the_network_is_told_what_was_published(told: FakeModel) -> None:
    VanillaSVD(weights=lambda: told).predict(first_of(frames=3))
    (clip,), (features,), (options,) = told.clips, told.features, told.options
    assert clip.video.shape == told.noise[0].noise.shape == (1, 3, 576, 1024)
    assert torch.equal(told.paths[0].source_from_target[-1], torch.eye(4, dtype=torch.float64))
    assert (clip.fps, options.motion_bucket, options.samples) == (7.0, 127.0, 1)
    assert features.frames == 14
    assert torch.equal(features.latents[13], features.latents[0])
    sampling = told.traits.config.sampling
    assert (sampling.steps, sampling.guidance, options.steps, options.guidance) == (25, (1.0, 2.5), None, None)


# --- by their names -------------------------------------------------------------------------------------------------


def named(*names: str, of: PairedSet | None = None, **options: object) -> tuple[Predictor, ...]:
    """These baselines, by default of pairs with classes; the usual ones where none are named."""
    clips = of or PairedSet.of(PlaneClips.make(1), "plane")
    return baselines(names or None, clips, EvaluateOptions(data=(), device="cpu", **options))


def test_options_of_learned_baselines_arrive_and_are_told() -> None:
    told = {"gaussian_updates": 7, "gaussians": 900, "hexplane_updates": 8, "hexplane_rays": 9}
    gaussians, planes = (each.details for each in named("4dgs_1", "hexplane_1", **told))
    assert (gaussians["updates"], gaussians["most"], planes["updates"], planes["rays"]) == ("7", "900", "8", "9")


def test_the_usual_baselines_are_those_that_the_clips_have_enough_for() -> None:
    clips = PairedSet.of(PlaneClips.make(1), "plane")
    plain, painted = replace(clips, classes=()), replace(clips, painted=True)
    every = ["copy_source", "ground_homography", "reproject_rgbd", "reproject_semd"]
    found = [[method.name for method in named(of=of)] for of in (clips, plain, painted)]
    assert found == [every, every[:3], [*every[:2], every[3]]]
    for name, of in (("reproject_rgbd", painted), ("hexplane_1", painted), ("reproject_semd", plain)):
        with pytest.raises(RecipeError, match=name):
            named(name, of=of)
    (released,) = named("reproject_rgbd", protocol="release")
    assert released == ReprojectRgbd(published=True)
    assert released.details == {"baseline": "reproject_rgbd", "published rounding": "yes"}


def test_by_its_name_it_is_built_from_the_options_and_described_by_its_weights(weights: Path) -> None:
    options = {"samples": 2, "seed": 5, "svd": str(weights)}
    svd, hexplane, copied = named("vanilla_svd", "hexplane_1", "copy_source", **options)
    assert isinstance(svd, VanillaSVD)
    assert (svd.samples, svd.seed) == (2, 5)
    assert svd.details["weights"] == svd.weights().traits.sha256_12
    assert (hexplane.details["updates"], copied.details) == ("1000", {"baseline": "copy_source"})
    assert named("vanilla_svd", svd="random:svd")[0].details["weights"] == "random:svd"
    with pytest.raises(RecipeError):
        named("vanilla_svd")
    with pytest.raises(CheckpointError):
        named("vanilla_svd", svd="nowhere.safetensors")
    for name, camera in (("mine.ckpt", "none"), ("mine.safetensors", "spherical")):  # GCD's, by another name
        with pytest.raises(RecipeError, match="GCD"):
            named("vanilla_svd", svd=str(write(weights.with_name(name), given(camera))))
