"""The GPU measurements as one script: it parses, its options exist, and a tiny model goes through all of it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gcd_model import ModelBench
from gcd_node.cli.bench import bench
from gcd_node.cli.bench_model import chosen_implementations
from gcd_node.load.bench_record import read_record

SCRIPT = Path(__file__).parents[2] / "launch" / "bench-gpu.sh"


def bash(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    there = shutil.which("bash")
    assert there is not None, "the project's own scripts need bash"
    return subprocess.run([there, *words], capture_output=True, text=True, check=False, env=os.environ | environment)


def test_it_parses() -> None:
    checked = bash("-n", str(SCRIPT))
    assert checked.returncode == 0, checked.stderr


def test_it_refuses_a_step_that_it_does_not_know(tmp_path: Path) -> None:
    run = bash(str(SCRIPT), str(tmp_path), STEPS="check fly")
    assert run.returncode == 2
    assert "no step is called fly" in run.stderr


def test_its_options_and_engines_exist() -> None:
    shown = CliRunner().invoke(bench, ["model", "--help"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    text = re.search(r"^if \[ -n \"\$SMALL.*^keep\(\)", SCRIPT.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert text is not None
    options = set(re.findall(r"--[a-z][a-z-]+", text[0])) - {"--no-index", "--find-links", "--signal"}
    assert {"--weights", "--engine", "--peer", "--compiled", "--json"} <= options
    assert [option for option in sorted(options) if option not in shown.output] == []
    engines = list(dict.fromkeys(re.findall(r"--engine ([a-z0-9-]+)", SCRIPT.read_text())))
    assert len(engines) == 5
    assert len(chosen_implementations(engines, "diffusers", compiled=True)) == 7


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
    reports = {name: read_record(tmp_path / "out" / name).report for name in files}
    for report in reports.values():
        assert isinstance(report, ModelBench)
        assert all(difference.latents < 1e-4 for difference in report.differences)
        assert "ours on cuda" in {each.name for each in report.implementations}
    second = bash(str(SCRIPT), str(tmp_path / "run"), **given)
    assert second.returncode == 0
    assert "bench model" not in second.stderr.replace("bench page", "")
