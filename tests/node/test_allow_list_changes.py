"""The list of clients is edited while the node runs."""

import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from control_fakes import Events, FakeCommands, wait_for
from wire_messages import window

from gcd_node.control.client import ControlClient
from gcd_node.control.server import ControlOptions, ControlServer
from gcd_node.errors import AuthError, ConfigError, ControlError
from gcd_node.publisher import Publisher
from gcd_node.publishing.options import PublisherOptions
from gcd_node.security.allow_list import WatchedList
from gcd_node.security.connections import Connections
from gcd_node.security.gate import ServerSecurity, new_key_pair
from gcd_node.security.keys import Client, ClientKeys, KeyPair
from gcd_node.subscriber import ViewSubscriber

pytestmark = pytest.mark.timeout(90)

NODE, DESK, EYE, LATE = (new_key_pair() for _ in range(4))
LOOPBACK = "tcp://127.0.0.1:0"


def entry(name: str, pair: KeyPair, role: str = "viewer") -> str:
    return f'[client.{name}]\nkey = "{pair.public}"\nrole = "{role}"\n'


DESK_ALONE = entry("desk", DESK, "operator")
BOTH = DESK_ALONE + entry("eye", EYE)


class ListFile:
    """A list on disk, and a clock that goes on by half a second with each look."""

    def __init__(self, folder: Path) -> None:
        self.path, self.now_s, self.events = folder / "allow.toml", 0.0, Events()
        self.write(BOTH)
        self.watched = WatchedList(self.path, self.events, clock=lambda: self.now_s)

    def write(self, text: str) -> None:
        fresh = self.path.with_suffix(".new")
        fresh.write_text(text)
        fresh.replace(self.path)

    def look(self, times: int = 3) -> Mapping[str, Client]:
        for _ in range(times):
            self.now_s += 0.6
            self.watched.refresh()
        return self.watched.refresh()


@pytest.fixture
def listed(tmp_path: Path) -> ListFile:
    return ListFile(tmp_path)


def test_who_is_written_into_the_list_may_connect_and_who_is_taken_out_may_not(listed: ListFile) -> None:
    first = listed.look()
    assert listed.look() is first  # nothing changed
    listed.write(DESK_ALONE + entry("late", LATE))
    assert {client.name for client in listed.look().values()} == {"desk", "late"}
    assert listed.events.seen == [("ALLOW_CHANGED", {"level": 0, "added": ["late"], "removed": ["eye"]})]


def test_a_new_key_or_role_is_another_client(listed: ListFile) -> None:
    listed.write(entry("desk", DESK) + entry("eye", LATE))
    assert listed.look() == {
        DESK.public: Client(name="desk", role="viewer"),
        LATE.public: Client(name="eye", role="viewer"),
    }
    assert listed.events.seen[0][1] == {"level": 0, "added": ["desk", "eye"], "removed": ["desk", "eye"]}


def everybody_may_write(path: Path) -> None:
    path.chmod(0o666)


SPOILT: dict[str, Callable[[Path], object]] = {
    "half": lambda path: path.write_text("[client.desk]\nkey = "),
    "one key twice": lambda path: path.write_text(entry("desk", DESK) + entry("eye", DESK)),
    "empty": lambda path: path.write_text(""),
    "gone": Path.unlink,
    "writable by all": everybody_may_write,
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_list_that_cannot_be_used_changes_nothing_and_is_told_of_once(
    listed: ListFile, spoil: Callable[[Path], object]
) -> None:
    before = listed.look()
    spoil(listed.path)
    assert listed.look(5) is before
    assert listed.events.codes() == ["ALLOW_REFUSED"]
    assert listed.events.seen[0][1]["level"] == 2
    listed.write(DESK_ALONE)
    assert list(listed.look()) == [DESK.public]
    assert listed.events.codes() == ["ALLOW_REFUSED", "ALLOW_CHANGED"]


def test_a_file_that_is_still_being_written_is_not_read(listed: ListFile) -> None:
    before = listed.look()
    for size in range(1, 40):
        listed.path.write_text(BOTH[:size])
        assert listed.look(1) is before
    assert listed.events.seen == []


def test_the_last_client_can_be_taken_out_but_no_node_starts_without_one(listed: ListFile) -> None:
    listed.write("[client]\n")
    assert listed.look() == {}
    with pytest.raises(ConfigError, match="names no client"):
        WatchedList(listed.path)


# At the sockets


class Door:
    """A secured node's sockets, and the clients they let in."""

    def __init__(self) -> None:
        self.clients: Mapping[str, Client] = {
            DESK.public: Client(name="desk", role="operator"),
            EYE.public: Client(name="eye", role="viewer"),
        }
        security = ServerSecurity(keys=NODE, clients=self.clients, refresh=lambda: self.clients)
        self.events = Events()
        data = PublisherOptions(data=LOOPBACK, status=None, security=security, linger_ms=100)
        self.publisher = Publisher(data, self.events)
        options = ControlOptions(endpoint=LOOPBACK, security=security)
        self.server = ControlServer(options, FakeCommands(), lambda: "active", self.events)

    def asked(self, who: KeyPair, verb: str = "hello") -> str:
        with ControlClient(self.server.endpoint, keys=ours(who), timeout_s=20.0) as client:
            return client.request(verb, {"view": "top"} if verb == "set_view" else None).code


def ours(who: KeyPair) -> ClientKeys:
    return ClientKeys(own=who, server=NODE.public)


@pytest.fixture
def door() -> Iterator[Door]:
    made = Door()
    yield made
    made.server.close()
    made.publisher.close()


def test_a_reader_who_is_taken_off_the_list_is_cut_off_and_the_others_go_on(door: Door) -> None:
    endpoint = door.publisher.endpoint
    with (
        ViewSubscriber(endpoint, "top", keys=ours(EYE)) as eye,
        ViewSubscriber(endpoint, "top", keys=ours(DESK)) as desk,
    ):
        wait_for(lambda: door.publisher.stats.subscribers == 2)
        door.publisher.send(window())
        assert eye.receive(20_000) is not None
        assert desk.receive(20_000) is not None
        door.clients = {DESK.public: door.clients[DESK.public]}
        with pytest.raises(AuthError, match="not on its list"):
            eye.receive(20_000)
        wait_for(lambda: door.publisher.send(window()) and desk.receive(50) is not None)  # it has come again
        assert door.publisher.stats.subscribers == 1


def test_a_client_who_may_do_less_may_do_less_at_once(door: Door) -> None:
    assert door.asked(DESK, "set_view") == "OK"
    with ControlClient(door.server.endpoint, keys=ours(DESK), timeout_s=20.0, attempts=10) as client:
        assert client.request("set_view", {"view": "top"}).code == "OK"
        door.clients = {DESK.public: Client(name="desk", role="viewer")}
        wait_for(lambda: client.request("set_view", {"view": "top"}).code == "FORBIDDEN")
        assert client.request("hello").code == "OK"
    with pytest.raises((AuthError, ControlError)):
        door.asked(EYE)


def test_who_is_let_in_later_disturbs_nobody(door: Door) -> None:
    with ViewSubscriber(door.publisher.endpoint, "top", keys=ours(EYE)) as eye:
        wait_for(lambda: door.publisher.stats.subscribers == 1)
        door.clients = {**door.clients, LATE.public: Client(name="late", role="viewer")}
        wait_for(lambda: _is_let_in(door, LATE))  # the list is looked at once a second
        for _ in range(3):
            door.publisher.send(window())
            view = eye.receive(20_000)
            assert view is not None
            assert view.skipped == 0
    assert set(door.events.codes()) <= {"AUTH_DENIED"}


def _is_let_in(door: Door, who: KeyPair) -> bool:
    try:
        return door.asked(who) == "OK"
    except AuthError:
        return False


def test_another_socket_that_took_the_number_of_a_connection_is_not_cut() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        with socket.create_connection(listener.getsockname()) as near, listener.accept()[0] as far:
            connections = Connections()
            connections.accepted(far.fileno())
            assert connections.cut_all(port=1) == 0
            near.sendall(b"still there")
            assert far.recv(64) == b"still there"
            connections.accepted(far.fileno())
            assert connections.cut_all(listener.getsockname()[1]) == 0
            assert near.recv(64) == b""
