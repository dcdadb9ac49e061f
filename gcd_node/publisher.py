"""Sends encoded messages: one thread owns the data and the status socket (wire protocol, section 1).

ZeroMQ sockets belong to one thread, so callers hand messages over through a bounded queue. The thread looks at its
sockets at least every 10 ms: without that, welcome messages and subscriptions would never be served.

Longer than most files: the two sockets and the thread that owns them are one matter.
"""

import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import zmq

from gcd_node.envelope import (
    PREVIEW_TOPIC,
    TOPIC_BYTES,
    WELCOME,
    EndMessage,
    NoteMessage,
    NoteTopic,
    ViewMessage,
    encode,
)
from gcd_node.errors import EndpointError, NodeError
from gcd_node.publishing.options import PublisherOptions, PublisherStats
from gcd_node.publishing.subscriptions import Subscriptions
from gcd_node.security.gate import Context, EventSink, Gate, Socket, unbind
from gcd_node.wire.endpoints import own_endpoint
from gcd_node.wire.header import OriginHeader

_LOG = logging.getLogger(__name__)
_IDLE_S = 0.01
_RETRY_MS = 3
_DATA_HWM = 4
_STATUS_HWM = 100
_LEAST_LINGER_MS = 100
_MAX_SUBSCRIPTION = 4096


@dataclass(frozen=True, kw_only=True, slots=True)
class _Parcel:
    """An encoded message; follow_s: how long it must come after the last one, None for at once."""

    part: bytes
    follow_s: float | None = None


class Publisher:
    """Publishes views, ends and notes. Use it as a context manager; every method may be called from any thread.

    Make one per boot_id: sequences count from 0 here. on_event gets AUTH_DENIED and its fields, from another thread.

    Raises:
        EndpointError: an endpoint is in use or cannot be bound.
        ConfigError: an endpoint is no endpoint, or others than this machine could reach it.
    """

    def __init__(self, options: PublisherOptions, on_event: EventSink | None = None) -> None:
        self._options = options
        self._queue: queue.Queue[_Parcel] = queue.Queue(options.queue_size)
        self._notes: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._preview: deque[bytes] = deque(maxlen=1)
        self._sequences: Counter[tuple[str, str]] = Counter()
        self._hand_over, self._note_order = threading.Lock(), threading.Lock()
        self._hurried = threading.Event()
        self._closing, self._abandoned, self._closed = threading.Event(), threading.Event(), threading.Event()
        self._failure: Exception | None = None
        self._dropped, self._closing_s = 0, 0.0
        self._context = zmq.Context()
        try:
            self._gate = Gate(self._context, options.security, on_event)
            self._data = _DataSocket(self._context, self._gate, options)
            self._status = None if options.status is None else _StatusSocket(self._context, self._gate, options.status)
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self._gate.start()
        self._thread = threading.Thread(target=self._serve, name="publisher", daemon=True)
        self._thread.start()

    def send(self, message: ViewMessage) -> bool:
        """Number, encode and hand over one message; its own `sequence` is replaced.

        Realtime never waits: with a full queue the message is dropped and counted. Lockstep waits for room. Previews
        of the input wait in a place of their own, the newest wins: they never take the room of a view, nor wait.

        Returns:
            Whether it was accepted.
        Raises:
            MessageError: it cannot be encoded. NodeError: the publisher is closed, or its thread failed.
        """
        with self._hand_over:
            self.check()
            if message.topic == PREVIEW_TOPIC:
                self._preview.append(self._encoded(message))
                return True
            if self._queue.full() and not self._options.lockstep:
                self._dropped += 1
                return False
            self._put(_Parcel(part=self._encoded(message)))
        time.sleep(0)  # lets the thread begin now, instead of when the caller has time
        return True

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Queue an end-of-stream message, to leave `delay_ms` (else end_delay_ms) after the last window; never dropped.

        Raises: as send().
        """
        delay = self._options.end_delay_ms if delay_ms is None else delay_ms
        with self._hand_over:
            self.check()
            self._put(_Parcel(part=self._encoded(message), follow_s=delay / 1000))

    def note(self, topic: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Send a status, event or meta message; the last of each topic is repeated to whoever subscribes later.

        Raises: as send().
        """
        with self._note_order:
            self.check()
            self._notes.put(self._encoded(NoteMessage(topic=topic, header=header, fields=fields)))

    def hurry(self) -> None:
        """Stop waiting for readers, for a node that was told to stop: what does not leave in `linger_ms` is lost."""
        self._hurried.set()

    def check(self) -> None:
        """Raises what stopped the thread, or NodeError if the publisher is closed."""
        self._raise_failure()
        if self._closed.is_set():
            raise NodeError("the publisher is closed; make a new one")

    @property
    def stats(self) -> PublisherStats:
        """Counters since the start."""
        data = self._data
        return PublisherStats(
            sent=data.sent,
            dropped=self._dropped,
            subscribers=data.readers.now.total,
            bytes=data.bytes,
            readers=data.readers.now,
        )

    @property
    def endpoint(self) -> str:
        """Where data was bound, with the port that was chosen if 0 was asked for."""
        return self._data.endpoint

    @property
    def status_endpoint(self) -> str | None:
        """Where status was bound, None without a status socket."""
        return None if self._status is None else self._status.endpoint

    def close(self, *, orderly: bool = True) -> None:
        """Send what is queued, give readers `linger_ms`, close. Not orderly: close at once. A second call does
        nothing, but one that is not orderly cuts the first one short.

        Raises:
            EndpointError: lockstep messages that no reader took. Else whatever stopped the thread.
        """
        first = not self._closed.is_set()
        self._shut(orderly)
        if first:
            self._raise_failure()

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if error is None:
            self.close()
            return
        self._shut(orderly=False)
        if self._failure is not None:
            _LOG.error("the publisher had failed too: %s", self._failure)

    def _encoded(self, message: ViewMessage | EndMessage | NoteMessage) -> bytes:
        key = (message.header.boot_id, message.topic)
        numbered = replace(message, sequence=self._sequences[key])
        part = encode(numbered, checksum=isinstance(message, NoteMessage) or not self._data.local)
        self._sequences[key] += 1
        return part

    def _put(self, parcel: _Parcel) -> None:
        while not self._hurried.is_set():
            try:
                return self._queue.put(parcel, timeout=0.05)
            except queue.Full:
                self.check()
        if parcel.follow_s is not None:
            self._queue.maxsize += 1  # room of its own: an end is never lost to a full queue
        try:
            self._queue.put_nowait(parcel)
        except queue.Full:
            self._dropped += 1

    def _raise_failure(self) -> None:
        if isinstance(self._failure, NodeError):
            raise self._failure
        if self._failure is not None:
            raise NodeError(f"the publisher thread stopped: {self._failure}") from self._failure

    def _shut(self, orderly: bool) -> None:
        if not orderly:
            self._abandoned.set()  # also cuts short an orderly close that another thread is in
        if self._closed.is_set():
            return
        self._closed.set()
        self._closing_s = time.monotonic()
        self._closing.set()
        self._thread.join()
        self._gate.close()
        self._context.term()

    # What follows runs in the publisher thread alone.

    def _serve(self) -> None:
        linger_ms = 0
        try:
            self._run()
            if not self._abandoned.is_set():
                self._see_off()
                linger_ms = max(_LEAST_LINGER_MS, round(1000 * self._left_s(time.monotonic())))
        except Exception as error:
            self._failure = error
        finally:
            self._data.close(linger_ms)
            if self._status is not None:
                self._status.close(linger_ms)

    def _run(self) -> None:
        parcel: _Parcel | None = None
        progress = time.monotonic()
        while not self._abandoned.is_set():
            closing = self._closing.is_set()  # read first: what was queued before it is seen below
            self._serve_sockets()
            parcel = parcel or self._take()
            if parcel is None and closing:
                return
            if parcel is None or self._data.send(parcel):
                parcel, progress = None, time.monotonic()
            elif not closing:
                progress = time.monotonic()
                self._data.wait(_RETRY_MS)
            elif self._left_s(progress) < 0:
                if self._hurried.is_set():
                    return
                raise EndpointError(self._undelivered())
            else:
                self._data.wait(_RETRY_MS)

    def _see_off(self) -> None:
        """Wait until readers have left. ZeroMQ's linger ends when its last batch of bytes is on its way, and loses it
        to a reader too slow to take it at once; who leaves has the end-of-stream message."""
        until = time.monotonic() + self._left_s(time.monotonic())
        while self._data.ended and self._data.readers.now.total > 0 and time.monotonic() < until:
            self._serve_sockets()
            self._data.wait(_RETRY_MS)
            if self._abandoned.is_set():
                return

    def _left_s(self, progress_s: float) -> float:
        """How much longer to wait for readers at the end, after the last progress. A node that was told to stop has
        linger_ms for all of it, so that slow readers cannot stretch the end one message at a time."""
        hurried, options = self._hurried.is_set(), self._options
        patience_ms = options.drain_ms if options.lockstep and not hurried else options.linger_ms
        return (self._closing_s if hurried else progress_s) + patience_ms / 1000 - time.monotonic()

    def _serve_sockets(self) -> None:
        self._data.serve()
        while self._preview:
            self._data.try_send(self._preview.pop())  # what finds no room is lost, in lockstep too
        while not self._notes.empty():
            part = self._notes.get()
            if self._status is not None:
                self._status.send(part)
        if self._status is not None:
            self._status.serve()

    def _take(self) -> _Parcel | None:
        try:
            return self._queue.get(timeout=_IDLE_S)
        except queue.Empty:
            return None

    def _undelivered(self) -> str:
        count, seconds = self._queue.qsize() + 1, self._options.drain_ms / 1000
        have, wanted = self._data.readers.now.watchers, self._options.min_subscribers
        readers = f"{have} subscribers, wanted {wanted}"
        return f"{count} messages were not taken within {seconds:g} s at {self.endpoint} ({readers}); start the reader"


class _DataSocket:
    """The data socket; in lockstep it refuses rather than skips."""

    def __init__(self, context: Context, gate: Gate, options: PublisherOptions) -> None:
        self._options = options
        self._socket = _made(context, _DATA_HWM, no_drop=options.lockstep)
        self.endpoint = gate.bind(self._socket, own_endpoint(options.data, "data"), "data")
        self.local = self.endpoint.startswith("ipc://")
        self.sent = self.bytes = 0
        self.readers = Subscriptions()
        self._begun = self.ended = False
        self._last_sent = time.monotonic()

    def serve(self) -> None:
        """Count who comes and goes."""
        for event in _events(self._socket):
            self.readers.hear(event)

    def send(self, parcel: _Parcel) -> bool:
        """Whether it left; if not, try again later."""
        if self._options.lockstep and not self._begun and self.readers.now.watchers < self._options.min_subscribers:
            return False
        if parcel.follow_s is not None and time.monotonic() < self._last_sent + parcel.follow_s:
            return False
        if not self.try_send(parcel.part):
            return False
        self._begun, self.ended = True, parcel.follow_s is not None
        if not self.ended:
            self._last_sent = time.monotonic()
        return True

    def try_send(self, part: bytes) -> bool:
        """Whether it left."""
        try:
            self._socket.send(part, zmq.NOBLOCK, copy=False)  # a copy would cost more than all the rest
        except zmq.Again:
            return False
        self.sent += 1
        self.bytes += len(part)
        return True

    def wait(self, timeout_ms: int) -> None:
        """Until a subscription arrives, at most `timeout_ms`."""
        self._socket.poll(timeout_ms)

    def close(self, linger_ms: int) -> None:
        unbind(self._socket, self.endpoint, linger_ms)


class _StatusSocket:
    """The status socket: keeps the last message of each topic for whoever comes later."""

    def __init__(self, context: Context, gate: Gate, endpoint: str) -> None:
        self._socket = _made(context, _STATUS_HWM, no_drop=False)
        self.endpoint = gate.bind(self._socket, own_endpoint(endpoint, "status"), "status")
        self._last: dict[bytes, bytes] = {}

    def serve(self) -> None:
        """Repeat what a new subscriber asks for; ZeroMQ sends it to all, who know it by its sequence."""
        for event in _events(self._socket):
            for part in [part for key, part in self._last.items() if event[0] and key.startswith(event[1:])]:
                self._socket.send(part)

    def send(self, part: bytes) -> None:
        self._last[part[:TOPIC_BYTES]] = part
        self._socket.send(part)

    def close(self, linger_ms: int) -> None:
        unbind(self._socket, self.endpoint, linger_ms)


def begin_zero_copy() -> None:
    """Start what lets go of messages once they have left. It begins with the first one otherwise, once a process, and
    stays: for whoever counts threads and sockets."""
    zmq.Frame(bytes(zmq.COPY_THRESHOLD), copy=False)


def _events(socket: Socket) -> list[bytes]:
    """Pending subscribe (first byte 1) and unsubscribe (first byte 0) events; anything else a peer sends is ignored."""
    found: list[bytes] = []
    while socket.poll(0):
        event = socket.recv(zmq.NOBLOCK)
        if event[:1] in (b"\0", b"\1"):
            found.append(event)
    return found


def _made(context: Context, high_water_mark: int, *, no_drop: bool) -> Socket:
    socket = context.socket(zmq.XPUB)
    socket.set(zmq.XPUB_VERBOSER, 1)  # VERBOSE, and unsubscriptions too: only so can subscribers be counted
    socket.set(zmq.XPUB_NODROP, int(no_drop))
    socket.set(zmq.XPUB_WELCOME_MSG, WELCOME)
    socket.set(zmq.SNDHWM, high_water_mark)
    socket.set(zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION)
    socket.set(zmq.LINGER, 0)
    return socket
