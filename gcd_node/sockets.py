"""The publisher's two sockets, and who subscribes to what. Everything here belongs to the publisher's thread."""

import time
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import zmq

from gcd_client.protocol import PREVIEW_TOPIC, TOPIC_BYTES, WELCOME, topic_key
from gcd_node.auth import Context, ServerSecurity, Socket, SocketGuard, own_endpoint

_DATA_HWM, _STATUS_HWM = 4, 100
_MAX_SUBSCRIPTION = 4096
_PREVIEW_KEY = topic_key(PREVIEW_TOPIC)


@dataclass(frozen=True, kw_only=True, slots=True)
class PublisherOptions:
    """Where and how to send.

    data, status: endpoints, or "ipc" for the runtime folder; status None opens no status socket.
    lockstep: wait for slow readers instead of skipping, and for min_subscribers before the first message.
    end_delay_ms: how long an end-of-stream message follows the last window, so that a conflated reader gets both.
    linger_ms: how long an orderly close waits for readers to take the end and leave; drain_ms: the same in lockstep,
        and there also how long a queued message may wait for a reader.
    queue_size: messages between the callers and the thread.
    security: keys and allowed clients of tcp endpoints; without them only this machine can be let in.
    """

    data: str = "ipc"
    status: str | None = "ipc"
    lockstep: bool = False
    min_subscribers: int = 0
    end_delay_ms: int = 500
    linger_ms: int = 1000
    drain_ms: int = 5000
    queue_size: int = 8
    security: ServerSecurity | None = None


class Queued(NamedTuple):
    part: bytes
    follow_s: float | None = None  # how long it must come after the last one; None for at once


class ReaderCounts(NamedTuple):
    """Subscriptions on the data socket. watchers, previews: those that get views, previews of the input."""

    total: int = 0
    watchers: int = 0
    previews: int = 0


class Readers:
    """Counts subscriptions as they come and go. now: may be read from any thread."""

    def __init__(self) -> None:
        self.now = ReaderCounts()
        self._topics: Counter[bytes] = Counter()

    def count(self, event: bytes) -> None:
        """A subscription (first byte 1) or its end (first byte 0).

        One to the welcome message alone is none. The end of one that never came is not counted: noise on the socket
        must not make readers disappear. ZeroMQ matches prefixes: who subscribes to everything gets views and previews.
        """
        topic, change = event[1:], 1 if event[0] else -1
        if (topic and topic == WELCOME[: len(topic)]) or (change < 0 and topic not in self._topics):
            return
        self._topics[topic] += change
        if self._topics[topic] == 0:
            del self._topics[topic]
        now, is_preview = self.now, _PREVIEW_KEY.startswith(topic)
        self.now = ReaderCounts(
            total=now.total + change,
            watchers=now.watchers + change * (topic == b"" or not is_preview),
            previews=now.previews + change * is_preview,
        )


class DataSocket:
    """The data socket; in lockstep it refuses rather than skips. ends: the end messages since the last view."""

    def __init__(self, context: Context, guard: SocketGuard, options: PublisherOptions) -> None:
        self._options = options
        self.socket = _xpub(context, _DATA_HWM, no_drop=options.lockstep)
        self.endpoint = guard.bind(self.socket, own_endpoint(options.data, "data"), "data")
        self.local = self.endpoint.startswith("ipc://")
        self.sent = self.bytes = 0
        self.readers = Readers()
        self.ends: list[bytes] = []
        self._begun, self._last_sent = False, time.monotonic()

    def send(self, queued: Queued) -> bool:
        """Whether it left; if not, try again later."""
        options = self._options
        if options.lockstep and not self._begun and self.readers.now.watchers < options.min_subscribers:
            return False
        if queued.follow_s is not None and time.monotonic() < self._last_sent + queued.follow_s:
            return False
        if not self.try_send(queued.part):
            return False
        self._begun = True
        if queued.follow_s is not None:
            self.ends.append(queued.part)
        else:
            self.ends.clear()
            self._last_sent = time.monotonic()
        return True

    def try_send(self, part: bytes) -> bool:
        """Whether it left."""
        try:
            self.socket.send(part, zmq.NOBLOCK, copy=False)  # a copy would cost more than all the rest
        except zmq.Again:
            return False
        self.sent += 1
        self.bytes += len(part)
        return True


class StatusSocket:
    """The status socket: keeps the last message of each topic for later subscribers."""

    def __init__(self, context: Context, guard: SocketGuard, endpoint: str) -> None:
        self.socket = _xpub(context, _STATUS_HWM, no_drop=False)
        self.endpoint = guard.bind(self.socket, own_endpoint(endpoint, "status"), "status")
        self._last: dict[bytes, bytes] = {}

    def repeat(self) -> None:
        """Send what a new subscriber asks for again; ZeroMQ sends it to all, who know it by its sequence."""
        for event in pending_events(self.socket):
            for part in [part for key, part in self._last.items() if event[0] and key.startswith(event[1:])]:
                self.socket.send(part)

    def send(self, part: bytes) -> None:
        self._last[part[:TOPIC_BYTES]] = part
        self.socket.send(part)


def pending_events(socket: Socket) -> list[bytes]:
    """Pending subscribe (first byte 1) and unsubscribe (first byte 0) events; anything else a peer sends is ignored."""
    events: list[bytes] = []
    while socket.poll(0):
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
