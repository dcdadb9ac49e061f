"""What is in a recording, read back with the reference libraries."""

import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import Box, FakeSource, warping_traits
from mcap_ros2._dynamic import serialize_dynamic
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
    said,
    summary,
)
from wire_messages import window

from gcd_node.config import parse_config
from gcd_node.envelope import depth_m, images
from gcd_node.health.report import Level
from gcd_node.recording import messages, schemas
from gcd_node.recording.diagnostics import to_diagnostics
from gcd_node.recording.entries import Translator
from gcd_node.recording.items import ViewItem
from gcd_node.recording.messages import DiagnosticStatus, FrameTransform, Stamped
from gcd_node.wire.record_json import to_json

pytestmark = pytest.mark.timeout(120)

HEAD = Stamped(stamp_ns=1_750_000_000_123_456_789, frame_id="öptical")
STAMP = {"sec": 1_750_000_000, "nanosec": 123_456_789}
HEADER = {"stamp": STAMP, "frame_id": "öptical"}

# --- messages are laid out as ROS 2 lays them out ----------------------------------------------------------------


PIXELS = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
CAMERA = {
    "header": HEADER,
    "height": 128,
    "width": 192,
    "distortion_model": "plumb_bob",
    "d": list(LENS.coefficients),
    "k": LENS.matrix.flatten().tolist(),
    "r": np.eye(3).flatten().tolist(),
    "p": [200.0, 0, 95.5, 0, 0, 201.0, 63.5, 0, 0, 0, 1, 0],
}
RAW = {"header": HEADER, "height": 4, "width": 6, "encoding": "rgb8", "step": 18, "data": PIXELS.tobytes()}
STATUS = {"level": 2, "name": "n", "message": "", "hardware_id": "h", "values": [{"key": "a", "value": "bß"}]}


@pytest.mark.parametrize(
    ("schema", "ours", "theirs"),
    [
        (schemas.STRING, messages.string("ä{}"), {"data": "ä{}"}),
        (schemas.FLOAT64, messages.float64(-1.5), {"data": -1.5}),
        (
            schemas.COMPRESSED_IMAGE,
            messages.compressed_image(HEAD, b"\xff\xd8x"),
            {"header": HEADER, "format": "jpeg", "data": b"\xff\xd8x"},
        ),
        (schemas.IMAGE, messages.image(HEAD, PIXELS), RAW),
        (schemas.CAMERA_INFO, messages.source_camera(HEAD, (192, 128), LENS), CAMERA),
        (
            schemas.CAMERA_INFO,
            messages.source_camera(HEAD, (96, 64), None),
            {"header": HEADER, "height": 64, "width": 96, "r": CAMERA["r"]},
        ),
        (
            schemas.DIAGNOSTIC_ARRAY,
            messages.diagnostics(
                HEAD.stamp_ns,
                [DiagnosticStatus(name="n", level=Level.ERROR, message="", hardware_id="h", values={"a": "bß"})],
            ),
            {"header": {"stamp": STAMP}, "status": [STATUS]},
        ),
        (
            schemas.TF_MESSAGE,
            messages.transforms(
                [FrameTransform(stamp_ns=HEAD.stamp_ns, parent="öptical", child="c", parent_from_child=np.eye(4))]
            ),
            {
                "transforms": [
                    {"header": HEADER, "child_frame_id": "c", "transform": {"rotation": {"w": 1.0}}},
                ]
            },
        ),
    ],
    ids=lambda each: getattr(each, "name", None),
)
def test_a_message_has_the_bytes_the_reference_encoder_gives_it(
    schema: schemas.Schema, ours: bytes, theirs: dict[str, object]
) -> None:
    assert ours == serialize_dynamic(schema.name, schema.text)[schema.name](theirs)


def test_a_rotation_survives_being_written_as_a_quaternion() -> None:
    for turn in np.random.default_rng(0).normal(size=(200, 3)) * 2:
        rotation = cv2.Rodrigues(turn)[0]
        x, y, z, w = messages.quaternion(rotation)
        axis = 2 * np.arctan2(np.linalg.norm((x, y, z)), w) * np.array((x, y, z)) / np.linalg.norm((x, y, z))
        np.testing.assert_allclose(cv2.Rodrigues(axis)[0], rotation, atol=1e-9)


# --- what is in a recording --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Said], Box, Path]:
    """Two windows of a model that draws class maps, on two samples, and everything recorded of them."""
    folder = tmp_path_factory.mktemp("run")
    config = recorder_config(folder, more="samples = 2")
    _, box = recorded(config, FakeSource(30, fps=10.0), warping_traits())
    (path,) = files(folder)
    return said(path), box, path


def test_everything_decodes_and_is_counted_by_the_index(run: tuple[list[Said], Box, Path]) -> None:
    heard, _, path = run
    counts, found = Counter(each.topic for each in heard), summary(path)
    assert found.statistics is not None
    assert {each.topic: found.statistics.channel_message_counts[key] for key, each in found.channels.items()} == counts
    assert {name: counts[name] for name in counts if not name.startswith(("/gcd", "/diag"))} == {
        "/src/image": 30,
        "/src/camera_info": 30,
        "/view/main/image": 28,
        "/view/main/camera_info": 28,
        "/view/main/classes": 28,
        "/view/main/std": 28,
        "/view/main/header": 2,
        "/view/main/std_header": 2,
        "/view/main/age_ms": 2,
        "/tf": 2,
    }
    assert counts["/gcd/status"] == counts["/diagnostics"] > 0
    assert counts["/gcd/meta"] == 1


def test_every_message_is_one_of_ros_2_so_that_it_can_be_played_there(run: tuple[list[Said], Box, Path]) -> None:
    """`ros2 bag play` refuses files in which some messages are CDR and others not (rosbag2 issue 1245)."""
    assert {each.channel.message_encoding for each in run[0]} == {"cdr"}
    assert {each.schema.encoding for each in run[0]} == {"ros2msg"}
    with run[2].open("rb") as file:
        assert b"ros2" in file.read(40)  # the profile


def test_stamps_are_those_of_the_capture_and_numbers_those_of_the_source(run: tuple[list[Said], Box, Path]) -> None:
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


def test_pictures_are_what_was_seen_and_published(run: tuple[list[Said], Box, Path]) -> None:
    heard, box, _ = run
    for each, number in zip(of(heard, "/src/image"), range(30), strict=True):
        picture = cv2.imdecode(np.frombuffer(each.value.data, np.uint8), cv2.IMREAD_COLOR)
        assert each.value.format == "jpeg"
        assert np.abs(picture.astype(int) - (20 + number)).max() <= 2
    drawn = np.concatenate([images(message) for message in box.of("cls")])
    for each, pixels in zip(of(heard, "/view/main/classes"), drawn, strict=True):
        assert (each.value.encoding, each.value.step) == ("mono8", 96)
        assert each.value.data == pixels.tobytes()
    spread = np.concatenate([images(message) for message in box.of("std")])
    assert b"".join(each.value.data for each in of(heard, "/view/main/std")) == spread.tobytes()
    shown = np.concatenate([images(message) for message in box.of("win")])
    for each, pixels in zip(of(heard, "/view/main/image"), shown, strict=True):
        picture = cv2.imdecode(np.frombuffer(each.value.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(picture.astype(int) - pixels).max() <= 3


def test_visibility_and_depth_come_back_as_they_were_published(tmp_path: Path) -> None:
    _, box = recorded(recorder_config(tmp_path), FakeSource(28), holds=("visibility", "inverse_depth"))
    heard = said(files(tmp_path)[0])
    seen = np.concatenate([images(message) for message in box.of("vis")])
    metres = np.concatenate([depth_m(message) for message in box.of("depth")])
    for topic, encoding, dtype, wanted in (
        ("visibility", "mono8", np.uint8, seen[..., 0]),
        ("depth", "32FC1", np.float32, metres),
    ):
        found = [each.value for each in of(heard, f"/view/main/{topic}")]
        assert {(each.encoding, each.height, each.step) for each in found} == {(encoding, 64, 96 * dtype().nbytes)}
        pixels = np.stack([np.frombuffer(each.data, dtype).reshape(64, 96) for each in found])
        assert np.array_equal(pixels, wanted, equal_nan=dtype is np.float32)


def test_headers_are_the_wire_s_own(run: tuple[list[Said], Box, Path]) -> None:
    heard, box, _ = run
    for topic, kind in (("header", "win"), ("std_header", "std")):
        assert [each.told for each in of(heard, f"/view/main/{topic}")] == [
            to_json(message.header) for message in box.of(kind)
        ]
    ages = [each.value.data for each in of(heard, "/view/main/age_ms")]
    assert ages == [message.header.age_ms for message in box.of("win")]


def test_the_virtual_camera_stands_where_the_header_says(run: tuple[list[Said], Box, Path]) -> None:
    heard, box, _ = run
    header = box.of("win")[1].header
    assert header.source_from_view is not None
    transforms = of(heard, "/tf")[1].value.transforms
    for each, numbers in zip(transforms, header.source_from_view, strict=True):
        place = each.transform.translation
        np.testing.assert_allclose((place.x, place.y, place.z), np.reshape(numbers, (4, 4))[:3, 3])
        assert (each.header.frame_id, each.child_frame_id) == (header.src_frame_id, "main_optical")


def test_a_scene_without_metres_has_no_transforms(tmp_path: Path) -> None:
    recorded(recorder_config(tmp_path), FakeSource(14))
    heard = said(files(tmp_path)[0])
    assert of(heard, "/view/main/header")
    assert not of(heard, "/tf")


def test_a_recording_says_who_made_it_with_what(tmp_path: Path) -> None:
    source = 'kind = "rtsp"\nurl = "rtsp://robot:hunter2@camera/stream"'
    _, box = recorded(recorder_config(tmp_path, source=source), Calibrated(14))
    (path,) = files(tmp_path)
    told = metadata(path)
    assert told["gcd-node"]["boot_id"] == box.of("win")[0].header.boot_id
    assert told["gcd-node/weights"]["cfg_digest"] == box.of("win")[0].header.cfg_digest
    assert told["gcd-node"]["version/torch"]
    assert told["gcd-node/weights"]["sha256_12"] == "0" * 12
    assert told["gcd-node/source"]["calibrated"] == "yes"
    launch = attachments(path)["config.toml"]
    again = parse_config(launch, "recorded")
    assert again.source.url == "rtsp://robot:***@camera/stream"
    assert again.record.folder == str(tmp_path)
    assert b"hunter2" not in path.read_bytes()
    assert not any(b"hunter2" in each.data for each in said(path))


def test_json_can_stand_on_channels_of_its_own_with_a_schema(tmp_path: Path) -> None:
    _, box = recorded(recorder_config(tmp_path, record='notes = "json"'), FakeSource(14))
    heard = said(files(tmp_path)[0])
    (header,) = of(heard, "/view/main/header")
    described = json.loads(header.schema.data)["properties"]
    assert (header.channel.message_encoding, header.schema.encoding) == ("json", "jsonschema")
    assert header.value == to_json(box.of("win")[0].header)
    kinds = {"string": str, "integer": int, "number": (int, float), "boolean": bool, "array": list, "object": dict}
    assert all(isinstance(header.value[key], kinds[described[key]["type"]]) for key in described if key in header.value)
    assert {"age_ms", "window_id", "src", "quality"} <= set(described)
    status = of(heard, "/gcd/status")[-1]
    assert status.value["state"] in ("deactivating", "inactive", "shuttingdown", "finalized")
    assert of(heard, "/diagnostics")


def test_a_view_that_was_published_as_jpeg_is_not_coded_again(tmp_path: Path) -> None:
    text = recorder_config(tmp_path)
    config = parse_config(
        f'[source]\nkind="synthetic"\npace="lockstep"\n[model]\nweights="fake"\n[view.main]\n'
        f'[publish]\nencoding="jpeg"\n[record]\nfolder="{text.record.folder}"\nkeep_free_mb=0\nautostart=true'.encode(),
        "test",
    )
    _, box = recorded(config, FakeSource(14))
    (message,) = box.of("win")
    assert b"".join(each.value.data for each in of(said(files(tmp_path)[0]), "/view/main/image")) == message.payload


def test_only_what_is_wanted_is_recorded(tmp_path: Path) -> None:
    for what, wanted, unwanted in (
        ("inputs", "/src/image", "/view/main/image"),
        ("views", "/view/main/image", "/src/image"),
    ):
        recorded(recorder_config(tmp_path / what, record=f'what = ["{what}"]'), FakeSource(14))
        heard = said(files(tmp_path / what)[0])
        assert of(heard, wanted)
        assert not of(heard, unwanted)
        assert of(heard, "/gcd/event")


def test_frames_of_a_view_follow_each_other_as_they_were_taken_and_end_before_the_next_window() -> None:
    message = window()
    live = parse_config(b'[source]\nkind="v4l2"\n[model]\nweights="fake"\n[view.top]', "test")
    lockstep = parse_config(b'[source]\nkind="synthetic"\npace="lockstep"\n[model]\nweights="fake"\n[view.top]', "t")
    at_ns, frames = message.header.t_publish_ns, message.header.shape[0]
    for config, step_ns in ((live, SECOND_NS // 10), (lockstep, 0)):
        made = [each for each in Translator(config).entries(ViewItem(message=message)) if each.topic.endswith("/image")]
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
    told = {each.name: each for each in to_diagnostics("gcd", fields)}
    assert {name: int(each.level) for name, each in told.items()} == {
        "gcd: node": 2,
        "gcd: source": 2,
        "gcd: model": 1,
        "gcd: stages": 0,
    }
    assert told["gcd: source"].message == "lost"
    assert told["gcd: stages"].values == {"age.p50_ms": "7.5"}
    assert told["gcd: node"].values["reasons"] == "SRC_LOST"


def test_the_layout_that_ships_shows_topics_that_are_recorded(run: tuple[list[Said], Box, Path]) -> None:
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
