"""The queue between the node and a recording's thread: bounded, so that a slow disk costs recorded data and never
memory, frames or views."""

import threading
import time
from collections import Counter, deque

from gcd_node.recording.items import InputItem, Item, ViewItem

_MOST_BYTES = 64 * 2**20
_MOST_SMALL_BYTES = 4 * 2**20
_MOST_SMALL = 4096
_LOCKSTEP_S = 5.0


class Inbox:
    """Items on their way to the disk. Pictures have 64 MiB; notes and commands have room of their own, so that
    neither pushes out the other. `put` may be called from any thread, `take` from one.

    waits: in lockstep nobody is in a hurry, so a full queue makes the node wait, for 5 s at most.
    """

    def __init__(self, *, waits: bool = False, most_bytes: int = _MOST_BYTES) -> None:
        self._waits, self._most_bytes = waits, most_bytes
        self._changed = threading.Condition()
        self._items: deque[Item] = deque()
        self._bytes = self._small = self._small_bytes = 0
        self._dropped: Counter[str] = Counter()
        self._end_s: float | None = None

    @property
    def dropped(self) -> dict[str, int]:
        """What found no room or could not be written, by topic: frames, windows, notes."""
        with self._changed:
            return dict(self._dropped)

    @property
    def exhausted(self) -> bool:
        """Whether it was closed, and nothing more comes out."""
        with self._changed:
            return self._end_s is not None and (not self._items or time.monotonic() > self._end_s)

    def put(self, item: Item) -> None:
        """Hand an item over, or count it as dropped."""
        with self._changed:
            if self._waits and isinstance(item, InputItem | ViewItem):
                self._changed.wait_for(
                    lambda: not self._waits or self._end_s is not None or self._fits(item), _LOCKSTEP_S
                )
            if self._end_s is not None:
                return
            if not self._fits(item):
                self._dropped[item.topic] += 1
                return
            self._count(item, 1)
            self._items.append(item)
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Item | None:
        """The next item; None if none comes in time, or the time of an inbox that was closed is over."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items) or self._end_s is not None, max(0.0, timeout_s))
            if not self._items or (self._end_s is not None and time.monotonic() > self._end_s):
                return None
            item = self._items.popleft()
            self._count(item, -1)
            self._changed.notify_all()
            return item

    def hurry(self) -> None:
        """Make nobody wait any more."""
        with self._changed:
            self._waits = False
            self._changed.notify_all()

    def drop(self, topic: str) -> None:
        """Count one that was taken and could not be written."""
        with self._changed:
            self._dropped[topic] += 1

    def close(self, patience_s: float) -> None:
        """Take nothing more in; what is in there may be taken for so long, then it counts as dropped."""
        with self._changed:
            end_s = time.monotonic() + patience_s
            self._end_s = end_s if self._end_s is None else min(end_s, self._end_s)
            self._changed.notify_all()

    def clear(self) -> None:
        """Count what is left as dropped."""
        with self._changed:
            self._dropped.update(item.topic for item in self._items)
            self._items.clear()
            self._bytes = self._small = self._small_bytes = 0

    # What follows is called with the lock held.

    def _fits(self, item: Item) -> bool:
        if isinstance(item, InputItem | ViewItem):
            return self._bytes == 0 or self._bytes + item.size <= self._most_bytes  # one always finds room
        return self._small < _MOST_SMALL and self._small_bytes + item.size <= _MOST_SMALL_BYTES

    def _count(self, item: Item, sign: int) -> None:
        if isinstance(item, InputItem | ViewItem):
            self._bytes += sign * item.size
        else:
            self._small += sign
            self._small_bytes += sign * item.size
