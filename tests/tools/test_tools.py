"""The developers' scripts run; what they measure, no test says."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def ran(script: str, *words: str) -> str:
    command = [sys.executable, str(TOOLS / script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_a_model_is_measured_with_its_memory_and_shown_again(tmp_path: Path) -> None:
    out = str(tmp_path / "a.json")
    size = ["--height", "64", "--width", "64", "--steps", "1", "--repeats", "1", "--warm", "0", "--threads", "1"]
    first = ran("bench_model.py", "--weights", "random:kubric90", *size, "--stages", "step", "--memory", "--json", out)
    assert ran("bench_model.py", "--show", out) == first
    record = json.loads((tmp_path / "a.json").read_text())
    assert "--json" not in record["command"]
    (ours,) = record["report"]["implementations"]
    assert [stage["stage"] for stage in ours["stages"]] == ["step"]
    assert 0 <= ours["memory"]["private_gb"] < ours["memory"]["resident_gb"]


def test_diffusers_computes_the_same_window_on_the_same_weights(tmp_path: Path) -> None:
    out = tmp_path / "b.json"
    size = ["--height", "64", "--width", "64", "--steps", "2", "--repeats", "1", "--warm", "0", "--threads", "1"]
    ran("bench_model.py", "--weights", "random:kubric90", *size, "--peer", "diffusers", "--json", str(out))
    (difference,) = json.loads(out.read_text())["report"]["differences"]
    assert difference["latents"] < 1e-4
    assert difference["pictures"] < 1e-4


def test_a_short_soak_ends_with_nothing_left_behind(tmp_path: Path) -> None:
    command = [sys.executable, str(TOOLS / "soak.py"), "--hours", "0.004", "--json", str(tmp_path / "soak.json")]
    subprocess.run(command, capture_output=True, text=True, check=False)  # 1 if it is too short to settle
    report = json.loads((tmp_path / "soak.json").read_text())
    assert (report["failures"], report["left"]) == ([], [])
    assert report["windows"] >= report["arrived"] > 0
    assert report["restarts"] > 0
    assert sum(report["attacks"]["done"].values()) > 10
    assert report["codes"]["OK"] > 0
    assert "INTERNAL" not in report["codes"]
    assert report["memory_mb"]["last"] - report["memory_mb"]["first"] < 100


def test_a_policy_learns_and_is_tried_with_its_camera_moved(tmp_path: Path) -> None:
    out = ["--out", str(tmp_path), "--highest", "0.25"]
    ran("policy_study.py", "demonstrations", *out, "--count", "4")
    ran("policy_study.py", "train", *out, "--cpu-minutes", "0.05")
    ran("policy_study.py", "evaluate", *out, "--episodes", "1", "--moves", "1")
    text = (tmp_path / "episodes.jsonl").read_text()
    rows = [json.loads(row) for row in text.splitlines()]
    assert {row["view"] for row in rows} > {"none", "homography", "homography-height", "canonical-learned"}
    (raised_m,) = {row["raised_m"] for row in rows}
    assert 0 < raised_m <= 0.25
    ran("policy_study.py", "evaluate", *out, "--episodes", "1", "--moves", "1")
    assert (tmp_path / "episodes.jsonl").read_text() == text
    ran("policy_study.py", "report", *out)
    assert (tmp_path / "report.png").exists()
    assert "of 1 |" in (tmp_path / "report.md").read_text()
