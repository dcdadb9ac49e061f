"""Several processes train what one would have trained; a killed one goes on; a lost one is missed."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from headless import needs_egl
from tiny_world import FRAMES, HEIGHT, RECIPE, WIDTH
from two_processes import KILLED_UPDATES

HERE = Path(__file__).parent
_SHARED_OUT = 5e-6
QUIET = {**os.environ, "OMP_NUM_THREADS": "1"}


def two_processes(folder: Path, *what: str) -> dict[str, Any]:
    command = [sys.executable, str(HERE / "two_processes.py"), str(folder), *what]
    done = subprocess.run(command, env=QUIET, capture_output=True, text=True, timeout=600, check=False)
    assert (folder / "found.json").exists(), done.stderr[-3000:]
    return json.loads((folder / "found.json").read_text())


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the shorter run of two_processes.py found."""
    return two_processes(tmp_path_factory.mktemp("two"))


@pytest.fixture(scope="module")
def more(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the longer run of two_processes.py found."""
    return two_processes(tmp_path_factory.mktemp("more"), "more")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_two_processes_end_with_the_weights_of_one_with_twice_the_batch(found: dict[str, Any]) -> None:
    assert found["ddp moved"] > 1e-5  # there was something to learn
    assert found["ddp against twice the batch"] < 1e-6
    assert found["ddp share of the way"] < 1e-3
    assert found["ddp against two batches"] < 1e-7


@pytest.mark.slow
def test_two_processes_share_three_batches(found: dict[str, Any]) -> None:
    assert found["uneven"] < 1e-6
    shared, alone = found["uneven speeds"]  # a batch that counts nothing is not counted
    assert shared == alone > 0


@pytest.mark.slow
def test_the_first_of_two_processes_measures_alone(found: dict[str, Any]) -> None:
    assert found["ddp measured"] == 0.5  # once in one, never in the other


@pytest.mark.slow
def test_means_over_processes_keep_what_one_of_them_alone_gives(found: dict[str, Any]) -> None:
    assert found["ddp rank 0"] == found["ddp rank 1"] == 1.0
    assert found["ddp weighed"] == 0.75  # three values of 1 beside one of 0


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_process_that_ends_ends_the_others_with_an_error(found: dict[str, Any]) -> None:
    assert "lost another process of this run" in found["lost"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_processes_that_share_the_weights_out_do_so_too(more: dict[str, Any]) -> None:
    """FSDP2: a minute of two CPUs, with what follows.

    Its gathered weights take other kernels than whole ones, and Adam makes steps of the rounding of gradients that are
    next to nothing: not 1e-6 as with copies, but a small part of the way.
    """
    assert more["fsdp moved"] > 1e-5
    assert more["fsdp against twice the batch"] < _SHARED_OUT
    assert more["fsdp share of the way"] < 0.1
    assert more["fsdp measured"] == 0.5


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("parallel", ["ddp", "fsdp"])
def test_a_stop_that_one_process_hears_stops_all_and_is_resumed(more: dict[str, Any], parallel: str) -> None:
    """States of torch.distributed.checkpoint, resumed and read by one process: a minute of two CPUs."""
    assert more[f"{parallel} stopped at"] == 2
    assert more[f"{parallel} resumed"] == 0.0
    assert more[f"{parallel} read by one"] == 0.0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_states_written_beside_training_are_kept_and_a_damaged_one_is_passed_over(more: dict[str, Any]) -> None:
    """As above."""
    assert more["beside"] == ["0000001", "0000002", "0000003"]
    assert more["put aside"] == ["0000003.damaged"]
    assert more["repaired"] == 0.0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_what_one_process_began_two_go_on_with_and_the_other_way_round(more: dict[str, Any]) -> None:
    """As above."""
    assert more["handed on after"] == ["0000001", "0000002"]
    assert more["handed back"] < _SHARED_OUT
    assert more["recomputed"] < _SHARED_OUT


def losses_of(folder: Path) -> dict[tuple[int, int], set[str]]:
    found: dict[tuple[int, int], set[str]] = {}
    for line in (folder / "losses.jsonl").read_text().splitlines():
        update, part, loss = json.loads(line)
        found.setdefault((update, part), set()).add(loss)
    return found


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_killed_at_three_random_points_goes_on_to_the_same_losses_bit_for_bit(tmp_path: Path) -> None:
    """kill -9 of a process that saves after every update: five starts of Python."""
    command = [sys.executable, str(HERE / "two_processes.py")]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    subprocess.run([*command, str(whole), "killed"], env=QUIET, check=True)
    for share in sorted(random.uniform(0.1, 0.9) for _ in range(3)):
        run = subprocess.Popen([*command, str(killed), "killed"], env=QUIET)
        seen = killed / "losses.jsonl"
        while not seen.exists() or len(losses_of(killed)) < 2 * KILLED_UPDATES * share:
            assert run.poll() is None, "ended before it was killed"
            time.sleep(0.003 * random.random())
        run.send_signal(signal.SIGKILL)
        assert run.wait() == -signal.SIGKILL
        torn = seen.read_text()
        seen.write_text(torn[: torn.rindex("\n") + 1])
    subprocess.run([*command, str(killed), "killed"], env=QUIET, check=True)
    found = losses_of(killed)
    assert len(found) == 2 * KILLED_UPDATES
    assert found == losses_of(whole)


@pytest.mark.slow
@pytest.mark.timeout(900)
@needs_egl
def test_torchrun_trains_a_recipe_from_its_clips_to_its_weights(tmp_path: Path) -> None:
    """The command of the manual with two gloo processes, every stage; then SIGTERM in the middle, and on again."""
    from gcd_train.scenes.pair_writer import generate
    from gcd_train.scenes.worlds import World

    world = World(
        name="driving",
        width=WIDTH,
        height=HEIGHT,
        frames=FRAMES,
        fps=10.0,
        hfov_deg=85.0,
        oversample=1,
        clips_per_shard=2,
    )
    list(generate(tmp_path / "data", world, range(2), workers=1))
    list(generate(tmp_path / "valid", world, range(1_000_000, 1_000_001), workers=1))
    (tmp_path / "tiny.toml").write_bytes(RECIPE)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "gcd_train"]
    command += ["train", str(tmp_path / "tiny.toml"), *(f"--{name}={tmp_path / name}" for name in ("data", "valid"))]
    command += [f"--out={tmp_path / 'run'}", "--set=unet.batch=2", "--set=unet.clip_batch=1"]
    command += ["--set=unet.budget.updates=40"]
    run = subprocess.Popen(command, env=QUIET, stderr=subprocess.PIPE, text=True)
    index = tmp_path / "run" / "latents" / "index.json"
    while not (index.exists() and json.loads(index.read_text())["sensitivity"]) and run.poll() is None:
        time.sleep(0.05)
    run.send_signal(signal.SIGTERM)
    _, said = run.communicate(timeout=300)
    assert run.returncode != 0
    assert "run again to go on" in said or "stopped" in said
    subprocess.run(command, env=QUIET, check=True, timeout=600)
    assert (tmp_path / "run" / "tiny.safetensors").exists()
    assert max(path.name for path in (tmp_path / "run" / "unet" / "states").iterdir()) == "0000040"
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    kinds = [(json.loads(line)["stage"], json.loads(line)["kind"]) for line in lines]
    assert kinds.count(("export", "measured")) == 1
