"""What keeps the control socket safe from its clients: replies kept for repeats, and deaf ears for a flood.

Pure: the time comes as an argument, monotonic seconds.
"""

import hashlib
from collections import OrderedDict, deque
from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class _Kept:
    digest: bytes
    reply: bytes
    until_s: float


class ReplyCache:
    """Replies of the last seconds, so that a request sent twice is carried out once.

    The key says who asked and under which id; the same id for another request is no repeat.
    """

    def __init__(self, seconds: float, most: int, most_bytes: int) -> None:
        self._seconds, self._most, self._most_bytes = seconds, most, most_bytes
        self._kept: OrderedDict[Hashable, _Kept] = OrderedDict()
        self._bytes = 0

    def find(self, key: Hashable, request: bytes, now_s: float) -> bytes | None:
        """The reply to the same request under this key, None if there is none.

        Raises:
            KeyError: the key was used for another request.
        """
        self._expire(now_s)
        kept = self._kept.get(key)
        if kept is None:
            return None
        if kept.digest != _digest(request):
            raise KeyError(key)
        return kept.reply

    def keep(self, key: Hashable, request: bytes, reply: bytes, now_s: float) -> None:
        """Remember a reply; the oldest make way when it gets too much."""
        self._kept[key] = _Kept(digest=_digest(request), reply=reply, until_s=now_s + self._seconds)
        self._bytes += len(reply)
        while len(self._kept) > self._most or self._bytes > self._most_bytes:
            self._drop_oldest()

    def __len__(self) -> int:
        return len(self._kept)

    def _expire(self, now_s: float) -> None:
        while self._kept and next(iter(self._kept.values())).until_s <= now_s:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        self._bytes -= len(self._kept.popitem(last=False)[1].reply)


class FloodGuard:
    """Ignores a peer for a while that sends too much nonsense; its length is the peers remembered."""

    def __init__(self, most_per_s: int, ignore_s: float, most_peers: int = 256) -> None:
        self._most, self._ignore_s, self._most_peers = most_per_s, ignore_s, most_peers
        self._bad_s: OrderedDict[bytes, deque[float]] = OrderedDict()
        self._ignored_until_s: dict[bytes, float] = {}

    def __len__(self) -> int:
        return len(self._bad_s)

    def ignores(self, peer: bytes, now_s: float) -> bool:
        """Whether to throw away what this peer sends."""
        until_s = self._ignored_until_s.get(peer)
        if until_s is None:
            return False
        if now_s < until_s:
            return True
        del self._ignored_until_s[peer]
        return False

    def bad(self, peer: bytes, now_s: float) -> bool:
        """Count a malformed request; True if the peer is ignored from now on."""
        times = self._bad_s.pop(peer, None) or deque[float](maxlen=self._most + 1)
        self._bad_s[peer] = times  # the peers heard last are at the end
        times.append(now_s)
        if len(self._bad_s) > self._most_peers:
            self._bad_s.popitem(last=False)
        if len(times) <= self._most or now_s - times[0] > 1.0:
            return False
        del self._bad_s[peer]
        self._ignored_until_s = {each: until for each, until in self._ignored_until_s.items() if until > now_s}
        self._ignored_until_s[peer] = now_s + self._ignore_s
        return True


def _digest(request: bytes) -> bytes:
    return hashlib.sha256(request).digest()
