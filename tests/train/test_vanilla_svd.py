"""Stable Video Diffusion as a baseline: the first frame alone, at the size of its training, several draws."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from driving_plane import PlaneClips
from msgspec import structs
from test_start import given, write

from gcd_model import CheckpointError, RenderOptions, Traits, Trajectory, View
from gcd_model.clip import Augmentation, Clip
from gcd_model.conditioning import SourceFeatures
from gcd_model.config import SamplingConfig
from gcd_model.geometry import CameraMount
from gcd_train.errors import RecipeError
from gcd_train.evaluation.baselines import BaselineSettings, VanillaSVD, baselines
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.predictors import CameraPair, SourceClip

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
    return replace(VanillaSVD.open(weights, BaselineSettings(device="cpu")), size=SIZE, steps=2)


def seen(frames: int = 4, key: str = "plane-0") -> SourceClip:
    clip = PlaneClips.make(1, frames=frames)[0]
    cameras = CameraPair.driving(CameraMount(), frames=frames, height=32, width=48)
    return SourceClip(
        source=clip.source, source_depth=clip.source_depth, source_classes=None, cameras=cameras, fps=7.0, key=key
    )


class Told:
    """Notes what a synthesizer is asked; shows the mean of what it was given, and noise by the seed."""

    def __init__(self, traits: Traits) -> None:
        self.traits = traits
        self.clips: list[Clip] = []
        self.features: list[SourceFeatures] = []
        self.options: list[RenderOptions] = []

    def encode(
        self, clip: Clip, augmentation: Augmentation | None = None, extra: torch.Tensor | None = None
    ) -> SourceFeatures:
        self.clips.append(clip)
        assert augmentation is not None
        assert augmentation.noise is not None
        assert augmentation.noise.shape == clip.video.shape
        latents = clip.video.mean(dim=1, keepdim=True).expand(-1, 4, -1, -1)
        return SourceFeatures(tokens=None, latents=latents, extra=None, fps=clip.fps, augmentation=0.02)

    def render(
        self,
        features: SourceFeatures,
        trajectories: Sequence[Trajectory],
        options: RenderOptions | None = None,
    ) -> list[View]:
        assert options is not None
        self.features.append(features)
        self.options.append(options)
        assert torch.equal(trajectories[0].source_from_target[-1], torch.eye(4, dtype=torch.float64))
        noise = torch.rand(features.frames, 3, 8, 12, generator=torch.Generator().manual_seed(options.seed)) / 2
        video = noise + (features.latents.mean() + 1) / 4
        return [View(samples=video[None], latents=video[None], trajectory=trajectories[0], motion_bucket=0.0)]


@pytest.fixture
def told(opened: VanillaSVD) -> Told:
    return Told(opened.synthesizer.traits)


def video(baseline: VanillaSVD, clip: SourceClip) -> torch.Tensor:
    made = baseline.predict(clip).video
    assert made is not None
    return made


def test_the_published_layout_gives_a_video_of_the_clips_size_and_length(opened: VanillaSVD) -> None:
    made = video(opened, seen())
    assert made.shape == (4, 3, 32, 48)
    assert made.dtype == torch.float32
    assert 0.0 <= float(made.min()) < float(made.max()) <= 1.0
    assert (opened.name, opened.privileged) == ("vanilla_svd", False)


def test_it_looks_at_the_first_frame_alone(told: Told) -> None:
    clip, baseline = seen(), VanillaSVD(synthesizer=told, size=SIZE)
    others = clip.source.copy()
    others[1:] = 255 - others[1:]
    blind = replace(clip, source=others, source_depth=clip.source_depth * 0)
    assert torch.equal(video(baseline, clip), video(baseline, blind))
    others[0] = 255 - others[0]
    assert not torch.equal(video(baseline, clip), video(baseline, blind))


def test_draws_differ_and_come_again_with_the_seed(told: Told) -> None:
    baseline = VanillaSVD(synthesizer=told, size=SIZE)
    several = replace(baseline, samples=3)
    draws = [draw.video for draw in several.predict(seen()).draws if draw.video is not None]
    again = [draw.video for draw in several.predict(seen()).draws if draw.video is not None]
    assert len(draws) == len(again) == 3
    assert len(told.clips) == 2  # encoded once for all draws
    assert all(torch.equal(one, two) for one, two in zip(draws, again, strict=True))
    assert not torch.equal(draws[0], draws[1])
    assert torch.equal(draws[0], video(baseline, seen()))
    assert not torch.equal(draws[0], video(replace(baseline, seed=1), seen()))
    assert not torch.equal(draws[0], video(baseline, seen(key="plane-1")))


def test_the_network_is_told_what_was_published(told: Told) -> None:
    VanillaSVD(synthesizer=told).predict(seen(frames=3))
    (clip,), (features,), (options,) = told.clips, told.features, told.options
    assert clip.video.shape == (1, 3, 576, 1024)
    assert (clip.fps, options.motion_bucket, options.samples) == (7.0, 127.0, 1)
    assert features.frames == 14
    assert torch.equal(features.latents[13], features.latents[0])
    sampling = told.traits.config.sampling
    assert (sampling.steps, sampling.guidance, options.steps, options.guidance) == (25, (1.0, 2.5), None, None)


def test_by_its_name_it_is_built_from_the_settings_and_told_by_its_weights(opened: VanillaSVD, weights: Path) -> None:
    clips = PairedSet.of(PlaneClips.make(1), "plane")
    settings = BaselineSettings(device="cpu", samples=2, seed=5, svd=str(weights))
    svd, hexplane, copied = baselines(["vanilla_svd", "hexplane_1", "copy_source"], clips, settings)
    made = svd.make()
    assert isinstance(made, VanillaSVD)
    assert (made.samples, made.seed) == (2, 5)
    assert svd.told["weights"] == opened.synthesizer.traits.sha256_12
    assert hexplane.told["updates"] == str(settings.hexplane.updates)
    assert copied.told == {"baseline": "copy_source"}
    (drawn,) = baselines(["vanilla_svd"], clips, replace(settings, svd="random:svd"))
    assert drawn.told["weights"] == "random:svd"
    with pytest.raises(RecipeError, match=r"give the path of svd\.safetensors"):
        baselines(["vanilla_svd"], clips, BaselineSettings())
    with pytest.raises(CheckpointError, match="no such file"):
        baselines(["vanilla_svd"], clips, BaselineSettings(svd="nowhere.safetensors"))
