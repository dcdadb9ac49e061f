"""What a node tells its recorder, and how recordings begin and end. With no recording under way all of it is free."""

import importlib.util
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from gcd_node.config import NodeConfig
from gcd_node.envelope import NoteTopic, ViewMessage
from gcd_node.errors import ConfigError
from gcd_node.frame import Frame, SourceInfo
from gcd_node.health.report import RecordHealth
from gcd_node.optics.calibration import LensModel
from gcd_node.recording.items import CommandItem, InputItem, Item, NoteItem, SourceFacts, ViewItem, is_recorded
from gcd_node.recording.recording import Origin, Recording, Tell
from gcd_node.security.keys import Client
from gcd_node.wire.header import OriginHeader

_PATIENCE_S = 10.0
_SHARP_NS = 100_000
_DRIFT_NS = 1_000_000


class Recorder:
    """Belongs to one life of a node. Every method may be called from any thread, and none waits for the disk."""

    def __init__(self, config: NodeConfig, boot_id: str, live: Callable[[], NodeConfig], tell: Tell) -> None:
        """live: the configuration in force. tell: publishes an event; called from the recorder's thread.

        Raises:
            ConfigError: there is a folder for recordings, and what writes them is not installed.
        """
        self._config = config.record
        if self._config.folder is not None and importlib.util.find_spec("mcap") is None:
            raise ConfigError("to record, the package mcap is needed: pip install 'gcd-node[record]'")
        self._origin = Origin(config=config, live=live, boot_id=boot_id, tell=tell)
        self._inputs, self._views = "inputs" in self._config.what, "views" in self._config.what
        self._order = threading.Lock()
        self._recording: Recording | None = None
        self._source: SourceFacts | None = None
        self._meta: NoteItem | None = None
        self._utc = _UtcClock()

    @property
    def available(self) -> bool:
        """Whether there is a folder for recordings."""
        return self._config.folder is not None

    @property
    def busy(self) -> bool:
        """Whether a recording is under way, or still being finished."""
        recording = self._recording
        return recording is not None and not recording.over

    def start(self) -> bool:
        """Begin; an event tells how that went. False if there is no folder, or a recording is under way."""
        with self._order:
            if not self.available or self.busy:
                return False
            known: tuple[Item | None, ...] = (self._source if self._inputs else None, self._meta)
            self._recording = Recording(self._origin, [item for item in known if item is not None])
            return True

    def start_if_wanted(self) -> None:
        """Begin, if the launch file says so."""
        if self._config.autostart:
            self.start()

    def stop(self) -> bool:
        """End soon; an event tells. False if no recording is under way."""
        recording = self._recording
        if recording is None or recording.over:
            return False
        recording.stop("ASKED", _PATIENCE_S)
        return True

    def hurry(self) -> None:
        """Make nobody wait for the disk any more, in lockstep either."""
        recording = self._recording
        if recording is not None:
            recording.hurry()

    def close(self, patience_s: float) -> None:
        """End for good: what waits is written for at most so long, and the last file is finished."""
        recording = self._recording
        if recording is not None:
            recording.stop("SHUTDOWN", patience_s / 2)
            recording.join(patience_s)

    def report(self) -> RecordHealth:
        """How the recording does, or did."""
        recording = self._recording
        return RecordHealth() if recording is None else recording.report()

    # What the node tells.

    def source(self, info: SourceInfo, lens: LensModel | None) -> None:
        """Frames are of this source from here on. lens: the calibration in use for its pictures."""
        self._source = SourceFacts(info=info, lens=lens)
        if self._inputs:
            self._put(self._source)

    def frame(self, frame: Frame) -> None:
        """A frame has arrived."""
        source = self._source
        if self._recording is None or source is None or not self._inputs:
            return
        is_live = source.info.clock == "realtime"
        stamp_ns = frame.stamp_ns + self._utc.offset_ns() if is_live else frame.stamp_ns
        log_ns = stamp_ns if is_live else time.time_ns()
        self._put(InputItem(frame=frame, source=source, stamp_ns=stamp_ns, log_ns=log_ns))

    def view(self, message: ViewMessage) -> None:
        """A view has left."""
        if self._recording is not None and self._views and is_recorded(message):
            self._put(ViewItem(message=message))

    def note(self, kind: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """A status, an event or the metadata was said."""
        item = NoteItem(kind=kind, header=header, fields=fields, log_ns=header.t_publish_ns)
        if kind == "meta":
            self._meta = item
        self._put(item)

    def command(self, request: bytes, reply: bytes, client: Client) -> None:
        """A request was answered."""
        if self._recording is not None:
            self._put(CommandItem(request=request, reply=reply, client=client, log_ns=time.time_ns()))

    def _put(self, item: Item) -> None:
        recording = self._recording
        if recording is not None:
            recording.put(item)


class _UtcClock:
    """UTC minus the monotonic clock, held still while it moves by less than a millisecond: so steps between stamps
    stay those of the camera. Used by one thread at a time."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None

    def offset_ns(self) -> int:
        """Now. A look that was interrupted between the two clocks is used only if there is no better one."""
        before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        offset_ns = utc_ns - (before_ns + after_ns) // 2
        held_ns = self._offset_ns
        sharp = after_ns - before_ns < _SHARP_NS
        if held_ns is None or (sharp and abs(offset_ns - held_ns) > _DRIFT_NS):
            self._offset_ns = held_ns = offset_ns
        return held_ns
