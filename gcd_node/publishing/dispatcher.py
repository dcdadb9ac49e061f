"""Sends the messages of windows: each moment once, single frames at the rhythm they were taken in."""

from collections.abc import Sequence

from gcd_node.envelope import ViewMessage
from gcd_node.publishing.frame_pacer import FramePacer
from gcd_node.publishing.outbox import Outbox


class Dispatcher:
    """Between the model thread and the outbox."""

    def __init__(self, outbox: Outbox, *, paced: bool) -> None:
        """paced: single frames leave at the windows' rhythm; else at once, because nobody waits for the clock."""
        self._pacer = FramePacer(outbox.send)
        self._paced = paced
        self._newest_goal: dict[str, tuple[int, int]] = {}

    def send(self, made: Sequence[ViewMessage], fps: float) -> None:
        """Send what one view of one window came to. Raises what a send failed with."""
        frames_sent = 0
        for message in self._unsent(made):
            is_frame = message.topic.endswith("/frm")
            self._pacer.send(message, frames_sent / fps if is_frame and self._paced else 0.0)
            frames_sent += is_frame

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
