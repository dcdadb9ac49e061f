"""One recording: its queue, its thread and its files, from `record_start` to `record_stop`, or to a full disk."""

import contextlib
import errno
import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from gcd_node.config import NodeConfig
from gcd_node.config_text import to_toml
from gcd_node.errors import NodeError
from gcd_node.health.report import Level, RecordHealth
from gcd_node.recording.entries import Translator
from gcd_node.recording.facts import WEIGHTS_METADATA, Identity, node_facts, source_facts, weights_facts
from gcd_node.recording.folder import LimitReachedError, Limits, is_due, limits_of, new_folder, part_path
from gcd_node.recording.inbox import Inbox
from gcd_node.recording.items import Item, NoteItem, SourceFacts
from gcd_node.sources.own_recording import NODE_METADATA, SOURCE_METADATA

if TYPE_CHECKING:
    from gcd_node.recording.mcap_part import McapPart

_LOG = logging.getLogger(__name__)
_FLUSH_S = 1.0
_SYNC_EVERY = 5  # flushes
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

Tell: TypeAlias = Callable[[str, Level, Mapping[str, object]], None]
"""Publishes an event: code, level, fields."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Origin:
    """Who records. config: the launch file. live: the configuration in force, for the head of each file."""

    config: NodeConfig
    live: Callable[[], NodeConfig]
    boot_id: str
    tell: Tell


class Recording:
    """Begins at once. `put` never waits, except in lockstep; see Inbox."""

    def __init__(self, origin: Origin, known: Iterable[Item]) -> None:
        """known: what was said before and still holds, for the head of each file."""
        self._origin, self._config = origin, origin.config.record
        self._inbox = Inbox(waits=origin.config.source.pace == "lockstep")
        self._translator = Translator(origin.config)
        self._known: dict[str, Item] = {item.topic: item for item in known}
        self._folder: Path | None = None
        self._limits: Limits | None = None
        self._part: McapPart | None = None
        self._begun_s = 0.0
        self._parts = self._earlier_bytes = self._earlier_written = 0
        self._bytes = self._written = 0  # of all parts, for others to read
        self._file: str | None = None
        self._whole = True
        self._stop: tuple[str, str] | None = None
        self._failed = False
        self._thread = threading.Thread(target=self._serve, name="recorder", daemon=True)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether its last file is closed."""
        return not self._thread.is_alive()

    def put(self, item: Item) -> None:
        """Record it, if there is room; from any thread."""
        self._inbox.put(item)

    def hurry(self) -> None:
        """See Inbox."""
        self._inbox.hurry()

    def stop(self, reason: str, patience_s: float) -> None:
        """End soon: what waits is written for so long, then given up. Does not wait."""
        if self._stop is None:
            self._stop = (reason, "")
        self._inbox.close(patience_s)

    def join(self, timeout_s: float) -> bool:
        """Wait for its end; whether it came."""
        self._thread.join(timeout_s)
        return self.over

    def report(self) -> RecordHealth:
        """How it does."""
        under_way = "recording" if self._stop is None else "stopping"
        return RecordHealth(
            state="failed" if self._failed else "off" if self.over else under_way,
            file=self._file,
            bytes=self._bytes,
            written=self._written,
            dropped=self._inbox.dropped,
        )

    # What follows runs in the recorder thread alone.

    def _serve(self) -> None:
        try:
            self._begin()
            self._work()
        except LimitReachedError as limit:
            self._give_up(limit.code, str(limit))
        except OSError as error:
            remedy = "look at the disk" if self._parts else "check folder in [record], its permissions and its disk"
            self._give_up("DISK_FULL" if error.errno in _FULL else "DISK_ERROR", f"{error}; {remedy}")
        except Exception as error:
            _LOG.exception("the recording broke")
            self._give_up("INTERNAL", f"{type(error).__name__}; see the log")
        self._end()

    def _begin(self) -> None:
        assert self._config.folder is not None, "the recorder looked"
        root = Path(self._config.folder).expanduser()
        root.mkdir(parents=True, exist_ok=True)
        self._limits = limits_of(root, self._config)
        self._limits.check(0)
        self._folder = new_folder(root, self._origin.config.node_id, self._origin.boot_id)
        self._open_part()
        self._tell("REC_STARTED", Level.OK, {"file": self._file})

    def _work(self) -> None:
        flush_s, flushes = time.monotonic() + _FLUSH_S, 0
        while not self._inbox.exhausted:
            item = self._inbox.take(flush_s - time.monotonic())
            if item is not None:
                self._write(item)
            if time.monotonic() >= flush_s:
                flush_s, flushes = time.monotonic() + _FLUSH_S, flushes + 1
                self._flush(sync=flushes % _SYNC_EVERY == 0)

    def _write(self, item: Item) -> None:
        try:
            entries = self._translator.entries(item)
        except Exception as error:  # of one item: a recording does not end for it
            _LOG.warning("something on %s is not recorded: %s", item.topic, error)
            self._inbox.drop(item.topic)
            return
        part = self._opened()
        if isinstance(item, SourceFacts) or (isinstance(item, NoteItem) and item.kind == "meta"):
            self._known[item.topic] = item
            _describe(part, item)
        part.write(entries)
        self._count(part)
        self._rotate_if_due()

    def _flush(self, *, sync: bool) -> None:
        part = self._opened()
        part.flush()
        if sync:
            part.sync()
        if self._limits is not None:
            self._limits.check(self._earlier_bytes + part.size)
        self._count(part)
        self._rotate_if_due()

    def _count(self, part: "McapPart") -> None:
        self._written = self._earlier_written + part.messages
        self._bytes = self._earlier_bytes + part.size

    def _rotate_if_due(self) -> None:
        if not is_due(self._config, self._opened().size, time.monotonic() - self._begun_s):
            return
        before = self._file
        self._close_part()
        self._open_part()
        self._tell("REC_ROTATED", Level.OK, {"file": self._file, "before": before})

    def _opened(self) -> "McapPart":
        assert self._part is not None, "a part is open while there is work"
        return self._part

    def _open_part(self) -> None:
        """Every file begins with all it takes to read it alone."""
        from gcd_node.recording.mcap_part import McapPart

        assert self._folder is not None, "the folder comes first"
        config, origin = self._origin.live(), self._origin
        path = part_path(self._folder, self._parts)
        identity = Identity(
            recording=self._folder.name, part=self._parts, node_id=config.node_id, boot_id=origin.boot_id
        )
        part = McapPart(path, profile="ros2" if self._config.notes == "ros2" else "")
        self._part, self._begun_s = part, time.monotonic()
        self._parts += 1
        self._file = f"{self._folder.name}/{path.name}"
        part.describe(NODE_METADATA, node_facts(identity, config))
        part.attach("config.toml", "application/toml", to_toml(config).encode())
        for item in self._known.values():
            _describe(part, item)
            part.write(self._translator.entries(_said_again(item)))
        part.flush()
        self._count(part)

    def _close_part(self) -> None:
        part, self._part = self._opened(), None
        self._whole &= part.finish()
        self._count(part)
        self._earlier_bytes, self._earlier_written = self._bytes, self._written

    def _give_up(self, reason: str, message: str) -> None:
        self._stop, self._failed = (reason, message), True

    def _end(self) -> None:
        self._inbox.close(0.0)
        self._inbox.clear()
        if self._part is not None:
            self._close_part()
        elif self._folder is not None and not self._parts:
            with contextlib.suppress(OSError):
                self._folder.rmdir()  # nothing came of it
        reason, message = self._stop or ("INTERNAL", "")
        done = self.report()
        fields: dict[str, object] = {
            "reason": reason,
            "file": done.file,
            "bytes": done.bytes,
            "written": done.written,
            "dropped": dict(done.dropped),
            "finished": self._whole and self._parts > 0,
        }
        level = Level.WARN if self._failed else Level.OK
        self._tell("REC_STOPPED", level, fields | ({"message": message} if message else {}))

    def _tell(self, code: str, level: Level, fields: Mapping[str, object]) -> None:
        try:
            self._origin.tell(code, level, fields)
        except NodeError as error:  # the publisher is closed, or failed: no reason to stop
            at = logging.INFO if level is Level.OK else logging.WARNING  # the event would have been logged
            _LOG.log(at, "nobody hears %s: %s %s", code, fields.get("message", ""), error)


def _describe(part: "McapPart", item: Item) -> None:
    """Add the metadata an item stands for."""
    if isinstance(item, SourceFacts):
        part.describe(SOURCE_METADATA, source_facts(item))
    elif isinstance(item, NoteItem) and (facts := weights_facts(item)) is not None:
        part.describe(WEIGHTS_METADATA, facts)


def _said_again(item: Item) -> Item:
    """At its place on the time line of a new file."""
    if not isinstance(item, NoteItem):
        return item
    return NoteItem(kind=item.kind, header=item.header, fields=item.fields, log_ns=time.time_ns())
