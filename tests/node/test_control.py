"""The control server and its client over real sockets, with plain ZeroMQ sockets as strangers have them, and as
`gcd-node ctl` and `gcd-node keys`; requests as bytes."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zmq
from cameras import until
from fakes import FakeNode
from wire_messages import origin

from gcd_client.control import ControlClient, Reply, decode_reply
from gcd_client.endpoints import fingerprint, read_key_pair
from gcd_client.protocol import PROTO
from gcd_node.auth import Socket, load_server_security
from gcd_node.cli.main import run_app
from gcd_node.config import PublishConfig, SecurityConfig
from gcd_node.control import ControlServer, FloodGuard, ReplyCache
from gcd_node.publisher import Publisher
from gcd_node.verbs import VERBS, RequestError, parse_command

Capture = pytest.CaptureFixture[str]


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


def test_a_request_reaches_the_node_once_and_typed_but_time_never_waits_for_it(
    client: ControlClient, node: FakeNode
) -> None:
    received, left = client.call("time")["t_rx"], client.call("time")["t_tx"]
    assert received <= left
    assert node.heard == []
    reply = client.request("hello", request_id="abc")
    assert (reply.id, reply.ok, reply.code, reply.state) == ("abc", True, "OK", "active")
    assert reply.result == {"role": "operator"}
    assert client.call("set_view", {"view": "top", "azimuth_deg": 30.0}) == {"view_rev": 2}
    assert [command.verb for command in node.heard] == ["hello", "set_view"]


@pytest.mark.parametrize("result", [{"a": object()}, {"a": 1 << 70}])
def test_whatever_happens_is_answered_without_code(
    client: ControlClient, node: FakeNode, result: dict[str, object]
) -> None:
    node.result = result  # which is no JSON
    assert client.request("stats").code in ("INTERNAL", "OK")
    assert client.request("configure").message == "no model here"
    reply = client.request("cleanup")
    assert reply.code == "INTERNAL"
    assert "secret" not in reply.message
    assert client.request("hello").ok


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


def test_f17_oversize_is_refused_and_a_huge_one_drops_its_sender(
    stranger: Socket, client: ControlClient, node: FakeNode
) -> None:
    assert asked(stranger, wire("set_view", "a", args={"view": "top", "pad": "x" * 100_000})).code == "TOO_LARGE"
    assert node.await_event("TOO_LARGE") == {"level": 1, "channel": "control"}
    stranger.send(wire("set_view", "b", args={"view": "top", "pad": "x" * 300_000}))
    assert not stranger.poll(300)
    assert client.request("hello").ok
    until(lambda: is_answered(stranger))  # it reconnects by itself
    assert node.view_rev == 1


def test_closing_lets_the_last_reply_out_and_leaves_nothing(tmp_path: Path, node: FakeNode) -> None:
    threads = threading.active_count()
    with node.serve(f"ipc://{tmp_path}/c") as server, ControlClient(server.endpoint, timeout_s=20.0) as client:
        assert client.request("shutdown").ok
        server.close()
        server.close()
    assert not (tmp_path / "c").exists()
    assert threading.active_count() == threads


IDENTITY = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
EXAMPLES: dict[str, dict[str, object]] = {
    "set_view": {"view": "top", "kind": "orbit", "azimuth_deg": 10, "rate_deg_s": 5, "amplitude_deg": 30},
    "set_pose": {"view": "top", "pose": [0, -2, -3, 0, 0, 0, 1]},
    "remove_view": {"view": "top"},
    "align_view": {"view": "top"},
    "set_param": {"steps": 5, "guidance": [1, 1.5], "seed": 7, "publish": "jpeg", "jpeg_quality": 80},
}


def refused(part: bytes) -> RequestError:
    with pytest.raises(RequestError) as caught:
        parse_command(part)
    return caught.value


def test_every_verb_is_read_as_its_own_struct() -> None:
    for name, verb in VERBS.items():
        command = parse_command(wire(name, args=EXAMPLES.get(name, {})))
        assert (command.verb, type(command.args)) == (name, verb.arguments)
    assert parse_command(wire("remove_view", args={"view": "a"}, if_view_rev=2)).if_view_rev == 2


def test_f16_another_protocol_keeps_the_short_printable_id() -> None:
    for changes, code in (
        *(({"proto": proto}, ("BAD_PROTO", "a1")) for proto in ("gcd/2.0", "", None, "gcd/1.0\n")),
        *(({"id": each}, ("BAD_ARG", "")) for each in ("", "x" * 65, "a\n", 7, "é")),
        ({"verb": "set_veiw"}, ("UNKNOWN_VERB", "a1")),
        ({"if_view_rev": 2}, ("BAD_ARG", "a1")),  # without a view
    ):
        error = refused(json.dumps({"proto": PROTO, "id": "a1", "verb": "activate", **changes}).encode())
        assert (error.code, error.request_id) == code
        assert code[0] != "UNKNOWN_VERB" or "set_view" in str(error)  # the nearest


def test_f14_a_wrong_argument_is_bad_arg_and_named() -> None:
    for args, says in (
        ({}, "view"),
        ({"view": "top\n"}, "view"),
        ({"view": "top", "azimut_deg": 1}, "azimuth_deg"),
        ({"view": "top", "azimuth_deg": "30"}, "azimuth_deg"),
        ({"view": "top", "kind": "spiral"}, "kind"),
        ({"view": "top", "T_src_dst": IDENTITY[:15]}, "T_src_dst"),
        ({"view": "top", "T_src_dst": IDENTITY, "radius": 1}, "radius, or"),
        ({"view": "top", "source_from_view": IDENTITY}, "source_from_view"),
        ({"view": "top", "kind": "orbit"}, "rate_deg_s"),
        ({"view": "top", "rate_deg_s": 3}, "rate_deg_s"),
        ([], "array"),
    ):
        error = refused(wire("set_view", args=args))
        assert error.code == "BAD_ARG"
        assert says in str(error)


def test_f14_out_of_range_gives_the_allowed_interval() -> None:
    for args, arg, allowed in (
        ({"steps": 0}, "steps", [1, 1000]),
        ({"jpeg_quality": 49}, "jpeg_quality", [50, 100]),
        ({"seed": 2**53}, "seed", [0, 2**53 - 1]),
        ({"guidance": [1.0, -0.5]}, "guidance", [0, 100]),
    ):
        error = refused(wire("set_param", args=args))
        assert (error.code, error.result) == ("OUT_OF_RANGE", {"allowed": {arg: allowed}})


@pytest.fixture
def ctl(tmp_path: Path, node: FakeNode) -> Iterator[Callable[..., int]]:
    """Runs `gcd-node ctl` on a node; gives its exit code."""
    with node.serve(f"ipc://{tmp_path}/c") as server:
        yield lambda *words: run_app(["ctl", *words, "--endpoint", server.endpoint, "--timeout", "20"])


def test_ctl_shows_the_result_as_json_or_what_is_allowed(
    ctl: Callable[..., int], node: FakeNode, capsys: Capture
) -> None:
    assert ctl("set_view", "view=top", "azimuth_deg=30") == 0
    headline, _, result = capsys.readouterr().out.partition("\n")
    assert (headline, json.loads(result)) == ("OK (the node is active)", {"view_rev": 2})
    assert ctl("remove_view", "view=1") == 0
    assert msgspec.to_builtins(node.heard[-1].args) == {"view": "1"}  # a name is text
    assert ctl("set_view", "view=top", "azimuth_deg=120") == 70
    assert "OUT_OF_RANGE" in (said := capsys.readouterr().err)
    assert "[-90,90]" in said


@pytest.mark.parametrize(
    "words",
    [
        *(["remove_view", *settings] for settings in (["view"], ["=top"], ["view=a", "view=b"])),
        ["hello", "--keys", "k"],
    ],
)
def test_ctl_wants_key_value_once_and_both_keys_or_none(words: list[str]) -> None:
    assert run_app(["ctl", *words]) == 64


def test_keys_made_on_the_command_line_open_the_door(tmp_path: Path, capsys: Capture, node: FakeNode) -> None:
    assert [run_app(["keys", "new", str(tmp_path / name)]) for name in ("node", "desk")] == [0, 0]
    shown, pair = capsys.readouterr().out, read_key_pair(tmp_path / "desk")
    assert (pair.secret in shown, fingerprint(pair.public) in shown) == (False, True)
    assert run_app(["keys", "show", str(tmp_path / "desk")]) == 0
    assert capsys.readouterr().out in shown
    stanza = shown[shown.rindex("[client.NAME]") :].replace("NAME", "desk")
    (tmp_path / "allow.toml").write_text(stanza)
    security = load_server_security(SecurityConfig(keys=str(tmp_path / "node"), allow=str(tmp_path / "allow.toml")))
    keys = ["--timeout", "20", "--keys", str(tmp_path / "desk"), "--node-key", str(tmp_path / "node" / "public.key")]
    endpoints = PublishConfig(data=f"ipc://{tmp_path}/data", status="tcp://127.0.0.1:0")
    with Publisher(endpoints, security=security) as publisher:
        publisher.note("status", origin(), {"state": "active", "level": 0})
        assert run_app(["status", publisher.status_endpoint, "--once", *keys]) == 0
        capsys.readouterr()
    with node.serve("tcp://127.0.0.1:0", security=security) as server:
        line = ["ctl", "hello", "--json", "--endpoint", server.endpoint, *keys]
        assert run_app(line) == 0
        assert json.loads(capsys.readouterr().out)["result"] == {"role": "viewer"}
        assert run_app([*line[:1], "activate", *line[3:]]) == 70
        assert "FORBIDDEN" in capsys.readouterr().err


@pytest.mark.slow
def test_who_talks_to_a_running_node_does_not_wait_for_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from gcd_node.cli.main import run_app; "
        f"ends = run_app(['-v', 'ctl', 'state', '--endpoint', 'ipc://{tmp_path}/none', '--timeout', '0.1']); "
        f"ends += run_app(['status', 'ipc://{tmp_path}/none', '--once', '--timeout', '0.1']); "
        f"ends += run_app(['view', 'ipc://{tmp_path}/none', '--timeout', '0.1']); "
        "ends += sum(run_app([name, '--help']) for name in ('run', 'check', 'demo', 'bench')); "
        "print(ends, sorted({'torch', 'cv2', 'kornia'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "207 []", done.stderr
