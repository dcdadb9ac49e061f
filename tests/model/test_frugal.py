"""Computing in pieces on a CPU changes nothing but time and memory, and happens only there."""

from collections.abc import Sequence

import pytest
import torch
from small_models import UNET, draw, randomise
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model import frugal, plane_mix
from gcd_model.config import PlaneMixConfig
from gcd_model.layers import FeedForward, ResBlock, Upsample, prepare
from gcd_model.plane_mix import PlaneMix
from gcd_model.unet import StageInputs, VideoUNet

FRAMES, CLIPS = 3, 2


def _unet() -> VideoUNet:
    unet = VideoUNet(UNET, FRAMES)
    randomise(unet)
    prepare(unet)
    return unet


def _inputs(unet: VideoUNet) -> tuple[StageInputs, ...]:
    rows = CLIPS * FRAMES
    plan = unet.plan(
        draw(1, seed=1), draw(rows, UNET.vector_width), draw(rows, UNET.camera_width, seed=2), draw(rows, 48, seed=3)
    )
    return plan.step(0)


@pytest.mark.parametrize("floats", [20_000, frugal.REUSED_FLOATS])
def test_the_u_net_is_the_same_however_little_memory_is_used_at_once(
    monkeypatch: pytest.MonkeyPatch, floats: int
) -> None:
    unet, latents = _unet(), draw(CLIPS * FRAMES, 4, 8, 16, seed=4)
    inputs = _inputs(unet)
    whole = unet(latents, latents, inputs).detach()  # with gradient nothing is cut up
    monkeypatch.setattr(frugal, "REUSED_FLOATS", floats)
    with torch.no_grad():
        pieces = unet(latents, latents, inputs)
    assert whole.abs().max() > 0.1
    assert_close(pieces, whole, rtol=1e-4, atol=1e-5)
    assert pieces.is_contiguous()


def test_clips_that_are_large_go_through_a_stage_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    unet, latents = _unet(), draw(CLIPS * FRAMES, 4, 8, 16, seed=4)
    inputs, seen = _inputs(unet), list[int]()

    def note(_module: nn.Module, given: Sequence[object]) -> None:
        assert isinstance(given[0], Tensor)
        seen.append(len(given[0]))

    next(unet.all_stages()).res.register_forward_pre_hook(note)
    with torch.no_grad():
        unet(latents, latents, inputs)
        monkeypatch.setattr(frugal, "REUSED_FLOATS", 20_000)
        unet(latents, latents, inputs)
    assert seen == [CLIPS * FRAMES, FRAMES, FRAMES]


class _Adapted(nn.Module):
    """A layer that computes more than its weight says, as an adapter does."""

    def __init__(self, base: nn.Linear) -> None:
        super().__init__()
        self.weight, self.bias = base.weight, base.bias

    def forward(self, x: Tensor) -> Tensor:
        return 3 * nn.functional.linear(x, self.weight, self.bias)


@pytest.mark.parametrize("adapted", [False, True])
@pytest.mark.parametrize("floats", [1, 100, frugal.REUSED_FLOATS])
def test_the_feed_forward_in_pieces_equals_the_whole_with_or_without_adapter(
    monkeypatch: pytest.MonkeyPatch, floats: int, adapted: bool
) -> None:
    feed, x = FeedForward(8), draw(2, 5, 8)
    if adapted:
        feed.expand = _Adapted(feed.expand)  # pyright: ignore[reportAttributeAccessIssue]
    whole = feed(x).detach()
    monkeypatch.setattr(frugal, "REUSED_FLOATS", floats)
    with torch.no_grad():
        pieces = feed(x)
    assert_close(pieces, whole)


def test_nothing_is_cut_up_or_laid_out_for_gradients_or_other_devices() -> None:
    wide = draw(8, 2, 16, 16)
    assert frugal.laid_out(wide) is wide
    assert frugal.rows_at_once(wide, 2 * frugal.REUSED_FLOATS) == len(wide)
    with torch.no_grad():
        elsewhere = wide.to("meta")
        assert frugal.laid_out(elsewhere) is elsewhere
        assert frugal.rows_at_once(wide, 2 * frugal.REUSED_FLOATS) == 1


def test_pixels_lie_channels_last_where_they_outnumber_the_channels_and_plainly_elsewhere() -> None:
    many, few = draw(2, 4, 16, 16), draw(2, 64, 4, 4)
    with torch.no_grad():
        assert frugal.laid_out(many).is_contiguous(memory_format=torch.channels_last)
        assert frugal.laid_out(few.contiguous(memory_format=torch.channels_last)).is_contiguous()
        assert_close(frugal.laid_out(many), many)


def test_an_exported_graph_knows_no_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frugal, "REUSED_FLOATS", 1)
    with torch.no_grad():
        graph = torch.export.export(FeedForward(4), (draw(6, 4),)).graph
    assert sum("linear" in str(node.target) for node in graph.nodes) == 2


@pytest.mark.parametrize("layer", [Upsample(6), ResBlock(6, 6, groups=2, eps=1e-5), ResBlock(6, 4, groups=2, eps=1e-5)])
def test_layers_that_write_in_place_give_the_same_and_leave_what_they_are_given(layer: nn.Module) -> None:
    x = draw(2, 6, 5, 7)
    before, whole = x.clone(), layer(x).detach()
    with torch.no_grad():
        frugally = layer(x)
    assert_close(frugally, whole)
    assert torch.equal(x, before)


@pytest.mark.parametrize("floats", [1, 2 * 2 * 3 * 16 * 24, 2**20])
@pytest.mark.parametrize("classes", [0, 3])
def test_pictures_are_mixed_the_same_frame_by_frame(monkeypatch: pytest.MonkeyPatch, floats: int, classes: int) -> None:
    frames, layers, height, width = 5, 2, 16, 24
    mix = PlaneMix(PlaneMixConfig(width=8, dilations=(1, 2), norm_groups=2), layers, 4, classes)
    randomise(mix)
    valid = draw(frames, layers, height, width, seed=1) > 0
    warped = draw(frames, layers, 3, height, width, seed=2) * valid[:, :, None]
    given = (draw(frames, 3, height, width), warped, valid, draw(frames, 4, 2, 3, seed=3))
    logits = draw(frames, classes, 4, 6, seed=4) if classes else None
    picture, sharpened = mix(*given, logits)  # with gradient all at once
    monkeypatch.setattr(plane_mix, "_CACHED_FLOATS", floats)
    with torch.no_grad():
        few, few_sharpened = mix(*given, logits)
    assert_close(few, picture.detach())
    if sharpened is None:
        assert few_sharpened is None
    else:
        assert_close(few_sharpened, sharpened.detach())
