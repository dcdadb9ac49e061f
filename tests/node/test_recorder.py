"""Recordings: made by a node over fakes, read back by the reference libraries."""

import errno
import hashlib
import json
import multiprocessing
import os
import re
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, pairwise
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pytest
from cameras import FPS, Bench, Camera, until
from fakes import LOCKSTEP, Box, FakeSource, FakeSynthesizer, fake_config, made_node, painting_traits, run, traits
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rig import Rig
from rosbags.highlevel import AnyReader
from wire_messages import origin, window
from zstandard import ZstdError

from gcd_client.control import Code
from gcd_client.images import depth_m, images
from gcd_client.protocol import to_json
from gcd_model import Traits
from gcd_node import ros_messages
from gcd_node.config import NodeConfig, parse_config
from gcd_node.frame import Frame, FrameSource, LensModel, SourceInfo
from gcd_node.health import Level
from gcd_node.node import Node
from gcd_node.recorder import Recorder
from gcd_node.ros_messages import McapFile, data_messages, note_messages
from gcd_node.sources import open_source
from gcd_node.sources.logs import LogSource, pose_of

pytestmark = pytest.mark.timeout(180)
SECOND_NS = 10**9
LENS = LensModel(
    width=192, height=128, fx=200.0, fy=201.0, cx=95.5, cy=63.5, distortion="plumb_bob",
    coefficients=(-0.1, 0.02, 0.0, 0.0, 0.0),
)  # fmt: skip


class Calibrated(FakeSource):
    """A source that knows its lens, with noise that no coder keeps whole."""

    def __init__(self, count: int = 30, fps: float = 24.0) -> None:
        draw = partial(np.random.default_rng(0).integers, 0, 256, (128, 192, 3), np.uint8)
        super().__init__(count, fps=fps, size=(192, 128), edit=lambda frame: replace(frame, image=draw()))
        self.info = replace(self.info, lens=LENS)


@dataclass(frozen=True)
class Said:
    """One message of a recording; value: decoded by the reference library for ROS 2."""

    topic: str
    log_ns: int
    publish_ns: int
    sequence: int
    value: Any

    @property
    def stamp_ns(self) -> int:
        """Of its header."""
        return self.value.header.stamp.sec * SECOND_NS + self.value.header.stamp.nanosec

    @property
    def told(self) -> dict[str, Any]:
        """The JSON in it."""
        return json.loads(self.value.data)


def recorder_config(folder: Path, *changes: str, source: str = LOCKSTEP, keep_free_mb: float = 0.0) -> NodeConfig:
    """changes: KEY=VALUE."""
    where = (f"record.folder={folder}", f"record.keep_free_mb={keep_free_mb}", "record.autostart=true")
    return fake_config(*where, *changes, source=source)


def recorded(
    config: NodeConfig, source: FrameSource | None = None, made: Traits | None = None, holds: Sequence[str] = ()
) -> tuple[Node, Box]:
    """A node that recorded a whole run. holds: see FakeSynthesizer."""
    box = Box()
    node = made_node(config, FakeSynthesizer(made or traits(), holds=holds), source or FakeSource(30), box)
    node.run()
    return node, box


def replayed(path: Path, made: Traits | None = None, topic: str = "") -> tuple[FrameSource, Box]:
    """What a node makes of a recording."""
    named = f'topic = "{topic}"' if topic else ""
    config = fake_config(source=f'kind = "mcap"\npath = "{path}"\npace = "lockstep"\n{named}')
    opened = open_source(config.source)
    return opened, run(config, FakeSynthesizer(made or traits()), opened)


def files(folder: Path) -> list[Path]:
    """Every file of every recording, in the order of their names."""
    return sorted(folder.rglob("*.mcap"))


def said(path: Path) -> list[Said]:
    """Every message of a finished file."""
    with path.open("rb") as file:
        return [
            Said(channel.topic, message.log_time, message.publish_time, message.sequence, decoded)
            for _, channel, message, decoded in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]


def of(messages: Sequence[Said], topic: str) -> list[Said]:
    return [each for each in messages if each.topic == topic]


def extras(path: Path) -> tuple[Any, dict[str, dict[str, str]], dict[str, bytes]]:
    """Its summary, and its metadata and attachments by name."""
    with path.open("rb") as file:
        reader = make_reader(file)
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        return reader.get_summary(), metadata, {each.name: each.data for each in reader.iter_attachments()}


def salvaged(path: Path, topic: str) -> list[int]:
    """Sequence numbers on a topic, as far as the reference reader gets front to back in a file without an end."""
    found: list[int] = []
    with path.open("rb") as file:
        try:
            for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                if channel.topic == topic:
                    found.append(message.sequence)
        except (McapError, EOFError, ValueError, ZstdError):
            pass  # where it was cut
    return found


# How recordings begin, end, rotate and play again; what they survive, and what they never touch: the stream.


RAW = "record.input_encoding=raw"
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
        assert [rig.ask("record_start").code for _ in range(2)] == [Code.ACCEPTED, Code.WRONG_STATE]
        begun = rig.await_event("REC_STARTED")
        camera.run(28)
        rig.await_views(2)
        status = rig.await_status(lambda status: status["rec"].get("written", 0) >= 2 * 28)
        for azimuth_deg in (20.0, 900.0):
            rig.ask("set_view", {"view": "main", "azimuth_deg": azimuth_deg})
        rig.ask("state")
        assert rig.ask("record_stop").code is Code.ACCEPTED
        stopped = rig.await_event("REC_STOPPED")
        captured_ns = [stamp for each in rig.of() for stamp in each.header.t_capture_ns]
        assert rig.ask("record_start").code is Code.ACCEPTED
        rig.await_event("REC_STARTED", 2)
    first, second = files(folder)
    name = f"{first.parent.name}/{first.name}"
    assert (begun["file"], status["rec"]["file"], status["rec"]["state"]) == (name, name, "recording")
    assert status["rec"]["dropped"] == {}
    heard = said(first)
    ending = [stopped[key] for key in ("reason", "finished", "level", "bytes", "written")]
    assert ending == ["ASKED", True, 0, first.stat().st_size, len(heard)]
    commands = [each.told for each in of(heard, "/gcd/command")]
    assert [(each["verb"], each["role"], each["code"]) for each in commands] == [  # no questions
        ("record_start", "operator", "ACCEPTED"),
        ("record_start", "operator", "WRONG_STATE"),
        ("set_view", "operator", "OK"),
        ("set_view", "operator", "OUT_OF_RANGE"),
    ]
    assert commands[-1]["args"] == {"view": "main", "azimuth_deg": 900.0}
    assert "VIEW_SET" in [each.told["code"] for each in of(heard, "/gcd/event")]
    assert rig.events("REC_STOPPED")[1]["reason"] == "SHUTDOWN"
    assert said(second)
    # stamps are the time of the capture, UTC
    inputs, views = of(heard, "/src/image")[-28:], of(heard, "/view/main/image")
    assert [each.sequence for each in inputs] == list(range(3, 31))
    assert all(before_ns <= each.stamp_ns == each.log_ns <= time.time_ns() for each in inputs)
    assert all(abs(b.stamp_ns - a.stamp_ns - SECOND_NS / FPS) <= 1_000_000 for a, b in pairwise(inputs))
    assert {each.stamp_ns for each in views} <= set(captured_ns)
    by_number = {each.sequence: each.stamp_ns for each in of(heard, "/src/image")}
    near = [abs(each.stamp_ns - by_number[each.sequence]) for each in views if each.sequence in by_number]
    assert max(near) <= 2_000_000  # two looks at the clock


def test_a_recording_that_rotated_is_read_part_by_part_and_plays_as_the_source_gave_it(tmp_path: Path) -> None:
    config = recorder_config(tmp_path, RAW, "record.rotate_mb=0.6")
    _, box = recorded(config, Calibrated(45, fps=10.0), painting_traits())
    found = files(tmp_path)
    assert len(found) >= 3
    numbers: list[int] = []
    for part, path in enumerate(found):
        heard = said(path)
        _, metadata, attachments = extras(path)
        assert {"gcd-node", "gcd-node/source"} <= metadata.keys()
        assert "config.toml" in attachments
        assert path.stat().st_size < 1_500_000
        assert part == 0 or of(heard, "/gcd/meta")[0].told["weights"]["name"] == "fake"
        images = [each.sequence for each in of(heard, "/src/image")]
        assert images == [each.sequence for each in of(heard, "/src/camera_info")]
        numbers += images
        assert len(of(heard, "/view/main/image")) == 14 * len(of(heard, "/view/main/header"))  # windows whole
    assert numbers == list(range(45))
    assert [fields["file"] for fields in box.events("REC_ROTATED")] == [
        f"{path.parent.name}/{path.name}" for path in found[1:]
    ]
    with AnyReader([found[0].parent]) as bag:  # one ROS 2 bag of several files
        assert bag.message_count == sum(len(said(path)) for path in found)
    source, again = replayed(found[0].parent, painting_traits())
    for kind in ("win", "cls"):
        assert hashes(again, kind) == hashes(box, kind)
        assert len(hashes(again, kind)) == 3
    captured = [[message.header.t_capture_ns for message in each.of("win")] for each in (again, box)]
    assert captured[0] == captured[1]
    assert (source.info.id, source.info.lens, source.info.width) == (found[0].parent.name, LENS, 192)  # the input
    view, _ = replayed(found[0].parent, painting_traits(), topic="/view/main/image")
    assert (view.info.width, view.info.lens is None) == (96, False)  # through its own camera


def record_for_ever(folder: Path) -> None:
    config, draw = recorder_config(folder, source='kind = "v4l2"'), np.random.default_rng(0)
    recorder = Recorder(config, "0" * 32, lambda: config, lambda *_: None, Box())
    recorder.source(LIVE, None)
    recorder.start()
    for seq in count():
        image = draw.integers(0, 256, (64, 96, 3), np.uint8)
        recorder.frame(Frame(image=image, stamp_ns=time.monotonic_ns(), seq=seq))
        time.sleep(0.01)


@pytest.mark.slow
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


def test_f22_a_full_disk_ends_the_recording_readably_and_not_the_stream(tmp_path: Path, small_disk: Path) -> None:
    more = section(small_disk / "here", ', autostart = true, input_encoding = "raw"')
    with Rig(tmp_path, lambda _: Calibrated(10_000_000), config=LOCKSTEP, more=more) as rig:
        stopped = rig.await_event("REC_STOPPED")
        status = rig.await_status(lambda status: "REC_FAILED" in status["reasons"])
        rig.await_views(len(rig.of()) + 2)
        assert rig.node.state.label == "active"
        (path,) = files(small_disk)
        heard = said(path)
        subprocess.run(["mount", "-o", "remount,size=1g", str(small_disk)], check=True)  # room for longer
        assert rig.ask("record_start").code is Code.ACCEPTED
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
        config = recorder_config(folder, f"record.max_total_mb={most_mb}", keep_free_mb=keep_free_mb)
        _, box = recorded(config, FakeSource(14))
        (done,) = box.events("REC_STOPPED")
        assert (done["reason"], done["file"], done["level"]) == (code, None, 1)
        assert (done["finished"], done["written"]) == (False, 0)  # it never began
        assert {each.name for each in folder.iterdir()} == {"older.mcap", "vanished.mcap"}
        assert box.of("win")


def test_a_disk_that_hangs_holds_up_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released, write, told = threading.Event(), McapFile.write, list[str]()
    monkeypatch.setattr(McapFile, "write", lambda file, each: (released.wait(100.0), write(file, each))[1])
    config = recorder_config(tmp_path, RAW, source='kind = "v4l2"')
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


# What is in a recording, read back with the reference libraries.


Run: TypeAlias = tuple[list[Said], Box, Path]
PICTURES = ("image", "camera_info", "classes", "std", "visibility", "depth")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two windows of a model that draws class maps, visibility and depth, on two samples, and all recorded of them."""
    folder = tmp_path_factory.mktemp("run")
    config = recorder_config(folder, "model.samples=2")
    holds = ("visibility", "inverse_depth")
    _, box = recorded(config, FakeSource(30, fps=10.0), painting_traits(), holds)
    (path,) = files(folder)
    return said(path), box, path


def test_everything_is_of_ros_2_decodes_and_is_counted_by_the_index(whole: Run) -> None:
    heard, _, path = whole
    counts, (found, *_) = Counter(each.topic for each in heard), extras(path)
    assert {each.topic: found.statistics.channel_message_counts[key] for key, each in found.channels.items()} == counts
    wanted = {"/src/image": 30, "/src/camera_info": 30, "/tf": 2} | {f"/view/main/{name}": 28 for name in PICTURES}
    wanted |= {f"/view/main/{name}": 2 for name in ("header", "std_header", "age_ms")}
    assert {name: counts[name] for name in counts if not name.startswith(("/gcd", "/diag"))} == wanted
    assert counts["/gcd/status"] == counts["/diagnostics"] > 0
    assert counts["/gcd/meta"] == 1
    # `ros2 bag play` refuses files in which some messages are CDR and others not (rosbag2 issue 1245)
    assert {each.message_encoding for each in found.channels.values()} == {"cdr"}
    assert {each.encoding for each in found.schemas.values()} == {"ros2msg"}
    with AnyReader([path.parent]) as reader:  # as a ROS 2 bag, by the definitions in it
        values = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert len(values) == len(heard)


def test_stamps_are_those_of_the_capture_and_numbers_those_of_the_source(whole: Run) -> None:
    heard, box, _ = whole
    topics = dict.fromkeys(("/src/image", "/src/camera_info"), 30) | {f"/view/main/{name}": 28 for name in PICTURES}
    for topic, number in topics.items():
        found = of(heard, topic)
        assert [(each.stamp_ns, each.sequence) for each in found] == [(round(i * 1e8), i) for i in range(number)]
        assert all(abs(each.log_ns - time.time_ns()) < 600 * SECOND_NS for each in found)
    sent_ns = {message.header.t_publish_ns for message in box.of("win")}
    assert {each.publish_ns for each in of(heard, "/view/main/image")} == sent_ns


def test_pictures_and_maps_are_what_was_seen_and_published(whole: Run) -> None:
    heard, box, _ = whole
    view = np.concatenate([images(message) for message in box.of("win")])
    for topic, wanted in (("/src/image", [20 + number for number in range(30)]), ("/view/main/image", view)):
        for each, pixels in zip(of(heard, topic), wanted, strict=True):
            assert each.value.format == "jpeg"
            picture = cv2.imdecode(np.frombuffer(each.value.data, np.uint8), cv2.IMREAD_COLOR)
            assert np.abs(picture[..., ::-1].astype(int) - pixels).max() <= 3
    for topic, kind in (("classes", "cls"), ("std", "std"), ("visibility", "vis"), ("depth", "depth")):
        encoding, pixels_of = ("32FC1", depth_m) if kind == "depth" else ("mono8", images)
        wanted = np.concatenate([pixels_of(message) for message in box.of(kind)]).reshape(-1, 64, 96)
        found = [each.value for each in of(heard, f"/view/main/{topic}")]
        assert {(each.encoding, each.height, each.step) for each in found} == {(encoding, 64, 96 * wanted.itemsize)}
        pixels = np.stack([np.frombuffer(each.data, wanted.dtype).reshape(64, 96) for each in found])
        np.testing.assert_array_equal(pixels, wanted)


def test_headers_and_poses_are_the_wire_s_own(whole: Run) -> None:
    heard, box, _ = whole
    for topic, kind in (("header", "win"), ("std_header", "std")):
        assert [each.told for each in of(heard, f"/view/main/{topic}")] == [
            json.loads(json.dumps(to_json(message.header))) for message in box.of(kind)
        ]
    ages = [each.value.data for each in of(heard, "/view/main/age_ms")]
    assert ages == [message.header.age_ms for message in box.of("win")]

    header = box.of("win")[1].header
    transforms = of(heard, "/tf")[1].value.transforms
    for each, numbers in zip(transforms, header.source_from_view, strict=True):
        place, turn = each.transform.translation, each.transform.rotation
        np.testing.assert_allclose(pose_of(place, turn), np.reshape(numbers, (4, 4)), atol=1e-6)
        assert (each.header.frame_id, each.child_frame_id) == (header.src_frame_id, "main_optical")


def test_a_recording_says_who_made_it_with_what(tmp_path: Path) -> None:
    source = 'kind = "rtsp"\nurl = "rtsp://robot:hunter2@camera/stream"'
    _, box = recorded(recorder_config(tmp_path, source=source), Calibrated(14))
    (path,) = files(tmp_path)
    _, told, attachments = extras(path)
    assert told["gcd-node"]["boot_id"] == box.of("win")[0].header.boot_id
    assert told["gcd-node"]["version/torch"]
    assert "hfov_deg" not in told["gcd-node/source"]  # it is calibrated
    again = parse_config(attachments["config.toml"], "recorded")
    assert again.source.url == "rtsp://robot:***@camera/stream"
    assert again.record.folder == str(tmp_path)
    assert b"hunter2" not in path.read_bytes()
    assert not any("hunter2" in each.value.data for each in said(path) if each.topic.startswith("/gcd"))


def test_only_what_is_wanted_is_recorded_jpeg_as_it_is_and_no_transforms_without_metres(tmp_path: Path) -> None:
    for what, wanted, unwanted in (
        ("inputs", "/src/image", "/view/main/image"),
        ("views", "/view/main/image", "/src/image"),
    ):
        config = recorder_config(tmp_path / what, f'record.what=["{what}"]', "publish.encoding=jpeg")
        _, box = recorded(config, FakeSource(14))
        heard = said(files(tmp_path / what)[0])
        assert of(heard, wanted)
        assert of(heard, "/gcd/event")
        assert not of(heard, unwanted) + of(heard, "/tf")
        assert replayed(files(tmp_path / what)[0])[0].info.width == 96  # the only pictures there are
    (message,) = box.of("win")
    assert b"".join(each.value.data for each in of(heard, "/view/main/image")) == message.payload  # not coded again


def test_frames_of_a_view_follow_each_other_as_they_were_taken_and_a_status_is_a_diagnosis_of_every_part() -> None:
    message = window()
    at_ns, frames = message.header.t_publish_ns, message.header.shape[0]
    for source, step_ns in (('kind = "v4l2"', SECOND_NS // 10), (LOCKSTEP, 0)):
        told = data_messages(message, fake_config("view.top={}", source=source))
        made = [each.log_ns for each in told if each.topic.endswith("/image")]
        assert made == [at_ns + i * step_ns for i in range(frames)]
    parts = {
        "source": {"state": "lost", "fps": 0.0},
        "model": {"state": "degraded"},
        "stages": {"age": {"p50_ms": 7.5}},
    }
    fields = {"state": "active", "level": 2, "reasons": ["SRC_LOST"], **parts}
    _, array = note_messages("status", origin(), fields, 1)
    parts = array.fields.status
    assert [(each.name.removeprefix("gcd: "), each.level, each.message) for each in parts] == [
        *(("node", 2, "active"), ("source", 2, "lost"), ("model", 1, "degraded"), ("stages", 0, "")),
    ]
    assert [(each.key, each.value) for each in parts[3].values] == [("age", '{"p50_ms": 7.5}')]
    assert ("reasons", '["SRC_LOST"]') in [(each.key, each.value) for each in parts[0].values]


@pytest.mark.parametrize("known", ["stated", "source", "lens", "none"])
def test_camera_info_says_what_is_known_of_the_camera_and_a_replay_knows_as_much(known: str, tmp_path: Path) -> None:
    made, hfov_deg = Calibrated(14), None if known in ("lens", "none") else 90.0
    lens = LENS if known == "lens" else None
    made.info = replace(made.info, lens=lens, hfov_deg=90.0 if known == "source" else None)
    recorded(recorder_config(tmp_path, *(["source.hfov_deg=90.0"] if known == "stated" else [])), made)
    each = of(said(files(tmp_path)[0]), "/src/camera_info")[0].value
    assert (each.width, each.height) == (192, 128)
    k = np.zeros((3, 3)) if lens is None else LENS.matrix  # ROS's rule of what is not calibrated
    np.testing.assert_array_equal(np.reshape(each.k, (3, 3)), k)
    if lens is not None:
        assert (each.distortion_model, tuple(each.d)) == ("plumb_bob", LENS.coefficients)
    info = replayed(files(tmp_path)[0])[0].info
    assert (info.lens, info.hfov_deg, info.stamp_uncertainty_us) == (lens, hfov_deg, 500)


def test_the_layout_that_ships_shows_topics_that_are_recorded(whole: Run) -> None:
    layout = (Path(__file__).parents[2] / "launch" / "foxglove-layout.json").read_text().replace("/topdown/", "/main/")
    topics = {each.topic for each in whole[0]}
    named = set(re.findall(r'"(/\w[\w/]+)', layout))
    assert len(named) >= 8
    assert named <= topics | {"/grid/around"}  # of launch files that have one
    parts = {status.name for each in of(whole[0], "/diagnostics") for status in each.value.status}
    assert (
        set(re.findall(r'name==\\"([^\\]+)', layout)) == {"gcd: node", "gcd: source", "gcd: model", "gcd: rec"} <= parts
    )
