"""`gcd-train bench train`: what training costs."""

from dataclasses import replace

import msgspec
import pytest
import torch

from gcd_model import ModelConfig
from gcd_model.config import SMALL, SVD_14
from gcd_model.unet import VideoUNet
from gcd_train.training.bench import BenchTrainOptions, MemoryRow, bench_train, memory_rows
from gcd_train.training.memory import PLANS, Kept, LiveBytes, account, kept_by_update, parameters_of

TINY = msgspec.structs.replace(
    SMALL,
    frames=2,
    height=64,
    width=64,
    unet=msgspec.structs.replace(SMALL.unet, multipliers=(1, 2), attention=(False, True)),
)
KEPT = Kept(everything=10**9, blocks=2 * 10**8, working=10**8, norms=5 * 10**7, weights=2 * 10**7, flops=4 * 10**12)


@pytest.fixture(scope="module")
def rows() -> tuple[MemoryRow, ...]:
    """Memory of the full model, with the activations counted for it by the slow test below."""
    kept = Kept(
        everything=10_726_686_796,
        blocks=499_479_488,
        working=1_652_883_716,
        norms=426_639_360,
        weights=321_963_524,
        flops=1,
    )
    return memory_rows(kept)


def test_storages_are_counted_as_long_as_they_live_and_views_not_again() -> None:
    with LiveBytes() as bytes_:
        first = torch.zeros(1000)
        view = first[10:].view(99, 10)
        second = first + 1
        assert bytes_.live == 8000
        del first
        assert bytes_.live == 8000  # the view keeps it
        del view, second
        assert bytes_.live == 0


def test_views_of_weights_are_not_counted_as_what_the_graph_keeps() -> None:
    weight = torch.zeros(100, 10, requires_grad=True)
    with LiveBytes() as bytes_:
        bytes_.leave_out([weight])
        made = torch.zeros(1, 10) @ weight.T
        assert bytes_.live == 4 * (10 + 100)
    assert made.requires_grad


def really_kept(config: ModelConfig) -> int:
    """What the graph of a real forward pass keeps alive."""
    height, width = config.height // config.vae.down_factor, config.width // config.vae.down_factor
    unet = VideoUNet(config.unet, config.frames).to(torch.bfloat16).train()
    rows = torch.zeros(config.frames, 4, height, width, dtype=torch.bfloat16)
    vector = torch.zeros(config.frames, config.unet.vector_width, dtype=torch.bfloat16)
    camera = torch.zeros(config.frames, config.unet.camera_width, dtype=torch.bfloat16)
    tokens = torch.zeros(config.frames, config.unet.context_width or 0, dtype=torch.bfloat16)
    with LiveBytes() as live:
        live.leave_out(unet.parameters())
        plan = unet.plan(torch.zeros(1, config.frames, dtype=torch.bfloat16), vector, camera, tokens)
        made = unet(rows, rows, plan.step(0))
        held = live.live
    assert made.requires_grad
    return held


def test_what_is_counted_without_content_is_what_a_real_update_keeps() -> None:
    kept = kept_by_update(TINY)
    assert kept.everything == pytest.approx(really_kept(TINY), rel=0.02)
    assert 0 < kept.blocks < kept.everything
    assert kept.working > 0


def test_attention_is_part_of_the_arithmetic() -> None:
    wide = msgspec.structs.replace(TINY, unet=msgspec.structs.replace(TINY.unet, attention=(True, True)))
    high, low = (kept_by_update(msgspec.structs.replace(wide, height=h)).flops for h in (128, 64))
    assert high > 2.02 * low  # all else grows with the number of pixels at most, attention with its square


def test_an_account_adds_up_bytes_of_parameters() -> None:
    trained, frozen = parameters_of(SMALL)
    plan = replace(PLANS[0], weights=4, gradient=4, state=8)
    counted = account(SMALL, plan, KEPT, cached=False)
    assert counted.weights == pytest.approx(4 * trained / 1e9)
    assert counted.gradients == pytest.approx(4 * trained / 1e9)
    assert counted.state == pytest.approx(8 * trained / 1e9)
    assert counted.activations == pytest.approx(0.35 + 0.02)
    assert account(SMALL, replace(plan, copies=False), KEPT, cached=False).activations == pytest.approx(0.35)
    assert counted.encoders == pytest.approx(2 * frozen / 1e9)
    assert counted.total == pytest.approx(0.37 + (16 * trained + 2 * frozen) / 1e9)
    assert account(SMALL, plan, KEPT, cached=True).encoders == 0


def test_full_fine_tunes_and_adapters_fit_common_gpus(rows: tuple[MemoryRow, ...]) -> None:
    totals = {row.name: row.total for row in rows if not row.cached}
    assert totals["8-bit Adam, float32 weights"] <= 20
    assert totals["8-bit Adam, bfloat16 weights"] <= 14
    assert totals["LoRA, rank 32, bfloat16 base"] <= 8


@pytest.mark.slow
def test_activations_of_the_full_model_are_counted_as_recorded() -> None:
    """Half a minute of counting."""
    kept = kept_by_update(SVD_14)
    assert kept.everything == pytest.approx(10.73e9, rel=0.01)
    assert kept.blocks + kept.working + kept.norms + kept.weights == pytest.approx(2.90e9, rel=0.02)
    assert kept.flops == pytest.approx(4 * 5.78e12, rel=0.01)


@pytest.mark.slow
def test_updates_of_the_small_model_are_measured_with_and_without_its_encoders() -> None:
    """Half a minute, most of it for counting the full model."""
    report = bench_train(BenchTrainOptions(full=False, updates=2, warm=1), lambda _: None)
    assert [row.name for row in report.speed] == ["latents cached", "encoded each time"]
    assert all(0 < row.lowest <= row.clips_per_s <= row.highest for row in report.speed)
    if not torch.cuda.is_available():
        assert all(row.hours is None and row.utilisation is None for row in report.speed)
