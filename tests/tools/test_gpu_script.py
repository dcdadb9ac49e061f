"""The GPU measurements as one script: it parses, its options exist, and a tiny model goes through all of it."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "launch" / "gpu.sh"


def bash(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    return subprocess.run([there, *words], capture_output=True, text=True, check=False, env=os.environ | environment)


@pytest.mark.parametrize("words", [(), ("fly",)])
def test_it_refuses_what_it_does_not_know(words: tuple[str, ...]) -> None:
    run = bash(str(SCRIPT), *words)
    assert run.returncode == 2
    assert "takes check, bench or train" in run.stderr


def test_its_options_and_engines_exist() -> None:
    command = [sys.executable, str(ROOT / "tools" / "bench_model.py"), "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    text = SCRIPT.read_text()
    bench = (
        text[text.index("MODEL=(") : text.index("declare")] + text[text.index("bench() {") : text.index("train() {")]
    )
    options = set(re.findall(r"--[a-z][a-z-]+", bench))
    engines = set(re.findall(r"ENGINES=\(([a-z0-9 -]+)\)", text)[1].split())
    assert {"--weights", "--engine", "--peer", "--compiled", "--memory"} <= options
    assert len(engines) == 4
    assert [word for word in sorted(options | engines) if word not in shown] == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_tiny_model_goes_through_check_and_bench_and_a_second_run_has_nothing_left_to_do(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    given = {"SMALL": "1", "PYTHON": sys.executable, "OUT": str(tmp_path / "out")}
    for verb in ("check", "bench"):
        run = bash(str(SCRIPT), verb, str(tmp_path / "run"), **given)
        assert run.returncode == 0, run.stderr[-3000:]
    made = {path.name for path in (tmp_path / "out").iterdir()}
    files = {f"gpu-{name}.json" for name in ("graphs", "cuda", "peer", "restart", "memory")}
    assert made == files | {"gpu-check.log"}
    for name in files:
        report = json.loads((tmp_path / "out" / name).read_text())["report"]
        assert all(difference["latents"] < 1e-4 for difference in report["differences"])
        names = {each["name"] for each in report["implementations"]}
        assert names & {"ours on cuda", "ours, graphs alone"}
    second = bash(str(SCRIPT), "bench", str(tmp_path / "run"), **given)
    assert second.returncode == 0
    assert "->" not in second.stderr


TINY = """kind = "live"
name = "tiny"
model = {depth = {widths = [8, 16, 16], mixers = 1, fine_width = 8, half_width = 8, bins = 8}, \
    paint = {widths = [8, 16, 16], fine_width = 8, half_width = 8, embedding_width = 16}, memory = 2000}
depth = {budget = {updates = 2}, batch = 1, optimiser = {rate = 1e-3}}
paint = {budget = {updates = 2}, batch = 1, optimiser = {rate = 1e-3}}
detail = {budget = {updates = 1}, batch = 1, optimiser = {rate = 1e-3}}
"""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_tiny_training_films_its_clips_and_leaves_its_weights(tmp_path: Path) -> None:
    recipe, out = tmp_path / "tiny.toml", tmp_path / "out"
    recipe.write_text(TINY)
    out.mkdir()
    given = {"SMALL": str(recipe), "PYTHON": sys.executable, "OUT": str(out)}
    run = bash(str(SCRIPT), "train", str(tmp_path / "live"), **given)
    assert run.returncode == 0, run.stderr[-3000:]
    assert (out / "tiny.safetensors").exists()
