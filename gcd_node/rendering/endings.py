"""Says on which topics nothing more comes: end-of-stream messages (wire protocol, section 4.5)."""

from collections.abc import Callable, Set
from dataclasses import replace
from typing import get_args

from gcd_node.envelope import ViewKind, view_topic
from gcd_node.life.live_config import LiveConfig, Settings
from gcd_node.publishing.dispatcher import Dispatcher
from gcd_node.wire.view_message import Run, end_messages, published_kinds

_KINDS: tuple[ViewKind, ...] = get_args(ViewKind)


class Endings:
    """Ends every topic once: what is made of a view now, and what was made of it before a command changed that."""

    def __init__(self, live: LiveConfig, dispatcher: Dispatcher, run: Callable[[], Run]) -> None:
        """run: what is known of the source now."""
        self._live, self._dispatcher, self._run = live, dispatcher, run
        self.carried: Set[ViewKind] = frozenset()
        """What the last window's views held of themselves."""

    def announce_due(self, last_window_id: int) -> None:
        """End views that were taken out, and what is made of a view no more, such as deviations of a single sample."""
        settings = self._live.settings()
        for view_id, rev in self._live.take_removed():
            self._end(view_id, rev, self._known(view_id, settings), last_window_id, delay_ms=0)
        made = self._made(settings)
        for view_id, rev in settings.revisions.items():
            if gone := self._known(view_id, settings) - made:
                self._end(view_id, rev, gone, last_window_id, delay_ms=0)

    def announce_all(self, last_window_id: int, *, delay_ms: int | None) -> None:
        """End everything. delay_ms: see Outbox."""
        self.announce_due(last_window_id)
        settings = self._live.settings()
        for view_id, rev in settings.revisions.items():
            self._end(view_id, rev, self._made(settings), last_window_id, delay_ms=delay_ms)

    def _made(self, settings: Settings) -> Set[ViewKind]:
        return {*published_kinds(replace(self._run(), config=settings.config)), *self.carried}

    def _known(self, view_id: str, settings: Settings) -> Set[ViewKind]:
        """What is made of a view now, or was and has not ended."""
        made = self._made(settings)
        return {kind for kind in _KINDS if kind in made or self._dispatcher.is_open(view_topic(view_id, kind))}

    def _end(self, view_id: str, rev: int, kinds: Set[ViewKind], last: int, *, delay_ms: int | None) -> None:
        ordered = sorted(kinds, key=_KINDS.index)
        self._dispatcher.end(end_messages(self._run(), view_id, rev, last, ordered), delay_ms=delay_ms)
