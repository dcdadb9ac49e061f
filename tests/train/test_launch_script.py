"""The GPU run as one script: it parses, and every command in it is one that exists."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.recipe import load_recipe

SCRIPT = Path(__file__).parents[2] / "launch" / "train-driving-small-gpu.sh"


def test_it_parses() -> None:
    bash = shutil.which("bash")
    assert bash is not None, "the project's own scripts need bash"
    checked = subprocess.run([bash, "-n", str(SCRIPT)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


def commands() -> list[list[str]]:
    lines = re.findall(r"^gcd_train (?!\()(.+)$", SCRIPT.read_text(), flags=re.MULTILINE)
    return [line.split() for line in lines]


def test_it_runs_every_step() -> None:
    assert [words[0] for words in commands()] == ["generate", "generate", "generate", "train", "evaluate"]


@pytest.mark.parametrize("words", commands(), ids=lambda words: " ".join(words[:4]))
def test_its_options_exist(words: list[str]) -> None:
    command = [word for word in words[:2] if word in ("generate", "driving", "train", "evaluate")]
    shown = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    for option in (word for word in words if word.startswith("--")):
        assert option in shown.output


def test_its_recipe_is_the_small_model_on_a_gpu() -> None:
    recipe = load_recipe("package:driving-small-gpu")
    minutes = [part.budget.minutes for part in (recipe.vae, recipe.unet, recipe.decoder) if part is not None]
    assert len(minutes) == 3
    assert sum(m or 99 for m in minutes) <= 19
