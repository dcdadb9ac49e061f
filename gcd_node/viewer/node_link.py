"""The viewer's end of a node: reads its sockets as any client does, and carries commands to it.

Views are read only while a browser wants them; the status always, so that a browser that comes later knows the last
minutes. Each subscriber has a thread of its own; everything else here belongs to the event loop's thread.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, get_args

from gcd_client.control import Code, ControlClient, ControlError
from gcd_client.endpoints import AuthError, ClientKeys
from gcd_client.protocol import PREVIEW_ID, ClientError, MessageError, StatusMessage, ViewKind
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_node.auth import Role
from gcd_node.viewer.messages import Ask, Mailbox, Picture, picture, text_message
from gcd_node.watching.status_board import StatusBoard

_LOG = logging.getLogger(__name__)
_LOOKING: Final = frozenset({"describe", "views"})
_STEERING: Final = frozenset({"set_view", "set_param", "get_config"})
_KINDS: tuple[ViewKind, ...] = tuple(kind for kind in get_args(ViewKind) if kind != "frm")
_WAIT_MS = 200.0
_RETRY_S = 2.0
_JOIN_S = 2.0
_REPLY_S = 2.0
_MOST_AT_ONCE = 64
_EVENTS = 50
_HISTORY = 300


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeEndpoints:
    """Where a node is reached. control: None if it takes no commands. keys: for tcp endpoints, if they ask for any."""

    data: str = "ipc"
    status: str = "ipc"
    control: str | None = "ipc"
    keys: ClientKeys | None = field(default=None, repr=False)

    def keys_for(self, endpoint: str) -> ClientKeys | None:
        """What this endpoint asks for: ipc endpoints of a secured node ask for nothing."""
        return self.keys if endpoint.startswith("tcp://") else None


class NodeLink:
    """What is known of the node, and which browsers are told."""

    def __init__(self, node: NodeEndpoints) -> None:
        """In the event loop. Begin to listen to the node's status."""
        self._node = node
        self._watched: dict[Mailbox, str | None] = {}
        self._readers: dict[str, _Reader] = {}
        self._newest: dict[tuple[str, str], Picture] = {}
        self._board = StatusBoard()
        self._last: dict[str, str] = {}
        self._events: deque[tuple[str, str]] = deque(maxlen=_EVENTS)
        self._samples: deque[dict[str, Any]] = deque(maxlen=_HISTORY)
        self._windows: deque[dict[str, Any]] = deque(maxlen=_HISTORY)
        self._count = 0
        self._notes = _Reader("status", self._subscribe_notes, self._take_note)

    @property
    def silent_ms(self) -> int | None:
        """Since the node spoke last; None before it ever has."""
        silent_s = self._board.silent_s(time.monotonic())
        return None if silent_s is None else round(1000 * silent_s)

    def join(self, browser: Mailbox) -> None:
        """A browser is there: from now on it hears what the node says, and sees the input."""
        browser.put("welcome", text_message("welcome", {"commands": self._node.control is not None}))
        self.watch(browser, None)
        history = text_message("history", {"samples": list(self._samples)})
        for slot, text in [("history", history), *self._events, *self._last.items()]:
            browser.put(slot, text)
        browser.put("windows", text_message("windows", {"windows": list(self._windows)}))

    def watch(self, browser: Mailbox, view: str | None) -> None:
        """A browser wants to see this view instead of the one before; None for the input alone."""
        browser.drop_views()
        self._watched[browser] = view
        self._read_what_is_watched()
        for newest in self._newest.values():
            if newest.view in (view, PREVIEW_ID):
                browser.put_picture(newest)

    def leave(self, browser: Mailbox) -> None:
        """A browser has gone."""
        self._watched.pop(browser, None)
        self._read_what_is_watched()

    async def ask(self, ask: Ask, role: Role) -> str:
        """Carry a command to the node; the reply, a refusal too."""
        try:
            self._check(ask.verb, role)
            reply = await asyncio.to_thread(self._request, ask)
        except (ControlError, AuthError) as error:
            code = Code.FORBIDDEN if isinstance(error, AuthError) else error.code or "NO_ANSWER"
            fields: dict[str, Any] = {"ok": False, "code": code, "message": str(error), "result": None}
        else:
            fields = {"ok": reply.ok, "code": reply.code, "message": reply.message, "result": reply.result}
        return text_message("reply", {"id": ask.id, "verb": ask.verb, **fields})

    def close(self) -> None:
        """Stop reading."""
        readers = [self._notes, *self._readers.values()]
        for reader in readers:
            reader.stop()
        for reader in readers:
            reader.join()

    def _check(self, verb: str, role: Role) -> None:
        """Raises ControlError."""
        if verb not in _LOOKING | _STEERING:
            known = ", ".join(sorted(_LOOKING | _STEERING))
            raise ControlError(f"a page asks for {known}, not for {verb!r}; use `gcd-node ctl`", Code.FORBIDDEN)
        if verb in _STEERING and role != "operator":
            raise ControlError(
                "you are looking, not steering: open the address that was printed, with its #token=...", Code.FORBIDDEN
            )

    def _request(self, ask: Ask) -> Any:
        endpoint = self._node.control
        if endpoint is None:
            raise ControlError("this node takes no commands: it has no [control] endpoint", Code.FORBIDDEN)
        keys = self._node.keys_for(endpoint)
        with ControlClient(endpoint, keys=keys, timeout_s=_REPLY_S, attempts=1) as client:
            return client.request(ask.verb, ask.args)

    def _read_what_is_watched(self) -> None:
        wanted = {view for view in self._watched.values() if view is not None}
        if self._watched:
            wanted.add(PREVIEW_ID)
        for view in self._readers.keys() - wanted:
            self._readers.pop(view).stop()
            self._newest = {key: newest for key, newest in self._newest.items() if key[0] != view}
        for view in wanted - self._readers.keys():
            self._readers[view] = _Reader(view, lambda view=view: self._subscribe(view), self._take_picture)

    def _subscribe(self, view: str) -> ViewSubscriber:
        kinds = ("frm",) if view == PREVIEW_ID else _KINDS
        return ViewSubscriber(self._node.data, view, kinds, conflate=False, keys=self._node.keys_for(self._node.data))

    def _subscribe_notes(self) -> StatusSubscriber:
        return StatusSubscriber(self._node.status, keys=self._node.keys_for(self._node.status))

    def _take_picture(self, shown: Picture) -> None:
        if shown.view not in self._readers:
            return
        self._newest[shown.view, shown.kind] = shown
        if shown.kind == "win":
            self._windows.append({"view": shown.view, **shown.head["published"], "at_s": shown.head["at_s"]})
        for browser, watched in self._watched.items():
            if shown.view in (watched, PREVIEW_ID):
                browser.put_picture(shown)

    def _take_note(self, note: StatusMessage) -> None:
        self._count += 1
        self._board.add(note, time.monotonic(), time.time_ns())
        header = note.header
        origin = {"node_id": header.node_id, "boot_id": header.boot_id, "at_s": header.t_publish_ns / 1e9}
        text = text_message(note.topic, {**origin, "number": self._count, "fields": dict(note.fields)})
        slot = note.topic
        if note.topic == "event":
            slot = f"event/{self._count}"
            self._events.append((slot, text))
        else:
            self._last[note.topic] = text
        if note.topic == "status":
            self._samples.append({"at_s": origin["at_s"], "stages": _medians(note.fields)})
        for browser in self._watched:
            browser.put(slot, text)


class _Reader:
    """Reads a subscriber in a thread of its own until it is stopped, and hands on the newest of each topic, pictures
    already coded, in the event loop that it was made in."""

    def __init__(
        self, name: str, subscribe: Callable[[], ViewSubscriber | StatusSubscriber], take: Callable[[Any], None]
    ) -> None:
        self._name, self._subscribe, self._take = name, subscribe, take
        self._loop = asyncio.get_running_loop()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"viewer {name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End soon. Does not wait."""
        self._stopped.set()

    def join(self) -> None:
        """Wait for the thread, after `stop`."""
        self._thread.join(_JOIN_S)

    def _serve(self) -> None:
        while not self._stopped.is_set():
            try:
                with self._subscribe() as subscriber:
                    while not self._stopped.is_set():
                        self._read(subscriber)
            except ClientError as error:
                _LOG.warning("the page gets nothing of %s: %s", self._name, error)
                self._stopped.wait(_RETRY_S)

    def _read(self, subscriber: ViewSubscriber | StatusSubscriber) -> None:
        """What has come by now. Of the views of a topic the newest: whoever is slow must not see old ones."""
        newest: dict[object, ReceivedView | StatusMessage] = {}
        received = subscriber.receive(_WAIT_MS)
        while received is not None:
            key = received.message.topic if isinstance(received, ReceivedView) else len(newest)
            newest[key] = received
            received = subscriber.receive(0) if len(newest) < _MOST_AT_ONCE else None
        for each in newest.values():
            try:
                message = picture(each) if isinstance(each, ReceivedView) else each
            except MessageError as error:
                _LOG.debug("the page leaves out a view: %s", error)
                continue
            if not self._stopped.is_set():
                self._loop.call_soon_threadsafe(self._take, message)


def _medians(status: Mapping[str, Any]) -> dict[str, float]:
    """What is plotted of a status: the median of each stage, ms. It was written by others: nothing is certain."""
    stages = status.get("stages")
    return {
        name: stage["p50_ms"]
        for name, stage in (stages.items() if isinstance(stages, Mapping) else ())
        if isinstance(stage, Mapping) and isinstance(stage.get("p50_ms"), int | float)
    }
