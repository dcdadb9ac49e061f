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
SCRIPT = ROOT / "launch" / "bench-gpu.sh"


def bash(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    return subprocess.run([there, *words], capture_output=True, text=True, check=False, env=os.environ | environment)


def test_it_refuses_a_step_that_it_does_not_know(tmp_path: Path) -> None:
    run = bash(str(SCRIPT), str(tmp_path), STEPS="check fly")
    assert run.returncode == 2
    assert "no step is called fly" in run.stderr


def test_its_options_and_engines_exist() -> None:
    command = [sys.executable, str(ROOT / "tools" / "bench_model.py"), "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    text = re.search(r"^if \[ -n \"\$SMALL.*^keep\(\)", SCRIPT.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert text is not None
    options = set(re.findall(r"--[a-z][a-z-]+", text[0])) - {"--no-index", "--find-links", "--signal"}
    engines = set(re.findall(r"--engine ([a-z0-9-]+)", SCRIPT.read_text()))
    assert {"--weights", "--engine", "--peer", "--compiled", "--json"} <= options
    assert len(engines) == 5
    assert [word for word in sorted(options | engines) if word not in shown] == []


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_tiny_model_goes_through_every_step_and_a_second_run_has_nothing_left_to_do(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    given = {"SMALL": "1", "PYTHON": sys.executable, "OUT": str(tmp_path / "out")}
    first = bash(str(SCRIPT), str(tmp_path / "run"), **given)
    assert first.returncode == 0, first.stderr[-3000:]
    made = {path.name for path in (tmp_path / "out").iterdir()}
    files = {"gpu-engines.json", "gpu-peer.json", "gpu-restart.json", "gpu-memory.json"}
    assert made == files | {"gpu-check.log", "gpu-restart.log"}
    for name in files:
        report = json.loads((tmp_path / "out" / name).read_text())["report"]
        assert all(difference["latents"] < 1e-4 for difference in report["differences"])
        assert "ours on cuda" in {each["name"] for each in report["implementations"]}
    second = bash(str(SCRIPT), str(tmp_path / "run"), **given)
    assert second.returncode == 0
    assert "->" not in second.stderr
