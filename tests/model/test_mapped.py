"""Weights that are read once: their pages go where a file has them, and nowhere else."""

import mmap
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from gcd_model import mapped
from gcd_model.layers import prepare
from gcd_model.mapped import let_go
from gcd_model.temporal import FramePositions

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux: pages are given back there alone")

WIDTH = 1024
MEGABYTES = 4 * WIDTH * WIDTH / 2**20


def held_mb(weight: Tensor) -> float:
    """How much of a weight is in memory that this process has mapped."""
    first, end = weight.data_ptr() // mmap.PAGESIZE, (weight.data_ptr() + 4 * weight.numel()) // mmap.PAGESIZE
    with open("/proc/self/pagemap", "rb", buffering=0) as pagemap:
        pagemap.seek(8 * first)
        entries = memoryview(pagemap.read(8 * (end - first))).cast("q")
    return sum(entry < 0 for entry in entries) * mmap.PAGESIZE / 2**20


@pytest.fixture
def drawn() -> Tensor:
    return torch.randn(WIDTH, WIDTH, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def layer(tmp_path: Path, drawn: Tensor) -> nn.Linear:
    """Its weight is mapped from a file, and has been read."""
    save_file({"weight": drawn}, tmp_path / "weights.safetensors")
    made = nn.Linear(WIDTH, WIDTH, bias=False, device="meta")
    made.load_state_dict(load_file(tmp_path / "weights.safetensors"), assign=True)
    assert torch.equal(made.weight, drawn)
    return made


def test_pages_of_a_file_go_and_come_back(layer: nn.Linear, drawn: Tensor) -> None:
    assert held_mb(layer.weight) > MEGABYTES - 0.1
    let_go(layer, None)
    assert held_mb(layer.weight) < 0.1
    assert torch.equal(layer.weight, drawn)
    assert held_mb(layer.weight) > MEGABYTES - 0.1


def test_a_weight_that_was_changed_keeps_its_change(layer: nn.Linear, drawn: Tensor) -> None:
    with torch.no_grad():
        layer.weight[500, 500] = 7.0
    let_go(layer)
    assert layer.weight[500, 500] == 7.0
    drawn[500, 500] = 7.0
    assert torch.equal(layer.weight, drawn)


def test_memory_of_our_own_is_not_touched(drawn: Tensor) -> None:
    layer = nn.Linear(WIDTH, WIDTH)
    with torch.no_grad():
        layer.weight.copy_(drawn)
    let_go(layer)
    assert torch.equal(layer.weight, drawn)


def test_a_part_of_a_weight_takes_nothing_from_its_neighbours(layer: nn.Linear, drawn: Tensor) -> None:
    part = nn.Linear(WIDTH, WIDTH // 2 + 1, bias=False, device="meta")
    part.load_state_dict({"weight": layer.weight.detach()[: WIDTH // 2 + 1]}, assign=True)
    let_go(part)
    assert held_mb(part.weight) < 0.1
    assert torch.equal(layer.weight, drawn)


def _refused(*_: object, **__: object) -> None:
    raise PermissionError("not here")


@pytest.mark.parametrize("why", ["no pagemap", "another system"])
def test_what_cannot_be_known_stays(layer: nn.Linear, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    if why == "another system":
        monkeypatch.setattr(mapped, "_library", lambda: None)
    else:
        monkeypatch.setattr(mapped, "open", _refused, raising=False)
    let_go(layer)
    assert held_mb(layer.weight) > MEGABYTES - 0.1


def test_a_layer_in_another_place_stays(layer: nn.Linear) -> None:
    let_go(layer.to("meta"))
    assert layer.weight.is_meta


def test_weights_of_a_kept_table_go(tmp_path: Path) -> None:
    table = FramePositions(320, 14)
    save_file(table.state_dict(), tmp_path / "table.safetensors")
    expected = table.derive().detach()
    table.load_state_dict(load_file(tmp_path / "table.safetensors"), assign=True)
    prepare(table)
    assert sum(held_mb(weight) for weight in table.parameters()) < 0.2  # of 3.1 MB
    assert torch.equal(table.derived(), expected)
