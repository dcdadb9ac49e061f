"""Where messages go: what the node needs of a publisher."""

from collections.abc import Mapping
from typing import Any, Protocol

from gcd_node.envelope import EndMessage, NoteTopic, ViewMessage
from gcd_node.publishing.options import PublisherStats
from gcd_node.wire.header import OriginHeader


class Outbox(Protocol):
    """A Publisher, or a list in a test."""

    def send(self, message: ViewMessage) -> object:
        """Hand over a view."""
        ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Hand over an end-of-stream, to follow the last view."""
        ...

    def note(self, topic: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Hand over a status, event or meta note."""
        ...

    def hurry(self) -> None:
        """Stop waiting for readers."""
        ...

    @property
    def stats(self) -> PublisherStats:
        """What has left."""
        ...
