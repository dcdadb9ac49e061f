"""Keys on disk, the list of clients, and who gets through to a secured node over tcp."""

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cameras import until
from fakes import CLIENTS, NODE, OPERATOR, SECURITY, VIEWER, FakeNode
from wire_messages import window

from gcd_client.control import ControlClient
from gcd_client.endpoints import AuthError, ClientKeys, KeyPair, SetupError, fingerprint, read_key_pair
from gcd_client.subscriber import ReceivedView, ViewSubscriber
from gcd_node.auth import AllowList, Client, ServerSecurity, load_server_security, new_key_pair, write_key_pair
from gcd_node.config import PublishConfig, SecurityConfig
from gcd_node.control import ControlServer
from gcd_node.errors import ConfigError, NodeError, OutputError
from gcd_node.publisher import Publisher

STRANGER = new_key_pair()
LOOPBACK = "tcp://127.0.0.1:0"


def keys(own: KeyPair, server: KeyPair = NODE) -> ClientKeys:
    return ClientKeys(own=own, server=server.public)


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def server(node: FakeNode) -> Iterator[ControlServer]:
    with node.serve(LOOPBACK, security=SECURITY) as made:
        yield made


@pytest.fixture
def publisher(node: FakeNode) -> Iterator[Publisher]:
    endpoints = PublishConfig(data=LOOPBACK, status=LOOPBACK)
    with Publisher(endpoints, node.event, security=SECURITY, linger_ms=100) as made:
        yield made


def ask(server: ControlServer, who: ClientKeys | None, verb: str, timeout_s: float = 20.0) -> str:
    """The code of the reply."""
    with ControlClient(server.endpoint, keys=who, timeout_s=timeout_s) as client:
        return client.request(verb, {"view": "top"} if verb == "set_view" else None).code


def heard(reader: ViewSubscriber) -> ReceivedView | None:
    """What arrives soon, None if the node does not let the reader in."""
    try:
        return reader.receive(200)
    except AuthError:
        return None


def test_f18_unknown_keys_get_no_reply_and_viewers_no_command(server: ControlServer, node: FakeNode) -> None:
    with pytest.raises(AuthError) as caught:
        ask(server, keys(STRANGER), "hello")
    assert caught.value.exit_code == 77
    first = {"fingerprint": fingerprint(STRANGER.public), "domain": "gcd.control", "address": "127.0.0.1"}
    assert node.await_event("AUTH_DENIED") == {"level": 1, **first, "suppressed": 0}
    for who in (STRANGER, STRANGER, *(new_key_pair() for _ in range(12))):
        with pytest.raises(AuthError):
            ask(server, keys(who), "hello")
    assert 2 <= node.codes.count("AUTH_DENIED") <= 8
    assert node.heard == []
    assert ask(server, keys(VIEWER), "set_view") == "FORBIDDEN"
    assert ask(server, keys(VIEWER), "hello") == "OK"
    assert [command.verb for command in node.heard] == ["hello"]


@pytest.mark.parametrize("who", [None, keys(STRANGER), keys(VIEWER, server=STRANGER)], ids=["plain", "key", "node"])
def test_f18_strangers_get_no_views_and_others_do(publisher: Publisher, node: FakeNode, who: ClientKeys | None) -> None:
    with (
        ViewSubscriber(publisher.endpoint, "top", keys=who) as stranger,
        ViewSubscriber(publisher.endpoint, "top", keys=keys(VIEWER)) as reader,
    ):
        until(lambda: publisher.stats.subscribers == 1)
        assert node.await_event("AUTH_DENIED")["domain"] == "gcd.data"
        publisher.send(window(3))
        received = reader.receive(20_000)
        assert received.header.window_id == 3
        assert heard(stranger) is None
        assert publisher.stats.subscribers == 1


def test_a_list_that_breaks_lets_nobody_in_and_goes_on() -> None:
    asked: list[str] = []

    def broken(key: str) -> Client | None:
        asked.append(key)
        if len(asked) == 1:
            raise RuntimeError(key)
        return CLIENTS.get(key)

    security = ServerSecurity(keys=NODE, find_client=broken)
    with Publisher(PublishConfig(data=LOOPBACK, status=LOOPBACK), security=security) as publisher:
        with ViewSubscriber(publisher.endpoint, "top", keys=keys(VIEWER)) as reader:
            until(lambda: len(asked) == 1)
            publisher.send(window())
            assert heard(reader) is None
        with ViewSubscriber(publisher.endpoint, "top", keys=keys(VIEWER)) as reader:
            until(lambda: publisher.stats.subscribers == 1)
            publisher.send(window())
            assert reader.receive(20_000) is not None


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("dies", [False, True])
def test_a_refusal_that_cannot_be_told_holds_up_no_end(dies: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []

    def closing(*event: object) -> bool:
        told.append(event)
        raise NodeError("the publisher is closed; make a new one")

    publisher = Publisher(PublishConfig(data=LOOPBACK, status=LOOPBACK), closing, security=SECURITY)
    if dies:
        monkeypatch.setattr(publisher.guard._authenticator, "callback", closing)
    with ViewSubscriber(publisher.endpoint, "top", keys=keys(STRANGER)):
        until(lambda: bool(told) and publisher.guard.threads[0].is_alive() is not dies)
    publisher.close()


def test_f19_where_a_node_may_be_reached(tmp_path: Path, node: FakeNode) -> None:
    before = os.umask(0)
    try:
        with node.serve(f"ipc://{tmp_path}/c"):  # never open to everybody
            assert stat.S_IMODE((tmp_path / "c").stat().st_mode) == 0o770
    finally:
        os.umask(before)
    with node.serve("tcp://0.0.0.0:0", security=SECURITY) as server:  # F19: with keys and clients
        port = server.endpoint.rpartition(":")[2]
        with ControlClient(f"tcp://127.0.0.1:{port}", keys=keys(VIEWER), timeout_s=20.0) as client:
            assert client.request("hello").ok
    with node.serve(LOOPBACK) as server, pytest.raises(AuthError):  # it uses no keys
        ask(server, keys(VIEWER), "hello")
    assert node.codes == []


@pytest.mark.parametrize(
    ("name", "mode", "text"),
    [
        ("secret.key", 0o640, NODE.secret),
        ("secret.key", 0o604, NODE.secret),
        ("secret.key", 0o600, "x" * 39),
        ("secret.key", 0o600, "~" * 40),
        ("public.key", 0o644, "x" * 39),
        ("public.key", 0o644, "~" * 40),
    ],
    ids=range(6),  # keys are random
)
def test_a_key_is_never_overwritten_and_a_damaged_one_or_a_secret_others_may_read_refused_and_never_shown(
    tmp_path: Path, name: str, mode: int, text: str
) -> None:
    write_key_pair(tmp_path, NODE)
    with pytest.raises(OutputError):
        write_key_pair(tmp_path, STRANGER)
    assert read_key_pair(tmp_path) == NODE
    (tmp_path / name).write_text(text)
    (tmp_path / name).chmod(mode)
    with pytest.raises(SetupError) as caught:
        read_key_pair(tmp_path)
    assert name == "public.key" or text not in str(caught.value)


def entry(name: str, pair: KeyPair, role: str = "viewer") -> str:
    return f'[client.{name}]\nkey = "{pair.public}"\nrole = "{role}"\n'


@pytest.fixture
def list_path(tmp_path: Path) -> Path:
    path = tmp_path / "allow.toml"
    path.write_text(entry("eye", VIEWER) + entry("hand", OPERATOR, "operator"))
    return path


@pytest.fixture
def listed(list_path: Path, node: FakeNode) -> AllowList:
    return AllowList(list_path, node.event)


def test_an_edited_list_counts_at_once(listed: AllowList, list_path: Path, node: FakeNode, tmp_path: Path) -> None:
    write_key_pair(tmp_path / "keys", NODE)
    security = load_server_security(SecurityConfig(keys=str(tmp_path / "keys"), allow=str(list_path)))
    assert security.keys == NODE
    assert {key: security.find_client(key) for key in (*CLIENTS, STRANGER.public)} == CLIENTS | {STRANGER.public: None}
    list_path.write_text(entry("hand", OPERATOR) + entry("late", STRANGER))
    assert listed.find(VIEWER.public) is None
    assert listed.find(STRANGER.public) == Client(name="late", role="viewer")
    assert listed.find(OPERATOR.public) == Client(name="hand", role="viewer")
    assert node.events == [("ALLOW_CHANGED", {"level": 0, "added": ["hand", "late"], "removed": ["eye", "hand"]})]
    list_path.write_text("[client]\n")  # nobody any more
    assert listed.find(OPERATOR.public) is None
    with pytest.raises(ConfigError):  # at a start that is an error
        AllowList(list_path)


SPOILT: dict[str, str | Callable[[Path], object]] = {
    "half": "[client.desk]\nkey = ",
    "one key twice": entry("eye", VIEWER) + entry("hand", VIEWER),
    "empty": "",
    "5,000 digits": "[client]\na = " + "9" * 5000,
    "short key": "[client.a]\nkey = 'short'",
    "no such role": entry("a", VIEWER, "root"),
    "misspelt": entry("a", VIEWER).replace("role", "rol"),
    "bad name": entry("'a b'", VIEWER),
    "gone": Path.unlink,
    "writable by all": lambda path: path.chmod(0o666),
}


@pytest.mark.parametrize("spoilt", SPOILT.values(), ids=SPOILT)
def test_a_broken_list_is_refused_at_a_start_and_later_leaves_in_who_was_in_and_is_reported_once(
    listed: AllowList, list_path: Path, node: FakeNode, spoilt: str | Callable[[Path], object]
) -> None:
    _ = list_path.write_text(spoilt) if isinstance(spoilt, str) else spoilt(list_path)
    with pytest.raises(ConfigError):
        AllowList(list_path)
    for _ in range(3):
        assert listed.find(VIEWER.public) is not None
        assert listed.find(STRANGER.public) is None
    assert [(code, fields["level"]) for code, fields in node.events] == [("ALLOW_REFUSED", 2)]
    list_path.unlink(missing_ok=True)
    list_path.write_text(entry("hand", OPERATOR))
    assert listed.find(VIEWER.public) is None
    assert node.codes == ["ALLOW_REFUSED", "ALLOW_CHANGED"]


def test_a_removed_key_gets_no_connection_and_a_role_counts_at_once(
    listed: AllowList, list_path: Path, node: FakeNode
) -> None:
    security = ServerSecurity(keys=NODE, find_client=listed.find)
    with (
        node.serve(LOOPBACK, security=security) as server,
        ControlClient(server.endpoint, keys=keys(OPERATOR), timeout_s=20.0) as hand,
    ):
        assert hand.request("set_view", {"view": "top"}).code == "OK"
        assert ask(server, keys(VIEWER), "hello") == "OK"
        list_path.write_text(entry("hand", OPERATOR))
        assert hand.request("set_view", {"view": "top"}).code == "FORBIDDEN"
        with pytest.raises(AuthError):
            ask(server, keys(VIEWER), "hello")
