"""One guided full-size step, ours against diffusers: the same numbers in less memory; both times are printed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file
from small_models import relative_error

WORKER = Path(__file__).with_name("full_size_worker.py")


def _warmed(folder: Path) -> Path:
    """Read the weights once, so that neither side waits for the disk."""
    with (folder / "unet.safetensors").open("rb") as file:
        while file.read(2**26):
            pass
    return folder


def _run(task: str, folder: Path) -> str:
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, str(WORKER), task, str(folder)],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=5400,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(10800)
def test_a_guided_full_size_step_equals_diffusers_in_less_memory_and_both_costs_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two branches of 14 frames of 32x48 latents, float32, random weights; each side in a process of its own."""
    try:
        _run("write", tmp_path)
        costs = {side: json.loads(_run(side, _warmed(tmp_path)).splitlines()[-1]) for side in ("ours", "diffusers")}
        results = {side: load_file(tmp_path / f"{side}.safetensors")["result"] for side in costs}
    finally:
        (tmp_path / "unet.safetensors").unlink(missing_ok=True)  # 6 GB
    error = relative_error(results["ours"], results["diffusers"])
    with capsys.disabled():
        for side, cost in costs.items():
            figures = ", ".join(f"{name} {value:.4g}" for name, value in cost.items())
            sys.stdout.write(f"\n{side}: {figures}")
        sys.stdout.write(f"\nrelative difference of the results: {error:.2e}\n")
    assert results["ours"].abs().max() > 0.1
    assert error < 1e-4
    assert costs["ours"]["cpu_s"] > 0
    assert costs["ours"]["peak_gb"] <= costs["diffusers"]["peak_gb"]
