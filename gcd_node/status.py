"""What the node tells of itself: status, events and metadata (wire protocol, section 4)."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass

from gcd_client.protocol import OriginHeader, to_json
from gcd_model import DeviceMemoryError
from gcd_node.errors import ModelFailedError
from gcd_node.health import Health, Level
from gcd_node.messages import camera_matrix, family_name, ontology, published_kinds, source_pose
from gcd_node.publisher import MessageSink
from gcd_node.stream_context import StreamContext
from gcd_node.views import LiveConfig, Settings

_LOG = logging.getLogger(__name__)
_PERIOD_S = 1.0
_LOG_PERIOD_S = 10.0  # of one code: a camera that loses a frame a second fills no disk


class Announcer:
    """Sends notes; every method may be called from any thread. Raises what the sink raises."""

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
        self._sink, self._health, self._clock = sink, health, clock
        self._next_s = clock()
        self._meta: Mapping[str, object] | None = None
        self._logged_s: dict[str, float] = {}
        self._order = threading.Lock()

    def event(self, code: str, level: Level, fields: Mapping[str, object] | None = None) -> None:
        """Something has happened. code: stable, for programs; fields: plain JSON, a `message` for people. Warnings and
        worse are logged too, each code at most once in ten seconds."""
        event = {**(fields or {}), "code": code, "level": int(level)}
        self._sink.note("event", self._origin(), event)
        if level >= Level.WARN and self._clock() >= self._logged_s.get(code, 0.0):
            self._logged_s[code] = self._clock() + _LOG_PERIOD_S
            rest = ", ".join(f"{name}: {value}" for name, value in (fields or {}).items() if name != "message")
            text = " ".join(part for part in (str(event.get("message", "")), f"({rest})" if rest else "") if part)
            severity = logging.ERROR if level is Level.ERROR else logging.WARNING
            _LOG.log(severity, "%s %s", code, text, extra={"event": event})

    def status(self) -> None:
        """Say how it is, now."""
        with self._order:
            self._next_s = self._clock() + _PERIOD_S
            sent = self._sink.stats
            self._health.totals(sent=sent.sent, subs=sent.subscribers, bytes=sent.bytes, queue=sent.dropped)
            self._sink.note("status", self._origin(), self._health.report())

    def status_if_due(self) -> None:
        """The same once a second, and as soon as something that matters has changed."""
        if self._clock() >= self._next_s or self._health.changed():
            self.status()

    def meta(self, fields: Mapping[str, object]) -> None:
        """Say what views are made of, if it is not what was said last."""
        with self._order:
            if fields == self._meta:
                return
            self._meta = dict(fields)
            self._sink.note("meta", self._origin(), fields)

    def _origin(self) -> OriginHeader:
        return OriginHeader(node_id=self.node_id, boot_id=self.boot_id, t_publish_ns=time.time_ns())


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeServices:
    """What every part of a node shares: the configuration in force, where messages go, how it does, what it says."""

    live: LiveConfig
    sink: MessageSink
    health: Health
    announcer: Announcer


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


# What goes wrong: with the model, up to the end of it (wire protocol, section 7, F11), and with its input.

_TRIES, _SPAN_S = 3, 60.0
_BAD_WINDOWS_IN_A_ROW = 3


@dataclass(frozen=True, kw_only=True, slots=True)
class OomLevel:
    """How much less is asked of the device. Each level keeps what the ones before it gave up.

    name: as events and logs say it.
    one_by_one: views are rendered after each other, so that only one is in memory.
    half: weights in bfloat16, loaded anew.
    steps_divisor: so many times fewer steps.
    single: the first view alone, with one sample.
    """

    name: str
    one_by_one: bool = False
    half: bool = False
    steps_divisor: int = 1
    single: bool = False


FULL = OomLevel(name="as asked")
"""Nothing is given up."""


def oom_levels(*, views: int, samples: int, steps: int, can_halve: bool, can_part: bool = True) -> tuple[OomLevel, ...]:
    """The way down from what was asked; levels that would change nothing are left out.

    views, samples, steps: as asked. can_halve: the weights are wider than bfloat16, on a device that gains by it.
    can_part: views may be rendered one by one.
    """
    levels, divisor = [FULL], 2 if steps > 1 else 1
    if views > 1 and can_part:
        levels.append(OomLevel(name="views one by one", one_by_one=True))
    if can_halve:
        levels.append(OomLevel(name="bfloat16", one_by_one=can_part, half=True))
    if steps > 1:
        levels.append(OomLevel(name="half the steps", one_by_one=can_part, half=can_halve, steps_divisor=2))
    if views > 1 or samples > 1:
        levels.append(
            OomLevel(name="a single view", one_by_one=can_part, half=can_halve, steps_divisor=divisor, single=True)
        )
    return tuple(levels)


class FailureCounter:
    """Counts what went wrong, tells it, and says when to give up. Belongs to the model thread.

    Of the device's memory it only ever asks less, until the next activation.
    """

    def __init__(self, health: Health, announcer: Announcer, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic seconds."""
        self._health, self._announcer, self._clock = health, announcer, clock
        self._levels: list[OomLevel] = []  # this one, and those still to come
        self._full_s: deque[float] = deque(maxlen=_TRIES)
        self._bad_in_a_row = 0

    @property
    def level(self) -> OomLevel:
        """How much to ask of the device."""
        return self._levels[0] if self._levels else FULL

    def success(self) -> None:
        """A window came out well."""
        self._bad_in_a_row = 0

    def out_of_memory(self, window_id: int, error: DeviceMemoryError, levels: tuple[OomLevel, ...]) -> None:
        """The device was full: from here on less is asked of it. levels: down from what is asked; see oom_levels().

        Raises:
            ModelFailedError: nothing is left to give up, and it was full three times within a minute.
        """
        self._health.count("oom_count")
        self._levels = self._levels or list(levels)
        if len(self._levels) > 1:
            del self._levels[0]
        else:
            self._full_s.append(self._clock())
        _LOG.warning("window %d: %s; from here on: %s", window_id, error, self.level.name)
        fields = {"window_id": window_id, "rung": self.level.name, "message": str(error)}
        self._announcer.event("GPU_OOM", Level.ERROR, fields)
        if len(self._full_s) == _TRIES and self._full_s[-1] - self._full_s[0] <= _SPAN_S:
            raise ModelFailedError(
                f"the device had no memory three times within a minute although little is asked ({self.level.name}): "
                f"{error} Free memory, or use a smaller model"
            )

    def not_a_number(self, fields: Mapping[str, object]) -> None:
        """A window came out with NaN or Inf, and so did its retry. fields: what it takes to render it again.

        Raises:
            ModelFailedError: the third in a row.
        """
        self._bad_in_a_row += 1
        self._health.count("nan_windows")
        self._announcer.event("MODEL_NAN", Level.ERROR, fields)
        if self._bad_in_a_row >= _BAD_WINDOWS_IN_A_ROW:
            raise ModelFailedError(
                f"{self._bad_in_a_row} windows in a row came out with NaN; none was published. "
                'Try dtype = "float32", and look at them with `gcd-node weights inspect`'
            )


class Condition:
    """A reason in the node's health while something is wrong with what comes in; announced once each time it begins.

    hold_s: how long it must be right again: frames, unlike windows, may be wrong every second time.
    """

    def __init__(self, code: str, health: Health, announcer: Announcer, *, hold_s: float) -> None:
        self._code, self._health, self._announcer, self._hold_s = code, health, announcer, hold_s
        self._wrong_s: float | None = None

    def update(self, problem: Mapping[str, object] | None) -> None:
        """Of the newest input. problem: fields of the event that announces its begin; None if all is right."""
        now_s = time.monotonic()
        if problem is not None:
            if self._wrong_s is None:
                self._health.raise_reason(self._code, Level.WARN)
                self._announcer.event(self._code, Level.WARN, problem)
            self._wrong_s = now_s
        elif self._wrong_s is not None and now_s - self._wrong_s >= self._hold_s:
            self._health.clear_reason(self._code)
            self._wrong_s = None
