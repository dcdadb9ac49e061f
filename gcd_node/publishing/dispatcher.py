"""Sends the messages of windows: each moment once, single frames at the rhythm they were taken in; and their end."""

from collections.abc import Sequence

from gcd_node.envelope import EndMessage, ViewMessage
from gcd_node.publishing.frame_pacer import FramePacer
from gcd_node.publishing.outbox import Outbox


class Dispatcher:
    """Between the model thread and the outbox."""

    def __init__(self, outbox: Outbox, *, paced: bool) -> None:
        """paced: single frames leave at the windows' rhythm; else at once, because nobody waits for the clock."""
        self._outbox, self._pacer = outbox, FramePacer(outbox.send)
        self._paced = paced
        self._newest_goal: dict[str, tuple[int, int]] = {}
        self._open: set[str] = set()

    def send(self, made: Sequence[ViewMessage], fps: float) -> None:
        """Send what one view of one window came to. Raises what a send failed with."""
        frames_sent = 0
        for message in self._unsent(made):
            is_frame = message.topic.endswith("/frm")
            self._pacer.send(message, frames_sent / fps if is_frame and self._paced else 0.0)
            frames_sent += is_frame
            self._open.add(message.topic)

    def is_open(self, topic: str) -> bool:
        """Whether something was sent on it, and no end since."""
        return topic in self._open

    def end(self, ends: Sequence[EndMessage], *, delay_ms: int | None) -> None:
        """Send the end of topics; single frames of theirs that still wait are forgotten. delay_ms: see Outbox."""
        self._pacer.forget({message.topic for message in ends})
        for message in ends:
            self._open.discard(message.topic)
            self._outbox.end(message, delay_ms=delay_ms)

    def finish(self, *, abandon: bool) -> None:
        """Wait until all have left, or forget those that wait."""
        self._pacer.finish(abandon=abandon)

    def _unsent(self, made: Sequence[ViewMessage]) -> list[ViewMessage]:
        """Without single frames of moments that an overlapping window has sent before."""
        kept: list[ViewMessage] = []
        for message in made:
            if message.topic.endswith("/frm"):
                moment = (message.header.src.epoch, message.header.src.seq[0])
                if moment <= self._newest_goal.get(message.topic, (-1, -1)):
                    continue
                self._newest_goal[message.topic] = moment
            kept.append(message)
        return kept
