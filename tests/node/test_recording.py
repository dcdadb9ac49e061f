"""What is in a recording, read back with the reference libraries."""

import json
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pytest
from fakes import Box, FakeSource, painting_traits
from recordings import (
    LENS,
    SECOND_NS,
    Calibrated,
    Said,
    attachments,
    files,
    metadata,
    of,
    recorded,
    recorder_config,
    replayed,
    said,
    summary,
)
from rosbags.highlevel import AnyReader
from wire_messages import origin, window

from gcd_client.images import depth_m, images
from gcd_client.protocol import to_json
from gcd_node.config import parse_config
from gcd_node.ros_messages import note_messages, view_messages
from gcd_node.sources.logs import pose_of

pytestmark = pytest.mark.timeout(120)
Run: TypeAlias = tuple[list[Said], Box, Path]

# --- what is in a recording --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Two windows of a model that draws class maps, visibility and depth, on two samples, and all recorded of them."""
    folder = tmp_path_factory.mktemp("run")
    config = recorder_config(folder, more="samples = 2")
    holds = ("visibility", "inverse_depth")
    _, box = recorded(config, FakeSource(30, fps=10.0), painting_traits(), holds)
    (path,) = files(folder)
    return said(path), box, path


def test_everything_is_of_ros_2_decodes_and_is_counted_by_the_index(run: Run) -> None:
    heard, _, path = run
    counts, found = Counter(each.topic for each in heard), summary(path)
    assert found.statistics is not None
    assert {each.topic: found.statistics.channel_message_counts[key] for key, each in found.channels.items()} == counts
    pictures = ("image", "camera_info", "classes", "std", "visibility", "depth")
    wanted = {"/src/image": 30, "/src/camera_info": 30, "/tf": 2} | {f"/view/main/{name}": 28 for name in pictures}
    wanted |= {f"/view/main/{name}": 2 for name in ("header", "std_header", "age_ms")}
    assert {name: counts[name] for name in counts if not name.startswith(("/gcd", "/diag"))} == wanted
    assert counts["/gcd/status"] == counts["/diagnostics"] > 0
    assert counts["/gcd/meta"] == 1
    # `ros2 bag play` refuses files in which some messages are CDR and others not (rosbag2 issue 1245)
    assert {each.message_encoding for each in found.channels.values()} == {"cdr"}
    assert {each.encoding for each in found.schemas.values()} == {"ros2msg"}
    with AnyReader([path]) as reader:  # by the definitions in the file
        values = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert len(values) == len(heard)


def test_stamps_are_those_of_the_capture_and_numbers_those_of_the_source(run: Run) -> None:
    heard, box, _ = run
    inputs, views = of(heard, "/src/image"), of(heard, "/view/main/image")
    assert [each.stamp_ns for each in inputs] == [round(i * 1e8) for i in range(30)]
    assert [each.sequence for each in inputs] == list(range(30))
    headers = [message.header for message in box.of("win")]
    assert [each.stamp_ns for each in views] == [stamp for header in headers for stamp in header.t_capture_ns]
    assert [each.sequence for each in views] == [number for header in headers for number in header.src.seq]
    for topic in ("classes", "std", "camera_info"):
        assert [each.stamp_ns for each in of(heard, f"/view/main/{topic}")] == [each.stamp_ns for each in views]
    assert [each.stamp_ns for each in of(heard, "/src/camera_info")] == [each.stamp_ns for each in inputs]
    assert {each.publish_ns for each in views} == {header.t_publish_ns for header in headers}
    assert all(abs(each.log_ns - time.time_ns()) < 600 * SECOND_NS for each in heard)


def test_pictures_are_what_was_seen_and_published(run: Run) -> None:
    heard, box, _ = run
    for topic, wanted, most in (
        ("/src/image", [np.full((64, 96, 3), 20 + number) for number in range(30)], 2),
        ("/view/main/image", np.concatenate([images(message) for message in box.of("win")]), 3),
    ):
        for each, pixels in zip(of(heard, topic), wanted, strict=True):
            assert each.value.format == "jpeg"
            picture = cv2.imdecode(np.frombuffer(each.value.data, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None
            assert np.abs(picture[..., ::-1].astype(int) - pixels).max() <= most


def test_maps_come_back_as_they_were_published(run: Run) -> None:
    heard, box, _ = run
    for topic, kind in (("classes", "cls"), ("std", "std"), ("visibility", "vis"), ("depth", "depth")):
        encoding, pixels_of = ("32FC1", depth_m) if kind == "depth" else ("mono8", images)
        wanted = np.concatenate([pixels_of(message) for message in box.of(kind)]).reshape(-1, 64, 96)
        found = [each.value for each in of(heard, f"/view/main/{topic}")]
        assert {(each.encoding, each.height, each.step) for each in found} == {(encoding, 64, 96 * wanted.itemsize)}
        pixels = np.stack([np.frombuffer(each.data, wanted.dtype).reshape(64, 96) for each in found])
        np.testing.assert_array_equal(pixels, wanted)


def test_headers_and_poses_are_the_wire_s_own(run: Run) -> None:
    heard, box, _ = run
    for topic, kind in (("header", "win"), ("std_header", "std")):
        assert [each.told for each in of(heard, f"/view/main/{topic}")] == [
            json.loads(json.dumps(to_json(message.header))) for message in box.of(kind)
        ]
    ages = [each.value.data for each in of(heard, "/view/main/age_ms")]
    assert ages == [message.header.age_ms for message in box.of("win")]

    header = box.of("win")[1].header
    assert header.source_from_view is not None
    transforms = of(heard, "/tf")[1].value.transforms
    for each, numbers in zip(transforms, header.source_from_view, strict=True):
        place, turn = each.transform.translation, each.transform.rotation
        np.testing.assert_allclose(pose_of(place, turn), np.reshape(numbers, (4, 4)), atol=1e-6)
        assert (each.header.frame_id, each.child_frame_id) == (header.src_frame_id, "main_optical")


def test_a_recording_says_who_made_it_with_what(tmp_path: Path) -> None:
    source = 'kind = "rtsp"\nurl = "rtsp://robot:hunter2@camera/stream"'
    _, box = recorded(recorder_config(tmp_path, source=source), Calibrated(14))
    (path,) = files(tmp_path)
    told = metadata(path)
    assert told["gcd-node"]["boot_id"] == box.of("win")[0].header.boot_id
    assert told["gcd-node"]["version/torch"]
    assert "hfov_deg" not in told["gcd-node/source"]  # it is calibrated
    launch = attachments(path)["config.toml"]
    again = parse_config(launch, "recorded")
    assert again.source.url == "rtsp://robot:***@camera/stream"
    assert again.record.folder == str(tmp_path)
    assert b"hunter2" not in path.read_bytes()
    assert not any("hunter2" in each.value.data for each in said(path) if each.topic.startswith("/gcd"))


def test_only_what_is_wanted_is_recorded_jpeg_as_it_is_and_no_transforms_without_metres(tmp_path: Path) -> None:
    for what, wanted, unwanted in (
        ("inputs", "/src/image", "/view/main/image"),
        ("views", "/view/main/image", "/src/image"),
    ):
        record = f'what = ["{what}"]\n[publish]\nencoding = "jpeg"'
        _, box = recorded(recorder_config(tmp_path / what, record=record), FakeSource(14))
        heard = said(files(tmp_path / what)[0])
        assert of(heard, wanted)
        assert not of(heard, unwanted) + of(heard, "/tf")
        assert of(heard, "/gcd/event")
    (message,) = box.of("win")
    assert b"".join(each.value.data for each in of(heard, "/view/main/image")) == message.payload  # not coded again


def test_frames_of_a_view_follow_each_other_as_they_were_taken_and_end_before_the_next_window() -> None:
    message = window()
    live = parse_config(b'[source]\nkind="v4l2"\n[model]\nweights="fake"\n[view.top]', "test")
    lockstep = parse_config(b'[source]\nkind="synthetic"\npace="lockstep"\n[model]\nweights="fake"\n[view.top]', "t")
    at_ns, frames = message.header.t_publish_ns, message.header.shape[0]
    for config, step_ns in ((live, SECOND_NS // 10), (lockstep, 0)):
        made = [each for each in view_messages(message, config) if each.topic.endswith("/image")]
        assert [each.log_ns for each in made] == [at_ns + i * step_ns for i in range(frames)]


def test_a_status_is_a_diagnosis_of_every_part() -> None:
    fields = {
        "state": "active",
        "level": 2,
        "reasons": ["SRC_LOST"],
        "source": {"state": "lost", "fps": 0.0},
        "model": {"state": "degraded"},
        "stages": {"age": {"p50_ms": 7.5}},
    }
    _, array = note_messages("status", origin(), fields, 1)
    parts = array.fields.status
    assert [(each.name, each.level, each.message) for each in parts] == [
        ("gcd: node", 2, "active"),
        ("gcd: source", 2, "lost"),
        ("gcd: model", 1, "degraded"),
        ("gcd: stages", 0, ""),
    ]
    assert [(each.key, each.value) for each in parts[3].values] == [("age", '{"p50_ms": 7.5}')]
    assert ("reasons", '["SRC_LOST"]') in [(each.key, each.value) for each in parts[0].values]


@pytest.mark.parametrize("known", ["stated", "source", "lens", "none"])
def test_camera_info_says_what_is_known_of_the_camera_and_a_replay_knows_as_much(known: str, tmp_path: Path) -> None:
    made, hfov_deg = Calibrated(14), None if known in ("lens", "none") else 90.0
    lens = LENS if known == "lens" else None
    made.info = replace(made.info, lens=lens, hfov_deg=90.0 if known == "source" else None)
    stated = "hfov_deg = 90.0" if known == "stated" else ""
    recorded(recorder_config(tmp_path, source=f'kind = "synthetic"\npace = "lockstep"\n{stated}'), made)
    each = of(said(files(tmp_path)[0]), "/src/camera_info")[0].value
    assert (each.width, each.height) == (192, 128)
    k = np.zeros((3, 3)) if lens is None else LENS.matrix  # ROS's rule of what is not calibrated
    np.testing.assert_array_equal(np.reshape(each.k, (3, 3)), k)
    if lens is not None:
        assert (each.distortion_model, tuple(each.d)) == ("plumb_bob", LENS.coefficients)
    info = replayed(files(tmp_path)[0])[0].info
    assert (info.lens, info.hfov_deg, info.stamp_uncertainty_us) == (lens, hfov_deg, 500)


def test_the_layout_that_ships_shows_topics_that_are_recorded(run: Run) -> None:
    layout = json.loads((Path(__file__).parents[2] / "launch" / "foxglove-layout.json").read_text())
    panels = layout["configById"]

    def shown(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else [*shown(node["first"]), *shown(node["second"])]

    assert sorted(shown(layout["layout"])) == sorted(panels)
    modes = [panel["imageMode"] for panel in panels.values() if "imageMode" in panel]
    paths = [path["value"] for panel in panels.values() for path in panel.get("paths", ())]
    named = {mode[key] for mode in modes for key in ("imageTopic", "calibrationTopic") if key in mode}
    named |= {path.split(".")[0] for path in paths}
    named |= {panel[key] for panel in panels.values() for key in ("topicToRender", "topicPath") if key in panel}
    assert len(named) >= 8
    assert {name.replace("/topdown/", "/main/") for name in named} <= {each.topic for each in run[0]}
    parts = {status.name for each in of(run[0], "/diagnostics") for status in each.value.status}
    drawn = {path.split('"')[1] for path in paths if "name==" in path}
    assert drawn == {"gcd: node", "gcd: source", "gcd: model", "gcd: rec"}
    assert drawn <= parts
