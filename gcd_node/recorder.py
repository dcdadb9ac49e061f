"""Recordings: what a node saw, drew, said and was asked, in MCAP files that ROS 2 tools and Foxglove open.

A recording has a thread of its own. Between it and the node is a queue, so that a slow or full disk costs recorded data
and never frames, views or memory.
"""

import contextlib
import errno
import itertools
import logging
import math
import platform
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeAlias

from gcd_client.protocol import PROTO, EndMessage, OriginHeader, StatusTopic, ViewMessage
from gcd_node.auth import Client
from gcd_node.config import NodeConfig, to_toml
from gcd_node.errors import NodeError
from gcd_node.frame import Frame, LensModel, SourceInfo
from gcd_node.health import Level, RecordHealth
from gcd_node.mcap_file import McapFile, RoomError, check_room
from gcd_node.messages import MessageSink, PublisherStats
from gcd_node.ros_messages import (
    COMMAND_TOPIC,
    IMAGE_TOPIC,
    command_messages,
    input_messages,
    note_messages,
    view_messages,
    view_topic,
)

_LOG = logging.getLogger(__name__)
_MB = 10**6
_QUEUED_BYTES, _QUEUED_ITEMS = 64 * 2**20, 4096
_LOCKSTEP_S, _PATIENCE_S = 5.0, 10.0
_FLUSH_S, _SYNC_EVERY, _SHARP_NS, _DRIFT_NS = 1.0, 5, 100_000, 1_000_000  # sync every so many flushes
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PACKAGES = ("gcd-node", "torch", "numpy", "opencv-contrib-python-headless", "mcap")

Tell: TypeAlias = Callable[[str, Level, Mapping[str, object]], None]  # publishes an event: code, level, fields


class Recorder:
    """Of one life of a node: a MessageSink before another one, that records what passes, once it was published.

    Every method may be called from any thread; none waits for the disk, but in lockstep. Previews are not recorded: the
    frames themselves are.
    """

    def __init__(
        self, config: NodeConfig, boot_id: str, live: Callable[[], NodeConfig], tell: Tell, sink: MessageSink
    ) -> None:
        """live: the configuration in force. tell: publishes an event; called from the recorder's thread."""
        self.config, self.boot_id, self.live, self.tell, self._sink = config, boot_id, live, tell, sink
        self._order = threading.Lock()
        self._recording: _Recording | None = None
        self._head: dict[str, _Item] = {}
        self._source: SourceInfo | None = None
        self._utc_offset_ns: int | None = None

    @property
    def available(self) -> bool:
        """Whether there is a folder for recordings."""
        return self.config.record.folder is not None

    @property
    def busy(self) -> bool:
        """Whether a recording is under way, or still being finished."""
        return self._recording is not None and self._recording.thread.is_alive()

    def start(self) -> bool:
        """Begin; an event tells how that went. False if there is no folder, or a recording is under way."""
        with self._order:
            if not self.available or self.busy:
                return False
            self._recording = _Recording(self, self._head)
            return True

    def stop(self) -> bool:
        """End soon; an event tells. False if no recording is under way."""
        if self._recording is None or not self.busy:
            return False
        self._recording.stop("ASKED", _PATIENCE_S)
        return True

    def close(self, patience_s: float) -> None:
        """End for good: what waits is written for at most so long, and the last file is finished."""
        if self._recording is not None:
            self._recording.stop("SHUTDOWN", patience_s / 2)
            self._recording.thread.join(patience_s)

    def report(self) -> RecordHealth:
        """How the recording does, or did."""
        return RecordHealth() if self._recording is None else self._recording.report()

    # What comes in.

    def source(self, info: SourceInfo, lens: LensModel | None) -> None:
        """Frames are of this source from here on. lens: the calibration in use for its pictures."""
        hfov_deg = self.config.source.hfov_deg or info.hfov_deg
        self._source = replace(info, lens=lens, hfov_deg=hfov_deg)
        if "inputs" in self.config.record.what:
            facts = {"kind": info.kind, "id": info.id, "stamp_uncertainty_us": str(info.stamp_uncertainty_us)}
            facts |= {"calibrated": "no" if lens is None else "yes"} | (
                {"hfov_deg": repr(hfov_deg)} if hfov_deg else {}
            )
            self._put("/src/camera_info", 0, lambda file: file.describe("gcd-node/source", facts), is_head=True)

    def frame(self, frame: Frame) -> None:
        """A frame has arrived."""
        if self._recording is None or self._source is None or "inputs" not in self.config.record.what:
            return
        source, record = self._source, self.config.record
        is_live = source.clock == "realtime"
        stamp_ns = frame.stamp_ns + self._to_utc_ns() if is_live else frame.stamp_ns
        at_ns = stamp_ns if is_live else time.time_ns()
        size = frame.image.nbytes
        self._put(IMAGE_TOPIC, size, lambda file: file.write(input_messages(frame, source, stamp_ns, at_ns, record)))

    def command(self, request: bytes, reply: bytes, client: Client) -> None:
        """A request was answered."""
        at_ns = time.time_ns()
        self._put(COMMAND_TOPIC, 0, lambda file: file.write(command_messages(request, reply, client, at_ns)))

    # What goes out; see MessageSink.

    def send(self, message: ViewMessage) -> object:
        sent, topic = self._sink.send(message), view_topic(message)
        if topic is not None and "views" in self.config.record.what:
            self._put(topic, len(message.payload), lambda file: file.write(view_messages(message, self.config)))
        return sent

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        self._sink.preview(made)

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        self._sink.end(message, delay_ms=delay_ms)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        def write(file: McapFile) -> None:
            log_ns = header.t_publish_ns
            if topic == "meta" and isinstance(weights := fields.get("weights"), Mapping):
                facts = {key: str(value) for key, value in weights.items()}
                file.describe("gcd-node/weights", facts | {"cfg_digest": str(fields.get("cfg_digest"))})
                log_ns = max(log_ns, file.begun_ns)  # it is said again at the head of each file
            file.write(note_messages(topic, header, fields, log_ns))

        self._sink.note(topic, header, fields)
        self._put(f"/gcd/{topic}", 0, write, is_head=topic == "meta")

    def stop_waiting(self) -> None:
        self._sink.stop_waiting()
        if self._recording is not None:
            self._recording.stop_waiting()

    @property
    def stats(self) -> PublisherStats:
        return self._sink.stats

    def _put(self, topic: str, size: int, write: Callable[[McapFile], None], *, is_head: bool = False) -> None:
        item = _Item(topic=topic, size=size, write=write, is_head=is_head)
        if is_head:
            self._head[topic] = item
        if self._recording is not None:
            self._recording.put(item)

    def _to_utc_ns(self) -> int:
        """UTC minus the monotonic clock, held still while it moves by less than a millisecond: so steps between stamps
        stay those of the camera. A look that was interrupted between the two clocks is used only if there is none."""
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        offset_ns, held_ns = utc_ns - (before_ns + after_ns) // 2, self._utc_offset_ns
        if held_ns is None or (after_ns - before_ns < _SHARP_NS and abs(offset_ns - held_ns) > _DRIFT_NS):
            self._utc_offset_ns = held_ns = offset_ns
        return held_ns


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Item:
    """Something on its way to the disk. topic: where its loss is counted. size: bytes of a picture, 0 of what is small.
    write: makes messages of it, in the recorder's thread. is_head: every file begins with it."""

    topic: str
    size: int
    write: Callable[[McapFile], None]
    is_head: bool


class _Recording:
    """From `record_start` to `record_stop`, or to a full disk: what waits for the disk, its thread and its files.

    When there is no room for it, the oldest pictures go; in lockstep whoever has a picture waits for room instead, for
    5 s at most.
    """

    def __init__(self, recorder: Recorder, head: Mapping[str, _Item]) -> None:
        """head: what was said before and still holds."""
        self._recorder, self._config, self._head = recorder, recorder.config.record, dict(head)
        self._waits, self._end_s = recorder.config.source.pace == "lockstep", math.inf
        self._changed = threading.Condition()
        self._items: deque[_Item] = deque()
        self._dropped: Counter[str] = Counter()  # what found no room or could not be written, by topic
        self._files: list[McapFile] = []
        self._stop: str | None = None
        self._failure: tuple[str, str] | None = None  # code and message
        self.thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self.thread.start()

    def put(self, item: _Item) -> None:
        """Hand an item over; from any thread."""
        with self._changed:
            if item.size:
                self._changed.wait_for(lambda: not self._waits or self._has_room(item), _LOCKSTEP_S)
            if self._end_s < math.inf:
                return
            if not item.size and len(self._items) >= _QUEUED_ITEMS:
                self._dropped[item.topic] += 1
                return
            while not self._has_room(item):
                oldest = next(each for each in self._items if each.size)
                self._items.remove(oldest)
                self._dropped[oldest.topic] += 1
            self._items.append(item)
            self._changed.notify_all()

    def stop_waiting(self) -> None:
        """Make nobody wait any more."""
        with self._changed:
            self._waits = False
            self._changed.notify_all()

    def stop(self, reason: str, patience_s: float) -> None:
        """End soon: what waits is written for so long, then given up. Does not wait."""
        self._stop = self._stop or reason
        self._end_s = min(self._end_s, time.monotonic() + patience_s)
        self.stop_waiting()

    def report(self) -> RecordHealth:
        """How it does."""
        files, under_way = tuple(self._files), "recording" if self._stop is None else "stopping"
        return RecordHealth(
            state="failed" if self._failure else under_way if self.thread.is_alive() else "off",
            file=f"{files[-1].path.parent.name}/{files[-1].path.name}" if files else None,
            bytes=sum(each.size for each in files),
            written=sum(each.messages for each in files),
            dropped=dict(self._dropped),
        )

    def _has_room(self, item: _Item) -> bool:
        waiting = sum(each.size for each in self._items)
        return waiting == 0 or waiting + item.size <= _QUEUED_BYTES  # one always finds room

    # What follows runs in the recorder thread alone.

    def _run(self) -> None:
        is_broken = False  # since a write failed
        try:
            root = Path(self._config.folder or "").expanduser()
            root.mkdir(parents=True, exist_ok=True)
            check_room(self._config, root)
            name = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}_{self._recorder.config.node_id}"
            name = f"{name}_{self._recorder.boot_id[:8]}"  # names sort by time; none is taken twice
            names = itertools.chain((name,), (f"{name}_{count}" for count in itertools.count(2)))
            folder = next(path for each in names if not (path := root / each).exists())
            folder.mkdir()
            self._open(folder)
            self._tell("REC_STARTED", Level.OK, {"file": self.report().file})
            self._work(root, folder)
        except RoomError as limit:
            self._failure = limit.code, str(limit)
        except OSError as error:
            is_broken = True
            remedy = "look at the disk" if self._files else "check folder in [record], its permissions and its disk"
            self._failure = "DISK_FULL" if error.errno in _FULL else "DISK_ERROR", f"{error}; {remedy}"
        except Exception as error:
            is_broken = True
            _LOG.exception("the recording broke")
            self._failure = "INTERNAL", f"{type(error).__name__}; see the log"
        with self._changed:
            self._end_s, self._waits = -math.inf, False
            self._dropped.update(item.topic for item in self._items)
            self._items.clear()
            self._changed.notify_all()
        if self._files:
            self._files[-1].close(is_broken=is_broken)
        reason, message = self._failure or (self._stop or "INTERNAL", "")
        done, finished = self.report(), bool(self._files) and all(each.is_whole for each in self._files)
        fields = {"reason": reason, "file": done.file, "bytes": done.bytes, "written": done.written}
        fields |= {"dropped": dict(done.dropped), "finished": finished} | ({"message": message} if message else {})
        self._tell("REC_STOPPED", Level.WARN if self._failure else Level.OK, fields)

    def _work(self, root: Path, folder: Path) -> None:
        config, flush_s, flushes = self._config, time.monotonic() + _FLUSH_S, 0
        while self._end_s == math.inf or (self._items and time.monotonic() < self._end_s):
            file = self._files[-1]
            with self._changed:
                self._changed.wait_for(
                    lambda: bool(self._items) or self._end_s < math.inf, max(0.0, flush_s - time.monotonic())
                )
                item = self._items.popleft() if self._items else None
                self._changed.notify_all()
            if item is not None:
                self._write(file, item)
            if time.monotonic() >= flush_s:
                flush_s, flushes = time.monotonic() + _FLUSH_S, flushes + 1
                file.flush(sync=flushes % _SYNC_EVERY == 0)
                check_room(config, root)
            age_s = (time.time_ns() - file.begun_ns) / 1e9
            if 0 < config.rotate_mb <= file.size / _MB or 0 < config.rotate_s <= age_s:
                before = self.report().file
                file.close()
                self._open(folder)
                self._tell("REC_ROTATED", Level.OK, {"file": self.report().file, "before": before})

    def _write(self, file: McapFile, item: _Item) -> None:
        if item.is_head:
            self._head[item.topic] = item
        try:
            item.write(file)
        except OSError:
            raise
        except Exception as error:  # of one item: a recording does not end for it
            _LOG.warning("something on %s is not recorded: %s", item.topic, error)
            with self._changed:
                self._dropped[item.topic] += 1

    def _open(self, folder: Path) -> None:
        """Every file begins with all it takes to read it alone."""
        config, part = self._recorder.live(), len(self._files)
        file = McapFile(folder / f"{folder.name}_{part:04d}.mcap")
        self._files.append(file)
        facts = {"format": "1", "recording": folder.name, "part": str(part), "node_id": config.node_id}
        facts |= {"boot_id": self._recorder.boot_id, "proto": PROTO, "what": ",".join(config.record.what)}
        facts |= {"python": platform.python_version()}
        if "inputs" in config.record.what:
            facts |= {"input_topic": IMAGE_TOPIC, "input_encoding": config.record.input_encoding}
        for package in _PACKAGES:
            with contextlib.suppress(PackageNotFoundError):
                facts[f"version/{package}"] = version(package)
        file.describe("gcd-node", facts)
        file.attach("config.toml", "application/toml", to_toml(config).encode())
        for item in tuple(self._head.values()):
            self._write(file, item)
        file.flush()

    def _tell(self, code: str, level: Level, fields: Mapping[str, object]) -> None:
        try:
            self._recorder.tell(code, level, fields)
        except NodeError as error:  # the publisher is closed, or failed: no reason to stop
            at = logging.INFO if level is Level.OK else logging.WARNING  # the event would have been logged
            _LOG.log(at, "nobody hears %s: %s %s", code, fields.get("message", ""), error)
