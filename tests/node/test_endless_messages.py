"""Clients whose message never ends: ZeroMQ collects its parts, so the node counts bytes and hangs up."""

import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from control_fakes import Events, FakeCommands, wait_for

from gcd_node.control.client import ControlClient
from gcd_node.control.server import ControlOptions, ControlServer
from gcd_node.load.zmtp import GREETING, message, ready
from gcd_node.publisher import Publisher, PublisherOptions
from gcd_node.security.connections import Allowance, Connections

PART = b"\1" + bytes([200]) + b"x" * 200
"""A part of 200 bytes; more follow."""
PIECE = PART * 300
MOST = 40_000_000
"""Who could send so much was not cut off."""


def connected(endpoint: str, kind: str) -> socket.socket:
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    client = socket.create_connection((host, int(port)), timeout=30)
    client.sendall(GREETING)
    greeted = b""
    while len(greeted) < len(GREETING):
        piece = client.recv(len(GREETING) - len(greeted))
        assert piece, "hung up during the greeting"
        greeted += piece
    client.sendall(ready(kind))
    return client


def streamed(endpoint: str, kind: str) -> int:
    """Parts without an end, at 30 MB/s at most; how many bytes went before the node hung up."""
    sent = 0
    with connected(endpoint, kind) as client:
        while sent < MOST:
            try:
                client.sendall(PIECE)
            except OSError:
                return sent
            sent += len(PIECE)
            time.sleep(0.002)
    raise AssertionError("nobody hung up")


def memory_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


@pytest.fixture
def control(events: Events) -> Iterator[ControlServer]:
    with ControlServer(ControlOptions(endpoint="tcp://127.0.0.1:0"), FakeCommands(), lambda: "active", events) as made:
        yield made


@pytest.fixture
def events() -> Events:
    return Events()


def test_who_never_ends_a_request_is_cut_off_and_the_memory_stays_flat(control: ControlServer, events: Events) -> None:
    with ControlClient(control.endpoint, timeout_s=20.0) as client:
        assert client.request("hello").ok
        streamed(control.endpoint, "DEALER")
        assert events.wait("TOO_LARGE") == {"level": 1, "channel": "control"}
        before_mb, sent = memory_mb(), 0
        for _ in range(4):
            sent += streamed(control.endpoint, "DEALER")
        assert sent > 8_000_000  # 2 MiB each at least: it is no limit on what a request may be
        assert memory_mb() - before_mb < 32
        assert client.request("hello").ok  # the same connection; others notice nothing


def test_who_never_ends_a_subscription_is_cut_off(events: Events) -> None:
    options = PublisherOptions(data="tcp://127.0.0.1:0", status="tcp://127.0.0.1:0")
    with Publisher(options, events) as publisher:
        assert publisher.status_endpoint is not None
        for endpoint, channel in ((publisher.endpoint, "data"), (publisher.status_endpoint, "status")):
            streamed(endpoint, "XSUB")
            told = ("TOO_LARGE", {"level": 1, "channel": channel})
            wait_for(lambda told=told: told in events.seen)  # cut off first, then told


def test_who_asks_a_lot_and_ends_what_he_asks_stays(control: ControlServer, events: Events) -> None:
    request = message(b'{"proto":"gcd/1.0","id":"%d","verb":"hello","args":{}}' + b" " * 60_000)
    with connected(control.endpoint, "DEALER") as client:
        for _ in range(100):  # 6 MB, each a request of its own
            client.sendall(request)
            assert client.recv(65536)
    assert events.codes() == []


def pair() -> tuple[socket.socket, socket.socket, int]:
    """Two ends of a tcp connection; and the port of the second."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        return near, far, int(far.getsockname()[1])


def test_what_is_counted_begins_anew_with_each_whole_message_and_grows_with_time() -> None:
    near, far, port = pair()
    connections, handle = Connections(), far.fileno()
    connections.accepted(handle)
    allowance = Allowance(burst=1000, per_s=10.0)

    def take(size: int) -> None:
        near.sendall(bytes(size))
        assert len(far.recv(size, socket.MSG_WAITALL)) == size

    with near, far:
        take(900)
        assert connections.cut_endless(port, allowance, 0.0) == 0
        connections.whole(handle)
        assert connections.cut_endless(port, allowance, 0.0) == 0
        take(900)
        assert connections.cut_endless(port, allowance, 0.0) == 0
        take(900)
        assert connections.cut_endless(port, allowance, 80.0) == 0  # 1000 and 10 a second
        near.sendall(bytes(900))  # not taken yet, so not in memory
        assert connections.cut_endless(port, allowance, 80.0) == 0
        assert connections.cut_endless(port + 1, allowance, 0.0) == 0  # another socket, whatever its number was once
        assert connections.cut_endless(port, allowance, 79.0) == 1
        with pytest.raises(OSError, match="Broken pipe"):
            far.sendall(b"x")
    connections.forget()
