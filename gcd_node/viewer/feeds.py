"""Reads what browsers want to see of a node, as any client would, and only while one of them wants it."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

from gcd_node.envelope import PREVIEW_ID, ViewKind
from gcd_node.errors import MessageError, NodeError
from gcd_node.security.keys import ClientKeys
from gcd_node.subscriber import ViewSubscriber
from gcd_node.viewer.messages import Picture, picture

_LOG = logging.getLogger(__name__)
_LOOK_MS = 200.0
_AGAIN_S = 2.0
_JOIN_S = 2.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Wanted:
    """One topic of the data socket, as ViewSubscriber names it."""

    view: str
    kind: ViewKind


INPUT = Wanted(view=PREVIEW_ID, kind="frm")
"""What every browser sees."""


def wanted_of(view: str | None) -> frozenset[Wanted]:
    """What a browser needs that looks at a view; None for the input alone."""
    if view is None or view == PREVIEW_ID:
        return frozenset({INPUT})
    return frozenset({INPUT, *(Wanted(view=view, kind=kind) for kind in get_args(ViewKind) if kind != "frm")})


class Feed:
    """Reads one topic in a thread of its own until it is stopped; the newest message is all it ever holds."""

    def __init__(
        self, endpoint: str, wanted: Wanted, keys: ClientKeys | None, give: Callable[[Wanted, Picture], None]
    ) -> None:
        """give: takes each picture, in the feed's thread."""
        self._endpoint, self._wanted, self._keys, self._give = endpoint, wanted, keys, give
        self._stopped = threading.Event()
        name = f"viewer {wanted.view}/{wanted.kind}"
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
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
                with ViewSubscriber(self._endpoint, self._wanted.view, self._wanted.kind, keys=self._keys) as views:
                    while not self._stopped.is_set():
                        self._read(views)
            except NodeError as error:
                _LOG.warning("the page gets no %s/%s: %s", self._wanted.view, self._wanted.kind, error)
                self._stopped.wait(_AGAIN_S)

    def _read(self, views: ViewSubscriber) -> None:
        try:
            view = views.receive(_LOOK_MS)
            if view is not None and not self._stopped.is_set():
                self._give(self._wanted, picture(view))
        except MessageError as error:
            _LOG.debug("the page leaves out a message: %s", error)
