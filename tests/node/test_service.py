"""What the process tells its machine: systemd over a real notify socket, and log lines that break nothing."""

import gc
import io
import itertools
import json
import logging
import os
import subprocess
import sys
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from fakes import fake_config, write_tiny
from rig import service_manager

from gcd_model.errors import CheckpointError
from gcd_model.weights.adapter import Adapter, base_digest
from gcd_model.weights.load import load_weights
from gcd_model.weights.save import write_adapter
from gcd_node.cli.main import run_app
from gcd_node.cli.run import apply_scheduling
from gcd_node.config import LifeConfig, ModelSection, NodeConfig
from gcd_node.errors import ConfigError
from gcd_node.service import JsonLines, ServiceManager
from gcd_node.session import load_model, model_threads
from gcd_node.stream_context import config_digest


def test_a_life_as_systemd_hears_it(tmp_path: Path) -> None:
    name = f"gcd-test-{os.getpid()}-{tmp_path.name}"
    for bound, told in ((f"\0{name}", f"@{name}"), (str(tmp_path / "notify"),) * 2):
        with service_manager(bound) as receive:
            service = ServiceManager({"NOTIFY_SOCKET": told})
            service.ready()
            service.alive()  # it watches nobody
            service.stopping()
            assert receive() == ["READY=1", "STOPPING=1"]


def test_the_watchdog_is_fed_four_times_a_period_however_often_it_is_called(tmp_path: Path) -> None:
    times, path = itertools.count(100.0, 0.125), str(tmp_path / "notify")
    environment = {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}
    service = ServiceManager(environment, lambda: next(times))
    service.alive()  # nobody there: it is tried again
    with service_manager(path) as receive:
        for _ in range(241):
            service.alive()
        assert receive() == ["WATCHDOG=1"] * 5


@pytest.mark.parametrize("address", ["/nonexistent/notify", "vsock:2:1234", "@" + "x" * 200])
def test_a_socket_that_is_not_there_is_logged_once_and_no_more(address: str, caplog: pytest.LogCaptureFixture) -> None:
    service = ServiceManager({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "30000000"})
    for tell in (service.ready, service.alive, service.alive, service.stopping):
        tell()
    assert len(caplog.records) == 1


def lines(text: str) -> list[dict[str, Any]]:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return [json.loads(line, parse_constant=refuse) for line in text.splitlines()]


def logged(*arguments: Any, **event: object) -> dict[str, Any]:
    """The line of a warning."""
    stream = io.StringIO()
    logger, handler = logging.Logger("gcd_node.test"), logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger.addHandler(handler)
    logger.warning(*arguments, extra={"event": event, "level": "forged"})
    (line,) = lines(stream.getvalue())
    return line


def test_a_line_says_when_where_and_what() -> None:
    before, event = datetime.now(UTC), {"code": "SRC_LOST", "level": 2, "view": None}
    line = logged("window %d took %.1f s", 7, 2.5, **event)
    assert before <= datetime.fromisoformat(line.pop("time")) <= datetime.now(UTC)
    assert line == {
        "pid": os.getpid(),
        "level": "WARNING",
        "logger": "gcd_node.test",
        "message": "window 7 took 2.5 s",
        "thread": threading.current_thread().name,
        "event": event,
    }


@pytest.mark.parametrize("value", [b"\xff", {1: {2}}, "\ud800", 'a\n{"level": 1}', "x" * 1_000_000])
def test_whatever_is_logged_is_one_line_of_json(value: object) -> None:
    assert logged("it is %s", value, value=value)["message"] == f"it is {value}"[-16_000:]


def in_a_process(code: str, **options: Any) -> "subprocess.Popen[str]":
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.slow
def test_a_process_that_logs_json_breaks_no_line() -> None:
    code = """
import logging, sys, threading, warnings
from gcd_node.service import background_logging
logging.basicConfig(level="INFO", format="%(message)s", stream=sys.stderr)
with background_logging(as_json=True):
    logging.getLogger("gcd_node.x").info("hello %s", "you")
    warnings.warn("careful")
    thread = threading.Thread(target=lambda: 1 / 0, name="model")
    thread.start(); thread.join()
raise RuntimeError("the end")
"""
    ended = in_a_process(code)
    told = lines(ended.communicate(timeout=50)[1])
    assert ended.returncode == 1
    assert [line["level"] for line in told] == ["INFO", "WARNING", "CRITICAL", "CRITICAL"]
    assert [line["logger"] for line in told] == ["gcd_node.x", "py.warnings", "gcd_node", "gcd_node"]
    assert told[0]["message"] == "hello you"
    assert told[2]["message"].startswith("uncaught ZeroDivisionError in model\nTraceback")
    assert "RuntimeError: the end" in told[3]["message"]


@pytest.mark.slow
def test_a_stderr_that_nobody_reads_holds_up_no_thread() -> None:
    code = """
import logging, sys, time
from gcd_node.service import background_logging
logging.basicConfig(level="INFO", stream=sys.stderr)
began = time.monotonic()
with background_logging(as_json=False):
    for i in range(5000):
        logging.getLogger("gcd_node.x").info("x" * 1000)
    print(time.monotonic() - began, flush=True)
import os; os._exit(0)
"""
    stuck = in_a_process(code, stdout=subprocess.PIPE)
    try:
        assert stuck.wait(timeout=30) == 0  # nobody read its 5 MB
        assert float(stuck.stdout.readline()) < 10.0
    finally:
        stuck.kill()
        stuck.communicate()


# How `gcd-node run` behaves beside others on its machine, and how the process ends.


def test_a_network_takes_half_the_cores_or_the_stated_threads_and_opencv_no_more(
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
    nice, before = list[int](), sys.getswitchinterval()
    monkeypatch.setattr(os, "nice", nice.append)
    try:
        apply_scheduling(LifeConfig(nice=7))
        assert (nice, sys.getswitchinterval()) == ([7], pytest.approx(0.001))
        assert gc.get_freeze_count() > 0
    finally:
        sys.setswitchinterval(before)
        gc.unfreeze()


@pytest.mark.slow
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


@pytest.mark.slow
def test_f23_a_node_that_has_not_even_begun_ends_with_0() -> None:
    code = """
import sys, time
from gcd_node.cli import main
sys.argv = ["gcd-node", "-v", "run", "launch.toml"]
main.run_app = lambda _: (print("importing torch", flush=True), [time.sleep(0.01) for _ in range(360_000)])
main.main()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as node:
        assert node.stdout.readline() == "importing torch\n"
        node.terminate()
        assert node.wait(60) == 0


# Adapters beside their weights, exports and engines: what is taken, and what is refused before anything runs.


def test_the_node_runs_weights_with_their_own_adapter_under_a_name_of_their_own(tmp_path: Path) -> None:
    loaded = load_weights(write_tiny(tmp_path))
    state, card = loaded.networks.state_dict(), replace(loaded.card, name="adapted")
    layer = min(name for name in state if name.endswith("query.weight") and state[name].ndim == 2).removesuffix(
        ".weight"
    )
    width = state[f"{layer}.weight"].shape[0]
    factors = {f"{layer}.down": torch.ones(2, width), f"{layer}.up": torch.ones(width, 2)}

    def config(name: str = "", base: str = "") -> NodeConfig:
        """With an adapter of this name, if any."""
        changes = [f"model.weights={tmp_path}/tiny.safetensors", "model.device=cpu"]
        if name:
            changes.append(f"model.adapter={tmp_path}/{name}.safetensors")
            adapter = Adapter(rank=2, alpha=1.0, base=base, card=card, tensors=factors)
            write_adapter(tmp_path / f"{name}.safetensors", adapter, overwrite=False)
        return fake_config(*changes)

    plain, adapted = config(), config("own", base_digest(state))
    before, traits = load_model(plain.model).traits, load_model(adapted.model).traits
    assert traits.name == "adapted"
    assert traits.sha256_12 != before.sha256_12
    assert config_digest(plain, before) != config_digest(adapted, before)
    with pytest.raises(CheckpointError):
        load_model(config("other", "0" * 12).model)


def test_onnxruntime_is_refused_for_what_is_no_export_and_an_export_over_a_folder_of_mine(tmp_path: Path) -> None:
    for change in ("model.engine=onnxruntime", 'model.providers=["CUDAExecutionProvider"]'):
        with pytest.raises(ConfigError, match="onnxruntime runs exports, and random:driving is none"):
            load_model(fake_config("model.weights=random:driving", change).model)
    pytest.importorskip("onnxscript", reason="needs the extra `onnx`")
    assert run_app(["export", "--weights", "random:driving", "--onnx", str(tmp_path), "--overwrite"]) == 64
