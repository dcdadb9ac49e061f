"""Computing in pieces on a CPU changes nothing but time and memory, and happens only there."""

import copy

import pytest
import torch
from small_models import UNET, draw, randomise
from torch import Tensor, nn
from torch.testing import assert_close

from gcd_model.engines import torch as engine
from gcd_model.engines.torch import arrange
from gcd_model.layers import Attention, FeedForward, ResBlock, Upsample, prepare
from gcd_model.unet import VideoUNet

FRAMES, CLIPS = 3, 2


def arranged(module: nn.Module) -> nn.Module:
    """A copy that is wrapped: the module itself stays plain."""
    wrapped = copy.deepcopy(module)
    arrange(wrapped)
    arrange(wrapped)  # a second time does nothing
    return wrapped


@pytest.mark.parametrize("floats", [20_000, engine.REUSED_FLOATS])
def test_the_u_net_is_the_same_however_little_memory_is_used_at_once(
    monkeypatch: pytest.MonkeyPatch, floats: int
) -> None:
    unet, rows, seen = VideoUNet(UNET, FRAMES), CLIPS * FRAMES, list[int]()
    randomise(unet)
    prepare(unet)
    wrapped, latents = arranged(unet), draw(rows, 4, 8, 16, seed=4)
    wrapped.stem.register_forward_pre_hook(lambda _, given: seen.append(len(given[0])))
    monkeypatch.setattr(engine, "REUSED_FLOATS", floats)
    with torch.no_grad():
        given = (draw(rows, width, seed=seed) for seed, width in enumerate((UNET.vector_width, UNET.camera_width, 48)))
        inputs = unet.plan(draw(1, seed=1), *given).step(0)
        whole, pieces = (each(latents, latents, *inputs) for each in (unet, wrapped))
    assert whole.abs().max() > 0.1
    assert_close(pieces, whole, rtol=1e-4, atol=1e-5)
    assert pieces.is_contiguous()
    assert seen == ([3, 3] if floats == 20_000 else [6]), "large clips go through it one after the other"


class _Adapted(nn.Module):
    """A layer that computes more than its weight says, as an adapter does."""

    def __init__(self, base: nn.Linear) -> None:
        super().__init__()
        self.weight, self.bias = base.weight, base.bias

    def forward(self, x: Tensor) -> Tensor:
        return 3 * nn.functional.linear(x, self.weight, self.bias)


def adapted() -> FeedForward:
    feed = FeedForward(8)
    feed.expand = _Adapted(feed.expand)  # pyright: ignore[reportAttributeAccessIssue]
    return feed


@pytest.mark.parametrize("floats", [1, 6 * 35 * 2])
@pytest.mark.parametrize(
    ("module", "given"),
    [
        (FeedForward(8), (draw(2, 5, 8),)),
        (adapted(), (draw(2, 5, 8),)),
        (Attention(8, 2), (draw(5, 5, 8),)),
        (Attention(8, 2), (draw(2, 5, 8)[:0],)),
        (Upsample(6), (draw(2, 6, 5, 7),)),
        (ResBlock(6, 6, groups=2, eps=1e-5), (draw(5, 6, 5, 7),)),
        (ResBlock(6, 4, groups=2, eps=1e-5), (draw(5, 6, 5, 7), draw(5, 4, 1, 1, seed=2))),
        (ResBlock(6, 4, groups=2, eps=1e-5), (draw(5, 6, 5, 7), draw(1, 4, 1, 1, seed=2))),
        (ResBlock(6, 4, groups=2, eps=1e-5), (draw(2, 6, 5, 7)[:0],)),
    ],
)
def test_a_part_is_the_same_a_few_rows_at_a_time_and_leaves_what_it_is_given(
    monkeypatch: pytest.MonkeyPatch, module: nn.Module, given: tuple[Tensor, ...], floats: int
) -> None:
    before, wrapped = [each.clone() for each in given], arranged(module)
    monkeypatch.setattr(engine, "REUSED_FLOATS", floats)
    with torch.no_grad():
        assert_close(wrapped(*given), module(*given))
    assert all(torch.equal(now, then) for now, then in zip(given, before, strict=True))


def test_with_gradient_on_other_devices_and_in_a_compiler_a_part_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "REUSED_FLOATS", 1)
    feed, x = arranged(FeedForward(4)), draw(6, 4)
    calls: list[int] = []
    feed.contract.register_forward_pre_hook(lambda _, given: calls.append(len(given[0])))
    feed(x)
    with torch.no_grad():
        copy.deepcopy(feed).to("meta")(x.to("meta"))
    assert calls == [6, 6]
    with torch.no_grad():
        graph = torch.export.export(arranged(FeedForward(4)), (x,)).graph
        feed(x)
    assert sum("linear" in str(node.target) for node in graph.nodes) == 2
    assert calls[2:] == [1] * 6


def test_a_copy_of_a_wrapped_part_computes_with_its_own_weights() -> None:
    first = arranged(FeedForward(4))
    second = copy.deepcopy(first)
    nn.init.zeros_(second.contract.weight)
    nn.init.zeros_(second.contract.bias)
    with torch.no_grad():
        assert not second(draw(6, 4)).any()
        assert first(draw(6, 4)).any()
