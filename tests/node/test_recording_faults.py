"""What a recording survives: kill -9, a full disk, a slow one, SIGTERM; and what it never touches: the stream."""

import errno
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cameras import until
from fakes import HEIGHT, WIDTH, FakeSource
from mcap.reader import make_reader
from recordings import files, metadata, of, recorded, recorder_config, said, salvaged, summary
from rig import Rig
from wire_messages import origin, pixels, window

import gcd_node
from gcd_node.control.message import Code
from gcd_node.frame import Frame, SourceInfo
from gcd_node.health.report import Level
from gcd_node.recording.disk_file import DiskFile
from gcd_node.recording.entries import Entry
from gcd_node.recording.inbox import Inbox
from gcd_node.recording.items import InputItem, NoteItem, SourceFacts, ViewItem
from gcd_node.recording.mcap_part import McapPart
from gcd_node.recording.recorder import Recorder
from gcd_node.recording.schemas import STRING
from gcd_node.sources.mcap_log import McapLog

pytestmark = pytest.mark.timeout(180)

LOCKSTEP = 'kind = "synthetic"\npace = "lockstep"'
START_S = 120.0  # what a busy machine may take to start a process


class Steady(FakeSource):
    """Noise at its rhythm until it is closed."""

    def __init__(self) -> None:
        super().__init__(10_000_000)
        self.period_s = 0.005

    def frames(self) -> Iterator[Frame]:
        draw = np.random.default_rng(0)
        for frame in super().frames():
            image = draw.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
            yield Frame(image=image, stamp_ns=frame.stamp_ns, seq=frame.seq)


def process(name: str, *arguments: str) -> "subprocess.Popen[str]":
    tests = str(Path(__file__).parent)
    paths = f"{Path(gcd_node.__file__).parent.parent}:{tests}:{os.environ.get('PYTHONPATH', '')}"
    command = [sys.executable, f"{tests}/{name}", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": paths})


# --- kill -9, SIGTERM --------------------------------------------------------------------------------------------


def test_after_kill_9_everything_written_is_readable_and_plays(tmp_path: Path) -> None:
    recorder = process("recording_process.py", str(tmp_path), "40")
    try:
        assert recorder.stdout is not None
        assert recorder.stdout.readline() == "written\n"
    finally:
        recorder.send_signal(signal.SIGKILL)
        recorder.communicate(timeout=START_S)
    (path,) = files(tmp_path)
    found = salvaged(path, "/src/image")
    assert len(found) >= 40
    assert found == list(range(len(found)))  # nothing is missing before the end
    assert [frame.seq for frame in McapLog(path).frames()][: len(found)] == found
    assert [frame.seq for frame in McapLog(path.parent).frames()][: len(found)] == found


# --- a full disk -------------------------------------------------------------------------------------------------


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


def test_f22_a_full_disk_ends_the_recording_with_a_whole_file_and_the_stream_goes_on(
    tmp_path: Path, small_disk: Path
) -> None:
    more = f'record = {{folder = "{small_disk}/here", keep_free_mb = 0, autostart = true, input_encoding = "raw"}}'
    with Rig(tmp_path, lambda _: Steady(), config=LOCKSTEP, more=more, keep=False) as rig:
        ended = rig.await_event("REC_STOPPED")
        status = rig.await_status(lambda status: "REC_FAILED" in status["reasons"])
        rig.await_views(len(rig.of()) + 2)
        assert rig.node.state.label == "active"
        (path,) = files(small_disk)
        heard, found = said(path), summary(path)
        for each in files(small_disk):
            each.unlink()
        assert rig.ask("record_start").code is Code.ACCEPTED  # there is room again
        rig.await_event("REC_STARTED", 2)
        rig.await_status(lambda later: later["heartbeat_seq"] > status["heartbeat_seq"] and later["level"] == 0)
    assert (ended["reason"], ended["finished"], ended["level"]) == ("DISK_FULL", True, Level.WARN)
    assert "No space left" in ended["message"]
    assert ended["written"] == len(heard)
    assert ended["bytes"] > 1_000_000
    assert (status["level"], status["rec"]["state"]) == (1, "failed")
    assert found.chunk_indexes
    numbers = [each.sequence for each in of(heard, "/src/image")]
    assert numbers == list(range(len(numbers)))
    assert len(of(heard, "/view/main/image")) == 14 * len(of(heard, "/view/main/header"))  # windows whole


def limited(monkeypatch: pytest.MonkeyPatch, room: Callable[[], int]) -> None:
    """From here on a file finds `room()` bytes, and every write is done piece by piece."""
    write = os.write

    def scarce(file: int, data: bytes) -> int:
        left = room() - os.fstat(file).st_size
        if left <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, bytes(data[: min(left, 10_000)]))

    monkeypatch.setattr(os, "write", scarce)


def entry(number: int, size: int = 50_000) -> Entry:
    data = np.random.default_rng(number).bytes(size)
    return Entry(topic="/noise", schema=STRING, data=data, log_ns=number, publish_ns=number, sequence=number)


def filled(part: McapPart) -> int:
    """How many messages found room."""
    for number in range(1000):
        try:
            part.write([entry(number)])
        except OSError:
            return number
    raise AssertionError("the disk was never full")


def test_a_file_that_has_its_reserve_ends_with_an_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [500_000]
    limited(monkeypatch, lambda: room[0])
    part = McapPart(tmp_path / "a.mcap", profile="ros2")
    count = filled(part)
    room[0] += 2**20  # what the reserve gives back
    assert part.finish()
    assert _numbers(tmp_path / "a.mcap") == list(range(count + 1))  # the last one was held
    assert part.messages == count + 1
    assert len(summary(tmp_path / "a.mcap").chunk_indexes) > 1


def test_a_file_without_room_for_an_index_ends_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, lambda: 500_000)
    part = McapPart(tmp_path / "a.mcap", profile="ros2")
    count = filled(part)
    assert part.finish()
    numbers = _numbers(tmp_path / "a.mcap")
    assert part.messages == len(numbers)
    assert numbers == list(range(len(numbers)))
    assert count - 1 <= len(numbers) <= count
    assert (tmp_path / "a.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")


def test_a_file_on_a_broken_disk_is_whole_up_to_its_last_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [500_000]
    limited(monkeypatch, lambda: room[0])
    part = McapPart(tmp_path / "a.mcap", profile="ros2")
    count = filled(part)
    room[0] = 0
    assert not part.finish()
    found = salvaged(tmp_path / "a.mcap", "/noise")
    assert found == list(range(len(found)))
    assert len(found) >= count - 1
    assert part.messages == len(found)


def _numbers(path: Path) -> list[int]:
    with path.open("rb") as file:
        return [message.sequence for _, _, message in make_reader(file).iter_messages()]


def test_a_piece_that_does_not_fit_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, lambda: 25_000)
    file = DiskFile(tmp_path / "a")
    file.write(b"a" * 20_000)
    file.commit()
    file.write(b"b" * 20_000)
    with pytest.raises(OSError, match="No space left"):
        file.commit()
    assert (tmp_path / "a").read_bytes() == b"a" * 20_000
    file.close()
    with pytest.raises(FileExistsError):
        DiskFile(tmp_path / "a")


def test_a_recording_stops_before_the_room_is_gone_that_it_must_leave(tmp_path: Path) -> None:
    for code, keep_free_mb, most_mb in (("DISK_LOW", 1e12, 0.0), ("TOTAL_LIMIT", 0.0, 0.5)):
        folder = tmp_path / code
        folder.mkdir()
        (folder / "older.mcap").write_bytes(bytes(600_000))
        config = recorder_config(folder, record=f"max_total_mb = {most_mb}", keep_free_mb=keep_free_mb)
        _, box = recorded(config, FakeSource(14))
        (ended,) = [fields for topic, fields in box.notes if topic == "event" and fields["code"] == "REC_STOPPED"]
        assert (ended["reason"], ended["file"], ended["level"]) == (code, None, 1)
        assert (ended["finished"], ended["written"]) == (False, 0)  # it never began
        assert files(folder) == [folder / "older.mcap"]
        assert [each.name for each in folder.iterdir()] == ["older.mcap"]
        assert box.of("win")


def test_a_folder_that_cannot_be_made_is_blamed_on_the_setting_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    _, box = recorded(recorder_config(tmp_path / "file" / "recordings"), FakeSource(14))
    (ended,) = [fields for topic, fields in box.notes if topic == "event" and fields["code"] == "REC_STOPPED"]
    assert (ended["reason"], ended["file"]) == ("DISK_ERROR", None)
    assert "check folder in [record]" in str(ended["message"])
    assert ended["finished"] is False
    assert caplog.text.count("check folder in [record]") == 1
    assert box.of("win")


# --- a slow disk -------------------------------------------------------------------------------------------------


def shot(seq: int, size: int = 100) -> InputItem:
    info = SourceInfo(kind="v4l2", id="t", width=size, height=size, fps_nominal=10.0, clock="realtime")
    frame = Frame(image=np.zeros((size, size, 3), np.uint8), stamp_ns=seq, seq=seq)
    return InputItem(frame=frame, source=SourceFacts(info=info, lens=None), stamp_ns=seq, log_ns=seq)


def note(number: int = 0) -> NoteItem:
    return NoteItem(kind="event", header=origin(), fields={"code": f"E{number}"}, log_ns=number)


def test_what_finds_no_room_is_dropped_whole_and_counted_by_topic() -> None:
    inbox = Inbox(most_bytes=70_000)
    for seq in range(4):
        inbox.put(shot(seq))  # 30 kB each
    inbox.put(ViewItem(message=window(images=pixels(height=100, width=100))))
    inbox.put(note())
    assert inbox.dropped == {"/src/image": 2, "/view/top/image": 1}
    inbox.close(10.0)
    inbox.put(shot(9))
    taken = [inbox.take(0.0) for _ in range(4)]
    assert [type(each).__name__ for each in taken] == ["InputItem", "InputItem", "NoteItem", "NoneType"]
    assert inbox.exhausted


def test_pictures_and_notes_do_not_push_each_other_out() -> None:
    inbox = Inbox(most_bytes=40_000)
    inbox.put(shot(0, 200))  # larger than the whole queue: one always finds room
    for number in range(5000):
        inbox.put(note(number))
    inbox.put(shot(1))
    assert inbox.dropped == {"/gcd/event": 5000 - 4096, "/src/image": 1}


def test_in_lockstep_the_queue_waits_for_the_disk_instead() -> None:
    inbox, order = Inbox(waits=True, most_bytes=40_000), list[int]()
    giver = threading.Thread(target=lambda: [inbox.put(shot(seq)) for seq in range(5)], daemon=True)
    giver.start()
    while len(order) < 5:
        item = inbox.take(30.0)
        assert isinstance(item, InputItem)
        order.append(item.frame.seq)
    giver.join(30.0)
    assert order == list(range(5))
    assert inbox.dropped == {}


def test_a_disk_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released, write = threading.Event(), McapPart.write
    monkeypatch.setattr(McapPart, "write", lambda part, entries: (released.wait(100.0), write(part, entries))[1])
    config = recorder_config(tmp_path, source='kind = "v4l2"', record='input_encoding = "raw"')
    told: list[tuple[str, object]] = []
    recorder = Recorder(config, "0" * 32, lambda: config, lambda code, level, fields: told.append((code, fields)))
    item = shot(0, 1000)
    recorder.source(item.source.info, None)
    recorder.start()
    for seq in range(60):  # 3 MB each; nobody waits, or this would never end
        recorder.frame(Frame(image=item.frame.image, stamp_ns=seq, seq=seq))
    lost = recorder.report().dropped["/src/image"]
    assert 30 <= lost < 60
    recorder.close(0.2)
    assert recorder.busy
    released.set()
    until(lambda: not recorder.busy)
    assert [code for code, _ in told] == ["REC_STARTED", "REC_STOPPED"]


def test_what_cannot_be_written_is_counted_and_the_rest_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from gcd_node.recording import entries

    code = entries.encode_frames

    def sometimes(frames: np.ndarray, quality: int) -> tuple[bytes, tuple[int, ...]]:
        if frames[0, 0, 0, 0] == 25:
            raise ValueError("no such picture")
        return code(frames, quality)

    monkeypatch.setattr(entries, "encode_frames", sometimes)
    node, _ = recorded(recorder_config(tmp_path), FakeSource(14))
    heard = said(files(tmp_path)[0])
    assert [each.sequence for each in of(heard, "/src/image")] == [0, 1, 2, 3, 4, *range(6, 14)]
    assert node.recorder.report().dropped == {"/src/image": 1}
    assert "no such picture" in caplog.text
    assert metadata(files(tmp_path)[0])["gcd-node"]["what"] == "inputs,views"
