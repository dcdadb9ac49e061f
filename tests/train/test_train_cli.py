"""`gcd-train`: what its commands list, and how they end where something is wrong."""

import importlib
import inspect
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest
import torch
import typer
from typer.testing import CliRunner

from gcd_train.cli.common import errors_shown
from gcd_train.cli.main import COMMANDS, app, main
from gcd_train.errors import RunError
from gcd_train.recipe import Recipe
from gcd_train.recipe_files import packaged_recipes


def ran(*words: object, columns: int = 200) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": str(columns)})
    assert "Traceback" not in result.output
    return result.exit_code, result.output


def test_recipes_are_listed_whole_and_one_is_shown_with_all_it_says() -> None:
    for columns in (60, 160):  # a name that is cut off cannot be given to `train`
        code, listed = ran("recipes", columns=columns)
        assert code == 0
        assert [name for name in packaged_recipes() if f"package:{name} " not in listed] == []
    assert "parallel_domain4d, classes" in listed
    code, shown = ran("recipes", "package:tabletop", "--small", "--set=unet.batch=6")
    assert code == 0
    for text in ('name = "tabletop-small"', 'camera = "relative_pose"', "batch = 6", "dropout_joint = false"):
        assert text in shown
    _, student = ran("recipes", "package:distill-kubric", "--set=student.steps=7")
    assert msgspec.convert(tomllib.loads(student), Recipe).student.steps == 7  # pyright: ignore


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["train", "none.toml"], 78, "none.toml"),
        (["train", "package:study-pretrain", "--valid=none"], 66, "none"),
        (["train", "package:study-pretrain", "--stage", "gan"], 2, "export"),
        (["train", "package:distill-kubric"], 78, "kubric_gradual_max90.ckpt"),
        (["train", "package:tabletop", "--small", "--set=unet.clip_bath=2"], 78, "clip_batch"),
        (["train", "package:tabletop", "--small"], 66, "none"),
        (["train", "package:live-small"], 78, "give --valid"),
        (["evaluate", "--no-baselines"], 66, "no[where]"),
    ],
)
def test_what_is_wrong_is_one_line_and_an_exit_code(tmp_path: Path, words: list[str], code: int, said: str) -> None:
    data = tmp_path / ("no[where]" if words[0] == "evaluate" else "none")
    found, output = ran(*words, f"--data={data}", f"--out={tmp_path / 'out'}")
    assert (found, said in output) == (code, True), output
    assert code != 78 or not (tmp_path / "out").exists()


def test_a_wrong_command_line_ends_with_64_as_that_of_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (["nonsense"], ["train"], []):
        monkeypatch.setattr(sys, "argv", ["gcd-train", *words])
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code == 64


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
