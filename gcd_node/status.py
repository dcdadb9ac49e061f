"""What the node tells of itself: status, events, lasting conditions and metadata (wire protocol, section 4)."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict

from gcd_client.protocol import OriginHeader, to_json
from gcd_node.health import Health, Level
from gcd_node.messages import MessageSink, camera_matrix, ontology
from gcd_node.stream_context import StreamContext, family_name, published_kinds, source_pose
from gcd_node.views import Settings

_LOG = logging.getLogger(__name__)
_PERIOD_S = 1.0
_LOG_PERIOD_S = 10.0  # of one code: a camera that loses a frame a second fills no disk


class Announcer:
    """Sends notes; every method may be called from any thread. Raises what the sink raises.

    sink, health: where a node's messages go, and how it does.
    """

    def __init__(
        self,
        node_id: str,
        boot_id: str,
        sink: MessageSink,
        health: Health,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """clock: monotonic seconds."""
        self.boot_id, self.node_id = boot_id, node_id
        self.sink, self.health, self._clock = sink, health, clock
        self._next_s = clock()
        self._meta: Mapping[str, object] | None = None
        self._logged_s: dict[str, float] = {}
        self._order = threading.Lock()

    def event(
        self, code: str, level: Level, fields: Mapping[str, object] | None = None, *, is_logged: bool = True
    ) -> None:
        """Something has happened. code: stable, for programs; fields: plain JSON, a `message` for people. Warnings and
        worse are logged too, each code at most once in ten seconds. is_logged: False for what ends the process, which
        says it itself."""
        event = {**(fields or {}), "code": code, "level": int(level)}
        self.sink.note("event", self._origin(), event)
        if is_logged and level >= Level.WARN and self._clock() >= self._logged_s.get(code, 0.0):
            self._logged_s[code] = self._clock() + _LOG_PERIOD_S
            rest = ", ".join(f"{name}: {value}" for name, value in (fields or {}).items() if name != "message")
            text = " ".join(part for part in (str(event.get("message", "")), f"({rest})" if rest else "") if part)
            severity = logging.ERROR if level is Level.ERROR else logging.WARNING
            _LOG.log(severity, "%s %s", code, text, extra={"event": event})

    def status(self) -> None:
        """Say how it is, now."""
        with self._order:
            self._next_s = self._clock() + _PERIOD_S
            sent = self.sink.stats
            self.health.counts.update(sent=sent.sent, subs=sent.subscribers, bytes=sent.bytes, queue=sent.dropped)
            self.sink.note("status", self._origin(), self.health.report())

    def status_if_due(self) -> None:
        """The same once a second, and as soon as something that matters has changed."""
        if self._clock() >= self._next_s or self.health.changed():
            self.status()

    def meta(self, fields: Mapping[str, object]) -> None:
        """Say what views are made of, if it is not what was said last."""
        with self._order:
            if fields == self._meta:
                return
            self._meta = dict(fields)
            self.sink.note("meta", self._origin(), fields)

    def _origin(self) -> OriginHeader:
        return OriginHeader(node_id=self.node_id, boot_id=self.boot_id, t_publish_ns=time.time_ns())


class Condition:
    """A reason in the node's health while something is wrong with what comes in; announced once each time it begins.

    hold_s: how long it must be right again: frames, unlike windows, may be wrong every second time. over: the event of
    its end, "" for none.
    """

    def __init__(self, code: str, announcer: Announcer, *, hold_s: float, over: str = "") -> None:
        self._code, self._announcer, self._hold_s, self._over = code, announcer, hold_s, over
        self._wrong_s = -math.inf

    def update(self, problem: Mapping[str, object] | None) -> None:
        """Of the newest input. problem: fields of the event that announces its begin; None if all is right."""
        now_s = time.monotonic()
        if problem is None:
            is_over = now_s - self._wrong_s >= self._hold_s and self._announcer.health.clear_reason(self._code)
            if is_over and self._over:
                self._announcer.event(self._over, Level.OK)
            return
        self._wrong_s = now_s
        if self._announcer.health.raise_reason(self._code, Level.WARN):
            self._announcer.event(self._code, Level.WARN, problem)


def metadata(context: StreamContext, settings: Settings) -> dict[str, object]:
    """Weights, views, cameras, classes: what changes only with the configuration or the source."""
    traits = context.traits
    return {
        "weights": {
            "name": traits.name,
            "family": family_name(traits),
            "sha256_12": traits.sha256_12,
            "trained": traits.trained,
            "uncertainty_scale": traits.uncertainty_scale,
        },
        "views": list(settings.revisions),
        "view_revs": dict(settings.revisions),
        "kinds": list(published_kinds(context)),
        "grids": list(context.config.grid),
        **calibration(context),
        "classes": [to_json(each) for each in ontology(traits)],
        "size": [traits.config.width, traits.config.height],
        "fps": context.fps,
        "cfg_digest": context.digest,
    }


def calibration(context: StreamContext) -> dict[str, object]:
    """The camera of the views, and where the source camera is: mounted on a vehicle, or on the sphere; None for what
    is unknown."""
    camera, mount, sphere = context.intrinsics, context.mount, source_pose(context)
    return {
        "K": None if camera is None else list(camera_matrix(camera)),
        "mount": None if mount is None else {**asdict(mount), "assumed": False},
        "src_pose": None if sphere is None else to_json(sphere),
    }
