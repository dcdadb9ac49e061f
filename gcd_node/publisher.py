"""Sends encoded messages: one thread owns the data and the status socket (wire protocol, section 1).

ZeroMQ sockets belong to one thread, so callers hand messages over through a bounded queue and wake the thread; it
sleeps until a message, a subscription or the end comes.
"""

import contextlib
import logging
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import cycle
from types import TracebackType
from typing import Any, Protocol

import zmq
from msgspec.structs import replace

from gcd_client.protocol import ClientError, EndMessage, OriginHeader, StatusMessage, StatusTopic, ViewMessage, encode
from gcd_node.auth import Context, EventSink, SocketGuard, unbind
from gcd_node.errors import EndpointError, NodeError, PublisherError
from gcd_node.sockets import DataSocket, PublisherOptions, Queued, StatusSocket, pending_events

_LOG = logging.getLogger(__name__)
_RETRY_MS, _REPEAT_MS = 3, 10
_LEAST_LINGER_MS = 100


@dataclass(frozen=True, kw_only=True, slots=True)
class PublisherStats:
    """sent, bytes: handed to ZeroMQ on the data socket. dropped: refused because the queue was full. What ZeroMQ drops
    for a slow reader shows in no counter here: that reader sees a gap in the sequence.
    subscribers: subscriptions on the data socket now; watchers, previews: those that get views, previews of the input.
    """

    sent: int = 0
    dropped: int = 0
    bytes: int = 0
    subscribers: int = 0
    watchers: int = 0
    previews: int = 0


class MessageSink(Protocol):
    """Where the node's messages go: a Publisher, the files of a replay, or a list in a test."""

    def send(self, message: ViewMessage) -> object:
        """Hand over a view."""
        ...

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        """Hand over the newest preview of the input, to be made when it leaves."""
        ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Hand over an end-of-stream, to follow the last view."""
        ...

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Hand over a status, event or meta note."""
        ...

    def stop_waiting(self) -> None:
        """Stop waiting for readers."""
        ...

    @property
    def stats(self) -> PublisherStats:
        """What has left."""
        ...


class Publisher:
    """Publishes views, ends and notes. Use it as a context manager; every method may be called from any thread.

    Make one per boot_id: sequences count from 0 here. on_event gets AUTH_DENIED and its fields, from another thread.

    Raises:
        EndpointError: an endpoint is in use or cannot be bound.
        ConfigError: an endpoint is no endpoint, or others than this machine could reach it.
    """

    def __init__(self, options: PublisherOptions, on_event: EventSink | None = None) -> None:
        self._options = options
        self._queue: queue.Queue[Queued] = queue.Queue(options.queue_size)
        self._notes: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._preview: Callable[[], ViewMessage] | None = None
        self._sequences: Counter[tuple[str, str]] = Counter()
        self._hand_over, self._note_order, self._waking = threading.Lock(), threading.Lock(), threading.Lock()
        self._hurried = threading.Event()
        self._closing, self._abandoned, self._closed = threading.Event(), threading.Event(), threading.Event()
        self._failure: Exception | None = None
        self._dropped, self._closing_s = 0, 0.0
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._context: Context = zmq.Context()
        self._guard = SocketGuard(self._context, options.security, on_event)
        try:
            self._data = DataSocket(self._context, self._guard, options)
            self._status = None if options.status is None else StatusSocket(self._context, self._guard, options.status)
        except BaseException:
            self._guard.close()
            self._context.destroy(linger=0)
            self._close_wake()
            raise
        self._poller = zmq.Poller()
        sockets = [self._data.socket] if self._status is None else [self._data.socket, self._status.socket]
        for source in (self._wake_fd, *sockets, *self._guard.monitors):
            self._poller.register(source, zmq.POLLIN)
        self._thread = threading.Thread(target=self._serve, name="publisher", daemon=True)
        self._thread.start()

    def send(self, message: ViewMessage) -> bool:
        """Number, encode and hand over one message; its own `sequence` is replaced.

        Realtime never waits: with a full queue the message is dropped and counted. Lockstep waits for room.

        Returns:
            Whether it was accepted.
        Raises:
            MessageError: it cannot be encoded. NodeError: the publisher is closed, or its thread failed.
        """
        with self._hand_over:
            self.check()
            if self._queue.full() and not self._options.lockstep:
                self._dropped += 1
                return False
            self._put(Queued(self._encoded(message)))
        time.sleep(0)  # lets the thread begin now, instead of when the caller has time
        return True

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        """Send the newest preview of the input, in lockstep too without waiting: what finds no room is lost.

        made: called in the publisher's thread. Raises: as send().
        """
        self.check()
        self._preview = made
        self._wake()

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Queue an end-of-stream message, to leave `delay_ms` (else end_delay_ms) after the last window; never dropped.

        Raises: as send().
        """
        delay = self._options.end_delay_ms if delay_ms is None else delay_ms
        with self._hand_over:
            self.check()
            self._put(Queued(self._encoded(message), delay / 1000))

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Send a status, event or meta message; the last of each topic is repeated to new subscribers.

        Raises: as send().
        """
        with self._note_order:
            self.check()
            self._notes.put(self._encoded(StatusMessage(topic=topic, header=header, fields=fields)))
        self._wake()

    def stop_waiting(self) -> None:
        """Stop waiting for readers, for a node that is stopping: what does not leave in `linger_ms` is lost."""
        self._hurried.set()

    def dead_threads(self) -> list[str]:
        """Threads that have died, of those whose end shows nowhere else."""
        return [] if self._guard.alive else ["authentication"]

    def check(self) -> None:
        """Raises what stopped the thread, or NodeError if the publisher is closed."""
        self._raise_failure()
        if self._closed.is_set():
            raise NodeError("the publisher is closed; make a new one")

    @property
    def stats(self) -> PublisherStats:
        """Counters since the start."""
        data, readers = self._data, self._data.readers.now
        return PublisherStats(
            sent=data.sent,
            dropped=self._dropped,
            bytes=data.bytes,
            subscribers=readers.total,
            watchers=readers.watchers,
            previews=readers.previews,
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
        is_first = not self._closed.is_set()
        self._shut(orderly)
        if is_first:
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

    def _encoded(self, message: ViewMessage | EndMessage | StatusMessage) -> bytes:
        key = (message.header.boot_id, message.topic)
        numbered = replace(message, sequence=self._sequences[key])
        part = encode(numbered, checksum=isinstance(message, StatusMessage) or not self._data.local)
        self._sequences[key] += 1
        return part

    def _put(self, queued: Queued) -> None:
        while not self._hurried.is_set():
            try:
                self._queue.put(queued, timeout=0.05)
            except queue.Full:
                self.check()
            else:
                self._wake()
                return
        if queued.follow_s is not None:
            self._queue.maxsize += 1  # room of its own: an end is never lost to a full queue
        try:
            self._queue.put_nowait(queued)
        except queue.Full:
            self._dropped += 1
        self._wake()

    def _wake(self) -> None:
        with self._waking:
            if self._wake_fd >= 0:  # else it may mean another file by now
                os.eventfd_write(self._wake_fd, 1)

    def _raise_failure(self) -> None:
        if isinstance(self._failure, NodeError):
            raise self._failure
        if self._failure is not None:
            raise PublisherError(f"the publisher thread died: {self._failure}") from self._failure

    def _shut(self, orderly: bool) -> None:
        if not orderly:
            self._abandoned.set()  # also cuts short an orderly close that another thread is in
            self._wake()
        if self._closed.is_set():
            return
        self._closed.set()
        self._closing_s = time.monotonic()
        self._closing.set()
        self._wake()
        self._thread.join()
        self._guard.close()
        self._context.term()
        self._close_wake()

    def _close_wake(self) -> None:
        with self._waking:
            descriptor, self._wake_fd = self._wake_fd, -1
        os.close(descriptor)

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
            unbind(self._data.socket, self._data.endpoint, linger_ms)
            if self._status is not None:
                unbind(self._status.socket, self._status.endpoint, linger_ms)

    def _run(self) -> None:
        queued: Queued | None = None
        progress = time.monotonic()
        while not self._abandoned.is_set():
            closing = self._closing.is_set()  # read first: what was queued before it is seen below
            self._serve_sockets()
            if queued is None:
                with contextlib.suppress(queue.Empty):
                    queued = self._queue.get_nowait()
            if queued is None:
                if closing:
                    return
                self._wait(None)
                progress = time.monotonic()
            elif self._data.send(queued):
                queued, progress = None, time.monotonic()
            elif closing and self._left_s(progress) < 0:
                if self._hurried.is_set():
                    return
                raise EndpointError(self._undelivered())
            else:
                progress = progress if closing else time.monotonic()
                self._wait(_RETRY_MS)

    def _wait(self, timeout_ms: int | None) -> None:
        """Until a message, a subscription or the end comes."""
        self._poller.poll(timeout_ms)
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake_fd)

    def _see_off(self) -> None:
        """Wait until readers have left. ZeroMQ's linger ends when its last batch of bytes is on its way, and loses it
        to a reader too slow to take it at once; who leaves has the end-of-stream message. The ends are sent again
        meanwhile: ZeroMQ skips them where a reader has no room."""
        until, ends = time.monotonic(), cycle(self._data.ends)
        until += self._left_s(until)
        while self._data.ends and self._data.readers.now.total > 0 and time.monotonic() < until:
            self._serve_sockets()
            self._wait(_REPEAT_MS)
            self._data.try_send(next(ends))
            if self._abandoned.is_set():
                return

    def _left_s(self, progress_s: float) -> float:
        """How much longer to wait for readers at the end, after the last progress. A node that is stopping has
        linger_ms for all of it, so that slow readers cannot stretch the end one message at a time."""
        hurried, options = self._hurried.is_set(), self._options
        patience_ms = options.drain_ms if options.lockstep and not hurried else options.linger_ms
        return (self._closing_s if hurried else progress_s) + patience_ms / 1000 - time.monotonic()

    def _serve_sockets(self) -> None:
        self._guard.report_failures()
        for event in pending_events(self._data.socket):
            self._data.readers.count(event)
        made, self._preview = self._preview, None
        if made is not None:
            try:
                self._data.try_send(self._encoded(made()))
            except (NodeError, ClientError) as error:  # views must not suffer from it
                _LOG.warning("a preview of the input cannot be sent: %s", error)
        while not self._notes.empty():
            part = self._notes.get()
            if self._status is not None:
                self._status.send(part)
        if self._status is not None:
            self._status.repeat()

    def _undelivered(self) -> str:
        count, seconds, readers = self._queue.qsize() + 1, self._options.drain_ms / 1000, self.stats.watchers
        return (
            f"{count} messages were not taken within {seconds:g} s at {self.endpoint} ({readers} subscribers, wanted "
            f"{self._options.min_subscribers}); start the reader"
        )
