"""How recordings begin, end, rotate and play again; what they survive, and what they never touch: the stream."""

import errno
import hashlib
import multiprocessing
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from itertools import count, pairwise
from pathlib import Path

import numpy as np
import pytest
from cameras import FPS, Bench, Camera, until
from fakes import LOCKSTEP, Box, FakeSource, painting_traits
from recordings import (
    LENS,
    SECOND_NS,
    Calibrated,
    attachments,
    files,
    metadata,
    of,
    recorded,
    recorder_config,
    replayed,
    said,
    salvaged,
)
from rig import Rig
from wire_messages import origin

from gcd_client.control import Code
from gcd_node import ros_messages
from gcd_node.frame import Frame, SourceInfo
from gcd_node.health import Level
from gcd_node.recorder import Recorder
from gcd_node.ros_messages import McapFile, note_messages
from gcd_node.sources.logs import LogSource

pytestmark = pytest.mark.timeout(180)

RAW = 'input_encoding = "raw"'
LIVE = SourceInfo(kind="v4l2", id="t", width=100, height=100, fps_nominal=10.0, clock="realtime")
START_S = 120.0  # what a busy machine may take to start a process


def hashes(box: Box, kind: str) -> list[str]:
    return [hashlib.sha256(each.payload).hexdigest() for each in box.of(kind)]


def section(folder: Path, more: str = "") -> str:
    return f'record = {{folder = "{folder}", keep_free_mb = 0{more}}}'


def test_a_live_node_records_from_start_to_stop_and_says_so(tmp_path: Path) -> None:
    camera, folder, before_ns = Camera(), tmp_path / "recordings", time.time_ns()
    with Rig(tmp_path, Bench(camera), more=section(folder)) as rig:
        rig.await_state("active")
        camera.run(3)  # before anybody records
        assert rig.ask("record_stop").code is Code.WRONG_STATE
        assert rig.client.request("record_start", dry_run=True).code is Code.OK
        assert not folder.exists()
        assert rig.ask("record_start").code is Code.ACCEPTED
        begun = rig.await_event("REC_STARTED")
        assert rig.ask("record_start").code is Code.WRONG_STATE
        camera.run(28)
        rig.await_views(2)
        status = rig.await_status(lambda status: status["rec"].get("written", 0) >= 2 * 28)
        rig.ask("set_view", {"view": "main", "azimuth_deg": 20.0})
        rig.ask("set_view", {"view": "main", "azimuth_deg": 900.0})
        rig.ask("state")
        assert rig.ask("record_stop").code is Code.ACCEPTED
        stopped = rig.await_event("REC_STOPPED")
        captured_ns = [stamp for each in rig.of() for stamp in each.header.t_capture_ns]
        assert rig.ask("record_start").code is Code.ACCEPTED
        rig.await_event("REC_STARTED", 2)
    first, second = files(folder)
    assert begun["file"] == f"{first.parent.name}/{first.name}"
    assert (status["rec"]["state"], status["rec"]["file"]) == ("recording", begun["file"])
    assert status["rec"]["dropped"] == {}
    assert (stopped["reason"], stopped["finished"], stopped["level"]) == ("ASKED", True, 0)
    heard = said(first)
    assert (stopped["bytes"], stopped["written"]) == (first.stat().st_size, len(heard))
    told = [(each.told["verb"], each.told["role"], each.told["code"]) for each in of(heard, "/gcd/command")]
    assert told == [  # no questions
        ("record_start", "operator", "ACCEPTED"),
        ("record_start", "operator", "WRONG_STATE"),
        ("set_view", "operator", "OK"),
        ("set_view", "operator", "OUT_OF_RANGE"),
    ]
    assert of(heard, "/gcd/command")[-1].told["args"] == {"view": "main", "azimuth_deg": 900.0}
    assert "VIEW_SET" in [each.told["code"] for each in of(heard, "/gcd/event")]
    assert rig.events("REC_STOPPED")[1]["reason"] == "SHUTDOWN"
    assert said(second)
    # stamps are the time of the capture, UTC
    inputs, views = of(heard, "/src/image")[-28:], of(heard, "/view/main/image")
    assert [each.sequence for each in inputs] == list(range(3, 31))
    assert all(before_ns <= each.stamp_ns == each.log_ns <= time.time_ns() for each in inputs)
    assert all(abs(b.stamp_ns - a.stamp_ns - SECOND_NS / FPS) <= 1_000_000 for a, b in pairwise(inputs))
    assert views
    assert {each.stamp_ns for each in views} <= set(captured_ns)
    by_number = {each.sequence: each.stamp_ns for each in of(heard, "/src/image")}
    near = [abs(each.stamp_ns - by_number[each.sequence]) for each in views if each.sequence in by_number]
    assert max(near) <= 2_000_000  # two looks at the clock


# --- files, and playing them again -------------------------------------------------------------------------------


def test_a_recording_that_rotated_is_read_part_by_part_and_plays_as_the_source_gave_it(tmp_path: Path) -> None:
    config = recorder_config(tmp_path, record=f"{RAW}\nrotate_mb = 0.6")
    _, box = recorded(config, Calibrated(45, fps=10.0), painting_traits())
    found = files(tmp_path)
    assert len(found) >= 3
    numbers: list[int] = []
    for part, path in enumerate(found):
        heard = said(path)
        assert {"gcd-node", "gcd-node/source"} <= metadata(path).keys()
        assert "config.toml" in attachments(path)
        assert path.stat().st_size < 1_500_000
        assert part == 0 or of(heard, "/gcd/meta")[0].told["weights"]["name"] == "fake"
        images = [each.sequence for each in of(heard, "/src/image")]
        assert images == [each.sequence for each in of(heard, "/src/camera_info")]
        numbers += images
        assert len(of(heard, "/view/main/image")) == 14 * len(of(heard, "/view/main/header"))  # windows whole
    assert numbers == list(range(45))
    told = [fields["file"] for topic, fields in box.notes if topic == "event" and fields["code"] == "REC_ROTATED"]
    assert told == [f"{path.parent.name}/{path.name}" for path in found[1:]]
    source, again = replayed(found[0].parent, painting_traits())
    for kind in ("win", "cls"):
        assert hashes(again, kind) == hashes(box, kind)
        assert len(hashes(again, kind)) == 3
    captured = [[message.header.t_capture_ns for message in each.of("win")] for each in (again, box)]
    assert captured[0] == captured[1]
    assert (source.info.id, source.info.lens) == (found[0].parent.name, LENS)


def test_the_input_is_played_though_there_are_views_and_a_view_where_it_is_named(tmp_path: Path) -> None:
    recorded(recorder_config(tmp_path / "a"), Calibrated(14))
    assert replayed(files(tmp_path)[0])[0].info.width == 192
    view, _ = replayed(files(tmp_path)[0], source='topic = "/view/main/image"')
    assert (view.info.width, view.info.lens is None) == (96, False)  # through its own camera
    recorded(recorder_config(tmp_path / "b", record='what = ["views"]'), FakeSource(14))
    assert replayed(files(tmp_path / "b")[0])[0].info.width == 96  # the only pictures there are


# --- kill -9, full and slow disks --------------------------------------------------------------------------------


def record_for_ever(folder: Path) -> None:
    config, draw = recorder_config(folder, source='kind = "v4l2"'), np.random.default_rng(0)
    recorder = Recorder(config, "0" * 32, lambda: config, lambda *_: None, Box())
    recorder.source(LIVE, None)
    recorder.start()
    for seq in count():
        image = draw.integers(0, 256, (64, 96, 3), np.uint8)
        recorder.frame(Frame(image=image, stamp_ns=time.monotonic_ns(), seq=seq))
        time.sleep(0.01)


def test_after_kill_9_everything_written_is_readable_and_plays(tmp_path: Path) -> None:
    recorder = multiprocessing.get_context("spawn").Process(target=record_for_ever, args=(tmp_path,))
    recorder.start()
    try:
        until(lambda: len(files(tmp_path)) > 0 and len(salvaged(files(tmp_path)[0], "/src/image")) >= 40, START_S)
    finally:
        recorder.kill()
        recorder.join()
    (path,) = files(tmp_path)
    found = salvaged(path, "/src/image")
    assert found == list(range(len(found)))  # nothing is missing before the end
    for place in (path, path.parent):
        assert [frame.seq for frame in LogSource(place).frames()][: len(found)] == found


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(place)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting a small disk needs root (CAP_SYS_ADMIN)")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_f22_a_full_disk_ends_the_recording_with_a_readable_file_and_the_stream_goes_on(
    tmp_path: Path, small_disk: Path
) -> None:
    more = section(small_disk / "here", f", autostart = true, {RAW}")
    with Rig(tmp_path, lambda _: Calibrated(10_000_000), config=LOCKSTEP, more=more) as rig:
        stopped = rig.await_event("REC_STOPPED")
        status = rig.await_status(lambda status: "REC_FAILED" in status["reasons"])
        rig.await_views(len(rig.of()) + 2)
        assert rig.node.state.label == "active"
        (path,) = files(small_disk)
        heard = said(path)
        path.unlink()
        assert rig.ask("record_start").code is Code.ACCEPTED  # there is room again
        rig.await_event("REC_STARTED", 2)
        rig.await_status(lambda later: later["heartbeat_seq"] > status["heartbeat_seq"] and later["level"] == 0)
    assert (stopped["reason"], stopped["finished"], stopped["level"]) == ("DISK_FULL", True, Level.WARN)
    assert "No space left" in stopped["message"]
    assert stopped["written"] == len(heard)
    assert (status["level"], status["rec"]["state"]) == (1, "failed")
    numbers = [each.sequence for each in of(heard, "/src/image")]
    assert numbers == list(range(len(numbers)))


def test_a_file_on_a_broken_disk_is_whole_up_to_its_last_flush(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    whole, file = McapFile(tmp_path / "b.mcap"), McapFile(tmp_path / "a.mcap")
    assert (whole.close(), whole.close(is_broken=True)) == (True, True)  # its end is written
    for number in range(100):
        file.write(note_messages("event", origin(), {"code": "E" * 3000, "number": number}, number))
    file.flush()
    file.write(note_messages("event", origin(), {"code": "lost"}, 100))
    for name in ("fdatasync", "pwrite"):
        monkeypatch.setattr(os, name, broken)
    assert not file.close()
    assert not file.close(is_broken=True)  # as when the next one cannot be opened
    assert len(salvaged(tmp_path / "a.mcap", "/gcd/event")) == file.messages == 100


def test_a_recording_stops_before_the_room_is_gone_that_it_must_leave(tmp_path: Path) -> None:
    for code, keep_free_mb, most_mb in (("DISK_LOW", 1e12, 0.0), ("TOTAL_LIMIT", 0.0, 0.5)):
        folder = tmp_path / code
        folder.mkdir()
        (folder / "older.mcap").write_bytes(bytes(600_000))
        (folder / "vanished.mcap").symlink_to("nowhere")
        config = recorder_config(folder, record=f"max_total_mb = {most_mb}", keep_free_mb=keep_free_mb)
        _, box = recorded(config, FakeSource(14))
        (done,) = (fields for topic, fields in box.notes if topic == "event" and fields["code"] == "REC_STOPPED")
        assert (done["reason"], done["file"], done["level"]) == (code, None, 1)
        assert (done["finished"], done["written"]) == (False, 0)  # it never began
        assert {each.name for each in folder.iterdir()} == {"older.mcap", "vanished.mcap"}
        assert box.of("win")


def test_a_disk_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released, write, told = threading.Event(), McapFile.write, list[str]()
    monkeypatch.setattr(McapFile, "write", lambda file, each: (released.wait(100.0), write(file, each))[1])
    config = recorder_config(tmp_path, source='kind = "v4l2"', record=RAW)
    recorder = Recorder(config, "0" * 32, lambda: config, lambda code, *_: told.append(code), Box())
    recorder.source(LIVE, None)
    recorder.start()
    until(lambda: "REC_STARTED" in told)
    for seq in range(60):  # 3 MB each; nobody waits, or this would never end
        recorder.frame(Frame(image=np.zeros((1000, 1000, 3), np.uint8), stamp_ns=seq, seq=seq))
        recorder.note("event", origin(), {"code": f"E{seq}"})
    lost = recorder.report().dropped
    assert 30 <= lost["/src/image"] < 60
    assert set(lost) == {"/src/image"}  # notes have room of their own
    recorder.close(0.2)
    assert recorder.busy
    released.set()
    until(lambda: not recorder.busy)
    assert told == ["REC_STARTED", "REC_STOPPED"]


def test_what_cannot_be_written_is_counted_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    code = ros_messages.encode_jpegs

    def sometimes(frames: np.ndarray, quality: int) -> tuple[bytes, tuple[int, ...]]:
        if frames[0, 0, 0, 0] == 25:
            raise ValueError("no such picture")
        return code(frames, quality)

    monkeypatch.setattr(ros_messages, "encode_jpegs", sometimes)
    node, _ = recorded(recorder_config(tmp_path), FakeSource(14))
    heard = said(files(tmp_path)[0])
    assert [each.sequence for each in of(heard, "/src/image")] == [0, 1, 2, 3, 4, *range(6, 14)]
    assert node.recorder.report().dropped == {"/src/image": 1}
    assert "no such picture" in caplog.text
