"""The splat as a condition: what its channels are, who sees them, and that weights without them give what they gave."""

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
import torch.nn.functional as F
from small_models import TINY, as_loaded, random_clip, randomise, relative_error, tiny_synthesizer, tiny_traits
from test_cuda_engine import PLAIN, with_engine
from test_onnx import engined
from torch import Tensor
from torch.testing import assert_close

from gcd_model.clip import Clip
from gcd_model.conditioning import Conditioning, splat_channels, splatted
from gcd_model.config import ModelConfig, SplatDepth, with_splat
from gcd_model.diffusion import RenderOptions
from gcd_model.errors import OptionError
from gcd_model.geometry import Intrinsics, SphericalDelta, Trajectory, pose_trajectory
from gcd_model.live.eyes import estimated_depth
from gcd_model.networks import Networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.adapter import carried_over
from gcd_model.weights.load import load_weights, save_weights

LENS = Intrinsics.from_hfov(60.0, TINY.width, TINY.height)
GIVEN = with_splat(TINY, "given")


def clip_with_depth(config: ModelConfig = TINY) -> Clip:
    clip = random_clip(config)
    return replace(clip, lens=LENS, depth=torch.full_like(clip.video[:, 0], 15.0))


def paths(synthesizer: Synthesizer) -> list[Trajectory]:
    return [synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=angle)) for angle in (10.0, -20.0)]


def test_a_wall_is_seen_where_its_rays_meet_it_and_nothing_is_before_black() -> None:
    """Against each target pixel's own ray through the plane z = 8, looked up in the source's picture."""
    wall_m, frames = 8.0, 3
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 1.5, 3.0])
    poses[:, 2, 3] = torch.tensor([0.0, 1.0, 2.0])
    rays = torch.cat([LENS.rays(), torch.ones(1, LENS.height, LENS.width)])  # [3, H, W]

    def painted(x: Tensor, y: Tensor) -> Tensor:
        return torch.stack([torch.sin(x / 3), torch.cos(y / 3), torch.sin((x + y) / 4)])

    video = painted(*(rays[:2] * wall_m)).expand(frames, -1, -1, -1)
    metres = torch.full((frames, LENS.height, LENS.width), wall_m)
    seen = splatted(video, metres, LENS, pose_trajectory(poses))
    for shown, pose in zip(seen, poses.float(), strict=True):
        x, y = (rays[:2] * (wall_m - pose[2, 3])) + pose[:2, 3, None, None]
        u, v = LENS.fx * x / wall_m + LENS.cx, LENS.fy * y / wall_m + LENS.cy
        inside = (u > 1) & (u < LENS.width - 1) & (v > 1) & (v < LENS.height - 1)
        outside = (u < -1) | (u > LENS.width + 1) | (v < -1) | (v > LENS.height + 1)
        assert_close(shown[3][inside], torch.ones_like(shown[3][inside]))
        assert (shown[:3] - painted(x, y))[:, inside].abs().max() < 0.05
        assert bool((shown[3][outside] == 0).all())
        assert bool((shown[:3, outside] == -1).all())
    assert bool(outside.any())


def test_its_channels_are_latents_of_its_colour_and_the_mean_coverage() -> None:
    splats = torch.rand(2, 4, 8, 16)
    made = splat_channels(splats, lambda frames: F.avg_pool2d(frames, 4))
    assert_close(made, F.avg_pool2d(splats, 4))


def conditions(synthesizer: Synthesizer, clip: Clip, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    """What the network is given beside the noisy latents: [R, K, T, C', h, w]."""
    given: list[Conditioning] = []
    engine = synthesizer._engine  # pyright: ignore[reportPrivateUsage]

    def sample(start: Tensor, conditioning: Conditioning, *_: object) -> Tensor:
        given.append(conditioning)
        return start

    with monkeypatch.context() as patch:
        patch.setattr(engine, "sample", sample)
        synthesizer.render(synthesizer.encode(clip), paths(synthesizer))
    return given[0].latents.unflatten(0, (2, 2, TINY.frames))


def test_each_view_is_given_its_own_splat_and_the_unconditional_branch_zeros(monkeypatch: pytest.MonkeyPatch) -> None:
    synthesizer, clip = tiny_synthesizer(GIVEN), clip_with_depth()
    without, given = conditions(synthesizer, clip, monkeypatch)
    assert given.shape[2] == 9
    assert bool((without == 0).all())
    assert torch.equal(given[0, :, :4], given[1, :, :4])
    with torch.inference_mode():
        encode = synthesizer.networks.condition_encoder
        for view, path in zip(given, paths(synthesizer), strict=True):
            splats = splatted(clip.video, clip.depth, LENS, path)  # pyright: ignore[reportArgumentType]
            assert_close(view[:, 4:8], encode(splats[:, :3]).mean)
            assert_close(view[:, 8:], F.avg_pool2d(splats[:, 3:], TINY.vae.down_factor))
    assert relative_error(given[0, :, 4:], given[1, :, 4:]) > 0.01


@pytest.mark.parametrize("camera", ["spherical", "none"])
def test_weights_without_it_give_the_views_they_gave(camera: str) -> None:
    """GCD's networks for Kubric-4D, and those of SVD and of driving; zeros at the new channels."""
    unet = msgspec.structs.replace(TINY.unet, camera_width=8 if camera == "spherical" else 0)
    config = msgspec.structs.replace(TINY, unet=unet, camera=camera)
    before, networks = Networks(config), Networks(with_splat(config, "given"))
    randomise(before)
    networks.load_state_dict(carried_over(before, networks.config).weights)
    assert networks.unet.stem.weight.shape[1] == 13
    options = RenderOptions(seed=2, guidance=(1.0, 2.0), motion_bucket=127.0)
    still = pose_trajectory(torch.eye(4, dtype=torch.float64).repeat(TINY.frames, 1, 1))
    views = []
    for each in (before, networks):
        synthesizer = Synthesizer(each, tiny_traits(each.config))
        path = paths(synthesizer)[0] if camera == "spherical" else still
        views.append(synthesizer.render(synthesizer.encode(clip_with_depth()), [path], options)[0])
    assert relative_error(views[1].latents, views[0].latents) < 1e-6


def test_our_own_file_keeps_it(tmp_path: Path) -> None:
    loaded = as_loaded(tiny_synthesizer(GIVEN))
    save_weights(loaded.diffusion, tmp_path / "splat.safetensors", loaded.card)
    again = load_weights(tmp_path / "splat.safetensors").diffusion
    assert again.config == GIVEN
    assert torch.equal(again.unet.stem.weight, loaded.diffusion.unet.stem.weight)


def test_without_depth_it_is_estimated_or_refused_by_how_the_weights_were_trained() -> None:
    clip = replace(random_clip(), lens=LENS)
    estimating = tiny_synthesizer(with_splat(TINY, "estimated"))
    features = estimating.encode(clip)
    assert features.metres is not None
    assert_close(features.metres, estimated_depth(clip.video, LENS))
    assert bool(((features.metres >= 0) & (features.metres < 1e4)).all())
    assert torch.equal(estimating.encode(clip_with_depth()).metres, clip_with_depth().depth)  # pyright: ignore
    frames = [estimating.encode(replace(clip, video=frame[None])) for frame in clip.video]
    assert_close(frames[0].followed_by(*frames[1:]).metres, features.metres)  # whatever windows overlap
    with pytest.raises(OptionError, match="depth"):
        tiny_synthesizer(GIVEN).encode(clip)
    with pytest.raises(OptionError, match="lens"):
        tiny_synthesizer(GIVEN, family_known=False).encode(replace(clip_with_depth(), lens=None))
    with pytest.raises(OptionError):
        estimated_depth(clip.video[..., :-8], LENS)


@pytest.mark.parametrize(("splat", "channels"), [("none", 9), ("given", 4), ("estimated", 8)])
def test_a_config_whose_channels_do_not_fit_is_refused(splat: SplatDepth, channels: int) -> None:
    unet = msgspec.structs.replace(TINY.unet, condition_channels=channels)
    with pytest.raises(OptionError):
        ModelConfig(**{**msgspec.structs.asdict(TINY), "unet": unet, "splat": splat})


@pytest.mark.parametrize("engine", [lambda plain: with_engine(plain, options=PLAIN), lambda plain: engined(plain)[0]])
def test_every_engine_takes_it(engine: object) -> None:
    plain, options = tiny_synthesizer(GIVEN), RenderOptions(steps=2, samples=2)
    ours, theirs = (
        each.render(each.encode(clip_with_depth()), paths(plain), options)
        for each in (engine(plain), plain)  # pyright: ignore[reportCallIssue]
    )
    for mine, other in zip(ours, theirs, strict=True):
        assert relative_error(mine.latents, other.latents) < 1e-5
