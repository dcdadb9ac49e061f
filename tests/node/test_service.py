"""What the process tells its machine: systemd over a real notify socket, and log lines that break nothing."""

import io
import itertools
import json
import logging
import os
import subprocess
import sys
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from rig import service_manager

from gcd_node.service import JsonLines, ServiceManager


@pytest.mark.parametrize("is_abstract", [False, True])
def test_a_life_as_systemd_hears_it(tmp_path: Path, is_abstract: bool) -> None:
    name = f"gcd-test-{os.getpid()}-{tmp_path.name}"
    bound, told = (f"\0{name}", f"@{name}") if is_abstract else (str(tmp_path / "notify"),) * 2
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
def test_a_socket_that_cannot_be_reached_is_logged_once_and_the_node_goes_on(
    address: str, caplog: pytest.LogCaptureFixture
) -> None:
    service = ServiceManager({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "30000000"})
    for tell in (service.ready, service.alive, service.alive, service.stopping):
        tell()
    assert len(caplog.records) == 1


# Log lines


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
    assert stuck.stdout is not None
    try:
        assert stuck.wait(timeout=30) == 0  # nobody read its 5 MB
        assert float(stuck.stdout.readline()) < 10.0
    finally:
        stuck.kill()
        stuck.communicate()
