"""The publisher's two sockets, and who subscribes to what. Everything here belongs to the publisher's thread."""

import time
from collections import Counter
from dataclasses import dataclass

import zmq

from gcd_client.protocol import PREVIEW_TOPIC, TOPIC_BYTES, WELCOME, topic_key
from gcd_node.auth import Context, ServerSecurity, Socket, SocketGuard, unbind
from gcd_node.binding import own_endpoint

_DATA_HWM = 4
_STATUS_HWM = 100
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Readers:
    """Subscriptions on the data socket at one moment.

    total: all. previews: those that get the preview of the input. previews_alone: those that get nothing else.
    """

    total: int = 0
    previews: int = 0
    previews_alone: int = 0

    @property
    def watchers(self) -> int:
        """Those that get views."""
        return self.total - self.previews_alone


NO_READERS = Readers()


@dataclass(frozen=True, kw_only=True, slots=True)
class Parcel:
    """An encoded message; follow_s: how long it must come after the last one, None for at once."""

    part: bytes
    follow_s: float | None = None


class Subscriptions:
    """Counts subscriptions as they come and go. now: may be read from any thread."""

    def __init__(self) -> None:
        self.now = NO_READERS
        self._topics: Counter[bytes] = Counter()

    def count(self, event: bytes) -> None:
        """A subscription (first byte 1) or its end (first byte 0).

        One to the welcome message alone is none. The end of one that never came is not counted: noise on the socket
        must not make readers disappear.
        """
        topic = event[1:]
        if topic and topic == WELCOME[: len(topic)]:
            return
        if event[0]:
            self._topics[topic] += 1
            self._add(topic, 1)
        elif topic in self._topics:
            self._topics[topic] -= 1
            if self._topics[topic] == 0:
                del self._topics[topic]
            self._add(topic, -1)

    def _add(self, topic: bytes, count: int) -> None:
        """Without looking at the others: a client may subscribe to as many topics as it likes. ZeroMQ matches prefixes,
        so a subscription to everything gets views and previews."""
        now, preview = self.now, _PREVIEW_KEY.startswith(topic)
        self.now = Readers(
            total=now.total + count,
            previews=now.previews + count * preview,
            previews_alone=now.previews_alone + count * (preview and topic != b""),
        )


class DataSocket:
    """The data socket; in lockstep it refuses rather than skips. ends: the end messages since the last view."""

    def __init__(self, context: Context, guard: SocketGuard, options: PublisherOptions) -> None:
        self._options = options
        self.socket = _made(context, _DATA_HWM, no_drop=options.lockstep)
        self.endpoint = guard.bind(self.socket, own_endpoint(options.data, "data"), "data")
        self.local = self.endpoint.startswith("ipc://")
        self.sent = self.bytes = 0
        self.subscriptions = Subscriptions()
        self._begun = False
        self.ends: list[bytes] = []
        self._last_sent = time.monotonic()

    def serve(self) -> None:
        """Count who comes and goes."""
        for event in _events(self.socket):
            self.subscriptions.count(event)

    def send(self, parcel: Parcel) -> bool:
        """Whether it left; if not, try again later."""
        if (
            self._options.lockstep
            and not self._begun
            and self.subscriptions.now.watchers < self._options.min_subscribers
        ):
            return False
        if parcel.follow_s is not None and time.monotonic() < self._last_sent + parcel.follow_s:
            return False
        if not self.try_send(parcel.part):
            return False
        self._begun = True
        if parcel.follow_s is not None:
            self.ends.append(parcel.part)
            return True
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

    def close(self, linger_ms: int) -> None:
        unbind(self.socket, self.endpoint, linger_ms)


class StatusSocket:
    """The status socket: keeps the last message of each topic for whoever comes later."""

    def __init__(self, context: Context, guard: SocketGuard, endpoint: str) -> None:
        self.socket = _made(context, _STATUS_HWM, no_drop=False)
        self.endpoint = guard.bind(self.socket, own_endpoint(endpoint, "status"), "status")
        self._last: dict[bytes, bytes] = {}

    def serve(self) -> None:
        """Repeat what a new subscriber asks for; ZeroMQ sends it to all, who know it by its sequence."""
        for event in _events(self.socket):
            for part in [part for key, part in self._last.items() if event[0] and key.startswith(event[1:])]:
                self.socket.send(part)

    def send(self, part: bytes) -> None:
        self._last[part[:TOPIC_BYTES]] = part
        self.socket.send(part)

    def close(self, linger_ms: int) -> None:
        unbind(self.socket, self.endpoint, linger_ms)


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
