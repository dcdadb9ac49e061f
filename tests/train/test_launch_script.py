"""The GPU runs as one script: it parses, and every command in it is one that exists."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.recipe import load_recipe

SCRIPT = Path(__file__).parents[2] / "launch" / "train-small-gpu.sh"
MODELS = ("driving-small", "driving-semantic-small", "objects-small")
COMMANDS = ("generate", "driving", "drop", "tabletop", "train", "evaluate")


def bash(*words: str) -> subprocess.CompletedProcess[str]:
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    return subprocess.run([there, *words], capture_output=True, text=True, check=False)


def test_it_parses() -> None:
    checked = bash("-n", str(SCRIPT))
    assert checked.returncode == 0, checked.stderr


def test_it_refuses_a_model_that_it_does_not_know() -> None:
    run = bash(str(SCRIPT), "driving-large")
    assert run.returncode == 2
    assert "driving-large" in run.stderr
    assert all(model in run.stderr for model in MODELS)


def commands() -> list[list[str]]:
    """Each line once, with a world in place of the loop's variable."""
    lines = re.findall(r"^ *gcd_train (?!\()(.+)$", SCRIPT.read_text(), flags=re.MULTILINE)
    worlds = [world for line in lines for world in (("drop", "tabletop") if '"$world"' in line else ("",))]
    doubled = [line for line in lines for _ in (range(2) if '"$world"' in line else range(1))]
    return [line.replace('"$world"', world, 1).split() for line, world in zip(doubled, worlds, strict=True)]


def test_it_runs_every_step() -> None:
    steps = [" ".join(words[:2]) if words[0] == "generate" else words[0] for words in commands()]
    assert sorted(steps) == sorted(
        [f"generate {world}" for world in ("drop", "tabletop", "driving")] * 3 + ["train", "evaluate"]
    )


@pytest.mark.parametrize("words", commands(), ids=lambda words: " ".join(words[:4]))
def test_its_options_exist(words: list[str]) -> None:
    command = [word for word in words[:2] if word in COMMANDS]
    shown = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    for option in (word for word in words if word.startswith("--")):
        assert option in shown.output


@pytest.mark.parametrize("model", MODELS)
def test_its_recipes_are_the_small_models_in_a_short_time(model: str) -> None:
    recipe, plain = load_recipe(f"package:{model}-gpu"), load_recipe(f"package:{model}")
    assert recipe.name == plain.name == model
    assert (recipe.model, recipe.data) == (plain.model, plain.data)
    assert recipe.stages == plain.stages
    minutes = [part.budget.minutes for part in (recipe.vae, recipe.unet, recipe.decoder) if part is not None]
    assert sum(m or 99 for m in minutes) <= 19
