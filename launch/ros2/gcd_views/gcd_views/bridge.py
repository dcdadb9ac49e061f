"""A ROS 2 node beside a gcd node: its views and grids as topics, its status as diagnostics, its lifecycle as services.

    ros2 run gcd_views gcd_views --ros-args -r __node:=gcd -p data:=ipc:///run/gcd/topdown/data \\
        -p status:=ipc:///run/gcd/topdown/status -p control:=ipc:///run/gcd/topdown/control

docs/deploy.md has the table of topics. Every pixel is generated: never evidence of free space. Each view has threads of
its own that read and publish; those of rclpy never wait for the node, but for the one that serves a lifecycle request.
"""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from grid_map_msgs.msg import GridMap
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header, String
from tf2_msgs.msg import TFMessage

from gcd_client import (
    ClientError,
    ClientKeys,
    ControlClient,
    GridSubscriber,
    ReceivedGrid,
    ReceivedView,
    SetupError,
    StatusMessage,
    StatusSubscriber,
    ViewSubscriber,
    read_key_pair,
    read_public_key,
)
from gcd_client.endpoints import resolve_endpoint
from gcd_client.protocol import PREVIEW_ID, ViewKind, grid_topic, to_text, view_topic
from gcd_client.subscriber import DataSubscriber
from gcd_views import messages

SILENT_AFTER_S = 3.0  # a node speaks once a second
_POLL_MS = 200.0  # how long a reader waits before it looks whether it is to stop
_RETRY_S = 1.0
_TRANSITION_S = 300.0  # loading a model from a slow disk takes minutes
_SETTLE_S = 0.1
_MAPS: Mapping[ViewKind, str] = {"cls": "classes", "depth": "depth", "vis": "visibility"}
_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)  # reaches best-effort subscribers, too
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STREAM = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The parameters of this node.

    data, status, control: the gcd node's endpoints; "ipc" finds those of a node of the same user.
    keys: for a node that asks for them.
    source_frame: TF frame of the source camera on this robot (x right, y down, z ahead). base_frame: of grids, on the
        ground below the vehicle's origin (x ahead, y left).
    max_age_ms: older pictures are not published; None: no limit but the node's own `valid_for_ms`.
    metres_per_unit: of the scene units of models that know no metres; 0: their views get no TF.
    """

    data: str
    status: str
    control: str
    keys: ClientKeys | None
    source_frame: str
    base_frame: str
    max_age_ms: float | None
    metres_per_unit: float


class Reader(threading.Thread):
    """Reads from the gcd node until stopped; connects anew after whatever goes wrong. trouble: what did last."""

    def __init__(self, name: str, stop: threading.Event) -> None:
        super().__init__(name=name, daemon=True)
        self.trouble, self._stop_event = "", stop

    def run(self) -> None:
        """What the thread does."""
        while not self._stop_event.is_set():
            try:
                self._read()
            except Exception as error:  # such as AuthError; the other readers go on
                self.trouble = f"{type(error).__name__}: {error}"
                self._stop_event.wait(_RETRY_S)

    def _read(self) -> None:
        """Connect and read until stopped."""
        raise NotImplementedError


class ViewReader(Reader):
    """Reads one kind of one view; gives `publish` the newest frame that may still be used, and counts the others."""

    def __init__(
        self,
        view_id: str,
        kind: ViewKind,
        settings: Settings,
        publish: Callable[[Any, int], None],
        stop: threading.Event,
    ) -> None:
        super().__init__(f"{view_id} {kind}", stop)
        self.published, self.expired = 0, 0
        self.kind: str = kind
        self._kind: ViewKind = kind
        self._view_id, self._settings, self._publish = view_id, settings, publish
        self._views: DataSubscriber[Any] | None = None

    def counts(self) -> dict[str, int]:
        """What became of the messages; all but the first two since the last connection."""
        counts, views = {"published": self.published, "expired": self.expired}, self._views
        if views is None:
            return counts
        return counts | {name: getattr(views, name) for name in ("stale", "damaged", "skipped", "restarts")}

    def _read(self) -> None:
        with self._connect() as self._views:
            while not self._stop_event.is_set():
                damaged = self._views.damaged
                view = self._views.receive(_POLL_MS)
                if self._views.damaged > damaged:
                    self.trouble = self._views.last_error
                if view is not None:
                    self._pass_on(view)

    def _connect(self) -> DataSubscriber[Any]:
        settings = self._settings
        return ViewSubscriber(
            settings.data, self._view_id, self._kind, max_age_ms=settings.max_age_ms, keys=settings.keys
        )

    def _index(self, view: Any) -> int | None:
        """Which of its frames is published."""
        return messages.newest_at_goal(view.header)

    def _pass_on(self, view: Any) -> None:
        index = self._index(view)
        if view.expired:
            self.expired += 1
        elif index is None:
            self.trouble = "no frame of this view has arrived at its goal pose"
        else:
            try:
                self._publish(view, index)
            except ClientError as error:  # damaged JPEG, or no cv2 to decode it
                self.trouble = str(error)
            else:
                self.published, self.trouble = self.published + 1, ""


class GridReader(ViewReader):
    """The same of a grid."""

    def __init__(
        self, grid_id: str, settings: Settings, publish: Callable[[ReceivedGrid, int], None], stop: threading.Event
    ) -> None:
        super().__init__(grid_id, "win", settings, publish, stop)
        self.kind = "grid"

    def _connect(self) -> DataSubscriber[Any]:
        settings = self._settings
        return GridSubscriber(settings.data, self._view_id, max_age_ms=settings.max_age_ms, keys=settings.keys)

    def _index(self, view: Any) -> int | None:
        return 0


class StatusReader(Reader):
    """Keeps the last status and the ids of the views and grids of the gcd node, and gives each event to `on_event`."""

    def __init__(self, settings: Settings, on_event: Callable[[StatusMessage], None], stop: threading.Event) -> None:
        super().__init__("status", stop)
        self._on_event = on_event
        self.status: StatusMessage | None = None
        self.views: tuple[str, ...] = ()
        self.grids: tuple[str, ...] = ()
        self._settings, self._heard_s = settings, 0.0

    @property
    def silent(self) -> bool:
        """Whether the gcd node has said nothing for too long."""
        return time.monotonic() - self._heard_s > SILENT_AFTER_S

    def _read(self) -> None:
        settings = self._settings
        with StatusSubscriber(settings.status, keys=settings.keys) as notes:
            while not self._stop_event.is_set():
                note = notes.receive(_POLL_MS)
                if note is None:
                    continue
                self.trouble = ""
                if note.topic == "meta":
                    views = tuple(note.fields.get("views", ()))
                    for each in views:
                        view_topic(each, "win")  # raises MessageError: no id of a view
                    grids = tuple(note.fields.get("grids", ()))
                    for each in grids:
                        grid_topic(each)  # the same of a grid
                    self.views, self.grids = views, grids
                elif note.topic == "event":
                    self._on_event(note)
                else:  # the last one is repeated to whoever subscribes: it may be old
                    kept_s = max(0.0, (time.time_ns() - note.header.t_publish_ns) / 1e9)
                    self.status, self._heard_s = note, time.monotonic() - kept_s


class ViewTopics:
    """The topics of one view, and the readers that fill them."""

    def __init__(self, node: Node, view_id: str, settings: Settings, stop: threading.Event) -> None:
        folder = f"~/view_{view_id}" if view_id[0].isdigit() else f"~/{view_id}"  # ROS: no name begins with a digit

        def topic(kind: type, name: str, qos: QoSProfile = _NEWEST) -> Any:
            return node.create_publisher(kind, f"{folder}/{name}", qos)

        self._settings = settings
        self._name = node.get_fully_qualified_name().strip("/")
        self._frame_id = f"{self._name}/{view_id}_optical"
        self._transforms = node.create_publisher(TFMessage, "/tf", _STREAM)
        self._image, self._compressed = topic(Image, "image"), topic(CompressedImage, "image/compressed")
        self._camera_info = topic(CameraInfo, "camera_info")
        self._class_names, self._last_names = topic(String, "class_names", _LATCHED), ""
        self._maps = {kind: topic(Image, name) for kind, name in _MAPS.items()}
        kinds: Mapping[ViewKind, Callable[[ReceivedView, int], None]] = {
            "win": self._publish_picture, **dict.fromkeys(_MAPS, self._publish_map)
        }  # fmt: skip
        self.readers = [ViewReader(view_id, kind, settings, publish, stop) for kind, publish in kinds.items()]
        for reader in self.readers:
            reader.start()

    def _publish_picture(self, view: ReceivedView, index: int) -> None:
        header, settings = view.header, self._settings
        source_frame = settings.source_frame or f"{self._name}/{header.src_frame_id}"
        transform = messages.to_transform(header, index, source_frame, self._frame_id, settings.metres_per_unit)
        if transform is not None:  # before the picture: who looks up its frame then finds it
            self._transforms.publish(TFMessage(transforms=[transform]))
        self._camera_info.publish(messages.to_camera_info(header, index, self._frame_id))
        if header.encoding == "jpeg":
            self._compressed.publish(messages.to_compressed_image(view.message, index, self._frame_id))
        if header.encoding != "jpeg" or self._image.get_subscription_count():  # decoded only for somebody
            self._image.publish(messages.to_image(view.message, index, self._frame_id))

    def _publish_map(self, view: ReceivedView, index: int) -> None:
        kind = view.message.topic.rpartition("/")[2]
        if kind == "cls":
            names = messages.to_class_names(view.header)
            if names.data != self._last_names:
                self._last_names = names.data
                self._class_names.publish(names)
        self._maps[kind].publish(messages.to_image(view.message, index, self._frame_id))


class GridTopics:
    """The same of a grid."""

    def __init__(self, node: Node, grid_id: str, settings: Settings, stop: threading.Event) -> None:
        folder, self._frame_id, self._last_names = f"~/grid_{grid_id}", settings.base_frame, ""
        self._occupancy = node.create_publisher(OccupancyGrid, f"{folder}/occupancy", _NEWEST)
        self._grid_map = node.create_publisher(GridMap, f"{folder}/grid_map", _NEWEST)
        self._class_names = node.create_publisher(String, f"{folder}/class_names", _LATCHED)
        self.readers: list[ViewReader] = [GridReader(grid_id, settings, self._publish, stop)]
        self.readers[0].start()

    def _publish(self, grid: ReceivedGrid, _: int) -> None:
        names = messages.to_class_names(grid.header)
        if names.data != self._last_names:
            self._last_names = names.data
            self._class_names.publish(names)
        self._occupancy.publish(messages.to_occupancy_grid(grid.message, self._frame_id))
        if self._grid_map.get_subscription_count():
            self._grid_map.publish(messages.to_grid_map(grid.message, self._frame_id))


class GcdViews(Node):
    """The ROS 2 node. Raises ClientError: a parameter is wrong."""

    def __init__(self) -> None:
        super().__init__("gcd")
        self._settings, self._stop_event = self._read_parameters(), threading.Event()
        self._topics: dict[str, ViewTopics | GridTopics] = {}
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", _STREAM)
        self._source = self.create_publisher(CompressedImage, f"~/{PREVIEW_ID}/image/compressed", _NEWEST)
        self._source_reader: ViewReader | None = None
        self._source_stop = threading.Event()
        self._events = self.create_publisher(String, "~/events", _STREAM)
        self._status = StatusReader(self._settings, self._publish_event, self._stop_event)
        self._status.start()
        self.create_timer(1.0, self._on_second)
        asking, changing = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()  # both wait for the node
        for kind, name, answer, group in (
            (GetState, "get_state", self._get_state, asking),
            (GetAvailableStates, "get_available_states", self._get_available_states, asking),
            (GetAvailableTransitions, "get_available_transitions", self._get_available_transitions, asking),
            (ChangeState, "change_state", self._change_state, changing),
        ):
            self.create_service(kind, f"~/{name}", answer, callback_group=group)

    def stop(self) -> None:
        """End all readers."""
        self._stop_event.set()
        self._source_stop.set()
        readers = [self._status, *(reader for view in self._topics.values() for reader in view.readers)]
        for reader in readers if self._source_reader is None else [*readers, self._source_reader]:
            reader.join()

    def _follow_source(self, *, is_watched: bool) -> None:
        """The node codes what the camera saw for as long as somebody reads it."""
        if is_watched and self._source_reader is None:
            stop = self._source_stop = threading.Event()
            self._source_reader = ViewReader(PREVIEW_ID, "frm", self._settings, self._publish_source, stop)
            self._source_reader.start()
        elif not is_watched and self._source_reader is not None:
            self._source_stop.set()
            self._source_reader = None

    def _publish_event(self, note: StatusMessage) -> None:
        self._events.publish(String(data=to_text(note.header, note.fields).decode()))

    def _publish_source(self, view: ReceivedView, index: int) -> None:
        frame_id = (
            self._settings.source_frame or f"{self.get_fully_qualified_name().strip('/')}/{view.header.src_frame_id}"
        )
        self._source.publish(messages.to_compressed_image(view.message, index, frame_id))

    def _read_parameters(self) -> Settings:
        def number(name: str) -> float:  # an integer will do: `max_age_ms:=500`
            value = self.declare_parameter(name, 0.0, ParameterDescriptor(dynamic_typing=True)).value
            try:
                return float(value)
            except (TypeError, ValueError) as error:
                raise SetupError(f"{name} must be a number, got {value!r}") from error

        def text(name: str, default: str = "") -> str:
            return self.declare_parameter(name, default).value

        own, server = text("keys"), text("node_key")
        keys = ClientKeys(own=read_key_pair(Path(own)), server=read_public_key(server)) if own or server else None
        return Settings(
            data=resolve_endpoint(text("data", "ipc"), "data"),
            status=resolve_endpoint(text("status", "ipc"), "status"),
            control=resolve_endpoint(text("control", "ipc"), "control"),
            keys=keys,
            source_frame=text("source_frame"),
            base_frame=text("base_frame", "base_link"),
            max_age_ms=number("max_age_ms") or None,
            metres_per_unit=number("metres_per_unit"),
        )

    def _on_second(self) -> None:
        for view_id in self._status.views:
            if view_id not in self._topics:
                self._topics[view_id] = ViewTopics(self, view_id, self._settings, self._stop_event)
        self._follow_source(is_watched=self._source.get_subscription_count() > 0)
        for grid_id in self._status.grids:
            if f"grid {grid_id}" not in self._topics:
                self._topics[f"grid {grid_id}"] = GridTopics(self, grid_id, self._settings, self._stop_event)
        header = Header(stamp=messages.to_time(time.time_ns()))
        self._diagnostics.publish(DiagnosticArray(header=header, status=self._all_diagnostics()))

    def _all_diagnostics(self) -> list[DiagnosticStatus]:
        status, name = self._status, self.get_fully_qualified_name().strip("/")
        silent = status.silent
        about_node = messages.to_node_diagnostic(f"{name}: node", status.status, silent=silent)
        if silent and status.trouble:
            about_node.message = status.trouble
        told = [about_node]
        for view_id, topics in self._topics.items():
            trouble = "; ".join(f"{reader.kind}: {reader.trouble}" for reader in topics.readers if reader.trouble)
            counts = {reader.kind: reader.counts() for reader in topics.readers}
            level = messages.WARN if trouble else messages.OK
            told.append(messages.to_diagnostic(f"{name}: {view_id}", level, trouble or "OK", counts))
        return told

    # --- lifecycle services ---

    def _client(self) -> ControlClient:
        return ControlClient(self._settings.control, keys=self._settings.keys)

    def _node_state(self) -> str:
        try:
            with self._client() as control:
                return control.request("state").state
        except ClientError as error:
            self.get_logger().warning(str(error))
            return "unknown"

    def _get_state(self, _: Any, response: Any) -> Any:
        response.current_state = messages.to_state(self._node_state())
        return response

    def _get_available_states(self, _: Any, response: Any) -> Any:
        response.available_states = [messages.to_state(label) for label in messages.STATES]
        return response

    def _get_available_transitions(self, _: Any, response: Any) -> Any:
        response.available_transitions = messages.available_transitions(self._node_state())
        return response

    def _change_state(self, request: Any, response: Any) -> Any:
        asked = messages.to_verb(request.transition)
        try:
            response.success = asked is not None and self._transition(*asked)
        except ClientError as error:
            self.get_logger().warning(str(error))
            response.success = False
        return response

    def _transition(self, verb: str, goal: str) -> bool:
        """Whether the gcd node did it. Waits until it has; not for one that shuts down: it is gone then."""
        deadline_s = time.monotonic() + _TRANSITION_S
        with self._client() as control:
            control.call(verb)
            if verb == "shutdown":
                return True
            while (state := control.request("state").state) not in messages.SETTLED:
                if time.monotonic() > deadline_s or self._stop_event.wait(_SETTLE_S):
                    return False
            return state == goal


def main() -> None:
    """Run until ROS shuts down."""
    rclpy.init()
    executor, node = MultiThreadedExecutor(num_threads=3), None
    try:
        node = GcdViews()
        executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ClientError as error:
        raise SystemExit(f"gcd_views: {error}") from error
    finally:
        if node is not None:
            node.stop()
        executor.shutdown()
        rclpy.try_shutdown()
