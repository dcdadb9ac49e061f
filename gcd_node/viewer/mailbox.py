"""What waits to be sent to one browser: of everything the newest."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeAlias

from gcd_node.viewer.messages import Note, Picture

Parcel: TypeAlias = Note | Picture

MOST_UNSEEN = 3
"""Pictures a browser may have on the way, sent and not yet shown."""

MOST_WAITING = 64
"""Slots; when it gets more, the oldest are given up."""


class Mailbox:
    """One slot for each name; a newer parcel replaces an unread one and keeps its place in the row.

    Pictures wait until the browser has shown earlier ones, so that what it is too slow for is left out here and never
    piles up on the way. Every method may be called from any thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: OrderedDict[str, Parcel] = OrderedDict()
        self._closed = False
        self._given = self._shown = 0
        self.replaced = 0
        """Parcels that were given up unread."""

    @property
    def closed(self) -> bool:
        """Whether nothing is sent any more."""
        return self._closed

    def put(self, slot: str, parcel: Parcel) -> None:
        """Leave a parcel. Never waits."""
        with self._changed:
            self.replaced += slot in self._waiting
            self._waiting[slot] = parcel
            if len(self._waiting) > MOST_WAITING:
                self._waiting.popitem(last=False)
                self.replaced += 1
            self._changed.notify()

    def forget(self, wanted: Callable[[str], bool]) -> None:
        """Give up what waits in the slots named."""
        with self._changed:
            for slot in [each for each in self._waiting if wanted(each)]:
                del self._waiting[slot]

    def take(self, timeout_s: float) -> tuple[int, Parcel] | None:
        """The next parcel and, of a picture, its number, else 0. None after `timeout_s` or once it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._next() is not None, timeout_s)
            slot = None if self._closed else self._next()
            if slot is None:
                return None
            parcel = self._waiting.pop(slot)
            if isinstance(parcel, Note):
                return 0, parcel
            self._given += 1
            return self._given, parcel

    def shown(self, number: int) -> None:
        """The browser has shown the picture of this number, and so all before it."""
        with self._changed:
            self._shown = max(self._shown, min(number, self._given))
            self._changed.notify()

    def close(self) -> None:
        """Whoever waits is let go; nothing is sent any more."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def _next(self) -> str | None:
        room = self._given - self._shown < MOST_UNSEEN
        return next((slot for slot, each in self._waiting.items() if room or isinstance(each, Note)), None)
