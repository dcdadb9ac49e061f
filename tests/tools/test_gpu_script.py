"""The GPU measurements as one script: it parses, its options exist, and a tiny model goes through all of it."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
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


@pytest.mark.slow
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
    assert len(engines) == 5
    assert [word for word in sorted(options | engines) if word not in shown] == []


STUB = """#!/usr/bin/env bash
echo "$*" >>"$LOG"
echo "$PYTHONPATH" >>"$LOG.path"
case "$*" in
  "-c import msgspec") exit 1 ;;
  *--json*) echo "{}" >"${@: -1}" ;;
  *gcd_train\\ train*) mkdir -p "${@: -1}"; head -c 40000000 /dev/zero >"${@: -1}/live.safetensors" ;;
  *gcd_train\\ generate*) mkdir -p "$5/street"; touch "$5/street/0.safetensors" ;;
esac
"""


def test_what_a_host_has_is_used_and_a_run_that_was_cut_goes_on_where_it_stopped(tmp_path: Path) -> None:
    stub, out, folder = tmp_path / "python", tmp_path / "out", tmp_path / "run"
    stub.write_text(STUB)
    stub.chmod(0o755)
    out.mkdir()
    given = {"SMALL": "1", "PYTHON": str(stub), "OUT": str(out), "WHEELS": "/wheels", "PYTHONPATH": "/host"}
    given |= {"LOG": str(tmp_path / "log")}
    assert bash(str(SCRIPT), "check", str(folder), **given).returncode == 0
    cut = bash(str(SCRIPT), "bench", str(folder), **given | {"MINUTES": "0"})
    assert cut.returncode == 0
    assert "out of MINUTES" in cut.stderr
    done = bash(str(SCRIPT), "bench", str(folder), **given)
    assert done.returncode == 0, done.stderr
    assert bash(str(SCRIPT), "train", str(folder), **given).returncode == 0
    called = (tmp_path / "log").read_text()
    assert called.count("--json") == 5
    assert {line for line in called.splitlines() if "pip install" in line} == {
        "-m pip install -q --timeout 10 --retries 1 --no-index --find-links /wheels msgspec"
    }
    assert all(line.endswith(":/host") for line in (tmp_path / "log.path").read_text().splitlines())
    with tarfile.open(out / "gpu-bench.tar.gz") as archive:
        names = {Path(name).name for name in archive.getnames()}
    files = {f"gpu-{name}.json" for name in ("graphs", "cuda", "peer", "restart", "memory")}
    assert files <= names
    parts = sorted(out.glob("live.safetensors.part*"))
    assert [part.stat().st_size for part in parts] == [16_000_000, 16_000_000, 8_000_000]
    before = called.count("bench_model.py")
    assert bash(str(SCRIPT), "bench", str(folder), **given).returncode == 0
    assert (tmp_path / "log").read_text().count("bench_model.py") == before


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_tiny_model_goes_through_check_and_bench(tmp_path: Path) -> None:
    given = {"SMALL": "1", "PYTHON": sys.executable, "MINUTES": "29"}
    for verb in ("check", "bench"):
        run = bash(str(SCRIPT), verb, str(tmp_path), **given)
        assert run.returncode == 0, run.stderr[-3000:]
    files = {f"gpu-{name}.json" for name in ("graphs", "cuda", "peer", "restart", "memory")}
    assert files | {"gpu-check.log"} <= {path.name for path in tmp_path.iterdir()}
    for name in files:
        report = json.loads((tmp_path / name).read_text())["report"]
        assert all(difference["latents"] < 1e-4 for difference in report["differences"])
        names = {each["name"] for each in report["implementations"]}
        assert names & {"ours on cuda", "ours, graphs alone"}


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
