"""Receives views, for planners: checked, read-only, newest first.

    with ViewSubscriber("ipc", "topdown", max_age_ms=10_000) as views:
        for view in views:
            plan(view.images, view.header)

Needs the standard library, numpy and pyzmq; keeps to Python 3.10 syntax. A subscriber belongs to one thread.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import zmq
from numpy.typing import NDArray

from gcd_node.envelope import (
    MAX_HEADER,
    MAX_PAYLOAD,
    PREFIX,
    PREVIEW_ID,
    WELCOME,
    EndMessage,
    Message,
    NoteMessage,
    NoteTopic,
    ViewKind,
    ViewMessage,
    colours,
    decode,
    images,
    inverse_depth,
    topic_key,
    view_topic,
)
from gcd_node.errors import ConfigError, StaleError
from gcd_node.security.gate import HandshakeWatch, use_client_keys
from gcd_node.security.keys import ClientKeys
from gcd_node.wire.endpoints import is_ipv6, resolve_endpoint
from gcd_node.wire.header import ViewHeader

_QUEUED = 4


@dataclass(frozen=True, kw_only=True, slots=True)
class ReceivedView:
    """A view and how it arrived.

    age_ms: age of its newest input frame now: age at publish, plus the time since by both machines' wall clocks.
    expired: more than `valid_for_ms` after publish; a planner must ignore it.
    skipped: messages of this topic that were published since the last one received here, but not received.
    restarted: the node was started anew since the last view; said once. Forget what was tied to the old one.
    """

    message: ViewMessage
    age_ms: float
    expired: bool
    skipped: int
    restarted: bool

    @property
    def header(self) -> ViewHeader:
        """The message's header."""
        return self.message.header

    @property
    def images(self) -> NDArray[np.uint8]:
        """The pixels, u8 [T, H, W, C], read-only; see envelope.images()."""
        return images(self.message)

    @property
    def inverse_depth(self) -> NDArray[np.float32]:
        """Of kind depth: 1/m, float32 [T, H, W]; 0 for none. See envelope.inverse_depth()."""
        return inverse_depth(self.message)

    @property
    def colours(self) -> NDArray[np.uint8]:
        """The pixels to look at, u8 RGB [T, H, W, 3], read-only; see envelope.colours()."""
        return colours(self.message)


@dataclass(kw_only=True, slots=True)
class SubscriberStats:
    """received: views given out. skipped: missed by gaps in the sequence. outdated: dropped because of an older
    view_rev or a repeated sequence. stale: older than max_age_ms. restarts: new boot_ids seen."""

    received: int = 0
    skipped: int = 0
    outdated: int = 0
    stale: int = 0
    restarts: int = 0


class ViewSubscriber:
    """Views of one node.

    endpoint: "ipc" for the node on this machine, or ipc://PATH, tcp://HOST:PORT.
    view: the view's id, or "src" (of kind "frm") for the preview of the input; None for all views, which needs
        conflate=False.
    kind: "win" for windows, "frm" for frames at the goal pose, "std" for standard deviations, "cls" for class maps,
        "vis" for what was seen and what is painted, "depth" for inverse depth. Several, or None for all kinds, need
        conflate=False; those of one window come in the order win, cls, vis, depth.
    conflate: keep only the newest message, so that a slow reader never works on old ones.
    max_age_ms: what is older raises StaleError; None for no limit.
    max_payload: largest payload accepted, bytes.
    keys: our keys and the node's, for a node that asks for them.

    Raises:
        ConfigError: the endpoint is none, or all views or kinds are to be conflated.
        MessageError: the view id is none.
    """

    def __init__(
        self,
        endpoint: str = "ipc",
        view: str | None = None,
        kind: ViewKind | tuple[ViewKind, ...] | None = "win",
        *,
        conflate: bool = True,
        max_age_ms: float | None = None,
        max_payload: int = MAX_PAYLOAD,
        keys: ClientKeys | None = None,
    ) -> None:
        kinds = kind if isinstance(kind, tuple) else (kind,)
        if conflate and (view is None or len(kinds) > 1 or None in kinds):
            raise ConfigError(
                "a conflated socket keeps one message of all topics: name a view and a kind, or set conflate=False"
            )
        wanted = tuple({_key(view, each) for each in kinds})
        self._link = _Link(resolve_endpoint(endpoint, "data"), wanted, conflate, max_payload, keys)
        self._suffixes = tuple("" if each is None else f"/{each}" for each in kinds)
        self._max_age_ms = max_age_ms
        self._streams: dict[str, _Stream] = {}
        self._boot_id: str | None = None
        self._restarted = False
        self.stats = SubscriberStats()

    @property
    def ended(self) -> bool:
        """Whether every view seen has ended; false again once a new message comes."""
        return bool(self._streams) and all(stream.ended for stream in self._streams.values())

    def receive(self, timeout_ms: float | None = None) -> ReceivedView | None:
        """The next view; None after `timeout_ms` (None: wait for ever), or when the stream has ended (see `ended`).

        Raises:
            StaleError: the view is older than max_age_ms. The next call goes on.
            MessageError: what came is no valid message. The next call goes on.
            AuthError: the node asks for a key, or does not know ours; then make a new subscriber.
        """
        deadline = _deadline(timeout_ms)
        while (message := self._link.receive(deadline)) is not None:
            if isinstance(message, NoteMessage) or not message.topic.endswith(self._suffixes):
                continue
            self._notice_boot(message.header.boot_id)
            if isinstance(message, EndMessage):
                self._end(message)
                if self.ended:
                    return None
            elif (skipped := self._advance(message)) is not None:
                return self._give(message, skipped)
        return None

    def __iter__(self) -> Iterator[ReceivedView]:
        """Views until the stream ends; stale ones are left out and counted. Raises: as receive() else."""
        while True:
            try:
                view = self.receive()
            except StaleError:
                continue
            if view is None:
                return
            yield view

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._link.close()

    def __enter__(self) -> "ViewSubscriber":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _notice_boot(self, boot_id: str) -> None:
        if self._boot_id not in (None, boot_id):
            self._restarted = True
            self._streams.clear()
            self.stats.restarts += 1
        self._boot_id = boot_id

    def _end(self, message: EndMessage) -> None:
        stream = self._streams.setdefault(message.topic, _Stream(sequence=message.sequence))
        stream.sequence, stream.ended = message.sequence, True

    def _advance(self, message: ViewMessage) -> int | None:
        """How many messages were missed before this one; None if it must be dropped."""
        revision = message.header.view_rev
        stream = self._streams.setdefault(message.topic, _Stream(sequence=message.sequence - 1, view_rev=revision))
        skipped = message.sequence - stream.sequence - 1
        if skipped < 0 or revision < stream.view_rev:
            stream.sequence = max(stream.sequence, message.sequence)
            self.stats.outdated += 1
            return None
        stream.sequence, stream.view_rev, stream.ended = message.sequence, revision, False
        self.stats.skipped += skipped
        return skipped

    def _give(self, message: ViewMessage, skipped: int) -> ReceivedView:
        header = message.header
        since_ms = max(0.0, (time.time_ns() - header.t_publish_ns) / 1e6)  # clocks of two machines may disagree
        age_ms = header.age_ms + since_ms
        if self._max_age_ms is not None and age_ms > self._max_age_ms:
            self.stats.stale += 1
            raise StaleError(
                f"{message.topic} window {header.window_id} is {age_ms:.0f} ms old, wanted at most "
                f"{self._max_age_ms:g}; render faster, or allow more with max_age_ms"
            )
        restarted, self._restarted = self._restarted, False
        self.stats.received += 1
        expired = since_ms > header.valid_for_ms
        return ReceivedView(message=message, age_ms=age_ms, expired=expired, skipped=skipped, restarted=restarted)


class NoteSubscriber:
    """Status, event and meta messages of one node; the last of each topic arrives at once. Not conflated."""

    def __init__(
        self,
        endpoint: str = "ipc",
        topics: tuple[NoteTopic, ...] = ("status", "event", "meta"),
        keys: ClientKeys | None = None,
    ) -> None:
        wanted = tuple(topic_key(topic) for topic in topics)
        self._link = _Link(resolve_endpoint(endpoint, "status"), wanted, conflate=False, max_payload=0, keys=keys)
        self._seen: dict[str, tuple[str, int]] = {}

    def receive(self, timeout_ms: float | None = None) -> NoteMessage | None:
        """The next note, None after `timeout_ms`; repeats for other readers are left out.

        Raises: MessageError, AuthError as ViewSubscriber.receive().
        """
        deadline = _deadline(timeout_ms)
        while (message := self._link.receive(deadline)) is not None:
            number = (message.header.boot_id, message.sequence)
            if isinstance(message, NoteMessage) and self._seen.get(message.topic) != number:
                self._seen[message.topic] = number
                return message
        return None

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._link.close()

    def __enter__(self) -> "NoteSubscriber":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()


@dataclass(kw_only=True, slots=True)
class _Stream:
    """What was last seen on one topic."""

    sequence: int
    view_rev: int = 0
    ended: bool = False


class _Link:
    """A SUB socket and its context; gives decoded messages."""

    def __init__(
        self, endpoint: str, topics: tuple[bytes, ...], conflate: bool, max_payload: int, keys: ClientKeys | None
    ) -> None:
        self._max_payload = max_payload
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.LINGER, 0)
        self._socket.set(zmq.IPV6, int(is_ipv6(endpoint)))
        self._socket.set(zmq.MAXMSGSIZE, PREFIX.size + MAX_HEADER + max_payload)
        self._socket.set(zmq.CONFLATE, int(conflate))
        self._socket.set(zmq.RCVHWM, _QUEUED)
        for topic in topics:
            self._socket.set(zmq.SUBSCRIBE, topic)
        if keys is not None:
            use_client_keys(self._socket, keys)
        self._watch = HandshakeWatch(self._socket, endpoint, keys)
        self._poller = zmq.Poller()
        for each in (self._socket, self._watch.monitor):
            self._poller.register(each, zmq.POLLIN)
        self._socket.connect(endpoint)

    def receive(self, deadline: float | None) -> Message | None:
        """The next message, None once the deadline (monotonic seconds) has passed. Raises MessageError, AuthError."""
        self._watch.check()
        while ready := self._poller.poll(_left_ms(deadline)):
            if self._socket not in dict(ready):
                self._watch.check()
                continue
            part = self._socket.recv(copy=False).buffer  # stays ZeroMQ's memory until nobody looks at it any more
            if part.nbytes != len(WELCOME) or bytes(part) != WELCOME:
                return decode(part, self._max_payload)
        return None

    def close(self) -> None:
        self._context.destroy(linger=0)


def _key(view: str | None, kind: ViewKind | None) -> bytes:
    """What to subscribe to: one topic, all topics of a view, or all views; the rest is left out on arrival."""
    if view is None:
        return b"view/"
    if kind is None and view != PREVIEW_ID:
        return view_topic(view, "win").removesuffix("win").encode()
    return topic_key(view_topic(view, kind or "frm"))


def _deadline(timeout_ms: float | None) -> float | None:
    return None if timeout_ms is None else time.monotonic() + timeout_ms / 1000


def _left_ms(deadline: float | None) -> int | None:
    return None if deadline is None else max(0, round((deadline - time.monotonic()) * 1000))
