"""The ROS 2 package without ROS: its messages by the definitions of rosbags, its node over real sockets of a gcd node.

Of rclpy there are stand-ins; by hand it was run with rclpy itself (docs/deploy.md).
"""

import ast
import json
import re
import runpy
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import zmq
from fakes import Steady
from msgspec.structs import replace
from rig import Rig
from ros_stand_in import ROS, STORE, RosNode
from wire_messages import (
    CLASSES,
    OTHER_BOOT,
    cells,
    class_map,
    depth,
    grid,
    jpeg_window,
    numbers,
    origin,
    visibility,
    window,
)

from gcd_client import AuthError, ViewSubscriber
from gcd_client.images import depth_m
from gcd_client.protocol import Message, StatusMessage, encode
from gcd_node.lifecycle import PATHS, State
from gcd_node.sources.logs import pose_of

PACKAGE = Path(__file__).parents[2] / "launch" / "ros2" / "gcd_views"
LAYOUT = (PACKAGE.parents[1] / "foxglove-live.json").read_text().replace("topdown", "top")
SHOWN = {re.sub("^/gcd/", "~/", name) for name in re.findall(r'"(/\w[\w/]+)', LAYOUT)}

with pytest.MonkeyPatch.context() as patch:
    for each, module in ROS.items():
        patch.setitem(sys.modules, each, module)
    patch.syspath_prepend(PACKAGE)
    from gcd_views import bridge, messages


def test_pictures_maps_and_cameras_pass_as_they_are_stamped_when_their_frame_was_captured() -> None:
    header = window().header
    info = messages.to_camera_info(header, 1, "gcd/top_optical")
    assert (info.height, info.width, info.header.frame_id) == (4, 6, "gcd/top_optical")
    assert tuple(info.k) == header.intrinsics
    assert np.array_equal(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))  # no distortion
    assert np.array_equal(info.r.reshape(3, 3), np.eye(3))
    unknown = messages.to_camera_info(replace(header, intrinsics=None), 1, "")
    assert not np.concatenate([unknown.k, unknown.r, unknown.p]).any()
    message = jpeg_window()
    picture, decoded = (
        make(message, 1, "gcd/top_optical") for make in (messages.to_compressed_image, messages.to_image)
    )
    assert decoded.header == picture.header
    assert picture.header.stamp.sec * 10**9 + picture.header.stamp.nanosec == message.header.t_capture_ns[1]
    assert picture.data.tobytes() == message.payload[message.header.offsets[1] :]
    expected = cv2.cvtColor(cv2.imdecode(picture.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert np.array_equal(decoded.data.reshape(16, 24, 3), expected)
    metres = depth_m(depth()).tobytes()  # NaN where unknown
    maps = [(each, "mono8", each.payload) for each in (class_map(), visibility())] + [(depth(), "32FC1", metres)]
    for message, encoding, payload in [(window(), "rgb8", window().payload), *maps]:
        made = messages.to_image(message, 1, "gcd/top_optical")
        assert (made.encoding, made.height, made.width, made.step) == (encoding, 4, 6, len(payload) // 8)
        assert made.data.tobytes() == bytes(payload[len(payload) // 2 :])


def test_a_transform_takes_points_of_the_view_to_the_source_camera() -> None:
    chance, pose, header = np.random.default_rng(0), np.eye(4), replace(window().header, pose_units="m")
    for turn in [*chance.normal(size=(50, 3)), *(np.pi * np.eye(3))]:  # half turns, too
        pose[:3] = np.column_stack([cv2.Rodrigues(turn)[0], (2.0, 3.0, 4.0)])
        header = replace(header, source_from_view=(tuple(pose.flatten().tolist()),) * 2)
        made = messages.to_transform(header, 1, "oak", "gcd/top_optical", 0.0)
        assert (made.header.frame_id, made.child_frame_id) == ("oak", "gcd/top_optical")
        np.testing.assert_allclose(pose_of(made.transform.translation, made.transform.rotation), pose, atol=1e-9)
    scene = replace(header, pose_units="scene")
    assert messages.to_transform(scene, 1, "", "", 0.0) is None
    assert messages.to_transform(scene, 1, "", "", 0.5).transform.translation.y == 1.5
    assert messages.to_transform(replace(header, source_from_view=None), 1, "", "", 1.0) is None


def status(**told: object) -> StatusMessage:
    return StatusMessage(topic="status", header=origin(), fields={"state": "active", "level": 0, "reasons": [], **told})


def test_a_status_becomes_a_diagnostic_with_every_field_and_silence_is_stale() -> None:
    note = status(level=2, reasons=["SRC_LOST", "fps"], source={"state": "lost", "fps": 9.5}, ready=False)
    made = messages.to_node_diagnostic("gcd: node", note, silent=False)
    assert (made.level, made.message, made.hardware_id) == (2, "SRC_LOST, fps", "gcd")
    told = {each.key: each.value for each in made.values}
    assert (told["source.fps"], told["ready"], told["reasons"]) == ("9.5", "False", "SRC_LOST, fps")
    for level in (7, -1, "2", None, True):
        assert messages.to_node_diagnostic("", status(level=level), silent=False).level == 1
    assert messages.to_node_diagnostic("", note, silent=True).level == 3


def test_states_and_transitions_are_those_of_ros_and_of_the_node() -> None:
    names = vars(STORE.types["lifecycle_msgs/msg/State"])
    of_ros = {key.rpartition("STATE_")[2].lower(): value for key, value in names.items() if "STATE_" in key}
    assert of_ros == messages.STATES == {"unknown": 0} | {state.label: state.value for state in State}
    numbers_of_ros = vars(STORE.types["lifecycle_msgs/msg/Transition"])
    for number, (verb, start, goal) in messages.TRANSITIONS.items():
        allowed, _, leads_to = PATHS[verb]
        assert State[start.upper()] in allowed
        assert leads_to.label == goal
        name = f"{start}_{verb}" if verb == "shutdown" else verb
        assert numbers_of_ros[f"TRANSITION_{name.upper()}"] == number
        assert number in {each.transition.id for each in messages.available_transitions(start)}
    transition = STORE.types["lifecycle_msgs/msg/Transition"]
    assert messages.to_verb(transition(id=3, label="")) == messages.to_verb(transition(id=0, label="activate"))
    assert messages.to_verb(transition(id=99, label="")) is None


def test_a_grid_map_is_read_by_its_own_rule_and_an_occupancy_grid_by_its_own() -> None:
    """Of the cell at x = 0.25, y = 2.25: the third of the first row, seen before, 0.25 m high."""
    occupancy, made = messages.to_occupancy_grid(grid(), "base"), messages.to_grid_map(grid(), "base")
    assert (occupancy.info.width, occupancy.info.height, occupancy.info.resolution) == (3, 2, 0.5)
    assert (occupancy.info.origin.position.x, occupancy.info.origin.position.y) == (-1.0, 2.0)
    assert occupancy.data.tolist() == cells().occupancy.ravel().tolist()
    planes = dict(zip(made.layers, made.data, strict=True))
    (column, row), info = planes["elevation"].layout.dim, made.info
    assert [(each.label, each.size) for each in (column, row)] == [("column_index", 2), ("row_index", 3)]
    i = int((info.pose.position.x + info.length_x / 2 - 0.25) / info.resolution)
    j = int((info.pose.position.y + info.length_y / 2 - 2.25) / info.resolution)
    assert {name: plane.data[j * row.stride + i] for name, plane in planes.items() if name != "occupancy"} == {
        "elevation": 0.25, "class": 1, "visibility": 1, "age": np.float32(0.9)
    }  # fmt: skip
    assert np.isnan(planes["occupancy"].data[j * row.stride + i])


def meta(*views: str, grids: tuple[str, ...] = ()) -> StatusMessage:
    return StatusMessage(topic="meta", header=origin(), fields={"views": list(views), "grids": list(grids)})


@dataclass
class Bench:
    """A bridge, and a gcd node that sends it its status, its views, and messages."""

    node: Any
    folder: Path
    sequence: int = 0
    views: tuple[str, ...] = ("top",)
    grids: tuple[str, ...] = ()

    def start(self) -> None:
        """The gcd node."""
        self.context = zmq.Context()
        self.sockets = {name: self.context.socket(zmq.PUB) for name in ("data", "status")}
        for name, socket in self.sockets.items():
            socket.bind(f"ipc://{self.folder}/{name}")

    def kill(self) -> None:
        self.context.destroy(linger=0)

    def until(self, holds: Callable[[], object], *sent: Message) -> None:
        """Send, and let a second pass for the bridge, until something holds."""
        deadline_s = time.monotonic() + 30
        while not holds():
            assert time.monotonic() < deadline_s, "it did not come about"
            self.sequence += 1
            for message in (status(), meta(*self.views, grids=self.grids), *sent):
                socket = self.sockets["status" if isinstance(message, StatusMessage) else "data"]
                socket.send(encode(replace(message, sequence=self.sequence)))
            self.node.tick()
            time.sleep(0.02)

    def out(self, topic: str) -> list[Any]:
        return self.node.published.get(topic, [])

    def diagnostic(self, index: int) -> Any:
        """Of the node (0) or of its view (1); `counts` are its values."""
        told = self.out("/diagnostics")[-1].status[index:] if self.out("/diagnostics") else []
        if not told:
            return SimpleNamespace(level=0, message="", counts={})
        counts = {each.key: each.value for each in told[0].values}
        return SimpleNamespace(level=told[0].level, message=told[0].message, counts=counts)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    endpoints = {name: f"ipc://{tmp_path}/{name}" for name in ("data", "status")}
    endpoints["control"] = f"ipc://{tmp_path}/node/control"
    monkeypatch.setattr(RosNode, "parameters", {**endpoints, "max_age_ms": 1_000_000})  # an integer, as a user writes
    monkeypatch.setattr(bridge, "_RETRY_S", 0.05)
    made = Bench(bridge.GcdViews(), tmp_path)
    made.start()
    yield made
    made.node.stop()
    made.kill()


def test_a_view_becomes_topics_of_one_stamp_and_frame_under_the_name_of_the_node(bench: Bench) -> None:
    names = ("image", "image/compressed", "camera_info", "classes", "class_names", "depth", "visibility")
    topics, pictures = {f"~/top/{name}" for name in names} | {"/tf", "/diagnostics"}, jpeg_window(pose_units="m")
    source = replace(pictures, topic="src/frm", header=replace(pictures.header, view_id="src"))
    topics |= {"~/src/image/compressed", "~/events"}
    event = StatusMessage(topic="event", header=origin(), fields={"code": "STATE", "level": 0})
    sent = (pictures, class_map(), depth(), visibility(), source, event)
    bench.until(lambda: topics <= set(bench.node.published), *sent)
    assert bench.node.topics == topics
    assert bench.out("~/src/image/compressed")[0].header.frame_id == "robot/gcd/source_optical"
    assert json.loads(bench.out("~/events")[0].data)["code"] == "STATE"
    assert len(SHOWN) >= 8
    assert topics >= SHOWN - {"~/grid_around/occupancy"}
    parts = set(re.findall(r'name==\\"([^\\]+)', LAYOUT))
    assert {f"robot/{name}" for name in parts} <= {each.name for each in bench.out("/diagnostics")[-1].status}
    headers = [bench.out(f"~/top/{name}")[0].header for name in names if name != "class_names"]
    newest_at_goal = divmod(window().header.t_capture_ns[1], 10**9)
    assert {(each.frame_id, (each.stamp.sec, each.stamp.nanosec)) for each in headers} == {
        ("robot/gcd/top_optical", newest_at_goal)
    }
    transform = bench.out("/tf")[0].transforms[0]
    assert transform.header.stamp == headers[0].stamp
    frames = (transform.header.frame_id, transform.child_frame_id)
    assert frames == ("robot/gcd/source_optical", "robot/gcd/top_optical")
    bench.until(lambda: len(bench.out("~/top/classes")) > 1, class_map())
    (latched,) = bench.out("~/top/class_names")
    assert [(each["id"], each["name"], tuple(each["colour"])) for each in json.loads(latched.data)] == [
        (each.id, each.name, each.colour) for each in CLASSES
    ]


def test_what_the_camera_saw_is_read_while_somebody_looks_and_no_longer(bench: Bench) -> None:
    topic = "~/src/image/compressed"
    source = replace(jpeg_window(), topic="src/frm", header=replace(jpeg_window().header, view_id="src"))

    def reads() -> bool:
        return any(each.name == "src frm" for each in threading.enumerate())

    bench.until(lambda: bench.out(topic), source)
    bench.node.unread.add(topic)
    bench.until(lambda: not reads(), source)
    bench.node.unread.clear()
    seen = len(bench.out(topic))
    bench.until(lambda: len(bench.out(topic)) > seen, source)


@pytest.mark.parametrize(("views", "grids"), [(("top", "~/../x"), ()), (("top",), ("~/../x",))])
def test_what_is_no_id_is_said_and_never_becomes_a_topic(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, views: tuple[str, ...], grids: tuple[str, ...]
) -> None:
    monkeypatch.setattr(bridge, "SILENT_AFTER_S", 0.0)  # says what is wrong instead of what the node says
    bench.views, bench.grids = views, grids
    bench.until(lambda: "~/../x" in bench.diagnostic(0).message)
    assert not any("x" in topic.split("/") for topic in bench.node.topics)


def test_a_grid_becomes_topics_of_its_own_in_the_frame_of_the_vehicle(bench: Bench) -> None:
    topics = {f"~/grid_around/{name}" for name in ("occupancy", "grid_map", "class_names")}
    bench.grids = ("around",)
    bench.until(lambda: topics <= set(bench.node.published), grid())
    assert topics & SHOWN
    headers = [bench.out(f"~/grid_around/{name}")[0].header for name in ("occupancy", "grid_map")]
    assert {each.frame_id for each in headers} == {"base_link"}
    stale = grid(t_publish_ns=time.time_ns() - 10**10, valid_for_ms=500)
    bench.until(lambda: bench.diagnostic(2).counts.get("grid.expired", "0") != "0", stale)


def test_what_is_old_or_on_its_way_is_never_published(bench: Bench) -> None:
    old = {"t_publish_ns": time.time_ns() - 10**10, "valid_for_ms": 500}
    for changes, count in ((old, "win.expired"), ({"age_ms": 2e6}, "win.stale")):
        bench.until(lambda count=count: bench.diagnostic(1).counts.get(count, "0") != "0", jpeg_window(**changes))
    bench.until(lambda: bench.diagnostic(1).level == 1, jpeg_window(frame_role=("in_transit",) * 2))
    assert set(bench.node.published) == {"/diagnostics"}
    bench.until(lambda: bench.out("~/top/image/compressed") and bench.diagnostic(1).level == 0, jpeg_window())


def test_what_goes_wrong_with_one_kind_leaves_the_others_alone(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(data: str, view: str, kind: str, **options: Any) -> ViewSubscriber:
        if kind == "cls" and refused:
            raise AuthError("no key")
        return ViewSubscriber(data, view, kind, **options)

    refused = ["cls"]
    monkeypatch.setattr(bridge, "ViewSubscriber", refusing)
    broken = replace(jpeg_window(), payload=bytes(len(jpeg_window().payload)))
    bench.until(lambda: "cls: " in bench.diagnostic(1).message and "win: " in bench.diagnostic(1).message, broken)
    bench.until(lambda: bench.out("~/top/depth"), broken, depth(), class_map())
    assert (bench.diagnostic(1).level, bench.out("~/top/classes")) == (1, [])
    refused.clear()
    bench.until(lambda: bench.out("~/top/classes"), class_map(drawn=numbers(1)))


def test_a_dead_node_shows_and_its_next_life_is_read(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.node.tick()
    assert (bench.diagnostic(0).level, bench.diagnostic(0).message) == (3, "no node")
    bench.until(lambda: bench.diagnostic(0).level == 0 and bench.out("~/top/depth"), depth())
    bench.kill()
    monkeypatch.setattr(bridge, "SILENT_AFTER_S", 0.1)
    time.sleep(0.2)
    bench.node.tick()
    assert bench.diagnostic(0).level == 3
    monkeypatch.undo()
    bench.start()
    before = len(bench.out("~/top/depth"))
    bench.until(
        lambda: len(bench.out("~/top/depth")) > before,
        replace(depth(), header=replace(depth().header, boot_id=OTHER_BOOT)),
    )
    bench.until(lambda: bench.diagnostic(0).level == 0 and bench.diagnostic(1).counts["depth.restarts"] == "1")


def test_lifecycle_services_command_the_node(bench: Bench) -> None:
    def call(service: str, **request: Any) -> Any:
        return bench.node.services[f"~/{service}"](SimpleNamespace(**request), SimpleNamespace())

    def change(number: int) -> bool:
        transition = messages.Transition(id=number, label="")
        return call("change_state", transition=transition).success

    (bench.folder / "node").mkdir()
    with Rig(bench.folder / "node", lambda _: Steady(), more="life = {autostart = false}"):
        assert call("get_state").current_state.label == "unconfigured"
        assert [change(number) for number in (3, 1, 3)] == [False, True, True]  # activate, configure, activate
        assert call("get_state").current_state.id == State.ACTIVE
        assert [each.transition.label for each in call("get_available_transitions").available_transitions] == [
            "deactivate", "shutdown"
        ]  # fmt: skip
        assert len(call("get_available_states").available_states) == len(messages.STATES)
        assert change(7)
    assert call("get_state").current_state.label == "unknown"


def test_the_package_is_complete_and_imports_what_it_declares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "setuptools", setuptools := MagicMock())
    runpy.run_path(str(PACKAGE / "setup.py"))
    setup, manifest = setuptools.setup.call_args.kwargs, ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert [manifest.findtext(key) for key in ("name", "version")] == [setup["name"], setup["version"]]
    assert all((PACKAGE / name).is_file() for _, names in setup["data_files"] for name in names)
    needed = set[str]()
    for path in [*PACKAGE.glob("gcd_views/*.py"), *PACKAGE.glob("launch/*.py")]:
        ast.parse(path.read_text(), feature_version=(3, 10))  # which Humble has
        needed |= set(re.findall(r"^(?:from|import) (\w+)", path.read_text(), re.MULTILINE))
    declared = {each.text for each in manifest.findall("exec_depend")} | set(setup["install_requires"])
    assert {name.replace("_", "-") if name == "gcd_client" else name for name in needed} <= (
        declared | set(sys.stdlib_module_names) | {"gcd_views"}
    )


def test_the_launch_file_has_parameters_the_package_knows(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    ros = MagicMock()
    ros.LaunchConfiguration = lambda name: (name,)
    for name in ("", ".actions", ".substitutions", "_ros.actions", "_ros.parameter_descriptions"):
        monkeypatch.setitem(sys.modules, f"launch{name}", ros)
    launch = runpy.run_path(str(PACKAGE / "launch" / "gcd_views.launch.py"))
    launch["generate_launch_description"]()
    node = ros.Node.call_args.kwargs
    monkeypatch.setattr(RosNode, "parameters", {"data": "udp://somewhere"})
    with pytest.raises(SystemExit, match="udp"):  # ends with a line
        bridge.main()
    known = set[str]()
    monkeypatch.setattr(RosNode, "parameters", SimpleNamespace(get=lambda name, default: known.add(name) or default))
    bridge.GcdViews().stop()
    assert {"data", "keys", "node_key"} <= set(node["parameters"][0]) <= known
    parts = ros.PythonExpression.call_args_list[0].args[0]
    for endpoint, given in (
        ("ipc:///run/gcd/left/data", {"folder": "/run/gcd/left", "host": ""}),
        ("tcp://robot:5580", {"folder": "", "host": "robot"}),
    ):
        assert eval("".join(part if isinstance(part, str) else given[part[0]] for part in parts)) == endpoint
