"""Who wants what of the data socket: subscriptions counted by what they get. No socket in here."""

from collections import Counter
from dataclasses import dataclass

from gcd_node.envelope import PREVIEW_TOPIC, WELCOME, topic_key

_PREVIEW_KEY = topic_key(PREVIEW_TOPIC)


@dataclass(frozen=True, kw_only=True, slots=True)
class Readers:
    """How many there are at one moment.

    total: subscriptions. previews: those that get the preview of the input. previews_alone: those that get nothing
    else.
    """

    total: int = 0
    previews: int = 0
    previews_alone: int = 0

    @property
    def watchers(self) -> int:
        """Those that get views."""
        return self.total - self.previews_alone


NOBODY = Readers()


class Subscriptions:
    """Counts subscriptions as they come and go. now: may be read from any thread."""

    def __init__(self) -> None:
        self.now = NOBODY
        self._topics: Counter[bytes] = Counter()

    def hear(self, event: bytes) -> None:
        """Take note of a subscription (first byte 1) or of its end (first byte 0).

        One to the welcome message alone is none. What nobody has asked for cannot be taken back: noise on the socket
        can look like that, and must not make readers disappear.
        """
        topic = event[1:]
        if topic and topic == WELCOME[: len(topic)]:
            return
        if event[0]:
            self._topics[topic] += 1
            self._add(topic, 1)
        elif topic in self._topics:
            self._topics[topic] -= 1
            if self._topics[topic] == 0:
                del self._topics[topic]
            self._add(topic, -1)

    def _add(self, topic: bytes, count: int) -> None:
        """Without looking at the others: a client may subscribe to as many topics as it likes. ZeroMQ matches prefixes,
        so a subscription to everything gets views and previews."""
        now, preview = self.now, _PREVIEW_KEY.startswith(topic)
        self.now = Readers(
            total=now.total + count,
            previews=now.previews + count * preview,
            previews_alone=now.previews_alone + count * (preview and topic != b""),
        )
