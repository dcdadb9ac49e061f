"""What a reader knows of a node from its status socket, and how bad that is. Nothing here draws or prints."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gcd_client.protocol import StatusMessage
from gcd_node.health import Level

STALE_AFTER_S = 3.0
"""A node speaks once a second; silent for so long, what it said last holds no longer."""

_EVENTS = 8


@dataclass(frozen=True, kw_only=True, slots=True)
class EventLine:
    """Something that happened. heard_s: when it was heard, seconds of the board's clock. details: the other fields."""

    heard_s: float
    code: str
    level: Level
    details: Mapping[str, Any]


class StatusBoard:
    """The last status, the last meta and the latest events of one node.

    Times are monotonic seconds, given by the caller. What a note holds was written by others: fields may be missing or
    of any type.
    """

    def __init__(self, stale_after_s: float = STALE_AFTER_S) -> None:
        self._stale_after_s = stale_after_s
        self._status: StatusMessage | None = None
        self._heard_s = 0.0
        self._boot_id: str | None = None
        self.restarts = 0
        self.meta: Mapping[str, Any] = {}
        self.events: deque[EventLine] = deque(maxlen=_EVENTS)

    def add(self, note: StatusMessage, now_s: float, wall_ns: int) -> None:
        """Take note of a note. wall_ns: the wall clock now; the first status may be one that was kept for late
        readers, and is as old as its stamp says."""
        self._notice_boot(note.header.boot_id)
        if note.topic == "status":
            kept_s = 0.0 if self._status is not None else max(0.0, (wall_ns - note.header.t_publish_ns) / 1e9)
            self._status, self._heard_s = note, now_s - kept_s
        elif note.topic == "meta":
            self.meta = note.fields
        else:
            self.events.append(_event(note.fields, now_s))

    @property
    def known(self) -> bool:
        """Whether a status has come."""
        return self._status is not None

    @property
    def node_id(self) -> str:
        """The node's name, empty before it spoke."""
        return "" if self._status is None else self._status.header.node_id

    @property
    def fields(self) -> Mapping[str, Any]:
        """The last status, as it came."""
        return {} if self._status is None else self._status.fields

    def section(self, name: str) -> Mapping[str, Any]:
        """An object within the last status; empty if there is none."""
        found = self.fields.get(name)
        return found if isinstance(found, Mapping) else {}

    def silent_s(self, now_s: float) -> float | None:
        """Since the last status; None before the first."""
        return None if self._status is None else max(0.0, now_s - self._heard_s)

    def stale(self, now_s: float) -> bool:
        """Whether the node has been silent for too long, or has not spoken yet."""
        silent_s = self.silent_s(now_s)
        return silent_s is None or silent_s > self._stale_after_s

    def level(self, now_s: float) -> Level:
        """As the node said, or STALE."""
        return Level.STALE if self.stale(now_s) else _level(self.fields.get("level"))

    def reasons(self) -> list[str]:
        """What is wrong, by the last status: codes."""
        return self._codes("reasons")

    def missing(self) -> list[str]:
        """What keeps the node from being ready, by the last status: codes."""
        return self._codes("not_ready")

    def _codes(self, name: str) -> list[str]:
        found = self.fields.get(name)
        return [each for each in found if isinstance(each, str)] if isinstance(found, list) else []

    def record(self, now_s: float) -> dict[str, Any]:
        """The last status for a program: as it came, with the node's name, its age in ms, and STALE where it is."""
        status = self._status
        if status is None:
            return {"level": int(Level.STALE), "stale": True}
        silent_s = self.silent_s(now_s) or 0.0
        header = status.header
        told = {"node_id": header.node_id, "boot_id": header.boot_id, "age_ms": round(1000 * silent_s)}
        return {**status.fields, **told, "level": int(self.level(now_s)), "stale": self.stale(now_s)}

    def _notice_boot(self, boot_id: str) -> None:
        if self._boot_id not in (None, boot_id):
            self.restarts += 1
            self._status, self.meta = None, {}
        self._boot_id = boot_id


def _event(fields: Mapping[str, Any], now_s: float) -> EventLine:
    details = {key: value for key, value in fields.items() if key not in ("code", "level")}
    return EventLine(
        heard_s=now_s, code=str(fields.get("code", "?")), level=_level(fields.get("level")), details=details
    )


def _level(value: object) -> Level:
    """A level as a node wrote it; what is none counts as an error."""
    try:
        return Level(value)  # pyright: ignore[reportArgumentType]  whatever came
    except ValueError:
        return Level.ERROR
