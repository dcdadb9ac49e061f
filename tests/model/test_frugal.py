"""Computing in pieces on a CPU changes nothing but time and memory, and happens only there."""

from collections.abc import Sequence

import pytest
import torch
from small_models import UNET, draw, randomise
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model import frugal, layers
from gcd_model.layers import Attention, FeedForward, ResBlock, Upsample, prepare
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


@pytest.mark.parametrize("floats", [1, 6 * 35 * 2, frugal.REUSED_FLOATS])
@pytest.mark.parametrize("embedded", [False, True])
def test_a_residual_block_is_the_same_a_few_rows_at_a_time(
    monkeypatch: pytest.MonkeyPatch, floats: int, embedded: bool
) -> None:
    block, x = ResBlock(6, 4, groups=2, eps=1e-5), draw(5, 6, 5, 7)
    embedding = draw(5, 4, 1, 1, seed=2) if embedded else None
    whole = block(x, embedding).detach()
    monkeypatch.setattr(frugal, "REUSED_FLOATS", floats)
    with torch.no_grad():
        assert_close(block(x, embedding), whole)


@pytest.mark.parametrize("floats", [1, 2 * 3 * 40, frugal.REUSED_FLOATS])
def test_attention_is_the_same_a_few_rows_at_a_time(monkeypatch: pytest.MonkeyPatch, floats: int) -> None:
    attention, x = Attention(8, 2), draw(5, 5, 8)
    whole = attention(x).detach()
    monkeypatch.setattr(frugal, "REUSED_FLOATS", floats)
    with torch.no_grad():
        assert_close(attention(x), whole)


def test_kernels_folded_for_up_sampling_are_kept_unless_they_are_large_and_on_a_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, small, large = draw(2, 6, 3, 4), Upsample(6), Upsample(6)
    large.load_state_dict(small.state_dict())
    prepare(small)
    monkeypatch.setattr(layers, "REUSED_FLOATS", 16 * 6 * 6 - 1)
    prepare(large)
    with torch.no_grad():
        assert small.derived() is small.derived()
        assert large.derived() is not large.derived()
        assert torch.equal(large(x), small(x))
    monkeypatch.setattr(layers, "REUSED_FLOATS", 16 * 6 * 6)
    prepare(large)
    assert large.derived() is large.derived()


def test_large_clips_go_through_the_whole_network_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    unet, latents = _unet(), draw(CLIPS * FRAMES, 4, 8, 16, seed=4)
    inputs, seen = _inputs(unet), list[tuple[str, int]]()

    def note(module: nn.Module, given: Sequence[object]) -> None:
        assert isinstance(given[0], Tensor)
        seen.append(("stem" if module is unet.stem else "stage", len(given[0])))

    unet.stem.register_forward_pre_hook(note)
    next(unet.all_stages()).res.register_forward_pre_hook(note)
    with torch.no_grad():
        unet(latents, latents, inputs)
        monkeypatch.setattr(frugal, "REUSED_FLOATS", 20_000)
        unet(latents, latents, inputs)
    assert seen == [("stem", 6), ("stage", 6), ("stem", 3), ("stage", 3), ("stem", 3), ("stage", 3)]


def test_an_embedding_of_one_row_counts_for_all_rows_however_they_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    block, x, embedding = ResBlock(6, 4, groups=2, eps=1e-5), draw(5, 6, 5, 7), draw(1, 4, 1, 1, seed=2)
    whole = block(x, embedding).detach()
    monkeypatch.setattr(frugal, "REUSED_FLOATS", 6 * 35 * 2)
    with torch.no_grad():
        assert_close(block(x, embedding), whole)


def test_no_rows_give_no_rows() -> None:
    with torch.no_grad():
        assert ResBlock(6, 4, groups=2, eps=1e-5)(draw(2, 6, 5, 7)[:0]).shape == (0, 4, 5, 7)
        assert Attention(8, 2)(draw(2, 5, 8)[:0]).shape == (0, 5, 8)
        assert Attention(8, 2)(draw(2, 5, 8)[:, :0]).shape == (2, 0, 8)
