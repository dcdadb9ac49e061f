"""How `gcd-node run` behaves beside others on its machine, and how the process ends."""

import gc
import os
import subprocess
import sys

import cv2
import pytest
import torch

from gcd_node.cli.run import apply_scheduling
from gcd_node.config import LifeConfig, ModelSection
from gcd_node.session import load_model, model_threads


def test_a_network_takes_half_the_cores_or_so_many_threads_as_is_stated_and_opencv_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for cores, threads in ((1, 1), (2, 1), (8, 4)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: set(range(cores)))
        assert model_threads(ModelSection(weights="fake")) == threads
    before = torch.get_num_threads(), cv2.getNumThreads()
    wanted = max(before) + 1
    try:
        load_model(ModelSection(weights="random:driving", device="cpu", threads=wanted))
        assert (torch.get_num_threads(), cv2.getNumThreads()) == (wanted, wanted)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def test_a_node_is_as_nice_as_it_is_told_and_its_threads_take_turns_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    nice: list[int] = []
    monkeypatch.setattr(os, "nice", nice.append)
    before = sys.getswitchinterval()
    try:
        apply_scheduling(LifeConfig(nice=7))
        assert nice == [7]
        assert sys.getswitchinterval() == pytest.approx(0.001)
        assert gc.get_freeze_count() > 0
    finally:
        sys.setswitchinterval(before)
        gc.unfreeze()


def test_a_thread_that_hangs_changes_neither_the_exit_code_nor_what_was_said() -> None:
    code = """
import sys, threading, time
from gcd_node.cli.main import main
threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()
sys.argv = ["gcd-node", "ctl", "state", "--endpoint", "ipc:///nowhere/at/all", "--timeout", "0.1"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 69
    assert done.stderr.startswith("error: ipc:///nowhere/at/all did not answer state")


def test_f23_a_node_that_has_not_even_begun_ends_with_0() -> None:
    code = """
import sys, time
from gcd_node.cli import main
sys.argv = ["gcd-node", "-v", "run", "launch.toml"]
main.run_app = lambda _: (print("importing torch", flush=True), [time.sleep(0.01) for _ in range(360_000)])
main.main()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == "importing torch\n"
        node.terminate()
        assert node.wait(60) == 0
