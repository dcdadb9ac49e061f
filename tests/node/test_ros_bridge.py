"""The ROS 2 bridge without ROS: what the wire's headers become, what is handed on, and every call it makes of rclpy."""

import ast
import importlib
import os
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import zmq
from msgspec.structs import replace
from wire_messages import OTHER_BOOT, depth, origin, pixels, visibility, window

import gcd_client
from gcd_client.endpoints import AuthError, SetupError
from gcd_client.images import encode_jpegs, inverse_depth
from gcd_client.protocol import Message, StatusMessage, ViewMessage, encode
from gcd_client.subscriber import ReceivedView

ROS2 = Path(__file__).parents[2] / "launch" / "ros2"
sys.path.insert(0, str(ROS2))
import bridge_messages as ros  # noqa: E402
import gcd_bridge  # noqa: E402
from bridge_messages import Settings  # noqa: E402

PATIENCE_S = 30.0
CAPTURED_NS = 1_700_000_000_000_000_001  # of the first frame in wire_messages


def received(message: ViewMessage, **changes: Any) -> ReceivedView:
    view = ReceivedView(message=message, age_ms=50.0, expired=False, skipped=0, restarted=False)
    return replace(view, **changes)


def with_header(message: ViewMessage, **changes: Any) -> ViewMessage:
    return replace(message, header=replace(message.header, **changes))


def jpeg_window(window_id: int = 0) -> ViewMessage:
    payload, offsets = encode_jpegs(pixels(window_id, height=16, width=24))
    made = window(window_id)
    header = replace(made.header, encoding="jpeg", offsets=offsets, shape=(2, 16, 24, 3))
    return ViewMessage(topic=made.topic, header=header, payload=payload)


# From the wire to records.


def test_a_time_is_split_without_losing_a_nanosecond() -> None:
    for stamp_ns in (0, 1, 999_999_999, 10**9, CAPTURED_NS):
        made = ros.to_time(stamp_ns)
        assert made.sec * 10**9 + made.nanosec == stamp_ns
        assert 0 <= made.nanosec < 10**9


def rotations() -> Iterator[np.ndarray]:
    chance = np.random.default_rng(0)
    for _ in range(50):
        basis = np.linalg.qr(chance.normal(size=(3, 3)))[0]
        yield basis * np.linalg.det(basis)
    yield np.eye(3)
    for axis in range(3):  # half turns, where the usual formula divides by zero
        half = -np.eye(3)
        half[axis, axis] = 1.0
        yield half


def test_a_quaternion_is_the_rotation_it_was_made_from() -> None:
    for rotation in rotations():
        q = ros.to_quaternion(rotation)
        x, y, z, w = q.x, q.y, q.z, q.w
        back = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        assert np.allclose(back, rotation, atol=1e-12)
        assert w >= 0


def test_the_picture_is_the_nodes_own_jpeg_stamped_when_its_frame_was_captured() -> None:
    message = jpeg_window()
    picture = ros.to_compressed_image(received(message), 1)
    assert picture.format == "jpeg"
    assert picture.data == array("B", message.payload[message.header.offsets[1] :])
    assert picture.header.frame_id == "top_optical"
    stamp = picture.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == message.header.t_capture_ns[1] == CAPTURED_NS + 100_000_000


def test_a_raw_picture_is_coded_with_red_where_it_was() -> None:
    image = np.zeros((2, 16, 24, 3), np.uint8)
    image[..., 0] = 255
    picture = ros.to_compressed_image(received(window(images=image)), 1)
    decoded = cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (16, 24, 3)
    assert decoded[..., 2].min() > 240  # OpenCV has blue first
    assert decoded[..., :2].max() < 15


def test_without_cv2_a_raw_picture_is_refused_and_the_remedy_named(monkeypatch: pytest.MonkeyPatch) -> None:
    coded = received(jpeg_window())
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(SetupError, match="cv2"):
        ros.to_compressed_image(received(window()), 1)
    assert ros.to_compressed_image(coded, 1).format == "jpeg"


def test_the_newest_frame_at_the_goal_is_chosen() -> None:
    header = window().header
    assert ros.newest_at_goal(header) == 1
    assert ros.newest_at_goal(replace(header, frame_role=("at_goal", "in_transit"))) == 0
    assert ros.newest_at_goal(replace(header, frame_role=("in_transit",) * 2)) is None


def test_the_camera_has_the_pictures_stamp_and_frame_and_no_distortion() -> None:
    message = window()
    info = ros.to_camera_info(message.header, 1)
    assert info.header == ros.to_compressed_image(received(message), 1).header
    assert (info.height, info.width) == (4, 6)
    assert info.k == message.header.intrinsics
    assert np.array_equal(np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3)))
    assert info.r == tuple(np.eye(3).ravel())
    assert (set(info.d), len(info.d)) == ({0.0}, 5)


def test_a_camera_nobody_knows_is_all_zeros() -> None:
    info = ros.to_camera_info(replace(window().header, intrinsics=None), 0)
    assert {*info.k, *info.r, *info.p} == {0.0}
    assert (len(info.k), len(info.r), len(info.p)) == (9, 9, 12)


SOURCE_FROM_VIEW = np.array([[0.0, 0, 1, 2], [-1, 0, 0, 3], [0, -1, 0, 4], [0, 0, 0, 1]])


def posed(units: str) -> Any:
    matrix = tuple(float(each) for each in SOURCE_FROM_VIEW.ravel())
    return replace(window().header, source_from_view=(matrix, matrix), pose_units=units)


def test_the_transform_takes_points_of_the_view_to_the_source_camera() -> None:
    made = ros.to_transform(posed("m"), 1, Settings())
    assert (made.header.frame_id, made.child_frame_id) == ("source_optical", "top_optical")
    moved, turned = made.transform.translation, made.transform.rotation
    assert (moved.x, moved.y, moved.z) == (2.0, 3.0, 4.0)
    assert np.allclose([turned.x, turned.y, turned.z, turned.w], [-0.5, 0.5, -0.5, 0.5])
    assert made.header.stamp == ros.to_header(posed("m"), 1).stamp


def test_scene_units_become_metres_only_if_somebody_says_how_long_they_are() -> None:
    assert ros.to_transform(posed("scene"), 1, Settings()) is None
    made = ros.to_transform(posed("scene"), 1, Settings(metres_per_unit=0.5, source_frame="oak_rgb"))
    assert made.transform.translation == ros.Vector3(x=1.0, y=1.5, z=2.0)
    assert made.header.frame_id == "oak_rgb"
    assert ros.to_transform(replace(posed("m"), source_from_view=None), 1, Settings()) is None


def status(**told: object) -> StatusMessage:
    return StatusMessage(topic="status", header=origin(), fields={"state": "active", "level": 0, "reasons": [], **told})


def test_a_status_becomes_a_diagnostic_with_every_field() -> None:
    note = status(level=2, reasons=["SRC_LOST", "fps"], source={"state": "lost", "fps": 9.5}, ready=False)
    made = ros.to_diagnostic(note, silent=False)
    assert (made.level, made.message, made.name, made.hardware_id) == (b"\2", "SRC_LOST, fps", "gcd: node gcd", "gcd")
    told = {each.key: each.value for each in made.values}
    assert told["source.state"] == "lost"
    assert (told["source.fps"], told["ready"], told["reasons"]) == ("9.5", "False", "SRC_LOST, fps")


def test_silence_is_stale_and_nonsense_is_a_warning() -> None:
    assert ros.to_diagnostic(None, silent=True).level == b"\3"
    assert ros.to_diagnostic(status(), silent=True).level == b"\3"
    assert ros.to_diagnostic(status(), silent=False).level == b"\0"
    for level in (7, -1, "2", None, True):
        assert ros.to_diagnostic(status(level=level, reasons={"a": 1}), silent=False).level == b"\1"


# The bridge, over real sockets.


@dataclass
class Sender:
    """A node's two sockets, that send what they are told to."""

    folder: Path
    context: "zmq.Context[zmq.Socket[bytes]]" = field(default_factory=zmq.Context)

    def __post_init__(self) -> None:
        self.sockets = {name: self.context.socket(zmq.XPUB) for name in ("data", "status")}
        for name, socket in self.sockets.items():
            socket.set(zmq.XPUB_VERBOSE, 1)
            socket.bind(f"ipc://{self.folder}/{name}")

    def wait(self, name: str, poll: Callable[[], None]) -> None:
        """Until somebody subscribes."""
        until(lambda: self.sockets[name].poll(10) and self.sockets[name].recv()[:1] == b"\1", poll)

    def send(self, message: Message, sequence: int = 0) -> None:
        name = "status" if isinstance(message, StatusMessage) else "data"
        self.sockets[name].send(encode(replace(message, sequence=sequence)))


def until(holds: Callable[[], object], poll: Callable[[], None]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline_s, "it did not come about"
        poll()
        time.sleep(0.002)


@dataclass
class Bench:
    """A bridge and what it has published, by topic."""

    sender: Sender
    bridge: Any
    out: dict[str, list[Any]]

    @property
    def feed(self) -> Any:
        return self.bridge.feeds[0]

    def pictures(self) -> list[Any]:
        return self.out.get("gcd/top/image/compressed", [])

    def until(self, holds: Callable[[], object]) -> None:
        until(holds, self.bridge.poll)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    sender, out = Sender(tmp_path), dict[str, list[Any]]()
    settings = Settings(
        data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status", views=("top",), max_age_ms=1e6
    )
    with gcd_bridge.Bridge(settings, lambda topic, record: out.setdefault(topic, []).append(record)) as bridge:
        sender.wait("data", bridge.poll)
        sender.wait("status", bridge.poll)
        yield Bench(sender, bridge, out)
    sender.context.destroy(linger=0)


def test_a_window_becomes_a_picture_its_camera_and_its_place_all_of_one_moment(bench: Bench) -> None:
    message = with_header(jpeg_window(3), pose_units="m")
    bench.sender.send(message)
    bench.until(bench.pictures)
    header = ros.to_header(message.header, 1)
    (picture,), (info,), (tree,) = bench.pictures(), bench.out["gcd/top/camera_info"], bench.out["/tf"]
    assert picture.header == info.header == header
    assert (tree.transforms[0].header.stamp, tree.transforms[0].child_frame_id) == (header.stamp, header.frame_id)
    assert list(bench.out) == ["/tf", "gcd/top/camera_info", "gcd/top/image/compressed"]
    assert bench.feed.counts == gcd_bridge.Counts(published=1)


def test_what_has_expired_or_is_too_old_or_damaged_is_not_published(bench: Bench) -> None:
    for sequence, (message, count) in enumerate(
        [
            (with_header(jpeg_window(), t_publish_ns=time.time_ns() - 10**9, valid_for_ms=500), "expired"),
            (with_header(jpeg_window(), age_ms=2e6), "too_old"),
        ]
    ):
        bench.sender.send(message, sequence)
        bench.until(lambda count=count: getattr(bench.feed.counts, count))
    bench.sender.sockets["data"].send(encode(jpeg_window())[:-1])
    bench.until(lambda: bench.feed.counts.damaged)
    assert bench.feed.to_diagnostic().level == b"\1"
    assert bench.pictures() == []
    bench.sender.send(jpeg_window(1), 5)
    bench.until(bench.pictures)
    assert (bench.feed.counts.missed, bench.feed.to_diagnostic().level) == (3, b"\0")


def test_a_restarted_node_gets_a_new_reader(bench: Bench) -> None:
    bench.sender.send(jpeg_window(8), 40)
    bench.until(bench.pictures)
    before = bench.feed._reader
    bench.sender.send(with_header(jpeg_window(0), boot_id=OTHER_BOOT), 0)
    bench.until(lambda: len(bench.pictures()) == 2)
    bench.sender.wait("data", bench.bridge.poll)
    assert bench.feed._reader is not before
    bench.sender.send(with_header(jpeg_window(1), boot_id=OTHER_BOOT), 1)
    bench.until(lambda: len(bench.pictures()) == 3)
    assert (bench.feed.counts.restarts, bench.feed.counts.missed) == (1, 0)


def test_a_view_that_arrives_nowhere_and_one_that_cannot_be_coded_are_trouble_in_the_diagnostics(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_transit = with_header(jpeg_window(), frame_role=("in_transit",) * 2)
    monkeypatch.setitem(sys.modules, "cv2", None)
    for sequence, message, said in (
        (0, in_transit, "at its goal"),
        (1, window(1), "cv2"),
    ):
        bench.sender.send(message, sequence)
        bench.until(lambda said=said: said in bench.feed.counts.trouble)
    assert bench.pictures() == []
    bench.until(lambda: "/diagnostics" in bench.out)
    assert "cv2" in bench.out["/diagnostics"][-1].status[1].message


def test_the_nodes_state_goes_to_diagnostics_once_a_second_and_silence_is_stale(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.until(lambda: "/diagnostics" in bench.out)
    assert bench.out["/diagnostics"][0].status[0].level == b"\3"
    bench.sender.send(status(level=1, reasons=["SRC_STALLED"]))
    bench.until(lambda: bench.bridge.to_diagnostics().status[0].level == b"\1")
    monkeypatch.setattr(gcd_bridge, "STALE_AFTER_S", 0.0)
    bench.until(lambda: bench.bridge.to_diagnostics().status[0].level == b"\3")


def test_a_node_that_does_not_let_us_in_is_asked_again_later(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(timeout_ms: float) -> None:
        raise AuthError("no key")

    bench.feed._reader.close()
    bench.feed._reader = SimpleNamespace(receive=refuse, close=lambda: None, stale=0, damaged=0)
    bench.bridge.poll()
    assert bench.feed.counts.trouble == "no key"
    assert bench.feed._reader is None
    bench.bridge.poll()
    assert bench.feed._reader is None  # it rests
    monkeypatch.setattr(bench.feed, "_rest_until_s", 0.0)
    bench.sender.wait("data", bench.bridge.poll)


# ROS, as far as the bridge calls it.

MESSAGES: dict[str, dict[str, dict[str, type | tuple[type, ...]]]] = {
    "builtin_interfaces.msg": {"Time": {"sec": int, "nanosec": int}},
    "std_msgs.msg": {"Header": {"stamp": object, "frame_id": str}},
    "sensor_msgs.msg": {
        "CompressedImage": {"header": object, "format": str, "data": array},
        "Image": {
            "header": object, "height": int, "width": int, "encoding": str, "is_bigendian": int, "step": int,
            "data": array,
        },
        "CameraInfo": {
            "header": object, "height": int, "width": int, "distortion_model": str, "d": list, "k": list, "r": list,
            "p": list, "binning_x": int, "binning_y": int, "roi": object,
        },
    },
    "geometry_msgs.msg": {
        "Vector3": {"x": float, "y": float, "z": float},
        "Quaternion": {"x": float, "y": float, "z": float, "w": float},
        "Transform": {"translation": object, "rotation": object},
        "TransformStamped": {"header": object, "child_frame_id": str, "transform": object},
    },
    "tf2_msgs.msg": {"TFMessage": {"transforms": list}},
    "diagnostic_msgs.msg": {
        "KeyValue": {"key": str, "value": str},
        "DiagnosticStatus": {"level": bytes, "name": str, "message": str, "hardware_id": str, "values": list},
        "DiagnosticArray": {"header": object, "status": list},
    },
}  # fmt: skip
"""Fields and Python types of the messages, by their .msg files."""


def message_class(name: str, known: dict[str, type | tuple[type, ...]]) -> type:
    def set_field(self: object, key: str, value: object) -> None:
        assert isinstance(value, known[key]), f"{name}.{key} is {type(value).__name__}"
        object.__setattr__(self, key, value)

    return type(name, (), {"__setattr__": set_field})


class EndedError(Exception):
    """As rclpy's."""


@dataclass
class FakeRos:
    """rclpy and its node: remembers what was asked of it; spin() runs the timers until `enough`."""

    parameters: dict[str, Any]
    enough: Callable[[], bool] = lambda: True
    published: dict[str, list[Any]] = field(default_factory=dict)
    publishers: dict[str, tuple[type, Any]] = field(default_factory=dict)
    calls: list[str] = field(default_factory=list)
    timers: list[tuple[float, Callable[[], None]]] = field(default_factory=list)

    def init(self, *, args: list[str]) -> None:
        self.calls.append(f"init {args[1:]}")

    def create_node(self, name: str) -> "FakeRos":
        self.calls.append(f"create_node {name}")
        return self

    def declare_parameter(self, name: str, default: Any) -> Any:
        value = self.parameters.get(name, default)
        assert type(value) is type(default), name  # ROS takes the type from the default
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: type, topic: str, qos: Any) -> Any:
        assert topic not in self.publishers
        self.publishers[topic] = (kind, qos)
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.timers.append((period_s, callback))

    def spin(self, node: object) -> None:
        ((_, callback),) = self.timers
        until(self.enough, callback)
        raise EndedError

    def destroy_node(self) -> None:
        self.calls.append("destroy_node")

    def try_shutdown(self) -> None:
        self.calls.append("try_shutdown")


@pytest.fixture
def fake_ros(monkeypatch: pytest.MonkeyPatch) -> FakeRos:
    fake = FakeRos({})
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {name: getattr(fake, name) for name in ("init", "create_node", "spin", "try_shutdown")},
        "rclpy.executors": {"ExternalShutdownException": EndedError},
        "rclpy.qos": {
            "QoSProfile": lambda *, depth, reliability: (depth, reliability),
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort", RELIABLE="reliable"),
        },
        **{
            package: {name: message_class(name, known) for name, known in classes.items()}
            for package, classes in MESSAGES.items()
        },
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return fake


def test_the_whole_bridge_runs_against_the_calls_it_makes_of_ros(fake_ros: FakeRos, tmp_path: Path) -> None:
    sender = Sender(tmp_path)
    fake_ros.parameters = {"data": f"ipc://{tmp_path}/data", "status": f"ipc://{tmp_path}/status", "views": "top, left"}
    topics = ["gcd/top/image/compressed", "gcd/top/camera_info", "/tf", "/diagnostics"]
    sequence = iter(range(10**6))

    def enough() -> bool:
        sender.send(with_header(jpeg_window(), pose_units="m"), next(sequence))
        return set(topics) <= {topic for topic, sent in fake_ros.published.items() if sent}

    fake_ros.enough = enough
    gcd_bridge.main(["gcd_bridge", "--ros-args"])
    sender.context.destroy(linger=0)
    assert set(fake_ros.publishers) == set(topics)
    qos = {topic: qos for topic, (_, qos) in fake_ros.publishers.items()}
    assert qos["gcd/top/image/compressed"] == qos["gcd/top/camera_info"] == (1, "best effort")
    assert qos["/tf"] == qos["/diagnostics"] == (10, "reliable")
    picture = fake_ros.published["gcd/top/image/compressed"][0]
    assert cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR).shape == (16, 24, 3)
    assert picture.header.stamp.sec == 1_700_000_000
    assert [each.name for each in fake_ros.published["/diagnostics"][0].status[1:]] == [
        "gcd: bridge top",
        "gcd: bridge left",
    ]
    assert fake_ros.calls == ["init ['--ros-args']", "create_node gcd_bridge", "destroy_node", "try_shutdown"]
    assert fake_ros.timers[0][0] == gcd_bridge.POLL_S


def test_every_record_has_the_fields_of_its_ros_message() -> None:
    known = {name: package for package, classes in MESSAGES.items() for name in classes}
    assert known == ros.PACKAGES
    for name, package in known.items():
        wanted = set(MESSAGES[package][name]) - {"binning_x", "binning_y", "roi"}  # their defaults are right
        assert {each.name for each in fields(getattr(ros, name))} == wanted


def test_depth_is_metres_with_nan_for_none_and_visibility_its_own_numbers() -> None:
    for index in range(2):
        message = depth(3)
        made, inverse = ros.to_image(received(message), index), inverse_depth(message)[index]
        assert (made.encoding, made.height, made.width, made.step) == ("32FC1", 4, 6, 24)
        metres = np.frombuffer(made.data, np.float32).reshape(4, 6)
        assert np.array_equal(np.isnan(metres), inverse == 0)
        assert np.allclose(metres[inverse > 0] * inverse[inverse > 0], 1)
        seen = ros.to_image(received(visibility(3)), index)
        assert (seen.encoding, seen.step) == ("mono8", 6)
        assert seen.data.tobytes() == visibility(3).payload[24 * index : 24 * (index + 1)]


def test_maps_are_published_where_they_are_asked_for(fake_ros: FakeRos, tmp_path: Path) -> None:
    sender = Sender(tmp_path)
    fake_ros.parameters = {"data": f"ipc://{tmp_path}/data", "status": f"ipc://{tmp_path}/status", "views": "top"}
    fake_ros.parameters["maps"] = "vis, depth"
    sequence = iter(range(10**6))

    def enough() -> bool:
        for message in (visibility(), depth()):
            sender.send(message, next(sequence))
        return {"gcd/top/vis", "gcd/top/depth", "/diagnostics"} <= {
            topic for topic, sent in fake_ros.published.items() if sent
        }

    fake_ros.enough = enough
    gcd_bridge.main(["gcd_bridge", "--ros-args"])
    sender.context.destroy(linger=0)
    assert set(fake_ros.publishers) == {"gcd/top/vis", "gcd/top/depth", "/diagnostics"}
    assert fake_ros.publishers["gcd/top/depth"][1] == (1, "best effort")
    assert [each.name for each in fake_ros.published["/diagnostics"][-1].status[1:]] == [
        "gcd: bridge top",
        "gcd: bridge top vis",
        "gcd: bridge top depth",
    ]


def test_settings_come_from_parameters(fake_ros: FakeRos) -> None:
    fake_ros.parameters = {"views": "a", "metres_per_unit": 0.2, "source_frame": "oak", "maps": "depth"}
    made = gcd_bridge.Ros(fake_ros).settings()
    assert made == Settings(views=("a",), metres_per_unit=0.2, source_frame="oak", maps=("depth",))


def test_the_launch_file_starts_the_bridge_with_parameters_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    def call(name: str) -> Callable[..., Any]:
        return lambda *args, **named: SimpleNamespace(kind=name, args=args, **named)

    classes = {
        "launch": "LaunchDescription",
        "launch.actions": "DeclareLaunchArgument",
        "launch.substitutions": "LaunchConfiguration",
        "launch_ros.actions": "Node",
        "launch_ros.parameter_descriptions": "ParameterValue",
    }
    for name, content in {"launch_ros": "", **classes}.items():
        module = ModuleType(name)
        vars(module)[content] = call(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("bridge_launch", ROS2 / "gcd_bridge.launch.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    *declared, node = module.generate_launch_description().args[0]
    assert os.access(node.executable, os.X_OK)
    assert Path(node.executable) == ROS2 / "gcd_bridge.py"
    (values,) = node.parameters
    assert set(values) <= {each.name for each in fields(Settings)}
    wanted = {part.args[0] for value in values.values() for part in parts_of(value) if not isinstance(part, str)}
    assert wanted == {each.args[0] for each in declared}


def parts_of(value: Any) -> list[Any]:
    (given,) = value.args
    return given if isinstance(given, list) else [given]


# What it needs.

BLOCKED = {"torch", "cv2", "kornia", "rich", "typer", "gcd_model", "gcd_node", "rclpy"}
LIGHT = f"""
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED!r}:
            raise ImportError(name)
sys.meta_path.insert(0, Blocker())
import gcd_bridge
print(gcd_bridge.Settings().views)
"""


def test_it_imports_with_the_client_alone_and_ros_only_when_it_runs() -> None:
    environment = os.environ | {"PYTHONPATH": f"{Path(gcd_client.__file__).parent.parent}:{ROS2}"}
    done = subprocess.run(
        [sys.executable, "-c", LIGHT], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.stdout.strip(), done.returncode) == ("('topdown',)", 0), done.stderr


@pytest.mark.parametrize("path", sorted(ROS2.glob("*.py")), ids=lambda path: path.name)
def test_it_keeps_to_the_syntax_of_python_3_10_and_says_that_it_is_unproven(path: Path) -> None:
    tree = ast.parse(path.read_text(), feature_version=(3, 10))
    if path.name != "bridge_messages.py":
        assert "unproven on a ros machine" in (ast.get_docstring(tree) or "").lower()
