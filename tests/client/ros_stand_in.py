"""ROS 2 for tests of the bridge: messages by the definitions of rosbags, and rclpy as far as the bridge calls it."""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar
from unittest.mock import MagicMock

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
for name, text in {  # of the package grid_map_msgs, as far as it is sent
    "GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose",
    "GridMap": "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index",
}.items():
    STORE.register(get_types_from_msg(text, f"grid_map_msgs/msg/{name}"))


def message_class(name: str) -> type:
    """A message of rosbags that is filled as one of ROS: with `array` and bytes, of exact types, the rest is zero."""
    real, plain = STORE.types[name], {"int": int, "float": float, "str": str, "bool": bool}
    plain |= {kind: list for kind in real.__annotations__.values() if kind.startswith("list")}

    def value_of(kind: str, value: Any = None) -> Any:
        if value is None:
            return plain[kind]() if kind in plain else message_class(kind.replace("__", "/"))()
        if kind.startswith("np.ndarray"):
            assert isinstance(value, array | np.ndarray), "rclpy would look at it number by number"
            return np.array(value)
        value = value[0] if isinstance(value, bytes) else value
        assert type(value) is plain.get(kind, type(value)), f"{name} takes {kind}, got {value!r}"
        return value

    def fill(self: Any, **fields: Any) -> None:
        kinds = {key: kind for key, kind in real.__annotations__.items() if not kind.startswith("ClassVar")}
        assert set(fields) <= set(kinds), name
        real.__init__(self, **{key: value_of(kind, fields.get(key)) for key, kind in kinds.items()})

    return type(name, (real,), {"__init__": fill})


@dataclass
class RosNode:
    """rclpy's node. published: messages by topic, each of which could be sent. Topics in `unread` have no reader."""

    name: str
    published: dict[str, list[Any]] = field(default_factory=dict)
    topics: set[str] = field(default_factory=set)
    unread: set[str] = field(default_factory=set)
    services: dict[str, Callable[[Any, Any], Any]] = field(default_factory=dict)
    parameters: ClassVar[dict[str, Any]] = {}

    def __post_init__(self) -> None:
        self.get_fully_qualified_name, self.get_logger = lambda: f"/robot/{self.name}", MagicMock

    def declare_parameter(self, name: str, default: Any, descriptor: Any = None) -> Any:
        value = self.parameters.get(name, default)
        assert type(value) is type(default) or descriptor.dynamic_typing, f"ROS refuses {name}: {value!r}"
        return SimpleNamespace(value=value)

    def create_publisher(self, kind: Any, topic: str, qos: object) -> Any:
        def publish(message: Any) -> None:
            STORE.serialize_cdr(message, kind.__msgtype__)
            self.published.setdefault(topic, []).append(message)

        self.topics.add(topic)
        return SimpleNamespace(publish=publish, get_subscription_count=lambda: int(topic not in self.unread))

    def create_service(self, kind: type, name: str, answer: Callable[[Any, Any], Any], callback_group: object) -> None:
        self.services[name] = answer

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.tick = callback


ROS: dict[str, Any] = {name: MagicMock() for name in ("rclpy", "rclpy.callback_groups", "rclpy.qos")}
ROS |= {"rclpy.node": SimpleNamespace(Node=RosNode), "lifecycle_msgs.srv": MagicMock()}
ROS |= {"rclpy.executors": MagicMock(ExternalShutdownException=type("ExternalShutdownException", (Exception,), {}))}
for each in STORE.types:
    package, _, message_name = each.split("/")
    ROS.setdefault(package, MagicMock())
    vars(ROS.setdefault(f"{package}.msg", SimpleNamespace()))[message_name] = message_class(each)
