"""What a publisher is told, and what it tells."""

from dataclasses import dataclass

from gcd_node.publishing.subscriptions import NOBODY, Readers
from gcd_node.security.gate import ServerSecurity


@dataclass(frozen=True, kw_only=True, slots=True)
class PublisherOptions:
    """Where and how to send.

    data, status: endpoints, or "ipc" for the runtime folder; status None opens no status socket.
    lockstep: wait for slow readers instead of skipping, and for min_subscribers before the first message.
    end_delay_ms: how long an end-of-stream message follows the last window, so that a conflated reader gets both.
    linger_ms: how long an orderly close waits for readers to take the end and leave; drain_ms: the same in lockstep,
        and there also how long a queued message may wait for a reader.
    queue_size: messages between the callers and the thread.
    security: keys and allowed clients of tcp endpoints; without them only this machine can be let in.
    """

    data: str = "ipc"
    status: str | None = "ipc"
    lockstep: bool = False
    min_subscribers: int = 0
    end_delay_ms: int = 500
    linger_ms: int = 1000
    drain_ms: int = 5000
    queue_size: int = 8
    security: ServerSecurity | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class PublisherStats:
    """sent, bytes: handed to ZeroMQ on the data socket. dropped: refused because the queue was full.
    subscribers: subscriptions on the data socket now; readers: the same by what they get. What ZeroMQ drops for a slow
    reader shows in no counter here: that reader sees a gap in the sequence."""

    sent: int
    dropped: int
    subscribers: int
    bytes: int
    readers: Readers = NOBODY
