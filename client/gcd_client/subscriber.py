"""Receives views, grids and status messages, checked and newest first.

    with ViewSubscriber("ipc", "topdown", max_age_ms=1000) as views:
        for view in views:
            plan(view.images, view.header)

`async for` and `receive_async` do it for asyncio, `run` calls a function. A subscriber belongs to one thread.
"""

import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import TYPE_CHECKING, Generic, TypeVar

import msgspec
import zmq

from gcd_client import protocol
from gcd_client.endpoints import Client, ClientKeys, Connection, SetupError, Steps, resolve_endpoint
from gcd_client.protocol import (
    DataMessage,
    EndMessage,
    GridHeader,
    GridMessage,
    Message,
    StatusMessage,
    StatusTopic,
    ViewHeader,
    ViewKind,
    ViewMessage,
)

if TYPE_CHECKING:  # numpy takes longer to import than all the rest
    import numpy as np
    from numpy.typing import NDArray

    from gcd_client.images import GridLayers

Item = TypeVar("Item")
_STOP_MS = 200.0


class _Received(msgspec.Struct, frozen=True, kw_only=True):
    """How a message arrived.

    age_ms: of its newest input frame now: age at publish, plus the time since by both machines' wall clocks.
    expired: more than `valid_for_ms` after publish; a planner must ignore it.
    skipped: messages of this topic that were published since the last one received here, but not received.
    restarted: the first one after a restart of the node; forget what was tied to the old one.
    """

    age_ms: float
    expired: bool
    skipped: int
    restarted: bool


class ReceivedGrid(_Received, frozen=True, kw_only=True):
    """A grid and how it arrived."""

    message: GridMessage

    @property
    def header(self) -> GridHeader:
        """The message's header."""
        return self.message.header

    @property
    def layers(self) -> "GridLayers":
        """Its cells; see gcd_client.images."""
        from gcd_client.images import layers

        return layers(self.message)


class ReceivedView(_Received, frozen=True, kw_only=True):
    """A view and how it arrived."""

    message: ViewMessage

    @property
    def header(self) -> ViewHeader:
        """The message's header."""
        return self.message.header

    @property
    def images(self) -> "NDArray[np.uint8]":
        """Pixels u8 [T, H, W, C], read-only; see gcd_client.images."""
        from gcd_client.images import images

        return images(self.message)

    @property
    def inverse_depth(self) -> "NDArray[np.float32]":
        """Of kind depth: 1/m, float32 [T, H, W], 0: none; see gcd_client.images."""
        from gcd_client.images import inverse_depth

        return inverse_depth(self.message)

    @property
    def colours(self) -> "NDArray[np.uint8]":
        """Pixels for display, u8 RGB [T, H, W, 3], read-only; see gcd_client.images."""
        from gcd_client.images import colours

        return colours(self.message)


class Subscriber(Client, Generic[Item]):
    """What both subscribers share. damaged: messages left out because they are not valid; last_error: why the last was.

    Whatever receives raises AuthError if the node refuses the connection; then make a new subscriber.
    """

    def __init__(
        self, endpoint: str, topics: set[bytes], conflate: bool, max_payload: int, keys: ClientKeys | None
    ) -> None:
        limit = protocol.PREFIX.size + protocol.MAX_HEADER + max_payload
        options: dict[int, int] = {zmq.MAXMSGSIZE: limit, zmq.CONFLATE: int(conflate), zmq.RCVHWM: 4}
        self._connection = Connection(endpoint, zmq.SUB, keys, options)
        for topic in topics:
            self._connection.socket.set(zmq.SUBSCRIBE, topic)
        self._max_payload, self.damaged, self.last_error = max_payload, 0, ""

    @property
    def ended(self) -> bool:
        """Whether the stream has ended."""
        return False

    def receive(self, timeout_ms: float | None = None) -> Item | None:
        """The next one; None after `timeout_ms` (None: no limit), or when the stream ends (see `ended`)."""
        return self._connection.run(self._steps(timeout_ms))

    async def receive_async(self, timeout_ms: float | None = None) -> Item | None:
        """receive() for asyncio."""
        return await self._connection.run_async(self._steps(timeout_ms))

    def run(self, on_item: Callable[[Item], object], stop: threading.Event | None = None) -> None:
        """Call `on_item` with each until the stream ends, or `stop` is set in any thread."""
        while stop is None or not stop.is_set():
            item = self.receive(None if stop is None else _STOP_MS)
            if item is not None:
                on_item(item)
            elif self.ended:
                return

    def __iter__(self) -> Iterator[Item]:
        while (item := self.receive()) is not None:
            yield item

    async def __aiter__(self) -> AsyncIterator[Item]:
        while (item := await self.receive_async()) is not None:
            yield item

    def _steps(self, timeout_ms: float | None) -> Steps[Item | None]:
        deadline_s = None if timeout_ms is None else time.monotonic() + timeout_ms / 1000
        while (yield from self._connection.wait(deadline_s)):
            part = self._connection.socket.recv(copy=False).buffer  # ZeroMQ's memory, as long as somebody uses it
            if part.nbytes == len(protocol.WELCOME) and bytes(part) == protocol.WELCOME:
                continue
            try:
                message = protocol.decode(part, self._max_payload)
            except protocol.MessageError as error:
                self.damaged, self.last_error = self.damaged + 1, str(error)
                continue
            item = self._accept(message)
            if item is not None or (isinstance(message, EndMessage) and self.ended):
                return item
        return None

    def _accept(self, message: Message) -> Item | None:
        """What to hand out for a message; None: nothing."""
        raise NotImplementedError


class _Stream(msgspec.Struct, kw_only=True):
    """What was last seen on one topic."""

    sequence: int
    view_rev: int = 0
    ended: bool = False


class DataSubscriber(Subscriber[Item]):
    """What subscribers of views and of grids share.

    It counts messages: received; skipped, by gaps in the sequence; outdated, of an older view_rev or a repeated
    sequence; stale, older than max_age_ms; and restarts of the node.
    """

    def __init__(
        self,
        endpoint: str,
        topics: set[bytes],
        conflate: bool,
        max_payload: int,
        keys: ClientKeys | None,
        max_age_ms: float | None,
    ) -> None:
        super().__init__(resolve_endpoint(endpoint, "data"), topics, conflate, max_payload, keys)
        self._max_age_ms, self._boot_id, self._restarted = max_age_ms, "", False
        self._streams: dict[str, _Stream] = {}
        self.received = self.skipped = self.outdated = self.stale = self.restarts = 0

    @property
    def ended(self) -> bool:
        """Whether every topic seen has ended; false again once a new message comes."""
        return bool(self._streams) and all(stream.ended for stream in self._streams.values())

    def _wants(self, topic: str) -> bool:
        """Whether it is one of its topics."""
        raise NotImplementedError

    def _item(self, message: DataMessage, how: _Received) -> Item | None:
        """What is handed out. how: it arrived."""
        raise NotImplementedError

    def _accept(self, message: Message) -> Item | None:
        if isinstance(message, StatusMessage) or not self._wants(message.topic):
            return None
        if self._boot_id not in ("", message.header.boot_id):
            self._streams.clear()
            self._restarted, self.restarts = True, self.restarts + 1
        self._boot_id = message.header.boot_id
        if isinstance(message, EndMessage):
            stream = self._streams.setdefault(message.topic, _Stream(sequence=message.sequence))
            stream.sequence, stream.ended = message.sequence, True
            return None
        skipped = self._advance(message)
        return None if skipped is None else self._received(message, skipped)

    def _advance(self, message: DataMessage) -> int | None:
        """How many messages were missed before this one; None: it is outdated."""
        revision = message.header.view_rev
        stream = self._streams.setdefault(message.topic, _Stream(sequence=message.sequence - 1, view_rev=revision))
        skipped = message.sequence - stream.sequence - 1
        if skipped < 0 or revision < stream.view_rev:
            stream.sequence = max(stream.sequence, message.sequence)
            self.outdated += 1
            return None
        stream.sequence, stream.view_rev, stream.ended = message.sequence, revision, False
        self.skipped += skipped
        return skipped

    def _received(self, message: DataMessage, skipped: int) -> Item | None:
        header = message.header
        since_ms = max(0.0, (time.time_ns() - header.t_publish_ns) / 1e6)  # clocks of two machines may disagree
        age_ms = header.age_ms + since_ms
        if self._max_age_ms is not None and age_ms > self._max_age_ms:
            self.stale += 1
            return None
        restarted, self._restarted = self._restarted, False
        self.received += 1
        expired = since_ms > header.valid_for_ms
        how = _Received(age_ms=age_ms, expired=expired, skipped=skipped, restarted=restarted)
        return self._item(message, how)


class ViewSubscriber(DataSubscriber[ReceivedView]):
    """Views of one node.

    endpoint: "ipc" for the node on this machine, or ipc://PATH, tcp://HOST:PORT.
    view: the view's id, or "src" (of kind "frm") for the preview of the input. None: all views, with conflate=False.
    kind: "win" for windows, "frm" for frames at the goal pose, "std" for standard deviations, "cls" for class maps,
        "vis" for what was seen and what is painted, "depth" for inverse depth. Several, or None for all, need
        conflate=False; those of one window come in the order win, cls, vis, depth.
    conflate: keep only the newest message, so that a slow reader never works on old ones.
    max_age_ms: older views are left out; None: no limit. max_payload: largest payload accepted, bytes.
    keys: for a node that asks for them.

    Raises:
        SetupError: no such endpoint, or all views or kinds are to be conflated. MessageError: no such view id.
    """

    def __init__(
        self,
        endpoint: str = "ipc",
        view: str | None = None,
        kind: ViewKind | tuple[ViewKind, ...] | None = "win",
        *,
        conflate: bool = True,
        max_age_ms: float | None = None,
        max_payload: int = protocol.MAX_PAYLOAD,
        keys: ClientKeys | None = None,
    ) -> None:
        kinds = kind if isinstance(kind, tuple) else (kind,)
        if conflate and (view is None or len(kinds) > 1 or None in kinds):
            raise SetupError("a conflated socket keeps one message: name a view and a kind, or set conflate=False")
        topics = {_subscription(view, each) for each in kinds}
        super().__init__(endpoint, topics, conflate, max_payload, keys, max_age_ms)
        self._suffixes = tuple("" if each is None else f"/{each}" for each in kinds)

    def _wants(self, topic: str) -> bool:
        return topic.endswith(self._suffixes)

    def _item(self, message: DataMessage, how: _Received) -> ReceivedView | None:
        return (
            ReceivedView(message=message, **msgspec.structs.asdict(how)) if isinstance(message, ViewMessage) else None
        )


class GridSubscriber(DataSubscriber[ReceivedGrid]):
    """A grid of one node. grid: its id. For all else see ViewSubscriber. Raises as that."""

    def __init__(
        self,
        endpoint: str = "ipc",
        grid: str = "around",
        *,
        conflate: bool = True,
        max_age_ms: float | None = None,
        max_payload: int = protocol.MAX_PAYLOAD,
        keys: ClientKeys | None = None,
    ) -> None:
        self._topic = protocol.grid_topic(grid)
        topics = {protocol.topic_key(self._topic)}
        super().__init__(endpoint, topics, conflate, max_payload, keys, max_age_ms)

    def _wants(self, topic: str) -> bool:
        return topic == self._topic

    def _item(self, message: DataMessage, how: _Received) -> ReceivedGrid | None:
        return (
            ReceivedGrid(message=message, **msgspec.structs.asdict(how)) if isinstance(message, GridMessage) else None
        )


class StatusSubscriber(Subscriber[StatusMessage]):
    """Status, event and meta messages of one node, each once; the last of each topic arrives at once."""

    def __init__(
        self,
        endpoint: str = "ipc",
        topics: tuple[StatusTopic, ...] = ("status", "event", "meta"),
        keys: ClientKeys | None = None,
    ) -> None:
        keyed = {protocol.topic_key(topic) for topic in topics}
        super().__init__(resolve_endpoint(endpoint, "status"), keyed, conflate=False, max_payload=0, keys=keys)
        self._seen: dict[str, tuple[str, int]] = {}

    def _accept(self, message: Message) -> StatusMessage | None:
        number = (message.header.boot_id, message.sequence)
        if not isinstance(message, StatusMessage) or self._seen.get(message.topic) == number:
            return None
        self._seen[message.topic] = number
        return message


def _subscription(view: str | None, kind: ViewKind | None) -> bytes:
    """One topic, all topics of a view, or all views."""
    if view is None:
        return b"view/"
    if kind is None and view != protocol.PREVIEW_ID:
        return protocol.view_topic(view, "win").removesuffix("win").encode()
    return protocol.topic_key(protocol.view_topic(view, kind or "frm"))
