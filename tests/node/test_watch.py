"""`gcd-node view` and `status`: the tables' figures, the saved pictures, and how a watch ends; through real sockets."""

import io
import json
import subprocess
import sys
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console, RenderableType
from wire_messages import BOOT, CLASSES, class_map, depth, end, numbers, origin, pixels, received, visibility, window

from gcd_client.protocol import EndMessage, OriginHeader, StatusMessage, StatusTopic, ViewMessage
from gcd_model import hatched
from gcd_node.cli.main import run_app
from gcd_node.cli.watch import StatusBoard, ViewTable
from gcd_node.config import PublishConfig
from gcd_node.demo import moments
from gcd_node.errors import OutputError
from gcd_node.health import Health, Level
from gcd_node.image_io import ViewSaver, to_u8, write_arrays, write_png
from gcd_node.publisher import Publisher
from gcd_node.sources.files import read_picture

Capture = pytest.CaptureFixture[str]
SEEN = np.random.default_rng(0).integers(0, 3, (2, 16, 16), np.uint8)
WALL_NS = 1_800_000_000_000_000_000


def text_of(renderable: RenderableType, width: int = 140) -> str:
    console = Console(width=width, record=True, file=io.StringIO(), markup=False)
    console.print(renderable)
    return console.export_text()


# Views.


def read_video(path: Path) -> np.ndarray:
    video = cv2.VideoCapture(str(path))
    frames = []
    while (frame := video.read()[1]) is not None:
        frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
    return np.stack(frames)


def watch(folder: Path, options: list[str], *messages: ViewMessage | EndMessage, readers: int = 1) -> int:
    """The exit code of `gcd-node view` beside a publisher that sends these."""
    command = ["view", f"ipc://{folder}/data", "--timeout", "20", *options]
    endpoints = PublishConfig(data=command[1], status=command[1] + ".status", min_subscribers=readers, end_delay_ms=0)
    with ThreadPoolExecutor() as pool, Publisher(endpoints, lockstep=True, drain_ms=3000) as publisher:
        code = pool.submit(run_app, command)
        for message in messages:
            if isinstance(message, EndMessage):
                publisher.end(message)
            else:
                publisher.send(message)
        return code.result(30)


def test_a_table_has_the_figures_of_each_topic() -> None:
    table = ViewTable()
    for i in range(5):
        table.add(received(window(i), skipped=2 if i == 3 else 0), now_s=10.0 + 0.5 * i)
    for now_s, ended, state in ((12.25, False, "live"), (72.2, False, "expired"), (12.25, True, "ended")):
        ((*figures, last),) = table.rows(now_s=now_s, ended=ended)
        assert last == f"{state}, fps"
        if state == "live":
            assert figures == ["view/top/win", "4", "2x4x6x3", "290", "2.00", "2"]


def test_what_is_saved_are_the_published_pixels_and_hatched_ones(tmp_path: Path, capsys: Capture) -> None:
    shown = [pixels(i, height=16, width=16) for i in range(3)]
    seen = [visibility(0, seen=SEEN), visibility(5, seen=SEEN)]  # the second is of another window
    first, second, third = (window(i, images=images) for i, images in enumerate(shown))
    messages = (first, class_map(0), seen[0], second, seen[1], third, end(), end(kind="vis"))
    top = tmp_path / "out" / "top"
    assert watch(tmp_path, ["--view", "top", "--hatch", "--save", str(top.parent)], *messages, readers=2) == 0
    assert "0 damaged; the stream ended" in capsys.readouterr().out
    assert {path.stem for path in top.glob("*.png")} == {f"{i:06}_0{j}" for i in range(3) for j in range(2)}
    assert np.array_equal(read_picture(top / "000001_01.png"), shown[1][1])
    assert np.array_equal(read_video(top.with_suffix(".mkv")), np.concatenate(shown))
    assert np.array_equal(read_video(top / "hatched.mkv"), hatched(shown[0], SEEN))


def test_maps_are_saved_in_colour_and_as_numbers_apart_from_windows(tmp_path: Path) -> None:
    drawn = [numbers(i, height=16, width=16) for i in range(2)]
    with closing(ViewSaver(tmp_path)) as saver:
        for i in range(2):
            saver.add(received(window(i, images=pixels(i, height=16, width=16))))
            saver.add(received(class_map(i, drawn=drawn[i])))
        saver.add(received(visibility(2, seen=SEEN)))
        saver.add(received(depth(2, inverse=np.full((2, 16, 16), 0.1, "<f2"))))
    assert saver.files == len([path for path in tmp_path.rglob("*.*") if path.is_file()])
    folder = tmp_path / "top" / "cls"
    assert np.array_equal(np.load(folder / "000001.npy"), drawn[1])
    shown = read_picture(folder / "000001_01.png")
    assert all((shown[drawn[1][1] == each.id] == each.colour).all() for each in CLASSES)
    assert np.array_equal(read_video(tmp_path / "top" / "cls.mkv")[3], shown)
    legend = read_picture(folder / "legend.png").reshape(-1, 3)
    assert {each.colour for each in CLASSES} <= {tuple(pixel) for pixel in legend.tolist()}
    assert len(read_video(tmp_path / "top.mkv")) == 4
    assert np.array_equal(np.load(tmp_path / "top" / "vis" / "000002.npy"), SEEN)
    assert (tmp_path / "top" / "vis" / "legend.png").exists()
    metres = 1 / np.load(tmp_path / "top" / "depth" / "000002.npy")
    assert metres.dtype == np.float32
    assert np.allclose(metres, 10, rtol=1e-3)


def test_a_view_that_changes_its_size_and_what_cannot_be_written_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    small, large = (received(window(images=pixels(height=16, width=width))) for width in (16, 32))
    with closing(ViewSaver(tmp_path)) as saver:
        saver.add(small)
        with pytest.raises(OutputError):
            saver.add(large)
    with closing(ViewSaver(tmp_path / "file")) as saver, pytest.raises(OutputError):
        saver.add(small)


def test_the_demo_shows_what_arrived_whole_in_order_and_hatches_the_unseen(tmp_path: Path) -> None:
    video = np.zeros((2, 3, 4, 5), np.float32)
    video[1, 0, 2, 3], video[1, 1, 2, 3] = 100.6 / 255, 1.1
    assert to_u8(video)[1, 2, 3].tolist() == [101, 255, 0]
    pictures = {number: [np.full((16, 16, 3), 10 * number + i, np.uint8) for i in range(2)] for number in (5, 2, 7)}
    for number, frames in pictures.items():
        write_arrays(tmp_path / "vis" / f"{number:06d}.npy", np.stack([2 + 0 * SEEN[0], 0 * SEEN[0]]))
        for i, frame in enumerate(frames):
            write_png(tmp_path / f"{number:06d}_{i:02d}.png", frame)
            write_png(tmp_path / "cls" / f"{number:06d}_{i:02d}.png", frame)
    (tmp_path / "vis" / "000007.npy").unlink()
    shown = list(moments(pictures, tmp_path))
    assert [int(view[0, 0, 0]) for _, view, _, _ in shown] == [20, 21, 50, 51]
    assert np.array_equal(shown[0][2], pictures[2][0])
    assert np.array_equal(shown[1][2], hatched(pictures[2][1], 0 * SEEN[0]))


# Status.


def note(topic: StatusTopic, fields: Mapping[str, Any], *, late_s: float = 0.0) -> StatusMessage:
    header = OriginHeader(node_id="robot_7", boot_id=BOOT, t_publish_ns=WALL_NS - round(late_s * 1e9))
    return StatusMessage(topic=topic, header=header, fields=fields)


def board_of(*notes: StatusMessage) -> StatusBoard:
    """A board that got these 10 s ago by its own clock, which stands at 10."""
    board = StatusBoard()
    for each in notes:
        board.add(each, 10.0, WALL_NS)
    return board


def working() -> dict[str, object]:
    """The status of a node at work."""
    health = Health()
    health.state, health.model = "active", "busy"
    health.source("streaming")
    health.expect(("topdown",), 3600.0)
    for i in range(11):
        health.frame(i * 100_000_000, time.monotonic_ns())
    health.published("topdown", 0.25)
    return health.report()


def test_a_status_holds_until_the_node_is_silent_for_three_seconds_and_a_kept_one_is_as_old_as_it_says() -> None:
    assert StatusBoard().record(0.0) == {"level": 3, "stale": True}
    board = board_of(note("status", {"level": 1, "reasons": ["fps"]}))
    assert [board.level(10.0 + ago) for ago in (0.0, 2.9, 3.1)] == [Level.WARN, Level.WARN, Level.STALE]
    assert (board.record(12.0)["age_ms"], board.record(20.0)["level"]) == (2000, 3)
    board = board_of(note("status", {"level": 0}, late_s=60.0))
    assert board.level(10.0) is Level.STALE
    board.add(note("status", {"level": 0}, late_s=60.0), 11.0, WALL_NS)  # another machine's clock
    assert board.level(11.0) is Level.OK
    assert board_of(note("status", {"level": 0}, late_s=-60.0)).record(10.5)["age_ms"] == 500


HOSTILE: tuple[dict[str, Any], ...] = (
    {},
    {"level": "high", "reasons": "fps", "source": 3, "window": [], "stages": [1], "views": None, "drops": "many"},
    {"level": 77, "reasons": [1, None, "\x1b[2J"], "state": {"a": 1}, "window": {"reason_counts": [1]}},
    {"level": [], "stages": {"render": None, "[red]": {"p50_ms": "x" * 10_000}}, "views": {"a": 5, "b": {}}},
    {"state": "[bold]\n\n", "source": {"state": "\r\x00" * 50, "fps": float("1e300")}, "ready": "yes"},
)


@pytest.mark.parametrize("fields", HOSTILE)
def test_whatever_a_node_says_is_drawn_without_harm(fields: dict[str, Any]) -> None:
    board = board_of(note("status", fields), note("event", {"code": ["\x1b"], "level": {}, "x": "[/]"}))
    text = text_of(board.render(10.0))
    assert "robot_7" in text
    assert not {char for char in text if not char.isprintable()} - {"\n"}
    assert max(map(len, text.splitlines())) <= 140
    assert json.loads(json.dumps(board.record(10.0)))["node_id"] == "robot_7"


def test_status_prints_a_table_or_notes_as_json(tmp_path: Path, capsys: Capture) -> None:
    endpoint = f"ipc://{tmp_path}/status"
    assert run_app(["status", endpoint, "--once", "--timeout", "0.2"]) == 69
    with Publisher(PublishConfig(data=endpoint + ".data", status=endpoint)) as publisher:
        publisher.note("status", origin(), working())  # each is kept for who comes later
        publisher.note("meta", origin(), {"fps": 10.0})
        publisher.note("event", origin(), {"code": "SRC_LOST", "level": 2})
        assert run_app(["status", endpoint, "--once", "--timeout", "20"]) == 0
        assert "state streaming, fps 10.0" in capsys.readouterr().out
        assert run_app(["status", endpoint, "--once", "--json", "--timeout", "20"]) == 0
        (line,) = map(json.loads, capsys.readouterr().out.splitlines())
        assert (line["topic"], line["node_id"], line["stale"], line["level"]) == ("status", "gcd", False, 0)
        assert line["source"]["fps"] == 10.0
        command = [sys.executable, "-m", "gcd_node", "status", endpoint, "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
            told = [json.loads(reader.stdout.readline()) for _ in range(3)]
            reader.terminate()
    lines = {line["topic"]: line for line in told}
    assert set(lines) == {"status", "meta", "event"}
    assert (lines["event"]["code"], lines["meta"]["node_id"]) == ("SRC_LOST", "gcd")
