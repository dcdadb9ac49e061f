"""Recordings: what a node saw, drew, said and was asked, in MCAP files that ROS 2 tools and Foxglove open.

A recording has a thread of its own. Between it and the node is a queue, so that a slow or full disk costs recorded data
and never frames, views or memory.
"""

import errno
import logging
import math
import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gcd_client.protocol import PROTO, DataMessage, EndMessage, OriginHeader, StatusTopic, ViewMessage
from gcd_node.auth import Client, EventSink
from gcd_node.config import NodeConfig, RecordConfig, to_toml
from gcd_node.errors import NodeError
from gcd_node.frame import Frame, LensModel, SourceInfo
from gcd_node.health import Level, RecordHealth
from gcd_node.messages import MessageSink, PublisherStats, utc_offset_ns
from gcd_node.ros_messages import (
    COMMAND_TOPIC,
    IMAGE_TOPIC,
    McapFile,
    command_messages,
    data_messages,
    data_topic,
    input_messages,
    note_messages,
    write_bag_metadata,
)

_LOG = logging.getLogger(__name__)
_MB = 10**6
_QUEUED_BYTES, _QUEUED_ITEMS = 64 * 2**20, 4096
_PATIENCE_S, _FLUSH_S = 10.0, 2.0
_DRIFT_NS = 1_000_000
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PACKAGES = ("gcd-node", "torch", "numpy", "mcap")


class RoomError(Exception):
    """Recordings must not take more room. code: stable, of the event."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def check_room(config: RecordConfig, root: Path) -> float:
    """MB that are free on the disk of `root`. Raises RoomError: recordings may not take more of it, by max_total_mb and
    keep_free_mb; OSError."""
    taken_mb = _taken_bytes(root) / _MB if config.max_total_mb else 0.0
    if taken_mb > config.max_total_mb:
        limit = f"max_total_mb is {config.max_total_mb:g}: move some away"
        raise RoomError("TOTAL_LIMIT", f"recordings in {root} take {taken_mb:.0f} MB, {limit}")
    free_mb = shutil.disk_usage(root).free / _MB
    if free_mb < config.keep_free_mb:
        limit = f"keep_free_mb is {config.keep_free_mb:g}: make room on it"
        raise RoomError("DISK_LOW", f"the disk of {root} has {free_mb:.0f} MB left, {limit}")
    return free_mb


def _taken_bytes(root: Path) -> int:
    total = 0
    for path in (Path(folder, name) for folder, _, names in os.walk(root) for name in names):
        with suppress(FileNotFoundError):  # somebody moved it away meanwhile
            total += path.stat().st_size if path.suffix == ".mcap" else 0
    return total


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Item:
    """Something on its way to the disk. topic: where its loss is counted. size: bytes of a picture, 0 of what is small.
    write: makes messages of it, in the recorder's thread."""

    topic: str
    size: int
    write: Callable[[McapFile], None]


class Recorder:
    """Of one life of a node: a MessageSink before another one, that records what passes, once it was published.

    Every method may be called from any thread; none waits for the disk: what finds no room in the queue is dropped.
    Previews are not recorded: the frames themselves are.
    """

    def __init__(
        self, config: NodeConfig, boot_id: str, live: Callable[[], NodeConfig], tell: EventSink, sink: MessageSink
    ) -> None:
        """live: the configuration in force. tell: publishes an event; called from the recorder's thread."""
        self._config, self._boot_id, self._live, self._tell_node, self._sink = config, boot_id, live, tell, sink
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._head: dict[str, _Item] = {}  # what was said and still holds: every file begins with it
        self._source: SourceInfo | None = None
        self._utc_offset_ns = 0
        self._end_s = -math.inf  # of the recording under way, as all that follows
        self._items: deque[_Item] = deque()
        self._dropped: Counter[str] = Counter()  # what found no room or could not be written, by topic
        self._said: list[_Item] = []  # at the head of the newest file
        self._files: list[McapFile] = []
        self._stop: str | None = None  # why it ends
        self._failure: tuple[str, str] | None = None  # code and message

    @property
    def available(self) -> bool:
        """Whether there is a folder for recordings."""
        return self._config.record.folder is not None

    @property
    def busy(self) -> bool:
        """Whether a recording is under way, or still being finished."""
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> bool:
        """Begin; an event tells how that went. False if there is no folder, or a recording is under way."""
        with self._changed:
            if not self.available or self.busy:
                return False
            self._dropped, self._files, self._end_s = Counter(), [], math.inf
            self._stop = self._failure = None
            self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
            self._thread.start()
            return True

    def stop(self, reason: str = "ASKED", patience_s: float = _PATIENCE_S) -> bool:
        """End soon: what waits is written for so long, then given up; an event tells. False if there is nothing to
        end."""
        if not self.busy:
            return False
        with self._changed:
            self._stop = self._stop or reason
            self._end_s = min(self._end_s, time.monotonic() + patience_s)
            self._changed.notify_all()
        return True

    def close(self, patience_s: float) -> None:
        """End for good: what waits is written for at most so long, and the last file is finished."""
        if self.stop("SHUTDOWN", patience_s / 2) and self._thread is not None:
            self._thread.join(patience_s)

    def report(self) -> RecordHealth:
        """How the recording does, or did."""
        files, under_way = tuple(self._files), "recording" if self._stop is None else "stopping"
        return RecordHealth(
            state="failed" if self._failure else under_way if self.busy else "off",
            file=f"{files[-1].path.parent.name}/{files[-1].path.name}" if files else None,
            bytes=sum(each.size for each in files),
            written=sum(each.messages for each in files),
            dropped=dict(self._dropped),
        )

    # What comes in.

    def source(self, info: SourceInfo, lens: LensModel | None) -> None:
        """Frames are of this source from here on. lens: the calibration in use for its pictures."""
        self._source = replace(info, lens=lens)
        if "inputs" in self._config.record.what:
            facts = {"topic": IMAGE_TOPIC, "kind": info.kind, "id": info.id}
            facts["stamp_uncertainty_us"] = str(info.stamp_uncertainty_us)
            if lens is None and (hfov_deg := self._config.source.hfov_deg or info.hfov_deg):
                facts["hfov_deg"] = repr(hfov_deg)
            self._put("/src/camera_info", 0, lambda file: file.describe("gcd-node/source", facts), is_head=True)

    def frame(self, frame: Frame) -> None:
        """A frame has arrived."""
        source, record, at_ns = self._source, self._config.record, time.time_ns()
        if source is None or "inputs" not in record.what or self._end_s < math.inf:
            return
        if source.clock == "realtime":
            offset_ns = utc_offset_ns()
            if abs(offset_ns - self._utc_offset_ns) > _DRIFT_NS:  # else held, so that steps stay the camera's
                self._utc_offset_ns = offset_ns
            at_ns = frame.stamp_ns + self._utc_offset_ns
            frame = replace(frame, stamp_ns=at_ns)
        size = frame.image.nbytes
        self._put(IMAGE_TOPIC, size, lambda file: file.write(input_messages(frame, source, at_ns, record)))

    def command(self, request: bytes, reply: bytes, client: Client) -> None:
        """A request was answered."""
        at_ns = time.time_ns()
        self._put(COMMAND_TOPIC, 0, lambda file: file.write(command_messages(request, reply, client, at_ns)))

    # What goes out; see MessageSink.

    def send(self, message: DataMessage) -> object:
        sent, topic = self._sink.send(message), data_topic(message)
        if topic is not None and "views" in self._config.record.what:
            self._put(topic, len(message.payload), lambda file: file.write(data_messages(message, self._config)))
        return sent

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        self._sink.preview(made)

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        self._sink.end(message, delay_ms=delay_ms)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        def write(file: McapFile) -> None:
            file.write(note_messages(topic, header, fields, file.begun_ns))

        self._sink.note(topic, header, fields)
        self._put(f"/gcd/{topic}", 0, write, is_head=topic == "meta")

    def stop_waiting(self) -> None:
        self._sink.stop_waiting()

    @property
    def stats(self) -> PublisherStats:
        return self._sink.stats

    def _put(self, topic: str, size: int, write: Callable[[McapFile], None], *, is_head: bool = False) -> None:
        item = _Item(topic=topic, size=size, write=write)
        with self._changed:
            if is_head:
                self._head[topic] = item
            if self._end_s < math.inf:
                return
            waiting = sum(each.size for each in self._items)  # of pictures, one of which always finds room
            if len(self._items) >= _QUEUED_ITEMS or (size and waiting and waiting + size > _QUEUED_BYTES):
                self._dropped[topic] += 1
            else:
                self._items.append(item)
                self._changed.notify_all()

    # What follows runs in the recorder thread alone.

    def _run(self) -> None:
        is_broken = False  # since a write failed
        try:
            self._work()
        except RoomError as limit:
            self._failure = limit.code, str(limit)
        except OSError as error:
            is_broken = True
            code = "DISK_FULL" if error.errno in _FULL else "DISK_ERROR"
            self._failure = code, f"{error}; look at folder in [record], its permissions and its disk"
        except Exception as error:
            is_broken = True
            _LOG.exception("the recording broke")
            self._failure = "INTERNAL", f"{type(error).__name__}; see the log"
        with self._changed:
            self._end_s = -math.inf
            self._dropped.update(item.topic for item in self._items)
            self._items.clear()
        finished = bool(self._files) and self._files[-1].close(is_broken=is_broken)
        if finished:
            with suppress(OSError):  # the disk is full: `ros2 bag reindex` makes it
                write_bag_metadata(self._files[0].path.parent, self._files)
        reason, message = self._failure or (self._stop or "INTERNAL", "")
        done = self.report()
        fields = {"reason": reason, "file": done.file, "bytes": done.bytes, "written": done.written}
        fields |= {"dropped": dict(done.dropped), "finished": finished} | ({"message": message} if message else {})
        self._tell("REC_STOPPED", Level.WARN if self._failure else Level.OK, fields)

    def _work(self) -> None:
        config = self._config.record
        root = Path(config.folder or "").expanduser()
        root.mkdir(parents=True, exist_ok=True)
        check_room(config, root)
        name = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}_{self._config.node_id}_{self._boot_id[:8]}"
        folder = root / name  # names sort by time; none is taken twice
        while folder.exists():
            folder = folder.with_name(f"{folder.name}_2")
        folder.mkdir()
        file, flush_s = self._open(folder), time.monotonic() + _FLUSH_S
        self._tell("REC_STARTED", Level.OK, {"file": self.report().file})
        while self._end_s == math.inf or (self._items and time.monotonic() < self._end_s):
            with self._changed:
                self._changed.wait_for(
                    lambda: bool(self._items) or self._end_s < math.inf, max(0.0, flush_s - time.monotonic())
                )
                item = self._items.popleft() if self._items else None
            if item is not None and item not in self._said:
                self._write(file, item)
            if time.monotonic() >= flush_s:
                file.flush()
                check_room(config, root)
                flush_s = time.monotonic() + _FLUSH_S
            age_s = (time.time_ns() - file.begun_ns) / 1e9
            if 0 < config.rotate_mb <= file.size / _MB or 0 < config.rotate_s <= age_s:
                before = self.report().file
                file.close()
                file = self._open(folder)
                self._tell("REC_ROTATED", Level.OK, {"file": self.report().file, "before": before})

    def _write(self, file: McapFile, item: _Item) -> None:
        try:
            item.write(file)
        except OSError:
            raise
        except Exception as error:  # of one item: a recording does not end for it
            _LOG.warning("something on %s is not recorded: %s", item.topic, error)
            with self._changed:
                self._dropped[item.topic] += 1

    def _open(self, folder: Path) -> McapFile:
        """Every file begins with all it takes to read it alone."""
        config = self._live()
        file = McapFile(folder / f"{folder.name}_{len(self._files):04d}.mcap")
        self._files.append(file)
        facts = {f"version/{package}": version(package) for package in _PACKAGES}
        facts |= {"node_id": config.node_id, "boot_id": self._boot_id, "proto": PROTO}
        file.describe("gcd-node", facts)
        file.attach("config.toml", "application/toml", to_toml(config).encode())
        with self._changed:
            self._said = list(self._head.values())
        for item in self._said:
            self._write(file, item)
        file.flush()
        return file

    def _tell(self, code: str, level: Level, fields: Mapping[str, object]) -> None:
        try:
            self._tell_node(code, level, fields)
        except NodeError as error:  # the publisher is closed, or failed: no reason to stop
            at = logging.INFO if level is Level.OK else logging.WARNING  # the event would have been logged
            _LOG.log(at, "nobody hears %s: %s %s", code, fields.get("message", ""), error)
