"""The U-Net against its plain twin and against diffusers; what it costs at full size, and what is computed once."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import pytest
import torch
from diffusers.models.transformers.transformer_temporal import TransformerSpatioTemporalModel
from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel
from plain_unet import plain_unet
from published import diffusers_state, released_unet
from small_models import UNET, draw, give_published_epsilon, random_clip, randomise, relative_error, tiny_synthesizer
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from gcd_model.conditioning import CameraEmbedder
from gcd_model.config import SVD_14, CameraControl
from gcd_model.diffusion import RenderOptions
from gcd_model.geometry import Spherical, SphericalDelta, spherical_trajectory
from gcd_model.layers import Derived, TemporalShare, Upsample, prepare
from gcd_model.networks import Networks, empty_networks
from gcd_model.unet import FramePositions, VideoTransformer, VideoUNet

FRAMES, CLIPS, BRANCHES = 3, 2, 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """Two clips, each with both guidance branches, the unconditional ones first.

    latents: [R*K*T, 4, h, w]. condition, tokens: [R*K*T, ...]. vector, camera: [K*T, ...].
    """

    latents: Tensor
    condition: Tensor
    tokens: Tensor
    vector: Tensor
    camera: Tensor | None
    noise_label: float

    def ours(self, unet: VideoUNet) -> Tensor:
        """With a plan of two steps, of which this batch is the second."""
        labels = torch.tensor([1.5, self.noise_label])
        plan = unet.plan(labels, self.vector, self.camera, self.tokens)
        return unet(self.latents, self.condition, *plan.step(1, BRANCHES))

    def plain(self, weights: dict[str, Tensor]) -> Tensor:
        vector = self.vector if self.camera is None else torch.cat([self.vector, self.camera], dim=1)
        return plain_unet(
            weights,
            torch.cat([self.latents, self.condition], dim=1),
            noise_label=torch.full((len(self.latents),), self.noise_label),
            vector=vector.repeat(BRANCHES, 1),
            tokens=self.tokens,
            frames=FRAMES,
            head_width=UNET.head_width,
        )


def camera_vectors(control: CameraControl) -> Tensor | None:
    """[K*T, W]: another path for each clip, embedded as the checkpoint's control does; None without control."""
    if control == "none":
        return None
    embedder = CameraEmbedder(control, UNET.camera_width)
    randomise(embedder)
    source = Spherical(azimuth_deg=0.0, elevation_deg=5.0, radius_m=15.0)
    goals = [SphericalDelta(azimuth_deg=30.0, elevation_deg=10.0), SphericalDelta(azimuth_deg=-70.0, radius_m=2.0)]
    paths = [spherical_trajectory(source, goal, frames=FRAMES, move_time=FRAMES - 1) for goal in goals]
    return torch.cat([embedder(path) for path in paths]).detach()


def batch(control: CameraControl = "spherical", clips: int = CLIPS) -> Batch:
    rows, camera = clips * FRAMES, camera_vectors(control)
    condition, tokens = draw(rows, 4, 8, 16, seed=2), draw(rows, 48, seed=3)
    return Batch(
        latents=draw(rows, 4, 8, 16, seed=1).repeat(BRANCHES, 1, 1, 1),
        condition=torch.cat([torch.zeros_like(condition), condition]),
        tokens=torch.cat([torch.zeros_like(tokens), tokens]),
        vector=draw(rows, UNET.vector_width, seed=4),
        camera=None if camera is None else camera[:rows],
        noise_label=-0.7,
    )


def small_unet(control: CameraControl = "spherical", **changes: Any) -> VideoUNet:
    width = 0 if control == "none" else UNET.camera_width
    unet = VideoUNet(msgspec.structs.replace(UNET, camera_width=width, **changes), FRAMES)
    randomise(unet)
    return unet


@pytest.mark.parametrize("control", ["spherical", "none"])
def test_the_u_net_equals_the_published_one_in_training_and_prepared(control: CameraControl) -> None:
    unet, given = small_unet(control).train(), batch(control)
    with torch.no_grad():
        plain = given.plain(released_unet(unet))
        assert relative_error(given.ours(unet), plain) < 1e-5
        prepare(unet)
        assert relative_error(given.ours(unet), plain) < 1e-5


def test_gradients_through_derived_values_equal_the_published_ones() -> None:
    """In double precision, so that rounding does not hide a wrong term; all parameters, also those derived from."""
    unet = small_unet(multipliers=(1, 2), attention=(True, False), blocks_per_level=1).double().train()
    given, weights = (
        batch(clips=1),
        {name: w.double().clone().requires_grad_() for name, w in released_unet(unet).items()},
    )
    doubled = ("latents", "condition", "tokens", "vector", "camera")
    given = replace(given, **{name: getattr(given, name).double() for name in doubled})
    direction = draw(*given.latents.shape, seed=9).double()
    (given.ours(unet) * direction).sum().backward()
    (given.plain(weights) * direction).sum().backward()
    ours = released_unet(unet, gradients=True)
    dormant = {name for name in weights if "attn2.to_q" in name or "attn2.to_k" in name or ".norm2." in name}
    assert ours.keys() == weights.keys() - dormant
    theirs = {name: weight.grad for name, weight in weights.items() if weight.grad is not None}
    for name, gradient in ours.items():
        assert theirs[name].any(), f"{name} has no influence, so the comparison says nothing"
        assert relative_error(gradient, theirs[name]) < 1e-4, name
    assert all(theirs[name].abs().max() < 1e-9 for name in dormant)  # the published network does not use them either


def test_a_fresh_u_net_starts_as_published_with_zero_output_even_shares_and_the_published_epsilons() -> None:
    unet = VideoUNet(UNET, FRAMES)
    assert not batch().ours(unet).any()
    zero = {name.rsplit(".", 1)[0] for name, p in unet.named_parameters() if p.ndim > 1 and not p.any()}
    expected = {"conv_out"}
    expected |= {
        f"{name}.conv2" for name, _ in unet.named_modules() if name.endswith((".res.spatial", ".res.temporal"))
    }
    expected |= {f"{name}.proj_out" for name, m in unet.named_modules() if isinstance(m, VideoTransformer)}
    assert zero == expected
    assert {p.item() for name, p in unet.named_parameters() if name.endswith("share.mix")} == {0.5}
    for name, module in unet.named_modules():
        if isinstance(module, nn.GroupNorm | nn.LayerNorm):
            assert module.eps == (1e-6 if name.endswith("attention.norm") else 1e-5), name


def small_diffusers_unet() -> UNetSpatioTemporalConditionModel:
    """The same small architecture, with the published epsilon throughout."""
    theirs = UNetSpatioTemporalConditionModel(
        block_out_channels=UNET.widths,  # pyright: ignore[reportArgumentType]
        addition_time_embed_dim=UNET.vector_width // 3,
        projection_class_embeddings_input_dim=UNET.vector_width,
        cross_attention_dim=48,
        num_attention_heads=tuple(width // UNET.head_width for width in UNET.widths),
        num_frames=FRAMES,
    )
    assert give_published_epsilon(theirs) == 3 * 2 * 4 + 4 * 3 * 4  # levels, blocks, norms: down and up
    return theirs


def test_the_u_net_equals_diffusers() -> None:
    ours, theirs = small_unet("none"), small_diffusers_unet()
    prepare(ours)
    theirs.load_state_dict(diffusers_state(ours, "unet", "unet/"))
    ids = torch.tensor([[12.0, 127.0, 0.02], [6.0, 31.0, 0.1]])
    tokens, latents = draw(CLIPS, 1, 48), draw(CLIPS, FRAMES, 8, 8, 16)  # one token per clip: diffusers knows no other
    with torch.inference_mode():
        expected = theirs(latents, torch.tensor(-0.7), tokens, ids).sample.flatten(0, 1)
        vector = theirs.add_time_proj(ids.flatten()).reshape(CLIPS, -1).repeat_interleave(FRAMES, dim=0)
        plan = ours.plan(torch.tensor([-0.7]), vector, None, tokens[:, 0].repeat_interleave(FRAMES, dim=0))
        rows = latents.flatten(0, 1)
        result = ours(rows[:, :4], rows[:, 4:], *plan.step(0))
    assert relative_error(result, expected) < 1e-5


def test_a_transformer_with_a_token_per_frame_equals_diffusers_which_takes_the_first_frames_across_frames() -> None:
    ours = VideoTransformer(32, head_width=16, context_width=48, groups=32, frames=FRAMES)
    randomise(ours)
    theirs = TransformerSpatioTemporalModel(2, 16, in_channels=32, cross_attention_dim=48)
    place = ("unet.down.0.stages.0.attention", "unet/down_blocks.0.attentions.0.")
    theirs.load_state_dict(diffusers_state(ours, *place))
    x, tokens = draw(CLIPS * FRAMES, 32, 4, 6), draw(CLIPS * FRAMES, 48)
    with torch.inference_mode():
        expected = theirs(x, tokens[:, None], image_only_indicator=torch.zeros(CLIPS, FRAMES)).sample
        cross = ours.cross(tokens)
        assert cross is not None
        result, wrong = ours(x, cross, FRAMES), ours(x, cross.roll(1, dims=0), FRAMES)
    assert relative_error(result, expected) < 1e-5
    assert relative_error(wrong, expected) > 1e-3


FULL_FRAMES, FULL_HEIGHT, FULL_WIDTH = 14, 32, 48


@pytest.fixture(scope="module")
def full_size() -> Networks:
    return empty_networks(SVD_14)


def _meta(*shape: int) -> Tensor:
    return torch.empty(shape, device="meta")


def _plain_flops(unet: VideoUNet) -> int:
    with FlopCounterMode(display=False) as counter:
        plain_unet(
            {name: torch.empty_like(weight, device="meta") for name, weight in released_unet(unet).items()},
            _meta(FULL_FRAMES, 8, FULL_HEIGHT, FULL_WIDTH),
            noise_label=_meta(FULL_FRAMES),
            vector=_meta(FULL_FRAMES, 768 + 128),
            tokens=_meta(FULL_FRAMES, 1024),
            frames=FULL_FRAMES,
            head_width=64,
        )
    return counter.get_total_flops()


def _our_flops(unet: VideoUNet) -> int:
    prepare(unet)
    vector, camera, tokens = _meta(FULL_FRAMES, 768), _meta(FULL_FRAMES, 128), _meta(FULL_FRAMES, 1024)
    plan = unet.plan(_meta(1), vector, camera, tokens)
    latents = _meta(FULL_FRAMES, 4, FULL_HEIGHT, FULL_WIDTH)
    with FlopCounterMode(display=False) as counter:
        unet(latents, latents, *plan.step(0))
    return counter.get_total_flops()


@pytest.mark.slow
def test_one_branch_at_full_size_costs_at_least_0_485_tflop_less_than_the_published_graph(full_size: Networks) -> None:
    plain, ours = _plain_flops(full_size.unet) / 1e12, _our_flops(full_size.unet) / 1e12
    assert plain == pytest.approx(6.265, abs=0.005)
    assert ours <= plain - 0.485


def _count(module: nn.Module | None) -> int:
    assert module is not None
    return sum(parameter.numel() for parameter in module.parameters())


def test_parameter_counts_at_full_size_are_the_published_ones(full_size: Networks) -> None:
    unet = full_size.unet
    assert _count(unet) == 1_526_427_882
    assert _count(unet.embed_camera) == 1_804_800
    assert len(unet.state_dict()) == 1432
    without_camera = [name for name in unet.state_dict() if not name.startswith("embed_camera.")]
    assert len(without_camera) == 1428
    assert _count(unet) - _count(unet.embed_camera) == 1_524_623_082
    assert _count(full_size.camera) == 1_792
    assert _count(full_size.image_encoder) == 632_076_800
    assert _count(full_size.target_encoder) == 34_163_592
    assert _count(full_size.condition_encoder) == 34_163_592 + 72
    assert _count(full_size.decoder) == 63_579_183


def _counted(modules: Mapping[str, nn.Module]) -> dict[str, int]:
    """How often each module runs from now on."""
    calls = dict.fromkeys(modules, 0)
    for name, module in modules.items():
        module.register_forward_hook(lambda *_, name=name: calls.update({name: calls[name] + 1}))
    return calls


def test_embeddings_and_cross_attention_run_once_a_window_however_many_steps_and_the_source_is_encoded_once() -> None:
    """Once for all views, samples and both guidance branches; two frames a call."""
    synthesizer = tiny_synthesizer()
    networks, unet = synthesizer.networks, synthesizer.networks.unet
    endings = ("embed_noise", "embed_vector", "embed_camera", ".embed", ".token.value", ".token.out")
    once = _counted({name: module for name, module in unet.named_modules() if name.endswith(endings)})
    assert networks.image_encoder is not None
    parts = {"tower": networks.image_encoder, "encoder": networks.condition_encoder, "stem": unet.stem}
    calls = _counted(parts)
    features = synthesizer.encode(random_clip(frames=2)).followed_by(synthesizer.encode(random_clip(frames=1)))
    paths = [synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=azimuth)) for azimuth in (10.0, 20.0)]
    synthesizer.render(features, paths, RenderOptions(samples=2, steps=5))
    assert calls == {"tower": 2, "encoder": 2, "stem": 5}
    assert len(once) > 10
    assert set(once.values()) == {1}


def test_what_the_weights_determine_is_not_derived_again_in_a_prepared_network(monkeypatch: pytest.MonkeyPatch) -> None:
    synthesizer = tiny_synthesizer()
    derived = [module for module in synthesizer.networks.modules() if isinstance(module, Derived)]
    assert {type(module) for module in derived} == {Upsample, FramePositions, TemporalShare}

    def refuse(_module: object) -> None:
        pytest.fail("derived again")

    for kind in (Upsample, FramePositions, TemporalShare):
        monkeypatch.setattr(kind, "derive", refuse)
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    assert synthesizer.render(synthesizer.encode(random_clip()), [path])[0].samples.isfinite().all()


def test_a_network_evaluation_never_waits_for_the_device_or_builds_anything_on_the_host() -> None:
    """On the meta device there are no values to wait for: reading one, or mixing in a host tensor, would raise."""
    with torch.device("meta"):
        unet = VideoUNet(UNET, 3)
    prepare(unet)
    plan = unet.plan(_meta(4), _meta(3, UNET.vector_width), _meta(3, UNET.camera_width), _meta(6, 48))
    latents = _meta(6, 4, 8, 16)
    assert unet(latents, latents, *plan.step(3, 2)).shape == (6, 4, 8, 16)
