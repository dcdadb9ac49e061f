"""What only a GPU can show."""

import pytest
import torch
from small_models import TINY, random_clip, relative_error

from gcd_model.clip import RenderOptions
from gcd_model.families import KUBRIC90
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


def latents(device: str, dtype: torch.dtype) -> torch.Tensor:
    networks = random_networks(TINY, seed=0).to(device)
    networks.to(dtype)
    networks.decoder.float()
    traits = Traits(
        name="tiny",
        config=TINY,
        family=KUBRIC90,
        move_time=TINY.frames - 1,
        sha256_12="0" * 12,
        precision=str(dtype),
        device=device,
    )
    synthesizer = Synthesizer(networks, traits)
    path = traits.plan_view(SphericalDelta(azimuth_deg=30.0))
    view = synthesizer.render(synthesizer.encode(random_clip()), [path], RenderOptions(steps=3, samples=2))[0]
    assert view.samples.device.type == view.latents.device.type == "cpu"
    return view.latents


def test_a_gpu_computes_what_the_cpu_computes() -> None:
    assert relative_error(latents("cuda", torch.float32), latents("cpu", torch.float32)) < 1e-2  # TF32 convolutions


def test_bfloat16_stays_near_float32_on_a_gpu() -> None:
    assert relative_error(latents("cuda", torch.bfloat16), latents("cpu", torch.float32)) < 0.1


def test_a_clip_may_lie_on_the_gpu() -> None:
    networks = random_networks(TINY, seed=0).cuda()
    traits = Traits(
        name="tiny", config=TINY, family=KUBRIC90, move_time=1, sha256_12="0" * 12, precision="float32", device="cuda"
    )
    clip = random_clip()
    on_gpu = type(clip)(video=clip.video.cuda(), fps=clip.fps)
    assert Synthesizer(networks, traits).encode(on_gpu).latents.is_cuda


def test_a_full_device_is_our_own_error_and_leaves_the_device_usable() -> None:
    from gcd_model.errors import DeviceMemoryError
    from gcd_model.synthesizer import _out_of_memory_is_our_error

    @_out_of_memory_is_our_error
    def greedy() -> torch.Tensor:
        return torch.empty(2**50, device="cuda")

    with pytest.raises(DeviceMemoryError):
        greedy()
    assert torch.ones(3, device="cuda").sum().item() == 3
