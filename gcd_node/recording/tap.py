"""An outbox that also shows the recorder what leaves."""

from collections.abc import Mapping
from typing import Any

from gcd_node.envelope import EndMessage, NoteTopic, ViewMessage
from gcd_node.publishing.options import PublisherStats
from gcd_node.publishing.outbox import Outbox
from gcd_node.recording.recorder import Recorder
from gcd_node.wire.header import OriginHeader


class RecordedOutbox:
    """Implements Outbox over another one. What is published goes first."""

    def __init__(self, outbox: Outbox, recorder: Recorder) -> None:
        self._outbox, self._recorder = outbox, recorder

    def send(self, message: ViewMessage) -> object:
        """See Outbox."""
        sent = self._outbox.send(message)
        self._recorder.view(message)
        return sent

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """See Outbox."""
        self._outbox.end(message, delay_ms=delay_ms)

    def note(self, topic: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """See Outbox."""
        self._outbox.note(topic, header, fields)
        self._recorder.note(topic, header, fields)

    def hurry(self) -> None:
        """See Outbox."""
        self._outbox.hurry()
        self._recorder.hurry()

    @property
    def stats(self) -> PublisherStats:
        """See Outbox."""
        return self._outbox.stats
