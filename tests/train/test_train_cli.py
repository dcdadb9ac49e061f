import importlib
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner

from gcd_train.cli.common import errors_shown
from gcd_train.cli.main import COMMANDS, app
from gcd_train.errors import RunError


def test_families_lists_every_family_with_its_limits() -> None:
    result = CliRunner().invoke(app, ["families"], env={"COLUMNS": "200"})
    assert result.exit_code == 0
    for text in ("kubric90", "kubric180", "driving-semantic", "svd", "±180°", "53.13°"):
        assert text in result.stdout


def test_one_family_can_be_asked_for() -> None:
    result = CliRunner().invoke(app, ["families", "driving"], env={"COLUMNS": "200"})
    assert "85°" in result.stdout
    assert "kubric" not in result.stdout


def test_an_unknown_family_is_refused_with_the_known_ones() -> None:
    result = CliRunner().invoke(app, ["families", "cubric"])
    assert result.exit_code != 0
    assert "kubric90" in result.output


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--no-baselines", "--data", "no[where]"], 66, "no[where]"),
    ],
)
def test_evaluation_says_what_is_wrong_in_one_line(tmp_path: Path, options: list[str], code: int, words: str) -> None:
    folders = [*([] if "--data" in options else ["--data", str(tmp_path)]), "--out", str(tmp_path / "report")]
    result = CliRunner().invoke(app, ["evaluate", *folders, *options])
    assert result.exit_code == code
    assert words in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("of the device"), RuntimeError("can't allocate memory")])
def test_want_of_memory_is_one_line_that_says_what_helps(
    error: RuntimeError, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as caught, errors_shown():
        raise error
    assert caught.value.exit_code == RunError.exit_code
    assert "clip_batch" in capsys.readouterr().err


def test_another_error_of_the_program_stays_a_traceback() -> None:
    with pytest.raises(RuntimeError, match="shape"), errors_shown():
        raise RuntimeError("shape mismatch")


@pytest.mark.parametrize("module", ["gcd_model", "gcd_node", "gcd_node.cli.main", "gcd_train.cli.main"])
def test_the_core_imports_without_cameras_gpu_ros_and_onnx(module: str) -> None:
    blocked = (
        "depthai",
        "onnxruntime",
        "onnx",
        "rclpy",
        "mcap",
        "moderngl",
        "diffusers",
        "transformers",
        "torchvision",
    )
    code = f"import sys; sys.modules.update(dict.fromkeys({blocked!r})); import {module}; print('imported')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "imported", done.stderr


def test_help_imports_no_torch_and_says_of_each_command_what_it_says_itself() -> None:
    code = "import sys; from gcd_train.cli.main import main; sys.argv = ['gcd-train', '--help']\n"
    code += "try: main()\nfinally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "False", done.stderr
    for name, (place, summary) in COMMANDS.items():
        module, _, attribute = place.partition(":")
        command = getattr(importlib.import_module(f"gcd_train.cli.{module}"), attribute)
        told = str(command.info.help if isinstance(command, typer.Typer) else inspect.getdoc(command))
        assert " ".join(told.split("\n\n")[0].split()) == summary, name
