"""Between the node and the browsers: who wants what, and who is given it."""

import threading
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from gcd_node.security.keys import ClientKeys
from gcd_node.viewer.feeds import INPUT, Feed, Wanted, wanted_of
from gcd_node.viewer.mailbox import Mailbox
from gcd_node.viewer.messages import Note, Picture, note
from gcd_node.viewer.node_watch import NodeWatch

_WINDOWS = 300


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeEndpoints:
    """Where a node is reached. control: None if it takes no commands. keys: for tcp endpoints, if they ask for any."""

    data: str
    status: str
    control: str | None = None
    keys: ClientKeys | None = field(default=None, repr=False)

    def keys_for(self, endpoint: str) -> ClientKeys | None:
        """What this endpoint asks for: ipc endpoints of a secured node ask for nothing."""
        return self.keys if endpoint.startswith("tcp://") else None


class Hub:
    """Every method may be called from any thread; none waits for a browser."""

    def __init__(self, node: NodeEndpoints) -> None:
        """Begin to listen to the node's status; nothing else is read before somebody looks."""
        self._node = node
        self._lock = threading.Lock()
        self._wishes: dict[Mailbox, frozenset[Wanted]] = {}
        self._feeds: dict[Wanted, Feed] = {}
        self._newest: dict[Wanted, Picture] = {}
        self._windows: deque[dict[str, Any]] = deque(maxlen=_WINDOWS)
        self.watch = NodeWatch(node.status, node.keys_for(node.status), self._tell)

    @property
    def feeds(self) -> int:
        """Topics that are read now."""
        with self._lock:
            return len(self._feeds)

    def join(self, box: Mailbox) -> None:
        """A browser is there: from now on it hears what the node says, and sees the input."""
        self.look(box, None)
        for slot, told in self.watch.known():
            box.put(slot, told)
        with self._lock:
            box.put("windows", note("windows", {"windows": list(self._windows)}))

    def look(self, box: Mailbox, view: str | None) -> None:
        """A browser wants to see this view instead of the one before; None for none."""
        box.forget(lambda slot: slot.startswith("picture/") and slot != _slot(INPUT))
        with self._lock:
            wanted = self._wishes[box] = wanted_of(view)
            self._adjust()
            for each in wanted & self._newest.keys():
                box.put(_slot(each), self._newest[each])

    def leave(self, box: Mailbox) -> None:
        """A browser has gone."""
        with self._lock:
            self._wishes.pop(box, None)
            self._adjust()

    def close(self) -> None:
        """Stop reading."""
        self.watch.close()
        with self._lock:
            self._wishes.clear()
            feeds = list(self._feeds.values())
            self._adjust()
        for feed in feeds:
            feed.join()

    def _adjust(self) -> None:
        """Read what is wanted, and nothing else. With the lock."""
        wanted = frozenset[Wanted]().union(*self._wishes.values())
        for each in self._feeds.keys() - wanted:
            self._feeds.pop(each).stop()
            self._newest.pop(each, None)
        for each in wanted - self._feeds.keys():
            self._feeds[each] = Feed(self._node.data, each, self._node.keys_for(self._node.data), self._give)

    def _give(self, wanted: Wanted, picture: Picture) -> None:
        with self._lock:
            if wanted not in self._feeds:
                return
            self._newest[wanted] = picture
            if wanted.kind == "win":
                self._windows.append({"view": wanted.view, **picture.head["published"], "at_s": picture.head["at_s"]})
            boxes = [box for box, wishes in self._wishes.items() if wanted in wishes]
        for box in boxes:
            box.put(_slot(wanted), picture)

    def _tell(self, slot: str, told: Note) -> None:
        with self._lock:
            boxes = list(self._wishes)
        for box in boxes:
            box.put(slot, told)


def _slot(wanted: Wanted) -> str:
    return f"picture/{wanted.view}/{wanted.kind}"
