"""The small-scale study: its recipes differ in what is studied alone, and its script runs."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
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
BASH = shutil.which("bash") or "bash"


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
    checked = subprocess.run([BASH, "-n", str(SCRIPT)], capture_output=True, text=True, check=False)
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


def test_the_pages_tables_come_from_the_records_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page, records, out = ROOT / "docs" / "log" / "small-study.md", tmp_path / "records", tmp_path / "out"
    with tarfile.open(page.with_suffix(".tar.xz")) as archive:
        archive.extractall(records, filter="data")
    monkeypatch.setattr(sys, "argv", ["findings", *map(str, sorted(records.iterdir())), "--out", str(out)])
    study_findings.main()
    assert (out / "findings.md").read_text() in page.read_text()


@pytest.mark.slow
@pytest.mark.timeout(1500)
@needs_egl
def test_the_whole_study_runs_in_its_tiny_form(tmp_path: Path) -> None:
    """From no data to the report; a part run again makes nothing anew but a run's export, byte for byte."""
    pytest.importorskip("matplotlib", reason="needs the extra `scenes`: pip install 'gcd-node[scenes]'")
    told = {**os.environ, "PYTHON": sys.executable, "SMALL": "yes", "HEXPLANE": "no"}
    call = [BASH, str(SCRIPT), str(tmp_path)]
    subprocess.run(call, env=told, check=True)
    found = (tmp_path / "findings" / "findings.md").read_text()
    assert re.findall(r" > (.*) \| 2-last \| not run", found) == ["HexPlane, one view"] * 2
    assert found.count(" > ") == len(study_findings.CLAIMS)
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
