"""The parts: up-sampling by phases, one-token attention, blends, and what is kept of derived values."""

import pytest
import torch
import torch.nn.functional as F
from small_models import draw, randomise, relative_error
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model.layers import Derived, TemporalShare, TokenAttention, Upsample, VideoResBlock, prepare
from gcd_model.unet import FramePositions


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (4, 6)])
@pytest.mark.parametrize("prepared", [False, True])
def test_up_sampling_by_phases_equals_nearest_neighbour_then_convolution(
    height: int, width: int, prepared: bool
) -> None:
    up = Upsample(5).double()
    randomise(up)
    if prepared:
        prepare(up)
    x = draw(2, 5, height, width).double()
    plain = F.conv2d(F.interpolate(x, scale_factor=2.0, mode="nearest"), up.conv.weight, up.conv.bias, padding=1)
    assert relative_error(up(x), plain) < 1e-12


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_a_video_block_normalises_over_all_frames_of_a_clip_and_of_no_other(frames: int) -> None:
    share = TemporalShare(of_sigmoid="space", initial=0.3)
    block = VideoResBlock(8, 8, groups=2, embedding_width=None, eps=1e-5, share=share)
    randomise(block)
    clips = draw(2, frames, 8, 3, 4, seed=frames)
    together = block(clips.flatten(0, 1), frames)
    alone = torch.cat([block(clip, frames) for clip in clips])
    assert_close(together, alone)
    shifted = clips.clone()
    shifted[:, -1] *= 3
    changed = block(shifted.flatten(0, 1), frames).unflatten(0, (2, frames))[:, 0]
    assert not torch.allclose(changed, together.unflatten(0, (2, frames))[:, 0], atol=1e-3)


def _derived_modules() -> list[Derived[Tensor]]:
    return [Upsample(4), FramePositions(4, 3), TemporalShare(of_sigmoid="space", initial=0.5)]


@pytest.mark.parametrize("module", _derived_modules(), ids=lambda module: type(module).__name__)
def test_a_derived_value_carries_gradient_until_it_is_prepared_and_is_then_kept(module: Derived[Tensor]) -> None:
    module.train()
    before = module.derived()
    assert before.requires_grad
    assert module.derived() is not before
    prepare(module)
    assert not module.training
    assert module.derived() is module.derived()
    assert not module.derived().requires_grad
    assert_close(module.derived(), before.detach())


@pytest.mark.parametrize("module", _derived_modules(), ids=lambda module: type(module).__name__)
def test_what_was_kept_is_dropped_with_new_weights_a_new_dtype_or_training(module: Derived[Tensor]) -> None:
    model = nn.Sequential(module)
    prepare(model)
    old = module.derived()
    model.load_state_dict({name: value + 1 for name, value in model.state_dict().items()})
    assert not torch.allclose(module.derived(), old)
    prepare(model)
    model.double()
    assert module.derived().dtype == torch.float64
    model.float()
    prepare(model)
    kept = module.derived()
    model.train()
    assert module.derived() is not kept
    assert module.derived().requires_grad


def test_dormant_weights_survive_the_round_trip_but_are_never_moved_cast_or_trained() -> None:
    attention = TokenAttention(8, 6)
    attention.double().to("meta")
    assert attention.value.weight.device.type == "meta"
    for parameter in attention.dormant.parameters():
        assert parameter.device.type == "cpu"
        assert parameter.dtype == torch.float32
        assert not parameter.requires_grad
    assert {name for name in attention.state_dict() if name.startswith("dormant.")} == {
        "dormant.query",
        "dormant.key",
        "dormant.norm_weight",
        "dormant.norm_bias",
    }
