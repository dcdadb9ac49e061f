"""A gate that hears of connections late, as on a busy machine: their numbers have come to stand for others."""

import socket
from collections.abc import Iterator

import pytest
import zmq
from control_fakes import Events, wait_for

from gcd_node.load.zmtp import GREETING, message, ready
from gcd_node.security.gate import Gate


@pytest.fixture
def server() -> Iterator["zmq.Socket[bytes]"]:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as made:
        made.set(zmq.MAXMSGSIZE, 1000)
        yield made


@pytest.fixture
def events() -> Events:
    return Events()


def welcomed(client: socket.socket) -> None:
    client.sendall(GREETING + ready("DEALER"))
    told = b""
    while b"ROUTER" not in told:
        told += client.recv(4096) or pytest.fail("hung up during the handshake")


def knows_one(gate: Gate) -> bool:
    """Whether the gate has heard of all that was, and of one that is there."""
    (monitored,) = gate._monitors.values()
    return not monitored.ahead and len(monitored.connections._kept) == 1


def came_and_went(port: int) -> None:
    """A connection that was welcomed and has ended on both sides: the next one gets its number."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
        welcomed(client)
        client.shutdown(socket.SHUT_WR)
        while client.recv(4096):
            pass


def test_f17_who_has_the_number_of_one_that_left_was_not_too_large(server: "zmq.Socket[bytes]", events: Events) -> None:
    gate = Gate(server.context, None, events)
    port = int(gate.bind(server, "tcp://127.0.0.1:0", "control").rpartition(":")[2])
    for _ in range(3):
        came_and_went(port)
    with socket.create_connection(("127.0.0.1", port), timeout=30) as here:
        welcomed(here)
        gate.start()
        assert not events.within("TOO_LARGE", 0.5)
        wait_for(lambda: knows_one(gate))
        here.sendall(message(b"x" * 5000))  # this one itself is still told of
        assert events.wait("TOO_LARGE") == {"level": 1, "channel": "control"}
    gate.close()
    assert events.codes() == ["TOO_LARGE"]


def test_a_backlog_is_worked_off_and_leaves_nothing_behind(server: "zmq.Socket[bytes]", events: Events) -> None:
    gate = Gate(server.context, None, events)
    port = int(gate.bind(server, "tcp://127.0.0.1:0", "control").rpartition(":")[2])
    for _ in range(100):  # 200 events, more than one turn takes
        came_and_went(port)
    (monitored,) = gate._monitors.values()
    gate.start()
    with socket.create_connection(("127.0.0.1", port), timeout=30) as here:
        welcomed(here)
        wait_for(lambda: knows_one(gate))
        here.sendall(message(b"x" * 5000))
        assert events.wait("TOO_LARGE") == {"level": 1, "channel": "control"}
    wait_for(lambda: not monitored.ahead)
    gate.close()
    assert not monitored.ends
    assert events.codes() == ["TOO_LARGE"]
