"""Weights in eight bits: what is lost, what files hold, and what is refused."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from small_models import TINY, draw
from torch.testing import assert_close

from gcd_model.checkpoints import convert_weights, inspect_weights, load_weights, save_weights
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.networks import random_networks
from gcd_model.own_format import Card
from gcd_model.packed import SCALE, Packed, is_packable


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(random_networks(TINY, seed=0), out, Card(name="tiny", config=TINY, family="kubric90", move_time=2))
    return out


@pytest.fixture(scope="module")
def packed(whole: Path) -> Path:
    out = whole.with_name("packed.safetensors")
    convert_weights(whole, out, dtype="int8")
    return out


@settings(deadline=None)
@given(st.integers(0, 2**31), st.floats(1e-12, 1e12))
def test_a_number_is_off_by_half_a_scale_at_most(seed: int, size: float) -> None:
    weight = draw(5, 40, seed=seed) * size
    found = Packed.of(weight)
    assert ((found.unpacked() - weight).abs() <= found.scales[:, None] * 0.5001).all()
    assert_close(found.scales * 127, weight.abs().amax(dim=1))


def test_zeros_stay_zeros_and_the_largest_of_a_row_is_exact() -> None:
    weight = torch.tensor([[0.0, 0.0], [3.0, -1.5]])
    unpacked = Packed.of(weight).unpacked()
    assert unpacked[0].tolist() == [0.0, 0.0]
    assert unpacked[1, 0].item() == pytest.approx(3.0)


def test_packing_again_changes_nothing() -> None:
    once = Packed.of(draw(7, 3, 3, 3))
    assert torch.equal(Packed.of(once.unpacked()).codes, once.codes)


def test_a_packed_file_is_smaller_and_loads_as_numbers_near_the_stored_ones(whole: Path, packed: Path) -> None:
    assert packed.stat().st_size < 0.5 * whole.stat().st_size
    before, after = load_weights(whole).networks.state_dict(), load_weights(packed).networks.state_dict()
    assert before.keys() == after.keys()
    for name, weight in before.items():
        assert after[name].dtype == torch.float32
        if is_packable(tuple(weight.shape)) and not name.startswith("decoder."):
            assert (after[name] - weight).norm() < 0.01 * weight.norm() + 1e-6
        else:
            assert torch.equal(after[name], weight), name


def test_a_report_says_how_weights_are_stored_and_trained_families_stay(packed: Path) -> None:
    report = inspect_weights(packed)
    stored = {each.name: each.dtypes for each in report.networks}
    assert "int8" in stored["unet"]
    assert stored["decoder"] == ("float32",)
    assert report.family == "kubric90"


def test_packed_weights_convert_back(packed: Path, tmp_path: Path) -> None:
    convert_weights(packed, tmp_path / "back.safetensors", dtype="float32")
    back, given_ = load_weights(tmp_path / "back.safetensors").networks, load_weights(packed).networks
    assert all(torch.equal(a, b) for a, b in zip(back.parameters(), given_.parameters(), strict=True))
    assert not any(name.endswith(SCALE) for name in load_file(tmp_path / "back.safetensors"))


def rewritten(source: Path, out: Path, changes: dict[str, torch.Tensor | None]) -> Path:
    tensors = load_file(source) | {name: tensor for name, tensor in changes.items() if tensor is not None}
    for name, tensor in changes.items():
        if tensor is None:
            del tensors[name]
    card = replace(Card(name="tiny", config=TINY, family="kubric90", move_time=2))
    save_file(tensors, out, card.to_metadata(packed=True))
    return out


def test_codes_without_scales_and_scales_without_codes_are_refused(packed: Path, tmp_path: Path) -> None:
    name = next(name for name in load_file(packed) if name.endswith(SCALE))
    bare = rewritten(packed, tmp_path / "bare.safetensors", {name: None})
    with pytest.raises(CheckpointError, match="lack codes or scales"):
        load_weights(bare)
    lone = rewritten(packed, tmp_path / "lone.safetensors", {f"unet.nothing{SCALE}": torch.ones(3)})
    with pytest.raises(CheckpointError, match=r"first: unet\.nothing"):
        load_weights(lone)


@pytest.mark.parametrize("scales", [torch.ones(1), torch.full((16,), torch.nan)])
def test_scales_that_cannot_be_are_refused(packed: Path, tmp_path: Path, scales: torch.Tensor) -> None:
    name = next(name for name, tensor in load_file(packed).items() if name.endswith(SCALE) and len(tensor) == 16)
    with pytest.raises(CheckpointError, match="one finite number a row"):
        load_weights(rewritten(packed, tmp_path / "odd.safetensors", {name: scales}))


def test_the_published_layout_takes_no_eight_bits(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="no place for int8"):
        convert_weights(whole, tmp_path / "x.ckpt", layout="gcd-ckpt", dtype="int8")
