"""The small-scale study: its recipes differ in what is studied alone, and its script runs."""

import os
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from headless import needs_egl
from made_records import record
from typer.testing import CliRunner

from gcd_model.config import PLAIN_SMALL
from gcd_train.cli.main import app
from gcd_train.evaluation.runs import MethodRecords
from gcd_train.recipe_files import load_recipe
from gcd_train.training.setup import model_config, sampled_as_trained

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tools"))
study_findings = import_module("study_findings")

SCRIPT = ROOT / "launch" / "small-study.sh"


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("world", ["", "-drop"])
def test_views_start_from_the_autoencoder_and_clips_of_their_pretraining(world: str, small: bool) -> None:
    first, then = (load_recipe(f"package:study{world}{kind}", small=small) for kind in ("-pretrain", ""))
    assert (first.latents, first.data.kind, first.data.repeats) == (then.latents, then.data.kind, then.data.repeats)
    assert (first.data.task, first.export.dtype, first.model.weights) == ("image-to-video", "float32", None)
    assert (then.model.weights, then.vae) == (f"study{world}-pretrain.safetensors", None)
    before, after = model_config(first.model), model_config(then.model)
    assert (before.vae, before.unet.widths) == (after.vae, after.unet.widths)


def test_the_models_have_the_papers_form() -> None:
    recipe = load_recipe("package:study")
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
    road, drops = (["generate"] * 3 + ["evaluate"] * count for count in (2, 1))
    assert [words[0] for words in called] == ["train", *road, *drops, "report"]
    for words in called:
        command = words[:2] if words[0] == "generate" else words[:1]
        shown = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
        assert [word for word in words if re.match(r"--[a-z]", word) and word not in shown.output] == []


# what is found


def measured(name: str, apart: float, spread: float) -> MethodRecords:
    """A method on twenty scenes that are alike but for the spread, dB."""
    own = np.random.default_rng(7).normal(20.0, 3.0, 20)  # of the scenes, for every method: pairs take it away
    noise = np.random.default_rng(len(name)).normal(0.0, spread, 20)
    records = tuple(
        record(name, f"scn{number:05d}.sample_00", psnr_db=value) for number, value in enumerate(own + noise + apart)
    )
    return MethodRecords(name=name, details={}, folder=Path(), records=records)


@pytest.mark.parametrize(
    ("apart", "verdict"),
    [((0.5, 0.6, 0.4), "better"), ((-0.5, -0.6, -0.4), "worse"), ((1.0, 0.9, -1.2), "open"), ((0.5,), "open")],
)
def test_a_claim_holds_where_scenes_and_seeds_agree(apart: tuple[float, ...], verdict: str) -> None:
    each = [measured(f"ours-s{seed}", value, 0.1) for seed, value in enumerate(apart)] + [measured("other", 0.0, 0.1)]
    pairs = study_findings.seeds_of(study_findings.by_name([SimpleNamespace(methods=each)]), "ours", "other")
    keys = tuple(each[0].places)
    found, seeds = study_findings.difference(pairs, study_findings.PICTURE_COLUMNS[0], "2-last", keys)
    assert study_findings.figures(found, seeds)[-1] == study_findings.VERDICTS[verdict]
    np.testing.assert_allclose(seeds, apart, atol=0.1)


def test_a_training_is_compared_with_that_of_its_own_seed() -> None:
    each = [measured(f"{name}-s{seed}", 0.0, 0.0) for name in ("ours", "other") for seed in (1, 2)][:3]
    pairs = study_findings.seeds_of(study_findings.by_name([SimpleNamespace(methods=each)]), "ours", "other")
    assert [(one.name, other.name) for one, other in pairs.values()] == [("ours-s1", "other-s1")]


@pytest.mark.slow
@pytest.mark.timeout(1500)
@needs_egl
def test_the_whole_study_runs_in_its_tiny_form(tmp_path: Path) -> None:
    """From no data to the report; a part run again makes nothing anew but a run's export, byte for byte."""
    pytest.importorskip("matplotlib", reason="needs the extra `scenes`: pip install 'gcd-node[scenes]'")
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    told = {**os.environ, "PYTHON": sys.executable, "SMALL": "yes", "HEXPLANE": "no"}
    call = [there, str(SCRIPT), str(tmp_path)]
    subprocess.run(call, env=told, check=True)
    text = (tmp_path / "findings" / "findings.md").read_text()
    claims = [line for line in text.splitlines() if " > " in line]
    assert len(claims) == len(study_findings.CLAIMS)
    assert [line.split(" | ")[0] for line in claims if "not run" in line] == [
        f"| {ours} > HexPlane, one view" for ours in ("gradual", "gradual 90")
    ]
    assert len(re.findall(r"^\| study-", text, flags=re.MULTILINE)) == 12  # means of what was trained
    assert (tmp_path / "report" / "report.md").stat().st_size > 1000
    kept = [
        path
        for path in tmp_path.rglob("*")
        if path.suffix in (".safetensors", ".pt", ".zip") or "records" in path.parts
    ]

    def state(path: Path) -> object:
        exported = path.parent.name == path.stem  # which a run that goes on writes again
        return path.read_bytes() if exported else path.stat().st_mtime_ns

    before = {path: state(path) for path in kept if path.is_file()}
    subprocess.run([*call, "drop"], env=told, check=True)
    assert [path.name for path, was in before.items() if state(path) != was] == []
