"""Adapters beside their weights, exports and engines: what is taken, and what is refused before anything runs."""

from pathlib import Path

import pytest
import torch
from fakes import write_tiny

from gcd_model.errors import CheckpointError
from gcd_model.weights.adapter import Adapter, base_digest
from gcd_model.weights.card import Card
from gcd_model.weights.load import load_weights
from gcd_model.weights.save import write_adapter
from gcd_node.cli.main import run_app
from gcd_node.config import NodeConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.session import load_model
from gcd_node.stream_context import config_digest

LAUNCH = b"""
[source]
path = "drive.mp4"
[model]
weights = "random:driving"
device = "cpu"
[view.topdown]
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Weights, an adapter of them, and one of others."""
    folder = tmp_path_factory.mktemp("adapters")
    loaded = load_weights(write_tiny(folder))
    state = loaded.networks.state_dict()
    layer = next(
        name for name in sorted(state) if name.endswith("query.weight") and state[name].ndim == 2
    ).removesuffix(".weight")
    width = state[f"{layer}.weight"].shape[0]
    factors = {f"{layer}.down": torch.ones(2, width), f"{layer}.up": torch.ones(width, 2)}
    assert loaded.family is not None
    card = Card(name="adapted", config=loaded.networks.config, family=loaded.family.name, move_time=loaded.move_time)
    for name, base in (("own", base_digest(state)), ("other", "0" * 12)):
        adapter = Adapter(rank=2, alpha=1.0, base=base, card=card, tensors=factors)
        write_adapter(folder / f"{name}.safetensors", adapter, overwrite=False)
    return {name: folder / f"{name}.safetensors" for name in ("tiny", "own", "other")}


def launch(weights: object, *changes: str) -> NodeConfig:
    return parse_config(LAUNCH, "launch.toml", [f"model.weights={weights}", *changes])


def test_the_node_runs_weights_with_their_own_adapter_under_a_name_of_their_own(files: dict[str, Path]) -> None:
    plain, adapted = launch(files["tiny"]), launch(files["tiny"], f"model.adapter={files['own']}")
    before, traits = load_model(plain.model).traits, load_model(adapted.model).traits
    assert traits.name == "adapted"
    assert traits.sha256_12 != before.sha256_12
    assert config_digest(plain, before) != config_digest(adapted, before)
    with pytest.raises(CheckpointError):
        load_model(launch(files["tiny"], f"model.adapter={files['other']}").model)


def test_an_export_over_a_folder_of_mine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
    assert run_app(["export", "--weights", "random:driving", "--onnx", str(tmp_path), "--overwrite"]) == 64
    assert "exists; give another name, or allow an export to be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["model.engine=onnxruntime", 'model.providers=["CUDAExecutionProvider"]'])
def test_onnxruntime_is_refused_for_what_is_no_export(change: str) -> None:
    section = launch("random:driving", change).model
    with pytest.raises(ConfigError, match="onnxruntime runs exports, and random:driving is none"):
        load_model(section)
