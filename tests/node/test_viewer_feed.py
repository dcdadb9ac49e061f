"""The feed of a page: who may open it, what it gives, and what hostile clients can do with it. No browser."""

import contextlib
import logging
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from cameras import until
from viewer_clients import (
    TOKEN,
    WAIT_S,
    farewell,
    get,
    hear,
    host_of,
    lonely_viewer,
    nobody,
    open_feed,
    raw_feed,
    say,
)
from websockets.exceptions import ConnectionClosed, InvalidStatus

from gcd_node.viewer.server import MOST_BROWSERS, ViewerServer

pytestmark = pytest.mark.timeout(90)


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[ViewerServer]:
    with lonely_viewer(tmp_path) as opened:
        yield opened


# The feed.


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://{host}", "http://localhost", ""]
)
def test_a_foreign_page_cannot_open_the_feed(viewer: ViewerServer, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        open_feed(viewer, origin.format(host=host_of(viewer)))
    assert refused.value.response.status_code == 403


def test_who_comes_is_a_viewer_until_the_token_is_shown(viewer: ViewerServer) -> None:
    with open_feed(viewer) as feed:
        say(feed, type="hello")
        assert hear(feed, "role")["role"] == "viewer"
        say(feed, type="hello", token=TOKEN + "x")
        assert hear(feed, "role", lambda told: told["refused"])["role"] == "viewer"
        say(feed, type="hello", token=TOKEN)
        assert hear(feed, "role", lambda told: not told["refused"])["role"] == "operator"


def test_the_token_is_in_no_log(viewer: ViewerServer, caplog: pytest.LogCaptureFixture) -> None:
    for name in (None, "gcd_node", "websockets", "websockets.server"):
        caplog.set_level(logging.DEBUG, logger=name)
    with open_feed(viewer) as feed:
        say(feed, type="hello", token=TOKEN)
        assert hear(feed, "role")["role"] == "operator"
    told = [record.getMessage() for record in caplog.records if record.name != "websockets.client"]  # our own end
    assert not [line for line in told if TOKEN in line]


@pytest.mark.parametrize(("role", "verbs"), [("viewer", ("set_view", "set_param", "get_config")), ("operator", ())])
def test_what_a_page_may_not_ask_is_refused_without_asking_the_node(
    viewer: ViewerServer, role: str, verbs: tuple[str, ...]
) -> None:
    with open_feed(viewer) as feed:
        if role == "operator":
            say(feed, type="hello", token=TOKEN)
        for verb in (*verbs, "shutdown", "remove_view", "record_start", "nonsense"):
            say(feed, type="ask", id=1, verb=verb, args={"view": "main"})
            reply = hear(feed, "reply")
            assert (reply["id"], reply["ok"], reply["code"]) == (1, False, "FORBIDDEN")


def test_a_node_without_a_control_socket_takes_no_commands(tmp_path: Path) -> None:
    node = nobody(tmp_path, control=False)
    with ViewerServer("127.0.0.1:0", node, TOKEN) as viewer, open_feed(viewer) as feed:
        assert hear(feed, "welcome")["commands"] is False
        say(feed, type="hello", token=TOKEN)
        say(feed, type="ask", id=1, verb="describe")
        reply = hear(feed, "reply")
        assert reply["code"] == "FORBIDDEN"
        assert "[control]" in reply["message"]


def test_a_ninth_page_is_asked_to_wait(viewer: ViewerServer) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(MOST_BROWSERS):
            stack.enter_context(open_feed(viewer))
        until(lambda: len(viewer.browsers) == MOST_BROWSERS)
        with open_feed(viewer) as ninth:
            assert farewell(ninth)[0] == 1013
        assert get(viewer, "/")[0] == 200
    until(lambda: not viewer.browsers)
    with open_feed(viewer) as feed:
        assert hear(feed, "beat")


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        ("x" * 5000, 1009),
        ("{}", 1008),
        ("[" * 4000, 1008),
        ('{"type":"watch","view":"../x"}', 1008),
        ('{"type":"got","number":1,"more":2}', 1008),
        (b"\x00\x01", 1008),
    ],
)
def test_who_sends_what_no_page_sends_is_sent_away(viewer: ViewerServer, sent: str | bytes, code: int) -> None:
    with open_feed(viewer) as other, open_feed(viewer) as feed:
        feed.send(sent)
        assert farewell(feed)[0] == code
        assert hear(other, "beat")


def test_a_flood_is_cut_off_and_others_do_not_notice(viewer: ViewerServer) -> None:
    with open_feed(viewer) as other, open_feed(viewer) as feed:
        with contextlib.suppress(ConnectionClosed):
            for number in range(100_000):
                say(feed, type="got", number=number)
        assert farewell(feed)[0] == 1008
        assert hear(other, "beat")
        say(other, type="hello", token=TOKEN)
        assert hear(other, "role")["role"] == "operator"


def test_the_end_waits_for_nobody_and_leaves_nothing_behind(tmp_path: Path) -> None:
    viewer = ViewerServer("127.0.0.1:0", nobody(tmp_path))
    host, port = host_of(viewer).split(":")
    hanging = [raw_feed(viewer) for _ in range(3)]
    silent = socket.create_connection((host, int(port)), WAIT_S)
    with open_feed(viewer) as feed:
        hear(feed, "beat")
        viewer.close()
        assert farewell(feed) == (1001, "the viewer has ended")
    viewer.close()
    for each in [*hanging, silent]:
        each.close()
    until(lambda: not [each.name for each in threading.enumerate() if each.name.startswith("viewer")])
