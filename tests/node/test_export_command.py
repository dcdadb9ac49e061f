"""`gcd-node export` and `[model] engine`: what is refused before anything is loaded, and what changes no name."""

from pathlib import Path

import pytest
from fakes import traits

from gcd_node.cli.main import run_app
from gcd_node.config import parse_config
from gcd_node.errors import ConfigError
from gcd_node.session import load_model
from gcd_node.stream_context import config_digest

LAUNCH = b"""
[source]
path = "drive.mp4"
[model]
weights = "random:driving"
threads = 1
[view.topdown]
"""


def test_an_export_over_a_folder_of_mine_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
    assert run_app(["export", "--weights", "random:driving", "--onnx", str(tmp_path), "--overwrite"]) == 64
    assert "exists; give another name, or allow an export to be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["model.engine=onnxruntime", 'model.providers=["CUDAExecutionProvider"]'])
def test_onnxruntime_is_refused_for_what_is_no_export(change: str) -> None:
    section = parse_config(LAUNCH, "launch.toml", [change]).model
    with pytest.raises(
        ConfigError, match=r"\[model\]: the engine onnxruntime runs exports, and random:driving is none"
    ):
        load_model(section)


def test_an_unknown_engine_is_refused() -> None:
    with pytest.raises(ConfigError, match="engine"):
        parse_config(LAUNCH, "launch.toml", ["model.engine=tensorrt"])


@pytest.mark.parametrize("change", ["model.engine=onnxruntime", 'model.providers=["CUDAExecutionProvider"]'])
def test_what_computes_does_not_change_the_name_of_a_configuration(change: str) -> None:
    plain, changed = (parse_config(LAUNCH, "launch.toml", changes) for changes in ([], [change]))
    assert config_digest(plain, traits()) == config_digest(changed, traits())
