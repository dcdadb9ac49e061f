"""What the U-Net costs at full size, and that nothing constant is computed in the loop."""

from collections.abc import Callable, Mapping

import pytest
import torch
from naming import released_unet
from plain_unet import plain_unet
from small_models import UNET, random_clip, tiny_synthesizer
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from gcd_model.config import SVD_14
from gcd_model.diffusion import RenderOptions
from gcd_model.geometry import SphericalDelta
from gcd_model.layers import Derived, TemporalShare, Upsample, prepare
from gcd_model.networks import Networks, empty_networks
from gcd_model.unet import FramePositions, VideoUNet

FULL_FRAMES, FULL_HEIGHT, FULL_WIDTH = 14, 32, 48


@pytest.fixture(scope="module")
def full_size() -> Networks:
    return empty_networks(SVD_14)


def _meta(*shape: int) -> Tensor:
    return torch.empty(shape, device="meta")


def _plain_flops(unet: VideoUNet) -> int:
    with FlopCounterMode(display=False) as counter:
        plain_unet(
            {name: weight.to("meta") for name, weight in released_unet(unet).items()},
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


class _Counter:
    """How often each module of a kind ran."""

    def __init__(self, modules: Mapping[str, nn.Module]) -> None:
        self.calls = dict.fromkeys(modules, 0)
        for name, module in modules.items():
            module.register_forward_hook(self._hook(name))

    def _hook(self, name: str) -> Callable[[nn.Module, object, object], None]:
        def count(_module: nn.Module, _given: object, _result: object) -> None:
            self.calls[name] += 1

        return count


def _once_a_window(unet: VideoUNet) -> dict[str, nn.Module]:
    """Embeddings, their projections and cross-attention: they depend on the window and the schedule alone."""
    endings = ("embed_noise", "embed_vector", "embed_camera", ".embed", ".token.value", ".token.out")
    return {name: module for name, module in unet.named_modules() if name.endswith(endings)}


def test_embeddings_and_cross_attention_run_once_a_window_however_many_steps_it_takes() -> None:
    synthesizer = tiny_synthesizer()
    features = synthesizer.encode(random_clip())
    path = synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    once, stem = _once_a_window(synthesizer.networks.unet), {"stem": synthesizer.networks.unet.stem}
    planned, looped = _Counter(once), _Counter(stem)
    assert len(once) > 10
    synthesizer.render(features, [path], RenderOptions(steps=5))
    assert looped.calls == {"stem": 5}
    assert set(planned.calls.values()) == {1}


def test_the_source_is_encoded_once_for_all_views_samples_and_both_guidance_branches() -> None:
    synthesizer = tiny_synthesizer()
    networks = synthesizer.networks
    assert networks.image_encoder is not None
    counter = _Counter({"tower": networks.image_encoder, "encoder": networks.condition_encoder})
    features = synthesizer.encode(random_clip(frames=2))
    assert counter.calls == {"tower": 1, "encoder": 1}  # two frames a call
    features = features.followed_by(synthesizer.encode(random_clip(frames=1)))
    counter.calls = dict.fromkeys(counter.calls, 0)
    paths = [synthesizer.traits.plan_view(SphericalDelta(azimuth_deg=azimuth)) for azimuth in (10.0, 20.0)]
    synthesizer.render(features, paths, RenderOptions(samples=2))
    assert counter.calls == {"tower": 0, "encoder": 0}


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
