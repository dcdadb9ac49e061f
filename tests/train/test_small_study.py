"""The small-scale study: its recipes differ in what is studied alone, and its script runs."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from headless import needs_egl
from typer.testing import CliRunner

from gcd_model.config import PLAIN_SMALL
from gcd_train.cli.main import app
from gcd_train.recipe import Recipe
from gcd_train.recipe_files import load_recipe
from gcd_train.training.setup import model_config, sampled_as_trained

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "launch" / "small-study.sh"
VIEWS = tuple(f"study-{path}-{start}" for path in ("gradual", "direct") for start in ("pretrained", "scratch"))


def without_what_is_studied(recipe: Recipe) -> Recipe:
    model = msgspec.structs.replace(recipe.model, weights=None, scratch=False)
    data = msgspec.structs.replace(recipe.data, path="gradual")
    vae = load_recipe("package:study-pretrain").vae
    return msgspec.structs.replace(recipe, name="study", model=model, data=data, vae=vae)


@pytest.mark.parametrize("small", [False, True])
def test_the_four_trainings_differ_in_path_and_start_alone(small: bool) -> None:
    recipes = {name: load_recipe(f"package:{name}", small=small) for name in VIEWS}
    assert len({msgspec.json.encode(without_what_is_studied(each)) for each in recipes.values()}) == 1
    for name, each in recipes.items():
        assert each.data.path == name.split("-")[1]
        assert each.model.scratch == name.endswith("scratch")
        assert (each.model.weights, each.vae) == ("study-pretrain.safetensors", None)


def test_pretraining_sees_the_same_clips_and_trains_the_autoencoder_of_all() -> None:
    first, then = load_recipe("package:study-pretrain"), load_recipe("package:study-gradual-scratch")
    assert (first.latents, first.seed, first.model.weights) == (then.latents, then.seed, None)
    assert (first.data.task, first.export.dtype) == ("image-to-video", "float32")
    assert model_config(first.model) == model_config(then.model)


def test_the_models_have_the_papers_form() -> None:
    recipe = load_recipe("package:study-gradual-pretrained")
    config = sampled_as_trained(model_config(recipe.model), recipe.unet)
    assert config.sampling.steps > 1
    assert config.unet.widths == PLAIN_SMALL.unet.widths
    assert 0 < recipe.unet.noise.fixed_share < 1


# the script


def commands() -> list[list[str]]:
    """Every call in the script: command, then its words."""
    text = SCRIPT.read_text().replace("\\\n", " ")
    return [line.split() for line in re.findall(r"^ *gcd_train (?!\()(.+)$", text, flags=re.MULTILINE)]


def test_the_script_parses_and_its_options_exist() -> None:
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    checked = subprocess.run([there, "-n", str(SCRIPT)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    called = commands()
    assert [words[0] for words in called] == [*["generate"] * 3, *["train"] * 3, *["evaluate"] * 2, "report"]
    for words in called:
        command = words[:2] if words[0] == "generate" else words[:1]
        shown = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
        assert [word for word in words if re.match(r"--[a-z]", word) and word not in shown.output] == []


@pytest.mark.slow
@pytest.mark.timeout(900)
@needs_egl
def test_the_whole_study_runs_in_its_tiny_form(tmp_path: Path) -> None:
    """From no data to the report, twice: the second time nothing is made anew but a run's export, byte for byte."""
    pytest.importorskip("matplotlib", reason="needs the extra `scenes`: pip install 'gcd-node[scenes]'")
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    told = {**os.environ, "PYTHON": sys.executable, "SMALL": "yes", "HEXPLANE": "no"}
    call = [there, str(SCRIPT), str(tmp_path)]
    subprocess.run(call, env=told, check=True)
    table = (tmp_path / "findings" / "findings.md").read_text()
    assert all(f"| {name}-small |" in table for name in VIEWS)
    assert table.count("not run") == 1  # HexPlane
    assert (tmp_path / "report" / "report.md").stat().st_size > 1000
    kept = [
        path
        for path in tmp_path.rglob("*")
        if path.suffix in (".safetensors", ".pt", ".zip") or "records" in path.parts
    ]

    def state(path: Path) -> object:
        return path.read_bytes() if path.name.endswith("-small.safetensors") else path.stat().st_mtime_ns

    before = {path: state(path) for path in kept if path.is_file()}
    subprocess.run(call, env=told, check=True)
    assert [path.name for path, was in before.items() if state(path) != was] == []
