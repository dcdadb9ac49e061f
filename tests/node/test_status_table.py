"""`gcd-node status`: what a reader knows of a node, when it is stale, how it is drawn; through real sockets."""

import io
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from wire_messages import BOOT, OTHER_BOOT, origin

from gcd_client.protocol import OriginHeader, StatusMessage, StatusTopic
from gcd_node.auth import Client, ServerSecurity, new_key_pair, write_key_pair
from gcd_node.cli.main import run_app
from gcd_node.errors import StaleError
from gcd_node.health import Health, Level
from gcd_node.publisher import Publisher
from gcd_node.sockets import PublisherOptions
from gcd_node.watching.status_board import StatusBoard
from gcd_node.watching.status_table import StatusRequest, render_status, watch_status

pytestmark = pytest.mark.timeout(60)
WALL_NS = 1_800_000_000_000_000_000


def note(topic: StatusTopic, fields: Mapping[str, Any], *, boot_id: str = BOOT, late_s: float = 0.0) -> StatusMessage:
    header = OriginHeader(node_id="robot_7", boot_id=boot_id, t_publish_ns=WALL_NS - round(late_s * 1e9))
    return StatusMessage(topic=topic, header=header, fields=fields)


def board_of(*notes: StatusMessage, now_s: float = 10.0) -> StatusBoard:
    board = StatusBoard()
    for each in notes:
        board.add(each, now_s, WALL_NS)
    return board


def shown(board: StatusBoard, now_s: float = 10.0) -> str:
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(render_status(board, now_s))
    return console.export_text()


def working() -> dict[str, object]:
    """The status of a node at work."""
    health = Health()
    health.state("active")
    health.source("streaming")
    health.model("busy")
    health.expect(("topdown",), 3600.0)
    for i in range(11):
        health.frame(i * 100_000_000, time.monotonic_ns())
    health.published("topdown", 0.25)
    health.stage("render", 0.125)
    health.windows(5, {"WIN_GAP": 2})
    health.totals(slot=3, sent=5, subs=1, bytes=4130)
    return health.report()


# --- the board


def test_a_board_without_a_status_is_stale() -> None:
    board = StatusBoard()
    assert (board.level(0.0), board.known, board.silent_s(0.0)) == (Level.STALE, False, None)
    assert board.record(0.0) == {"level": 3, "stale": True}
    assert "no status yet" in shown(board)


def test_why_a_node_is_not_ready_is_named() -> None:
    assert "not ready: NOT_ACTIVE, SRC_NOT_STREAMING" in shown(board_of(note("status", Health().report())))


def test_a_status_holds_until_the_node_is_silent_for_three_seconds() -> None:
    board = board_of(note("status", {"level": 1, "reasons": ["fps"]}), now_s=10.0)
    assert [board.level(10.0 + ago) for ago in (0.0, 2.9, 3.1)] == [Level.WARN, Level.WARN, Level.STALE]
    assert board.record(12.0)["age_ms"] == 2000
    assert board.record(20.0)["level"] == 3
    assert "silent for 10 s" in shown(board, 20.0)


def test_a_first_status_that_was_kept_for_late_readers_is_as_old_as_it_says() -> None:
    board = board_of(note("status", {"level": 0}, late_s=60.0))
    assert board.level(10.0) is Level.STALE
    board.add(note("status", {"level": 0}, late_s=60.0), 11.0, WALL_NS)  # another machine's clock
    assert board.level(11.0) is Level.OK


def test_a_clock_that_is_ahead_makes_no_status_younger() -> None:
    board = board_of(note("status", {"level": 0}, late_s=-60.0), now_s=10.0)
    assert board.silent_s(10.5) == 0.5


def test_a_restarted_node_begins_anew() -> None:
    board = board_of(note("status", {"level": 2}), note("meta", {"fps": 10.0}))
    board.add(note("event", {"code": "HELLO"}, boot_id=OTHER_BOOT), 11.0, WALL_NS)
    assert (board.restarts, board.known, dict(board.meta)) == (1, False, {})
    board.add(note("status", {"level": 0}, boot_id=OTHER_BOOT), 11.0, WALL_NS)
    assert (board.restarts, board.level(11.0)) == (1, Level.OK)


def test_only_the_latest_events_are_kept() -> None:
    board = board_of(*(note("event", {"code": f"E{i}", "level": 1, "count": i}) for i in range(20)))
    assert [event.code for event in board.events] == [f"E{i}" for i in range(12, 20)]
    assert board.events[-1].details == {"count": 19}


# --- drawing


def test_a_working_node_is_shown_with_its_figures() -> None:
    text = shown(board_of(note("status", working()), note("event", {"code": "SRC_LOST", "level": 2, "epoch": 3})))
    for expected in (
        "OK",
        "robot_7",
        "active",
        "ready",
        "streaming, 10.0 FPS",
        "5 built, 2 rejected, 3 skipped",
        "WIN_GAP 2",
        "busy, 125.0 ms p50, 125.0 ms p99",
        "5 sent, 1 subscribed, 4130 B",
        "topdown",
        "slot 3",
        "capture_gap",
        "100.0",
        "SRC_LOST",
        "epoch 3",
    ):
        assert expected in text, expected


def test_a_dead_node_is_not_shown_as_if_it_lived() -> None:
    text = shown(board_of(note("status", working()), now_s=10.0), 20.0)
    headline = text.splitlines()[0]
    assert headline.split() == ["STALE", "robot_7", "silent", "for", "10", "s", "before:", "active"]
    assert "streaming" in text  # what it said last is still there


def test_every_figure_fits_into_80_columns() -> None:
    said = working() | {"views": {"a_long_view_name": {"last_ms": 12_345}, "another_long_one": {"last_ms": 3}}}
    board = board_of(note("status", said), note("event", {"code": "SRC_STALLED", "level": 1, "message": "no frame"}))
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(render_status(board, 10.0))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    for expected in ("a_long_view_name 12345 ms ago", "another_long_one 3 ms ago", "capture_gap", "125.0 ms p99"):
        assert expected in " ".join(text.split()), expected


HOSTILE: tuple[dict[str, Any], ...] = (
    {},
    {"level": "high", "reasons": "fps", "source": 3, "window": [], "stages": [1], "views": None, "drops": "many"},
    {"level": 77, "reasons": [1, None, "\x1b[2J"], "state": {"a": 1}, "window": {"reason_counts": [1]}},
    {
        "level": [],
        "stages": {"render": None, "[red]": {"p50_ms": "x" * 10_000}},
        "views": {"a": 5, "b": {"last_ms": {}}},
    },
    {"state": "[bold]\n\n", "source": {"state": "\r\x00" * 50, "fps": float("1e300")}, "ready": "yes"},
)


@pytest.mark.parametrize("fields", HOSTILE)
def test_whatever_a_node_says_is_drawn_without_harm(fields: dict[str, Any]) -> None:
    board = board_of(
        note("status", fields), note("event", {"code": ["\x1b"], "level": {}, "x": "[/]"}), note("meta", {})
    )
    text = shown(board)
    assert "robot_7" in text
    assert not {char for char in text if not char.isprintable()} - {"\n"}
    assert max(map(len, text.splitlines())) <= 140
    assert json.loads(json.dumps(board.record(10.0)))["node_id"] == "robot_7"


# --- over the wire


class Node:
    """Publishes a status every 0.1 s from a thread."""

    def __init__(self, endpoint: str, fields: dict[str, object]) -> None:
        self.publisher = Publisher(PublisherOptions(data=f"{endpoint}.data", status=endpoint))
        self._fields = fields
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._speak, daemon=True)
        self._thread.start()

    def _speak(self) -> None:
        while not self._stopped.is_set():
            self.publisher.note("status", origin(), self._fields)
            self._stopped.wait(0.1)

    def silence(self) -> None:
        self._stopped.set()
        self._thread.join(20)


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/status"


@pytest.fixture
def node(endpoint: str) -> Iterator[Node]:
    made = Node(endpoint, working())
    with made.publisher:
        yield made
        made.silence()


def test_once_gives_the_first_status(node: Node, endpoint: str) -> None:
    boards: list[StatusBoard] = []
    watch_status(StatusRequest(endpoint=endpoint, once=True, timeout_s=20.0), boards.append, lambda _: None)
    assert [board.node_id for board in boards] == ["gcd"]
    assert boards[0].level(time.monotonic()) is Level.OK


def test_a_watch_shows_a_node_that_falls_silent_as_stale(node: Node, endpoint: str) -> None:
    class SeenError(Exception):
        pass

    def look(board: StatusBoard) -> None:
        if board.known and not board.stale(time.monotonic()):
            node.silence()
        elif board.known:
            raise SeenError

    with pytest.raises(SeenError):
        watch_status(StatusRequest(endpoint=endpoint, timeout_s=0.5), look, lambda _: None)


def test_nobody_there_is_an_error_that_says_what_to_do(endpoint: str) -> None:
    with pytest.raises(StaleError, match=r"no status from ipc.* within 0.2 s: is the node running"):
        watch_status(StatusRequest(endpoint=endpoint, once=True, timeout_s=0.2), lambda _: None, lambda _: None)


def test_the_command_prints_a_table(node: Node, endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["status", endpoint, "--once", "--timeout", "20"]) == 0
    assert "streaming, 10.0 FPS" in capsys.readouterr().out


def test_the_command_prints_one_json_line(node: Node, endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["status", endpoint, "--once", "--json", "--timeout", "20"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    told = json.loads(line)
    assert (told["topic"], told["node_id"], told["stale"], told["level"]) == ("status", "gcd", False, 0)
    assert told["source"]["fps"] == 10.0


def test_the_command_ends_with_69_when_nobody_answers(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["status", endpoint, "--once", "--timeout", "0.2"]) == 69
    assert capsys.readouterr().err.startswith("error: no status from")


@pytest.mark.parametrize(("known", "code"), [(True, 0), (False, 77)])
def test_a_node_that_asks_for_keys_is_reached_with_them_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], known: bool, code: int
) -> None:
    node, ours, other = new_key_pair(), new_key_pair(), new_key_pair()
    clients = {(ours if known else other).public: Client(name="planner", role="viewer")}
    security = ServerSecurity(keys=node, find_client=clients.get)
    write_key_pair(tmp_path / "keys", ours)
    options = PublisherOptions(data=f"ipc://{tmp_path}/data", status="tcp://127.0.0.1:0", security=security)
    with Publisher(options) as publisher:
        publisher.note("status", origin(), working())
        assert publisher.status_endpoint is not None
        command = ["status", publisher.status_endpoint, "--once", "--timeout", "20"]
        assert run_app([*command, "--keys", str(tmp_path / "keys"), "--node-key", node.public]) == code
    told = capsys.readouterr()
    assert ("streaming, 10.0 FPS" in told.out) == known
    assert (told.err != "") == (not known)


def test_a_stream_of_json_has_every_note_on_its_line(node: Node, endpoint: str) -> None:
    node.publisher.note("meta", origin(), {"fps": 10.0})
    node.publisher.note("event", origin(), {"code": "SRC_LOST", "level": 2})
    command = [sys.executable, "-m", "gcd_node", "status", endpoint, "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        told: dict[str, dict[str, Any]] = {}
        while len(told) < 3:
            line = json.loads(reader.stdout.readline())
            told[line["topic"]] = line
        reader.terminate()
    assert set(told) == {"status", "meta", "event"}
    assert told["event"]["code"] == "SRC_LOST"
    assert told["meta"]["node_id"] == "gcd"
