"""How recordings begin, end and rotate in a node that lives, and how they play again."""

import hashlib
import importlib.util
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from cameras import FPS, Bench, Camera
from fakes import Box, FakeSource, warping_traits
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
)
from rig import Rig

from gcd_node.config import parse_config
from gcd_node.control.message import Code
from gcd_node.errors import ConfigError, SourceError
from gcd_node.recording.folder import is_due, new_folder
from gcd_node.recording.recorder import Recorder
from gcd_node.sources.mcap_log import McapLog
from gcd_node.sources.own_recording import NODE_METADATA, SOURCE_METADATA, own_recording

pytestmark = pytest.mark.timeout(120)

RAW = 'input_encoding = "raw"'


def hashes(box: Box, kind: str = "win") -> list[str]:
    return [hashlib.sha256(each.payload).hexdigest() for each in box.of(kind)]


def section(folder: Path, more: str = "") -> str:
    return f'record = {{folder = "{folder}", keep_free_mb = 0{more}}}'


# --- a node that lives -------------------------------------------------------------------------------------------


def test_a_live_node_records_from_start_to_stop_and_says_so(tmp_path: Path) -> None:
    camera, folder = Camera(), tmp_path / "recordings"
    with Rig(tmp_path, Bench(camera), more=section(folder)) as rig:
        rig.await_state("active")
        camera.run(3)  # before anybody records
        assert rig.ask("record_stop").code is Code.WRONG_STATE
        assert rig.try_out("record_start").code is Code.OK
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
        ended = rig.await_event("REC_STOPPED")
        assert rig.ask("record_start").code is Code.ACCEPTED
        rig.await_event("REC_STARTED", 2)
    first, second = files(folder)
    assert begun["file"] == f"{first.parent.name}/{first.name}"
    assert status["rec"]["state"] == "recording"
    assert status["rec"]["file"] == begun["file"]
    assert status["rec"]["dropped"] == {}
    assert (ended["reason"], ended["file"], ended["finished"], ended["level"]) == ("ASKED", begun["file"], True, 0)
    assert ended["bytes"] == first.stat().st_size
    heard = said(first)
    assert ended["written"] == len(heard)
    assert [each.sequence for each in of(heard, "/src/image")][-28:] == list(range(3, 31))
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


def test_live_frames_are_stamped_with_the_time_of_their_capture(tmp_path: Path) -> None:
    camera, folder = Camera(), tmp_path / "recordings"
    before_ns = time.time_ns()
    with Rig(tmp_path, Bench(camera), more=section(folder, ", autostart = true")) as rig:
        rig.await_state("active")
        camera.run(15)
        rig.await_views(1)
        captured_ns = rig.of()[0].header.t_capture_ns
    after_ns = time.time_ns()
    heard = said(files(folder)[0])
    inputs, views = of(heard, "/src/image"), of(heard, "/view/main/image")
    assert all(before_ns <= each.stamp_ns <= after_ns for each in inputs)
    assert [each.log_ns for each in inputs] == [each.stamp_ns for each in inputs]
    steps = {later.stamp_ns - earlier.stamp_ns for earlier, later in pairwise(inputs)}
    assert all(abs(step - SECOND_NS / FPS) <= 1_000_000 for step in steps)
    assert [each.stamp_ns for each in views] == list(captured_ns)
    by_number = {each.sequence: each.stamp_ns for each in inputs}
    assert all(abs(each.stamp_ns - by_number[each.sequence]) <= 2_000_000 for each in views)  # two looks at the clock
    seconds, nanoseconds = of(heard, "/view/main/header")[0].told["t_publish"]
    assert views[0].log_ns == views[0].publish_ns == seconds * SECOND_NS + nanoseconds


def test_without_a_folder_or_the_package_nothing_can_be_recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="state the folder"):
        parse_config(b'[source]\nkind="synthetic"\n[model]\nweights="fake"\n[view.a]\n[record]\nautostart=true', "t")
    with pytest.raises(ConfigError, match=r"at least 0\.1 MB"):
        recorder_config(tmp_path, record="rotate_mb = 0.01")
    config = recorder_config(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(ConfigError, match=r"pip install 'gcd-node\[record\]'"):
        Recorder(config, "0" * 32, lambda: config, lambda *_: None)


# --- files -------------------------------------------------------------------------------------------------------


def test_a_recording_never_takes_the_name_of_another_one(tmp_path: Path) -> None:
    names = [new_folder(tmp_path, "gcd", "a" * 32).name for _ in range(3)]
    assert len(set(names)) == 3
    assert names == sorted(names)
    recorded(recorder_config(tmp_path / "deep" / "er"), FakeSource(14))
    recorded(recorder_config(tmp_path / "deep" / "er"), FakeSource(14))
    assert len(files(tmp_path / "deep")) == 2


@pytest.mark.parametrize(
    ("limits", "size", "age_s", "due"),
    [
        ("rotate_mb = 1", 999_999, 1e9, False),
        ("rotate_mb = 1", 1_000_000, 0.0, True),
        ("rotate_mb = 0\nrotate_s = 5", 10**12, 4.9, False),
        ("rotate_mb = 0\nrotate_s = 5", 0, 5.0, True),
        ("rotate_mb = 0", 10**12, 1e9, False),
    ],
)
def test_a_file_is_followed_by_another_by_size_or_by_age(
    limits: str, size: int, age_s: float, due: bool, tmp_path: Path
) -> None:
    assert is_due(recorder_config(tmp_path, record=limits).record, size, age_s) is due


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Box]:
    folder = tmp_path_factory.mktemp("rotated")
    _, box = recorded(recorder_config(folder, record=f"{RAW}\nrotate_mb = 0.6"), Calibrated(45))
    return folder, box


def test_every_file_of_a_recording_that_rotated_can_be_read_alone(rotated: tuple[Path, Box]) -> None:
    folder, box = rotated
    found = files(folder)
    assert len(found) >= 3
    numbers: list[int] = []
    for part, path in enumerate(found):
        heard = said(path)
        assert metadata(path)["gcd-node"]["part"] == str(part)
        assert metadata(path)["gcd-node/source"]["width"] == "192"
        assert "config.toml" in attachments(path)
        assert path.stat().st_size < 1_500_000
        if part > 0:
            assert metadata(path)["gcd-node/weights"]["name"] == "fake"
            assert of(heard, "/gcd/meta")[0].told["weights"]["name"] == "fake"
        images = [each.sequence for each in of(heard, "/src/image")]
        assert images == [each.sequence for each in of(heard, "/src/camera_info")]
        numbers += images
        assert len(of(heard, "/view/main/image")) == 14 * len(of(heard, "/view/main/header"))  # windows whole
    assert numbers == list(range(45))
    told = [fields for topic, fields in box.notes if topic == "event" and fields["code"] == "REC_ROTATED"]
    assert [fields["file"] for fields in told] == [f"{path.parent.name}/{path.name}" for path in found[1:]]


# --- playing again -----------------------------------------------------------------------------------------------


def test_a_folder_plays_all_parts_of_its_recording_as_the_source_gave_them(rotated: tuple[Path, Box]) -> None:
    folder, box = rotated
    recording = files(folder)[0].parent
    source, again = replayed(recording)
    assert hashes(again) == hashes(box)
    assert len(hashes(again)) == 3
    assert [message.header.t_capture_ns for message in again.of("win")] == [
        message.header.t_capture_ns for message in box.of("win")
    ]
    assert source.info.id == recording.name
    alone = [frame.seq for frame in McapLog(files(folder)[1]).frames()]
    assert alone == [each.sequence for each in of(said(files(folder)[1]), "/src/image")]


def test_a_raw_recording_gives_the_same_payloads_every_time(tmp_path: Path) -> None:
    _, box = recorded(recorder_config(tmp_path, record=RAW), FakeSource(30, fps=10.0), warping_traits())
    (path,) = files(tmp_path)
    runs = [replayed(path, warping_traits())[1] for _ in range(2)]
    for kind in ("win", "cls"):
        assert hashes(runs[0], kind) == hashes(runs[1], kind) == hashes(box, kind) != []


def test_the_input_is_played_though_there_are_views_and_its_lens_comes_back(tmp_path: Path) -> None:
    recorded(recorder_config(tmp_path), Calibrated(14))
    source, _ = replayed(files(tmp_path)[0])
    assert source.info.lens == LENS
    assert (source.info.width, source.info.stamp_uncertainty_us) == (192, 500)
    view, _ = replayed(files(tmp_path)[0], source='topic = "/view/main/image"')
    assert (view.info.width, view.info.lens is None) == (96, False)  # a view can be played too, through its own camera


def test_a_field_of_view_comes_back_as_one_and_not_as_a_lens(tmp_path: Path) -> None:
    class Wide(FakeSource):
        def __init__(self) -> None:
            super().__init__(14)
            self.info = replace(self.info, hfov_deg=53.13)

    _, box = recorded(recorder_config(tmp_path), Wide())
    source, again = replayed(files(tmp_path)[0])
    assert (source.info.lens, source.info.hfov_deg) == (None, 53.13)
    assert again.of("win")[0].header.intrinsics == box.of("win")[0].header.intrinsics


def test_a_folder_with_two_recordings_does_not_play(tmp_path: Path) -> None:
    recorded(recorder_config(tmp_path / "a"), FakeSource(14))
    recorded(recorder_config(tmp_path / "b"), FakeSource(14))
    both = tmp_path / "both"
    both.mkdir()
    for path in files(tmp_path):
        path.rename(both / path.name)
    with pytest.raises(SourceError, match=r"is a folder; give the \.mcap file"):
        replayed(both)


def test_a_recording_without_inputs_says_what_it_has(tmp_path: Path) -> None:
    recorded(recorder_config(tmp_path, record='what = ["views"]'), FakeSource(14))
    source, _ = replayed(files(tmp_path)[0])
    assert source.info.width == 96  # the only pictures there are


def test_what_strangers_write_into_the_metadata_is_left_out() -> None:
    junk = {"recording": "r", "part": "x", "input_topic": "/src/image"}
    source = {"hfov_deg": "nan", "stamp_uncertainty_us": "-1", "calibrated": "perhaps"}
    own = own_recording({NODE_METADATA: junk, SOURCE_METADATA: source})
    assert own is not None
    assert (own.part, own.hfov_deg, own.stamp_uncertainty_us, own.calibrated) == (0, None, None, False)
    assert own_recording({"rosbag2": {"recording": "r"}}) is None
