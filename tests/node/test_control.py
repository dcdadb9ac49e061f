"""The control server and its client over real sockets, and with plain ZeroMQ sockets as strangers have them."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from cameras import until
from fakes import FakeNode

from gcd_client.control import ControlClient, Reply, decode_reply
from gcd_client.protocol import PROTO
from gcd_node.auth import Socket
from gcd_node.control import ControlServer, FloodGuard, ReplyCache

pytestmark = pytest.mark.timeout(90)


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def server(tmp_path: Path, node: FakeNode) -> Iterator[ControlServer]:
    with node.serve(f"ipc://{tmp_path}/control", ignore_s=1.0) as made:
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


def is_answered(stranger: Socket) -> bool:
    stranger.send(wire("hello", "later"))
    return bool(stranger.poll(100))


# Asking and commanding


def test_a_request_reaches_the_node_once_and_typed_and_is_answered(client: ControlClient, node: FakeNode) -> None:
    reply = client.request("hello", request_id="abc")
    assert (reply.id, reply.ok, reply.code, reply.state) == ("abc", True, "OK", "active")
    assert reply.result == {"role": "operator"}
    assert client.call("set_view", {"view": "top", "azimuth_deg": 30.0}) == {"view_rev": 2}
    assert [command.verb for command in node.heard] == ["hello", "set_view"]


def test_time_never_waits_for_the_node(client: ControlClient, node: FakeNode) -> None:
    received, left = client.call("time")["t_rx"], client.call("time")["t_tx"]
    assert isinstance(received, list)
    assert isinstance(left, list)
    assert received <= left
    assert node.heard == []


@pytest.mark.parametrize("result", [{"a": object()}, {"a": 1 << 70}])
def test_whatever_the_node_does_is_answered_and_shows_no_code(
    client: ControlClient, node: FakeNode, result: dict[str, object]
) -> None:
    node.result = result  # which is no JSON
    assert client.request("stats").code in ("INTERNAL", "OK")
    assert client.request("configure").message == "no model here"
    reply = client.request("cleanup")
    assert reply.code == "INTERNAL"
    assert "secret" not in reply.message
    assert client.request("hello").ok


# Repeats


def test_the_same_id_is_one_request(client: ControlClient, node: FakeNode) -> None:
    first, again = (client.request("set_view", {"view": "top"}, request_id="same") for _ in range(2))
    other = client.request("set_view", {"view": "top", "azimuth_deg": 5.0}, request_id="same")
    assert again == first
    assert other.code == "BAD_ARG"
    assert node.view_rev == 2


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


@pytest.mark.parametrize("parts", [[b""], [b"{"], [b"\xff"], [b"[" * 30_000], [b"", wire("hello")]])
def test_f16_a_malformed_request_is_answered_and_the_connection_kept(stranger: Socket, parts: list[bytes]) -> None:
    reply = asked(stranger, *parts)
    assert (reply.id, reply.code, reply.state) == ("", "BAD_JSON", "active")
    assert asked(stranger, wire("hello")).ok


def test_f16_a_flood_is_ignored_and_others_are_not(stranger: Socket, client: ControlClient, node: FakeNode) -> None:
    for _ in range(60):
        stranger.send(b"{")
    assert node.await_event("CONTROL_FLOOD")["ignored_s"] == 1.0
    assert client.request("hello").ok
    while stranger.poll(100):
        assert decode_reply(stranger.recv()).code == "BAD_JSON"
    stranger.send(wire("hello", "ignored"))
    assert not stranger.poll(100)
    until(lambda: is_answered(stranger))


def test_f16_the_guard_counts_each_peer_by_itself_and_only_the_last_second() -> None:
    guard = FloodGuard(5.0)
    assert not any(guard.bad(b"slow", 0.06 * i) for i in range(200))
    assert [guard.bad(b"fast", 0.01 * i) for i in range(21)] == [False] * 20 + [True]
    assert not any(guard.bad(b"%d" % i, 0.3) for i in range(300))
    assert guard.ignores(b"fast", 5.1)
    assert not guard.ignores(b"slow", 5.1)
    assert not guard.ignores(b"fast", 5.21)
    assert [guard.bad(b"fast", 6.0 + 0.01 * i) for i in range(21)] == [False] * 20 + [True]


def test_f17_an_oversize_request_is_refused_and_reported_and_a_huge_one_drops_its_sender_alone(
    stranger: Socket, client: ControlClient, node: FakeNode
) -> None:
    assert asked(stranger, wire("set_view", "a", args={"view": "top", "pad": "x" * 100_000})).code == "TOO_LARGE"
    assert node.await_event("TOO_LARGE") == {"level": 1, "channel": "control"}
    stranger.send(wire("set_view", "b", args={"view": "top", "pad": "x" * 300_000}))
    assert not stranger.poll(300)
    assert client.request("hello").ok
    until(lambda: is_answered(stranger))  # it reconnects by itself
    assert node.view_rev == 1


# Life


def test_closing_lets_the_last_reply_out_and_leaves_nothing(tmp_path: Path, node: FakeNode) -> None:
    threads = threading.active_count()
    server = node.serve(f"ipc://{tmp_path}/c")
    with ControlClient(server.endpoint, timeout_s=20.0) as client:
        assert client.request("shutdown").ok
        server.close()
        server.close()
    assert not (tmp_path / "c").exists()
    assert threading.active_count() == threads
