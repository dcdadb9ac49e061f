"""Hears what a node says on its status socket, always, so that a browser that comes later knows the last minutes."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from gcd_node.envelope import NoteMessage
from gcd_node.errors import MessageError, NodeError
from gcd_node.security.keys import ClientKeys
from gcd_node.subscriber import NoteSubscriber
from gcd_node.viewer.messages import Note, note
from gcd_node.watching.status_board import StatusBoard

SILENT_S = 1.8
"""A node speaks once a second; silent for so long, it is dead or hung."""

_LOG = logging.getLogger(__name__)
_LOOK_MS = 200.0
_JOIN_S = 2.0
_EVENTS = 50
_SAMPLES = 300
_AGAIN_S = 1.0


class NodeWatch:
    """Keeps the last status, the metadata, the latest events, and a line for each status of the last five minutes."""

    def __init__(self, endpoint: str, keys: ClientKeys | None, tell: Callable[[str, Note], None]) -> None:
        """tell: takes each note and the slot it belongs in, from this object's thread."""
        self._endpoint, self._keys, self._tell = endpoint, keys, tell
        self._order = threading.Lock()
        self._board = StatusBoard(SILENT_S)
        self._last: dict[str, Note] = {}
        self._events: deque[tuple[str, Note]] = deque(maxlen=_EVENTS)
        self._samples: deque[dict[str, Any]] = deque(maxlen=_SAMPLES)
        self._count = 0
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="viewer notes", daemon=True)
        self._thread.start()

    @property
    def silent_s(self) -> float | None:
        """Since the node spoke last; None before it ever has."""
        with self._order:
            return self._board.silent_s(time.monotonic())

    @property
    def node_id(self) -> str:
        """The node's name, empty before it spoke."""
        return self._board.node_id

    def known(self) -> list[tuple[str, Note]]:
        """What a browser that comes now has to know, by slot, in the order in which it happened."""
        with self._order:
            history = note("history", {"samples": list(self._samples)})
            return [("history", history), *self._events, *self._last.items()]

    def close(self) -> None:
        """Stop listening."""
        self._stopped.set()
        self._thread.join(_JOIN_S)

    def _serve(self) -> None:
        while not self._stopped.is_set():
            try:
                with NoteSubscriber(self._endpoint, keys=self._keys) as notes:
                    while not self._stopped.is_set():
                        self._read(notes)
            except NodeError as error:
                _LOG.warning("the page hears nothing of the node: %s", error)
                self._stopped.wait(_AGAIN_S)

    def _read(self, notes: NoteSubscriber) -> None:
        try:
            heard = notes.receive(_LOOK_MS)
        except MessageError as error:
            _LOG.debug("the page leaves out a note: %s", error)
            return
        if heard is not None:
            slot, told = self._kept(heard)
            self._tell(slot, told)

    def _kept(self, heard: NoteMessage) -> tuple[str, Note]:
        header = heard.header
        wall_s = header.t_publish_ns / 1e9
        origin = {"node_id": header.node_id, "boot_id": header.boot_id, "at_s": wall_s}
        with self._order:
            self._count += 1
            told = note(heard.topic, {**origin, "number": self._count, "fields": dict(heard.fields)})
            self._board.add(heard, time.monotonic(), time.time_ns())
            if heard.topic == "event":
                slot = f"event/{self._count}"
                self._events.append((slot, told))
                return slot, told
            if heard.topic == "status":
                self._samples.append(_sample(wall_s, heard.fields))
            self._last[heard.topic] = told
            return heard.topic, told


def _sample(wall_s: float, fields: Mapping[str, Any]) -> dict[str, Any]:
    """What is plotted of a status: the median of each stage, ms."""
    stages = fields.get("stages")
    medians = {
        name: stage["p50_ms"]
        for name, stage in (stages.items() if isinstance(stages, Mapping) else ())
        if isinstance(stage, Mapping) and isinstance(stage.get("p50_ms"), int | float)
    }
    return {"at_s": wall_s, "stages": medians}
