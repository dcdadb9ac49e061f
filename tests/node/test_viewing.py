"""Watching a node: the table's rows, the pictures, and how a watch ends."""

import io
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console
from wire_messages import CLASSES, class_map, depth, end, numbers, pixels, visibility, window

from gcd_client.protocol import ViewMessage
from gcd_client.subscriber import ReceivedView
from gcd_model import hatched
from gcd_node.errors import OutputError
from gcd_node.publisher import Publisher
from gcd_node.sockets import PublisherOptions
from gcd_node.watching.views import ViewSaver, ViewTable, WatchReport, WatchRequest, render, watch

pytestmark = pytest.mark.timeout(30)
SEEN = np.random.default_rng(0).integers(0, 3, (2, 16, 16), np.uint8)


def received(message: ViewMessage, *, skipped: int = 0, expired: bool = False) -> ReceivedView:
    return ReceivedView(message=message, age_ms=40.0, expired=expired, skipped=skipped, restarted=False)


def read_video(path: Path) -> np.ndarray:
    video = cv2.VideoCapture(str(path))
    frames = []
    while (frame := video.read()[1]) is not None:
        frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))
    return np.stack(frames)


def watched(tmp_path: Path, request: WatchRequest, windows: int, *, ending: bool) -> WatchReport:
    """A watch of a publisher that sends `windows` of view top and one of view side."""
    options = PublisherOptions(
        data=request.endpoint, status=None, lockstep=True, min_subscribers=1, end_delay_ms=0, drain_ms=3000
    )
    reports: list[WatchReport] = []
    rows = []
    with Publisher(options) as publisher:
        thread = threading.Thread(target=lambda: reports.append(watch(request, rows.append)), daemon=True)
        thread.start()
        publisher.send(window(0, view_id="side", images=pixels(100, height=16, width=16)))
        for i in range(windows):
            publisher.send(window(i, images=pixels(i, height=16, width=16)))
        for view_id in ("side", "top") if ending else ():
            publisher.end(end(view_id=view_id))
        thread.join(15)
    assert reports, "the watch did not end"
    assert rows
    return reports[0]


def test_rows_hold_what_arrived() -> None:
    table = ViewTable()
    for i in range(5):
        table.add(received(window(i), skipped=2 if i == 3 else 0), now_s=10.0 + 0.5 * i)
    table.add(received(window(7, view_id="alt")), now_s=12.0)
    alt, top = table.rows(now_s=12.25)
    assert (alt.topic, alt.window_id, alt.rate_hz) == ("view/alt/win", 7, 0.0)
    assert (top.topic, top.window_id, top.shape) == ("view/top/win", 4, (2, 4, 6, 3))
    assert (top.rate_hz, top.missed, top.bytes, top.state) == (2.0, 2, 5 * 144, "live")
    assert top.age_ms == 40.0 + 250.0


def test_a_row_expires_and_ends() -> None:
    table = ViewTable()
    table.add(received(window()), now_s=0.0)
    assert table.rows(now_s=60.1)[0].state == "expired"
    assert table.rows(now_s=1.0)[0].state == "live"
    assert table.rows(now_s=1.0, ended=True)[0].state == "ended"


def test_a_rendered_table_shows_each_row_and_the_warning() -> None:
    table = ViewTable()
    table.add(received(window(31)), now_s=0.0)
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(render(table.rows(now_s=0.0)))
    shown = console.export_text()
    for word in ("never evidence of free space", "view/top/win", "31", "2x4x6x3", "live"):
        assert word in shown


def test_the_table_of_long_names_loses_nothing_in_80_columns() -> None:
    table = ViewTable()
    for name in ("topdown", "a_view_name_of16"):
        table.add(received(window(123_456, view_id=name)), now_s=0.0)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(render(table.rows(now_s=99.0)))
    shown = console.export_text()
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= 80
    for word in ("window", "age ms", "rate Hz", "missed", "123456", "view/topdown/win", "expired"):
        assert word in shown, word


def test_a_watch_sees_all_views_until_the_stream_ends(tmp_path) -> None:
    request = WatchRequest(endpoint=f"ipc://{tmp_path}/data", timeout_s=10)
    report = watched(tmp_path, request, 3, ending=True)
    assert report.ended
    assert (report.received, report.damaged, report.restarts, report.files) == (4, 0, 0, 0)
    assert [(row.topic, row.window_id, row.state) for row in report.rows] == [
        ("view/side/win", 0, "ended"),
        ("view/top/win", 2, "ended"),
    ]


def test_saved_pictures_and_video_are_the_published_pixels(tmp_path) -> None:
    request = WatchRequest(endpoint=f"ipc://{tmp_path}/data", save=tmp_path / "out", timeout_s=10)
    report = watched(tmp_path, request, 2, ending=True)
    out = tmp_path / "out"
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*.*"))
    assert names == [
        *("side.mkv", "side/000000_00.png", "side/000000_01.png", "top.mkv"),
        *("top/000000_00.png", "top/000000_01.png", "top/000001_00.png", "top/000001_01.png"),
    ]
    assert report.files == len(names)
    sent = np.concatenate([pixels(i, height=16, width=16) for i in range(2)])
    assert np.array_equal(read_video(out / "top.mkv"), sent)
    last = cv2.cvtColor(cv2.imread(str(out / "top" / "000001_01.png")), cv2.COLOR_BGR2RGB)
    assert np.array_equal(last, sent[3])


def test_class_maps_are_saved_in_colour_with_a_legend_and_as_numbers(tmp_path) -> None:
    drawn = [numbers(i, height=16, width=16) for i in range(2)]
    with ViewSaver(tmp_path) as saver:
        for i in range(2):
            saver.add(received(window(i, images=pixels(i, height=16, width=16))))
            saver.add(received(class_map(i, drawn=drawn[i])))
        assert saver.files == len([path for path in tmp_path.rglob("*.*") if path.is_file()])
    folder = tmp_path / "top" / "cls"
    assert np.array_equal(np.load(folder / "000001.npy"), drawn[1])
    shown = cv2.cvtColor(cv2.imread(str(folder / "000001_01.png")), cv2.COLOR_BGR2RGB)
    for each in CLASSES:
        assert (shown[drawn[1][1] == each.id] == each.colour).all()
    assert np.array_equal(read_video(tmp_path / "top" / "cls.mkv")[3], shown)
    legend = cv2.cvtColor(cv2.imread(str(folder / "legend.png")), cv2.COLOR_BGR2RGB).reshape(-1, 3)
    assert {each.colour for each in CLASSES} <= {tuple(pixel) for pixel in legend.tolist()}
    assert len(read_video(tmp_path / "top.mkv")) == 4  # windows stay apart from class maps


def test_visibility_is_saved_as_numbers_in_colour_and_depth_in_floats(tmp_path) -> None:
    with ViewSaver(tmp_path) as saver:
        saver.add(received(visibility(2, seen=SEEN)))
        saver.add(received(depth(2, inverse=np.full((2, 16, 16), 0.1, "<f2"))))
        assert saver.files == len([path for path in tmp_path.rglob("*.*") if path.is_file()])
    assert np.array_equal(np.load(tmp_path / "top" / "vis" / "000002.npy"), SEEN)
    assert (tmp_path / "top" / "vis" / "legend.png").exists()
    metres = 1 / np.load(tmp_path / "top" / "depth" / "000002.npy")
    assert metres.dtype == np.float32
    assert np.allclose(metres, 10, rtol=1e-3)
    assert abs(read_video(tmp_path / "top" / "depth.mkv").astype(int) - 127).max() <= 1


def test_saved_windows_are_hatched_where_they_are_painted_and_all_over_where_nobody_says(tmp_path) -> None:
    shown = [pixels(i, height=16, width=16) for i in range(3)]
    with ViewSaver(tmp_path, hatch=True) as saver:
        saver.add(received(window(0, images=shown[0])))
        saver.add(received(visibility(0, seen=SEEN)))
        saver.add(received(window(1, images=shown[1])))
        saver.add(received(visibility(5, seen=SEEN)))  # of another window
        saver.add(received(window(2, images=shown[2])))
    saved = read_video(tmp_path / "top.mkv")
    blank = np.zeros_like(SEEN)
    wanted = [hatched(image, seen) for image, seen in zip(shown, (SEEN, blank, blank), strict=True)]
    assert np.array_equal(saved, np.concatenate(wanted))


def test_a_watch_for_hatching_takes_windows_with_their_visibility(tmp_path) -> None:
    kinds = ("win", "vis")
    request = WatchRequest(
        endpoint=f"ipc://{tmp_path}/data", view="top", kind=kinds, save=tmp_path / "out", hatch=True, timeout_s=10
    )
    options = PublisherOptions(
        data=request.endpoint, status=None, lockstep=True, min_subscribers=2, end_delay_ms=0, drain_ms=3000
    )
    reports: list[WatchReport] = []
    with Publisher(options) as publisher:
        thread = threading.Thread(target=lambda: reports.append(watch(request, lambda rows: None)), daemon=True)
        thread.start()
        for message in (window(0, images=pixels(0, height=16, width=16)), class_map(0), visibility(0, seen=SEEN)):
            publisher.send(message)
        for kind in kinds:
            publisher.end(end(kind=kind))
        thread.join(15)
    assert [row.topic for row in reports[0].rows] == ["view/top/vis", "view/top/win"]
    assert np.array_equal(read_video(tmp_path / "out" / "top.mkv"), hatched(pixels(0, height=16, width=16), SEEN))


def test_a_watch_of_all_kinds_ends_when_all_have(tmp_path) -> None:
    request = WatchRequest(endpoint=f"ipc://{tmp_path}/data", view="top", kind=None, timeout_s=10)
    options = PublisherOptions(
        data=request.endpoint, status=None, lockstep=True, min_subscribers=1, end_delay_ms=0, drain_ms=3000
    )
    reports: list[WatchReport] = []
    with Publisher(options) as publisher:
        thread = threading.Thread(target=lambda: reports.append(watch(request, lambda rows: None)), daemon=True)
        thread.start()
        publisher.send(window(0, view_id="side"))
        publisher.send(window(0))
        publisher.send(class_map(0))
        publisher.end(end())
        publisher.send(class_map(1))
        publisher.end(end(kind="cls"))
        thread.join(15)
    assert reports
    assert reports[0].ended
    assert [(row.topic, row.window_id) for row in reports[0].rows] == [("view/top/cls", 1), ("view/top/win", 0)]


def test_a_view_that_changes_its_size_is_an_error(tmp_path) -> None:
    with ViewSaver(tmp_path) as saver:
        saver.add(received(window(images=pixels(height=16, width=16))))
        with pytest.raises(OutputError, match=r"was \(16, 16\) .* now \(16, 32\)"):
            saver.add(received(window(images=pixels(height=16, width=32))))


def test_a_folder_that_cannot_be_written_is_named(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    with ViewSaver(tmp_path / "file") as saver, pytest.raises(OutputError, match="file"):
        saver.add(received(window(images=pixels(height=16, width=16))))
