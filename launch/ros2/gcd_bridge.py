#!/usr/bin/env python3
"""Publishes the views of a gcd-node, and how it does, as ROS 2 topics. A process of its own, beside the node.

UNPROVEN ON A ROS MACHINE: there was none. Everything but the class `Ros` and main() is tested without ROS; these two
are tested against stand-ins of the calls they make.

    python3 gcd_bridge.py --ros-args -p views:=topdown \\
        -p data:=ipc:///run/gcd/topdown/data -p status:=ipc:///run/gcd/topdown/status

    gcd/<view>/image/compressed   sensor_msgs/CompressedImage    newest frame at the goal pose; best effort, depth 1
    gcd/<view>/depth              sensor_msgs/Image              with maps:=vis,depth: metres as 32FC1, NaN for none;
    gcd/<view>/vis                sensor_msgs/Image              mono8, 2 seen now, 1 seen before, 0 painted
    gcd/<view>/camera_info        sensor_msgs/CameraInfo         the same stamp; zeros if nobody knows the field of view
    /tf                           the virtual camera, seen from the source camera, at the stamp of the picture
    /diagnostics                  diagnostic_msgs/DiagnosticArray, once a second; STALE when the node is silent for 3 s

Every pixel is generated: never evidence of free space; depth under painted pixels is a guess.
`header.stamp` is when the real camera took the frame, so
pictures come seconds old; what is past its `valid_for_ms` is not published. From a recording, stamps are its own time.

Needs Python 3.10 and gcd-client (pip install ./client). The node should publish
encoding = "jpeg": its pictures are passed on as they are. From rgb8 they are coded here, which needs cv2.
"""

import importlib
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from types import TracebackType
from typing import Any

from bridge_messages import (
    OK,
    PACKAGES,
    STALE_AFTER_S,
    WARN,
    CameraInfo,
    CompressedImage,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    Image,
    KeyValue,
    Settings,
    TFMessage,
    newest_at_goal,
    to_camera_info,
    to_compressed_image,
    to_diagnostic,
    to_image,
    to_time,
    to_transform,
)

from gcd_client import AuthError, ClientError, ReceivedView, StatusMessage, StatusSubscriber, ViewSubscriber
from gcd_client.protocol import ViewKind

POLL_S = 0.02


@dataclass(kw_only=True, slots=True)
class Counts:
    """What became of the windows of one view. trouble: the last error, until a picture is published again."""

    published: int = 0
    expired: int = 0
    too_old: int = 0
    damaged: int = 0
    missed: int = 0
    restarts: int = 0
    trouble: str = ""


@dataclass(kw_only=True, slots=True)
class ViewFeed:
    """One kind of one view: its reader, which is made anew with each start of the node, and what became of what it
    read."""

    view_id: str
    settings: Settings
    kind: ViewKind = "win"
    counts: Counts = field(default_factory=Counts)
    _reader: ViewSubscriber | None = None
    _rest_until_s: float = 0.0

    def newest(self) -> ReceivedView | None:
        """The newest window that may be used, None if there is none. Never waits."""
        if self._resting():
            return None
        counts, reader = self.counts, self._opened()
        stale, damaged = reader.stale, reader.damaged
        try:
            view = reader.receive(timeout_ms=0)
        except AuthError as error:
            counts.trouble = str(error)
            self.close()
            self._rest_until_s = time.monotonic() + 1.0
            return None
        counts.too_old += reader.stale - stale
        if reader.damaged > damaged:
            counts.damaged, counts.trouble = counts.damaged + reader.damaged - damaged, reader.last_error
        return None if view is None else self._usable(view)

    def close(self) -> None:
        """Close the reader; the next newest() opens another."""
        if self._reader is not None:
            self._reader.close()
        self._reader = None

    def to_diagnostic(self) -> DiagnosticStatus:
        """What became of this view's windows; a warning while there is trouble."""
        counts = self.counts
        values = [KeyValue(key=each.name, value=str(getattr(counts, each.name))) for each in fields(counts)]
        return DiagnosticStatus(
            level=bytes([WARN if counts.trouble else OK]),
            name=f"gcd: bridge {self.view_id}" + ("" if self.kind == "win" else f" {self.kind}"),
            message=counts.trouble or "OK",
            hardware_id="",
            values=tuple(values),
        )

    def _resting(self) -> bool:
        return time.monotonic() < self._rest_until_s

    def _opened(self) -> ViewSubscriber:
        if self._reader is None:
            limit_ms = self.settings.max_age_ms or None
            self._reader = ViewSubscriber(self.settings.data, self.view_id, self.kind, max_age_ms=limit_ms)
        return self._reader

    def _usable(self, view: ReceivedView) -> ReceivedView | None:
        self.counts.missed += view.skipped
        if view.restarted:
            self.counts.restarts += 1
            self.close()
        if view.expired:
            self.counts.expired += 1
            return None
        return view


class Bridge:
    """Hands on what the node sends. Belongs to one thread; knows nothing of ROS but the names of its records."""

    def __init__(self, settings: Settings, publish: Callable[[str, Any], None]) -> None:
        """publish: takes a topic and one of the records above."""
        self._settings, self._publish = settings, publish
        kinds: tuple[ViewKind, ...] = ("win", *settings.maps)
        self.feeds = tuple(
            ViewFeed(view_id=each, settings=settings, kind=kind) for each in settings.views for kind in kinds
        )
        self._notes = StatusSubscriber(settings.status, ("status",))
        self._status: StatusMessage | None = None
        self._heard_s = -math.inf
        self._next_s = time.monotonic() + 1.0

    def __enter__(self) -> "Bridge":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._notes.close()
        for feed in self.feeds:
            feed.close()

    def poll(self) -> None:
        """Publish what has come since the last call; call it often."""
        for feed in self.feeds:
            view = feed.newest()
            if view is not None:
                self._hand_on(feed, view)
        self._listen()
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + 1.0
            self._publish("/diagnostics", self.to_diagnostics())

    def to_diagnostics(self) -> DiagnosticArray:
        """The node, and each view here."""
        silent = time.monotonic() - self._heard_s > STALE_AFTER_S
        told = (to_diagnostic(self._status, silent=silent), *(feed.to_diagnostic() for feed in self.feeds))
        return DiagnosticArray(header=Header(stamp=to_time(time.time_ns())), status=told)

    def _hand_on(self, feed: ViewFeed, view: ReceivedView) -> None:
        index, base = newest_at_goal(view.header), f"{self._settings.prefix}/{feed.view_id}"
        if index is None:
            feed.counts.trouble = "no frame of this view is at its goal pose"
            return
        try:
            picture = to_compressed_image(view, index) if feed.kind == "win" else to_image(view, index)
        except ClientError as error:
            feed.counts.trouble = str(error)
            return
        feed.counts.published, feed.counts.trouble = feed.counts.published + 1, ""
        if feed.kind != "win":
            self._publish(f"{base}/{feed.kind}", picture)
            return
        transform = to_transform(view.header, index, self._settings)
        if transform is not None:  # before the picture: who looks up its frame then finds it
            self._publish("/tf", TFMessage(transforms=(transform,)))
        self._publish(f"{base}/camera_info", to_camera_info(view.header, index))
        self._publish(f"{base}/image/compressed", picture)

    def _listen(self) -> None:
        try:
            while (note := self._notes.receive(timeout_ms=0)) is not None:
                kept_s = max(0.0, (time.time_ns() - note.header.t_publish_ns) / 1e9)
                self._status, self._heard_s = note, time.monotonic() - kept_s
        except AuthError:
            self._notes.close()
            self._notes = StatusSubscriber(self._settings.status, ("status",))


class Ros:
    """Everything that needs ROS: parameters, publishers, and records made into messages."""

    def __init__(self, node: Any) -> None:
        self._node, self._publishers = node, dict[str, Any]()
        qos = importlib.import_module("rclpy.qos")
        self._best_effort = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._reliable = qos.QoSProfile(depth=10, reliability=qos.ReliabilityPolicy.RELIABLE)

    def settings(self) -> Settings:
        """Each setting from the parameter of the same name; `views` and `maps` separated by commas."""
        return Settings(
            data=self._parameter("data", "ipc"),
            status=self._parameter("status", "ipc"),
            views=tuple(each.strip() for each in self._parameter("views", "topdown").split(",")),
            prefix=self._parameter("prefix", "gcd"),
            max_age_ms=self._parameter("max_age_ms", 0.0),
            source_frame=self._parameter("source_frame", ""),
            metres_per_unit=self._parameter("metres_per_unit", 0.0),
            maps=tuple(each.strip() for each in self._parameter("maps", "").split(",") if each.strip()),
        )

    def publish(self, topic: str, record: Any) -> None:
        """Send a record as the ROS message of its name. Pictures and their cameras: the newest, or none."""
        message = self.to_message(record)
        if topic not in self._publishers:
            newest_only = isinstance(record, CompressedImage | Image | CameraInfo)
            qos = self._best_effort if newest_only else self._reliable
            self._publishers[topic] = self._node.create_publisher(type(message), topic, qos)
        self._publishers[topic].publish(message)

    def to_message(self, record: Any) -> Any:
        """The ROS message with the fields of a record."""
        name = type(record).__name__
        message = getattr(importlib.import_module(PACKAGES[name]), name)()
        for each in fields(record):
            setattr(message, each.name, self._to_value(getattr(record, each.name)))
        return message

    def _parameter(self, name: str, default: Any) -> Any:
        return self._node.declare_parameter(name, default).value

    def _to_value(self, value: Any) -> Any:
        if is_dataclass(value):
            return self.to_message(value)
        return [self._to_value(each) for each in value] if isinstance(value, tuple) else value


def main(arguments: Sequence[str] = tuple(sys.argv)) -> None:
    """Run until ROS shuts down."""
    rclpy = importlib.import_module("rclpy")
    ended = importlib.import_module("rclpy.executors").ExternalShutdownException
    rclpy.init(args=list(arguments))
    node = rclpy.create_node("gcd_bridge")
    ros = Ros(node)
    try:
        with Bridge(ros.settings(), ros.publish) as bridge:
            node.create_timer(POLL_S, bridge.poll)
            rclpy.spin(node)
    except (KeyboardInterrupt, ended):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
