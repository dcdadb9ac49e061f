"""What the process tells its machine: systemd over a real notify socket, and log lines that break nothing."""

import io
import json
import logging
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from gcd_node.service import JsonLines, ServiceManager


class Clock:
    """Monotonic seconds that a test moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


Receive = Callable[[], list[str]]


def listening(address: str) -> Iterator[Receive]:
    """A notify socket at `address`; calling it gives what has arrived, a message each."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(address)
        link.setblocking(False)

        def receive() -> list[str]:
            found: list[str] = []
            while True:
                try:
                    found.append(link.recv(4096).decode())
                except BlockingIOError:
                    return found

        yield receive


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "notify")


@pytest.fixture
def receive(path: str) -> Iterator[Receive]:
    yield from listening(path)


def manager(path: str, clock: Clock | None = None, **environment: str) -> ServiceManager:
    return ServiceManager({"NOTIFY_SOCKET": path, **environment}, clock or Clock())


# systemd


def test_a_life_as_systemd_hears_it(path: str, receive: Receive) -> None:
    service = manager(path)
    assert service.extend_start(90.0)
    assert service.ready()
    assert service.stopping()
    assert receive() == ["EXTEND_TIMEOUT_USEC=90000000", "READY=1", "STOPPING=1"]


def test_an_abstract_socket_is_reached(tmp_path: Path) -> None:
    name = f"gcd-test-{os.getpid()}-{tmp_path.name}"
    for receive in listening(f"\0{name}"):
        assert manager(f"@{name}").ready()
        assert receive() == ["READY=1"]


def test_the_watchdog_is_fed_four_times_a_period_however_often_it_is_called(path: str, receive: Receive) -> None:
    clock = Clock()
    service = manager(path, clock, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getpid()))
    fed: list[bool] = []
    for _ in range(241):
        fed.append(service.alive())
        clock.now_s += 0.125
    assert sum(fed) == 5
    assert receive() == ["WATCHDOG=1"] * 5


@pytest.mark.parametrize("address", ["/nonexistent/notify", "vsock:2:1234", "@" + "x" * 200])
def test_a_socket_that_cannot_be_reached_is_logged_once_and_the_node_goes_on(
    address: str, caplog: pytest.LogCaptureFixture
) -> None:
    service = manager(address, WATCHDOG_USEC="30000000")
    assert [service.ready(), service.alive(), service.alive(), service.stopping()] == [False] * 4
    assert len(caplog.records) == 1


def test_a_feed_that_did_not_arrive_is_tried_again(path: str) -> None:
    service = manager(path, WATCHDOG_USEC="30000000")
    assert not service.alive()
    for receive in listening(path):
        assert service.alive()
        assert receive() == ["WATCHDOG=1"]


# Log lines


@pytest.fixture
def stream() -> io.StringIO:
    return io.StringIO()


@pytest.fixture
def log(stream: io.StringIO) -> Iterator[logging.Logger]:
    """A logger of its own that writes JSON lines to `stream`."""
    logger = logging.Logger("gcd_node.test", level=logging.DEBUG)
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger.addHandler(handler)
    yield logger
    handler.close()


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line, parse_constant=_refuse) for line in text.splitlines()]


def _refuse(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def test_a_line_says_when_where_and_what(log: logging.Logger, stream: io.StringIO) -> None:
    before = datetime.now(UTC)
    log.warning("window %d took %.1f s", 7, 2.5, extra={"code": "SRC_LOST", "view": None, "level": "forged"})
    (line,) = lines(stream.getvalue())
    assert before <= datetime.fromisoformat(line.pop("time")) <= datetime.now(UTC)
    assert isinstance(line.pop("pid"), int)
    assert line == {
        "level": "WARNING",
        "logger": "gcd_node.test",
        "message": "window 7 took 2.5 s",
        "thread": threading.current_thread().name,
        "code": "SRC_LOST",
        "view": None,
    }


class Unwritable:
    """Fails whenever it is to become text."""

    def __str__(self) -> str:
        raise RuntimeError("no")

    __repr__ = __str__


@pytest.mark.parametrize(
    "value",
    [float("nan"), b"\xff", {1: {2}}, object, 2**53, 10**5000, Unwritable(), "\ud800", 'a\n{"level": 1}'],
    ids=["nan", "bytes", "dict", "type", "large", "huge", "unwritable", "surrogate", "lines"],
)
def test_whatever_is_logged_is_one_line_of_json(log: logging.Logger, stream: io.StringIO, value: object) -> None:
    log.error("%s and %d", value, extra={"value": value})
    log.error("x" * 1_000_000)
    line, long = lines(stream.getvalue())
    assert isinstance(line["value"], str)
    assert len(long["message"]) == 16_000


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
    assert [line["message"] for line in told[::2]] == ["hello you", "uncaught ZeroDivisionError in model"]
    assert told[2]["exception"].endswith("ZeroDivisionError: division by zero")
    assert "RuntimeError: the end" in told[3]["exception"]


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
