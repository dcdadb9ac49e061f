"""The control server and its client over real sockets, and with plain ZeroMQ sockets as strangers have them."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from cameras import until
from control_fakes import Events, FakeCommands

from gcd_client.control import ControlClient, Reply, decode_reply
from gcd_client.protocol import PROTO
from gcd_node.auth import Client, Socket
from gcd_node.control import ControlServer, FloodGuard, ReplyCache

pytestmark = pytest.mark.timeout(90)

VIEWER, OPERATOR = Client(name="eye", role="viewer"), Client(name="hand", role="operator")


@pytest.fixture
def commands() -> FakeCommands:
    return FakeCommands()


@pytest.fixture
def events() -> Events:
    return Events()


@pytest.fixture
def server(tmp_path: Path, commands: FakeCommands, events: Events) -> Iterator[ControlServer]:
    with ControlServer(f"ipc://{tmp_path}/control", commands.handle, lambda: "active", events, ignore_s=1.0) as made:
        yield made


@pytest.fixture
def client(server: ControlServer) -> Iterator[ControlClient]:
    with ControlClient(server.endpoint, timeout_s=20.0, attempts=1) as made:
        yield made


@pytest.fixture
def stranger(server: ControlServer) -> Iterator[Socket]:
    """A DEALER that knows nothing of our client."""
    with zmq.Context() as context:
        made = context.socket(zmq.DEALER)
        made.set(zmq.LINGER, 0)
        made.connect(server.endpoint)
        yield made
        context.destroy(linger=0)


def wire(verb: str, request_id: str = "a1", **more: object) -> bytes:
    return json.dumps({"proto": PROTO, "id": request_id, "verb": verb, **more}).encode()


def asked(stranger: Socket, *parts: bytes) -> Reply:
    stranger.send_multipart(parts)
    assert stranger.poll(20_000), "no reply"
    return decode_reply(stranger.recv())


# Asking and commanding


def test_a_reply_says_who_asked_and_in_which_state_the_node_is(client: ControlClient) -> None:
    reply = client.request("hello", request_id="abc")
    assert (reply.id, reply.ok, reply.code, reply.state) == ("abc", True, "OK", "active")
    assert reply.result == {"role": "operator"}


def test_a_command_reaches_the_node_once_and_typed(client: ControlClient, commands: FakeCommands) -> None:
    assert client.call("set_view", {"view": "top", "azimuth_deg": 30.0}) == {"view_rev": 2}
    assert [command.verb for command, _ in commands.heard] == ["set_view"]


def test_time_never_waits_for_the_node(client: ControlClient, commands: FakeCommands) -> None:
    received, left = client.call("time")["t_rx"], client.call("time")["t_tx"]
    assert isinstance(received, list)
    assert isinstance(left, list)
    assert received <= left
    assert commands.heard == []


def test_an_error_of_the_node_is_internal_and_shows_no_code(client: ControlClient) -> None:
    assert client.request("configure").message == "no model here"
    reply = client.request("cleanup")
    assert reply.code == "INTERNAL"
    assert "secret" not in reply.message
    assert client.request("hello").ok


@pytest.mark.parametrize("result", [{"a": object()}, {"a": 1 << 70}])
def test_a_result_that_is_no_json_is_internal(
    client: ControlClient, commands: FakeCommands, result: dict[str, object]
) -> None:
    commands.result = result
    assert client.request("stats").code in ("INTERNAL", "OK")
    assert client.request("hello").ok


# Repeats


def test_the_same_id_for_another_request_is_refused(client: ControlClient, commands: FakeCommands) -> None:
    client.request("set_view", {"view": "top"}, request_id="same")
    reply = client.request("set_view", {"view": "top", "azimuth_deg": 5.0}, request_id="same")
    assert reply.code == "BAD_ARG"
    assert commands.view_rev == 2


def test_replies_are_forgotten_in_time_and_kept_within_bounds() -> None:
    cache = ReplyCache(60.0, most_bytes=10_000)
    cache.keep("a", b"?", b"1", 0.0)
    assert cache.find("a", b"?", 59.9) == b"1"
    assert cache.find("a", b"?", 60.0) is None
    for i in range(50):
        cache.keep(i, b"?", b"x", 61.0)
    assert [cache.find(i, b"?", 62.0) is None for i in (0, 49)] == [True, False]
    cache.keep("big", b"?" * 4000, b"x" * 4900, 62.0)
    assert [cache.find(i, b"?", 62.0) is None for i in (48, 49)] == [True, False]
    assert cache.find("big", b"?" * 4000, 63.0) == b"x" * 4900


# Strangers


@pytest.mark.parametrize("part", [b"", b"{", b"\xff", b"[" * 30_000])
def test_f16_malformed_json_is_answered_and_the_connection_kept(stranger: Socket, part: bytes) -> None:
    reply = asked(stranger, part)
    assert (reply.id, reply.code, reply.state) == ("", "BAD_JSON", "active")
    assert asked(stranger, wire("hello")).ok


def test_f16_a_request_in_two_parts_is_refused(stranger: Socket) -> None:
    assert asked(stranger, b"", wire("hello")).code == "BAD_JSON"


def test_f16_a_flood_is_ignored_and_others_are_not(stranger: Socket, client: ControlClient, events: Events) -> None:
    for _ in range(60):
        stranger.send(b"{")
    assert events.wait("CONTROL_FLOOD")["ignored_s"] == 1.0
    assert client.request("hello").ok
    while stranger.poll(100):
        assert decode_reply(stranger.recv()).code == "BAD_JSON"
    stranger.send(wire("hello", "ignored"))
    assert not stranger.poll(100)
    until(lambda: _answered(stranger))


def _answered(stranger: Socket) -> bool:
    stranger.send(wire("hello", "later"))
    return bool(stranger.poll(100))


def test_f16_the_guard_counts_each_peer_by_itself_and_only_the_last_second() -> None:
    guard = FloodGuard(5.0)
    assert not any(guard.bad(b"slow", 0.06 * i) for i in range(200))
    assert [guard.bad(b"fast", 0.01 * i) for i in range(21)] == [False] * 20 + [True]
    assert guard.ignores(b"fast", 5.1)
    assert not guard.ignores(b"slow", 5.1)
    assert not guard.ignores(b"fast", 5.21)
    assert [guard.bad(b"fast", 6.0 + 0.01 * i) for i in range(21)] == [False] * 20 + [True]


def test_f17_an_oversize_request_is_refused_and_reported(
    stranger: Socket, client: ControlClient, events: Events, commands: FakeCommands
) -> None:
    too_large = wire("set_view", "big", args={"view": "top", "pad": "x" * 100_000})
    assert asked(stranger, too_large).code == "TOO_LARGE"
    assert events.wait("TOO_LARGE") == {"level": 1, "channel": "control"}
    assert client.request("hello").ok
    assert commands.view_rev == 1


def test_f17_a_huge_request_drops_its_sender_alone(
    stranger: Socket, client: ControlClient, commands: FakeCommands
) -> None:
    assert asked(stranger, wire("hello", "before")).ok
    stranger.send(wire("set_view", "big", args={"view": "top", "pad": "x" * 300_000}))
    assert not stranger.poll(300)
    assert client.request("hello").ok
    until(lambda: _answered(stranger))  # it reconnects by itself
    assert commands.view_rev == 1


# Life


def test_closing_lets_the_last_reply_out_and_leaves_nothing(
    tmp_path: Path, commands: FakeCommands, events: Events
) -> None:
    threads = threading.active_count()
    server = ControlServer(f"ipc://{tmp_path}/c", commands.handle, lambda: "active", events)
    with ControlClient(server.endpoint, timeout_s=20.0) as client:
        assert client.request("shutdown").ok
        server.close()
        server.close()
    assert not (tmp_path / "c").exists()
    assert threading.active_count() == threads
