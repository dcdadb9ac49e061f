"""Sends encoded messages: one thread owns the data and the status socket (wire protocol, section 1).

ZeroMQ sockets belong to one thread, so callers hand messages over through a bounded queue and wake the thread; it
sleeps until a message, a subscription or the end comes.
"""

import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import cycle
from types import TracebackType
from typing import Any

import zmq
from msgspec.structs import replace

from gcd_client.protocol import (
    PREVIEW_TOPIC,
    TOPIC_BYTES,
    WELCOME,
    ClientError,
    DataMessage,
    EndMessage,
    Message,
    OriginHeader,
    StatusMessage,
    StatusTopic,
    ViewMessage,
    encode,
    topic_key,
)
from gcd_node.auth import Context, EventSink, ServerSecurity, Socket, SocketGuard, unbind
from gcd_node.config import PublishConfig
from gcd_node.errors import EndpointError, NodeError, PublisherError
from gcd_node.messages import PublisherStats

_LOG = logging.getLogger(__name__)
_DATA_HWM, _STATUS_HWM = 4, 100
_MAX_SUBSCRIPTION, _MOST_EVENTS = 1024, 256  # bytes, as a handshake with keys takes hundreds; between two sendings
_PREVIEW_KEY = topic_key(PREVIEW_TOPIC)
_RETRY_MS, _REPEAT_MS = 3, 10
_LEAST_LINGER_MS = 100


class Publisher:
    """Publishes views, ends and notes. Use it as a context manager; every method may be called from any thread.

    Make one per boot_id: sequences count from 0 here. on_event gets AUTH_DENIED and its fields, from another thread.
    lockstep: wait for slow readers instead of skipping, and for min_subscribers before the first message.
    security: keys and allowed clients of tcp endpoints; without them only this machine can be let in.
    linger_ms: how long an orderly close waits for readers to take the end and leave; drain_ms: the same in lockstep,
        and there also how long a queued message may wait for a reader.
    queue_size: messages between the callers and the thread.
    guard: of its sockets.
    endpoint, status_endpoint: where data and status were bound, with the port that was chosen if 0 was asked for.

    Raises:
        EndpointError: an endpoint is in use or cannot be bound.
        ConfigError: an endpoint is no endpoint, or others than this machine could reach it.
    """

    def __init__(
        self,
        config: PublishConfig,
        on_event: EventSink | None = None,
        *,
        lockstep: bool = False,
        security: ServerSecurity | None = None,
        linger_ms: int = 1000,
        drain_ms: int = 5000,
        queue_size: int = 8,
    ) -> None:
        self._config, self._lockstep, self._linger_ms, self._drain_ms = config, lockstep, linger_ms, drain_ms
        self._queue: queue.Queue[tuple[bytes, float | None]] = queue.Queue(queue_size)  # and what it follows by
        self._notes: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._preview: Callable[[], ViewMessage] | None = None
        self._sequences: Counter[tuple[str, str]] = Counter()
        self._hand_over, self._note_order = threading.Lock(), threading.Lock()
        self._is_hurried = self._is_abandoned = self._has_begun = False
        self._failure: Exception | None = None
        self._closing_s: float | None = None
        self._sent = self._bytes = self._dropped = 0
        self._last_sent_s = time.monotonic()
        self._ends: list[bytes] = []  # those since the last view
        self._last_notes: dict[bytes, bytes] = {}
        self._topics: Counter[bytes] = Counter()  # subscriptions on the data socket; of the publisher's thread alone
        self._readers = (0, 0, 0)  # all, of views, of previews; never changed, only replaced
        self.guard = SocketGuard(security, on_event)
        try:
            self._data = _xpub(self.guard.context, _DATA_HWM, no_drop=lockstep)
            self.endpoint = self.guard.bind(self._data, config.data, "data")
            self._status = _xpub(self.guard.context, _STATUS_HWM, no_drop=False)
            self.status_endpoint = self.guard.bind(self._status, config.status, "status")
        except BaseException:
            self.guard.close()
            raise
        self._thread = threading.Thread(target=self._serve, name="publisher", daemon=True)
        self._thread.start()

    def send(self, message: DataMessage) -> bool:
        """Number, encode and hand over one message; its own `sequence` is replaced.

        Realtime never waits: with a full queue the message is dropped and counted. Lockstep waits for room.

        Returns:
            Whether it was accepted.
        Raises:
            MessageError: it cannot be encoded. NodeError: the publisher is closed, or its thread failed.
        """
        with self._hand_over:
            self.check()
            if self._queue.full() and not self._lockstep:
                self._dropped += 1
                return False
            self._put(self._encoded(message), None)
        time.sleep(0)  # lets the thread begin now, instead of when the caller has time
        return True

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        """Send the newest preview of the input, in lockstep too without waiting: what finds no room is lost.

        made: called in the publisher's thread. Raises: as send().
        """
        self.check()
        self._preview = made
        self.guard.wake()

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Queue an end-of-stream message, to leave `delay_ms` (else end_delay_ms) after the last window; never dropped.

        Raises: as send().
        """
        delay = self._config.end_delay_ms if delay_ms is None else delay_ms
        with self._hand_over:
            self.check()
            self._put(self._encoded(message), delay / 1000)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Send a status, event or meta message; the last of each topic is repeated to new subscribers.

        Raises: as send().
        """
        with self._note_order:
            self.check()
            self._notes.put(self._encoded(StatusMessage(topic=topic, header=header, fields=fields)))
        self.guard.wake()

    def stop_waiting(self) -> None:
        """Stop waiting for readers, for a node that is stopping: what does not leave in `linger_ms` is lost."""
        self._is_hurried = True

    def check(self) -> None:
        """Raises what stopped the thread, or NodeError if the publisher is closed."""
        if isinstance(self._failure, NodeError):
            raise self._failure
        if self._failure is not None:
            raise PublisherError(f"the publisher thread died: {self._failure}") from self._failure
        if self._closing_s is not None:
            raise NodeError("the publisher is closed; make a new one")

    @property
    def stats(self) -> PublisherStats:
        """Counters since the start."""
        subscribers, watchers, previews = self._readers
        return PublisherStats(
            sent=self._sent,
            dropped=self._dropped,
            bytes=self._bytes,
            subscribers=subscribers,
            watchers=watchers,
            previews=previews,
        )

    def close(self, *, orderly: bool = True) -> None:
        """Send what is queued, give readers `linger_ms`, close. Not orderly: close at once. A second call does
        nothing, but one that is not orderly cuts the first one short.

        Raises:
            EndpointError: lockstep messages that no reader took. Else whatever stopped the thread.
        """
        is_first = self._closing_s is None
        self._is_abandoned |= not orderly
        if is_first:
            self._closing_s = time.monotonic()
        self.guard.wake()
        if not is_first:
            return
        self._thread.join()
        self.guard.close()
        if self._failure is not None:
            self.check()

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        try:
            self.close(orderly=error is None)
        except NodeError as failure:
            if error is None:
                raise
            _LOG.error("the publisher had failed too: %s", failure)

    def _encoded(self, message: Message) -> bytes:
        key = (message.header.boot_id, message.topic)
        is_local = self.endpoint.startswith("ipc://")
        numbered = replace(message, sequence=self._sequences[key])
        part = encode(numbered, checksum=isinstance(message, StatusMessage) or not is_local)
        self._sequences[key] += 1
        return part

    def _put(self, part: bytes, follow_s: float | None) -> None:
        """follow_s: how long it must come after the last view; None for at once."""
        while not self._is_hurried:
            try:
                self._queue.put((part, follow_s), timeout=0.05)
            except queue.Full:
                self.check()
            else:
                self.guard.wake()
                return
        if follow_s is not None:
            self._queue.maxsize += 1  # room of its own: an end is never lost to a full queue
        try:
            self._queue.put_nowait((part, follow_s))
        except queue.Full:
            self._dropped += 1
        self.guard.wake()

    # What follows runs in the publisher thread alone.

    def _serve(self) -> None:
        linger_ms = 0
        try:
            self._run()
            if not self._is_abandoned:
                self._see_off()
                linger_ms = max(_LEAST_LINGER_MS, round(1000 * self._left_s(time.monotonic())))
        except Exception as error:
            self._failure = error
        finally:
            unbind(self._data, self.endpoint, linger_ms)
            unbind(self._status, self.status_endpoint, linger_ms)

    def _run(self) -> None:
        queued: tuple[bytes, float | None] | None = None
        progress = time.monotonic()
        while not self._is_abandoned:
            closing = self._closing_s is not None  # read first: what was queued before it is seen below
            self._serve_sockets()
            if queued is None:
                with contextlib.suppress(queue.Empty):
                    queued = self._queue.get_nowait()
            if queued is None:
                if closing:
                    return
                self.guard.wait(None)
                progress = time.monotonic()
            elif self._send(*queued):
                queued, progress = None, time.monotonic()
            elif closing and self._left_s(progress) < 0:
                if self._is_hurried:
                    return
                raise EndpointError(
                    f"{self._queue.qsize() + 1} messages were not taken within {self._drain_ms / 1000:g} s at "
                    f"{self.endpoint} ({self.stats.watchers} subscribers, wanted {self._config.min_subscribers}); "
                    "start the reader"
                )
            else:
                progress = progress if closing else time.monotonic()
                self.guard.wait(_RETRY_MS)

    def _send(self, part: bytes, follow_s: float | None) -> bool:
        """Whether it left; if not, try again later."""
        if self._lockstep and not self._has_begun and self.stats.watchers < self._config.min_subscribers:
            return False
        if follow_s is not None and time.monotonic() < self._last_sent_s + follow_s:
            return False
        if not self._try_send(part):
            return False
        self._has_begun = True
        if follow_s is not None:
            self._ends.append(part)
        else:
            self._ends.clear()
            self._last_sent_s = time.monotonic()
        return True

    def _try_send(self, part: bytes) -> bool:
        """Whether it left."""
        try:
            self._data.send(part, zmq.NOBLOCK, copy=False)  # a copy would cost more than all the rest
        except zmq.Again:
            return False
        self._sent += 1
        self._bytes += len(part)
        return True

    def _see_off(self) -> None:
        """Wait until readers have left. ZeroMQ's linger ends when its last batch of bytes is on its way, and loses it
        to a reader too slow to take it at once; who leaves has the end-of-stream message. The ends are sent again
        meanwhile: ZeroMQ skips them where a reader has no room."""
        until, ends = time.monotonic(), cycle(self._ends)
        until += self._left_s(until)
        while self._ends and self._readers[0] and time.monotonic() < until:
            self._serve_sockets()
            self.guard.wait(_REPEAT_MS)
            self._try_send(next(ends))
            if self._is_abandoned:
                return

    def _left_s(self, progress_s: float) -> float:
        """How much longer to wait for readers at the end, after the last progress. A node that is stopping has
        linger_ms for all of it, so that slow readers cannot stretch the end one message at a time."""
        patience_ms = self._drain_ms if self._lockstep and not self._is_hurried else self._linger_ms
        begun_s = self._closing_s if self._is_hurried and self._closing_s is not None else progress_s
        return begun_s + patience_ms / 1000 - time.monotonic()

    def _serve_sockets(self) -> None:
        for event in _pending_events(self._data):
            self._count_reader(event)
        made, self._preview = self._preview, None
        if made is not None:
            try:
                self._try_send(self._encoded(made()))
            except (NodeError, ClientError) as error:  # views must not suffer from it
                _LOG.warning("a preview of the input cannot be sent: %s", error)
        while not self._notes.empty():
            part = self._notes.get()
            self._last_notes[part[:TOPIC_BYTES]] = part
            self._status.send(part)
        for event in _pending_events(self._status):  # a new subscriber gets the last of each topic; so do all others,
            for part in [part for key, part in self._last_notes.items() if event[0] and key.startswith(event[1:])]:
                self._status.send(part)  # who know it by its sequence

    def _count_reader(self, event: bytes) -> None:
        """A subscription (first byte 1) or its end (first byte 0).

        One to the welcome message alone is none. The end of one that never came is not counted: noise on the socket
        must not make readers disappear.
        """
        topic, change = event[1:], 1 if event[0] else -1
        if (topic and topic == WELCOME[: len(topic)]) or (change < 0 and topic not in self._topics):
            return
        self._topics[topic] += change
        if not self._topics[topic]:
            del self._topics[topic]
        # ZeroMQ matches prefixes: who subscribes to everything gets views and previews.
        is_preview = _PREVIEW_KEY.startswith(topic)
        gained = (change, change * (topic == b"" or not is_preview), change * is_preview)
        self._readers = tuple(map(sum, zip(self._readers, gained, strict=True)))


def _pending_events(socket: Socket) -> list[bytes]:
    """Pending subscribe (first byte 1) and unsubscribe (first byte 0) events; anything else a peer sends is ignored."""
    events: list[bytes] = []
    while len(events) < _MOST_EVENTS and socket.poll(0):
        event = socket.recv(zmq.NOBLOCK)
        if event[:1] in (b"\0", b"\1"):
            events.append(event)
    return events


def _xpub(context: Context, high_water_mark: int, *, no_drop: bool) -> Socket:
    socket = context.socket(zmq.XPUB)
    socket.set(zmq.XPUB_VERBOSER, 1)  # VERBOSE, and unsubscriptions too: only so can subscribers be counted
    socket.set(zmq.XPUB_NODROP, int(no_drop))
    socket.set(zmq.XPUB_WELCOME_MSG, WELCOME)
    socket.set(zmq.SNDHWM, high_water_mark)
    socket.set(zmq.MAXMSGSIZE, _MAX_SUBSCRIPTION)
    socket.set(zmq.LINGER, 0)
    return socket
