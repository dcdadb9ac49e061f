"""What systemd is told, over a real notify socket."""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gcd_node.health.systemd import ServiceManager, service_manager


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


def test_a_life_as_systemd_hears_it(path: str, receive: Receive) -> None:
    told = manager(path)
    assert told.present
    assert told.extend_start(90.0)
    assert told.ready("2 views")
    assert told.status("streaming")
    assert told.stopping()
    assert receive() == ["EXTEND_TIMEOUT_USEC=90000000", "READY=1\nSTATUS=2 views", "STATUS=streaming", "STOPPING=1"]


def test_an_abstract_socket_is_reached(tmp_path: Path) -> None:
    name = f"gcd-test-{os.getpid()}-{tmp_path.name}"
    for receive in listening(f"\0{name}"):
        assert manager(f"@{name}").ready()
        assert receive() == ["READY=1"]


def test_a_status_stays_on_one_line(path: str, receive: Receive) -> None:
    manager(path).status("lost\nREADY=1\n\nMAINPID=1 " + "x" * 500)
    (message,) = receive()
    assert message.startswith("STATUS=lost READY=1 MAINPID=1 xxx")
    assert len(message) == len("STATUS=") + 200


def test_the_watchdog_is_fed_four_times_a_period_however_often_it_is_called(path: str, receive: Receive) -> None:
    clock = Clock()
    told = manager(path, clock, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getpid()))
    fed = []
    assert told.watchdog_s == 30.0
    for _ in range(241):
        fed.append(told.alive())
        clock.now_s += 0.125
    assert sum(fed) == 5
    assert receive() == ["WATCHDOG=1"] * 5


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"},
    ],
)
def test_a_watchdog_that_is_none_or_not_ours_is_not_fed(
    path: str, receive: Receive, environment: dict[str, str]
) -> None:
    told = manager(path, None, **environment)
    assert told.watchdog_s is None
    assert not told.alive()
    assert receive() == []


def test_without_a_service_manager_nothing_is_sent() -> None:
    told = ServiceManager({"WATCHDOG_USEC": "30000000"})
    assert not told.present
    assert told.watchdog_s is None
    assert [told.ready(), told.status("x"), told.alive(), told.extend_start(1), told.stopping()] == [False] * 5


@pytest.mark.parametrize("address", ["/nonexistent/notify", "vsock:2:1234", "x" * 20, "@" + "x" * 200])
def test_a_socket_that_cannot_be_reached_is_logged_once_and_the_node_goes_on(
    address: str, caplog: pytest.LogCaptureFixture
) -> None:
    told = manager(address, WATCHDOG_USEC="30000000")
    assert [told.ready(), told.alive(), told.alive(), told.stopping()] == [False] * 4
    assert len(caplog.records) == 1
    assert address[:20] in caplog.text
    assert "goes on" in caplog.text


def test_a_feed_that_did_not_arrive_is_tried_again(path: str) -> None:
    clock = Clock()
    told = manager(path, clock, WATCHDOG_USEC="30000000")
    assert not told.alive()
    for receive in listening(path):
        assert told.alive()
        assert receive() == ["WATCHDOG=1"]


def test_a_full_socket_does_not_hold_up_the_node(path: str, receive: Receive) -> None:
    told = manager(path)
    sent = [told.status("x" * 200) for _ in range(2)]
    while told.status("x" * 200):
        sent.append(True)
        assert len(sent) < 100_000, "the socket never filled"
    assert len(receive()) == len(sent)
    assert told.status("again")


def test_the_environment_of_the_process_is_what_counts(path: str, receive: Receive) -> None:
    code = "from gcd_node.health.systemd import service_manager; print(service_manager().ready('from a child'))"
    environment = os.environ | {"NOTIFY_SOCKET": path}
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=50, check=False)
    assert (ended.stdout, ended.returncode) == ("True\n", 0), ended.stderr
    assert receive() == ["READY=1\nSTATUS=from a child"]


def test_this_process_was_not_started_by_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not service_manager().present
