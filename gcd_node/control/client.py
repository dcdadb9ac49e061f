"""Commands a node, or asks it: the other end of the control socket.

    with ControlClient("ipc") as node:
        node.call("set_view", {"view": "top", "azimuth_deg": 30.0})

A client belongs to one thread.
"""

import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType

import msgspec
import zmq

from gcd_node.control.message import MAX_REPLY, Reply, Request, decode_reply, encode_request
from gcd_node.errors import ControlError
from gcd_node.security.gate import HandshakeWatch, use_client_keys
from gcd_node.security.keys import ClientKeys, fingerprint
from gcd_node.wire.endpoints import is_ipv6, resolve_endpoint
from gcd_node.wire.header import PROTO

_SECOND_NS = 1_000_000_000
_REASON_MS = 1000


@dataclass(frozen=True, kw_only=True, slots=True)
class ClockOffset:
    """The node's wall clock minus ours, and how long the way there and back took; the offset is at most half of that
    wrong."""

    offset_ns: int
    delay_ns: int


class ControlClient:
    """Sends one request at a time and waits for its reply.

    endpoint: "ipc" for the node on this machine, or ipc://PATH, tcp://HOST:PORT. keys: for a node that asks for them.
    timeout_s: how long to wait for a reply. attempts: how often the same request, under the same id, is sent in that
        time; the node carries it out once.

    Raises:
        ConfigError: the endpoint is none, or a key is not the other's half.
    """

    def __init__(
        self, endpoint: str = "ipc", *, keys: ClientKeys | None = None, timeout_s: float = 2.0, attempts: int = 2
    ) -> None:
        self.endpoint = resolve_endpoint(endpoint, "control")
        self._keys, self._timeout_s, self._attempts = keys, timeout_s, max(1, attempts)
        self._context = zmq.Context()
        try:
            self._socket = self._context.socket(zmq.DEALER)
            self._socket.set(zmq.LINGER, 0)
            self._socket.set(zmq.IPV6, int(is_ipv6(self.endpoint)))
            self._socket.set(zmq.MAXMSGSIZE, MAX_REPLY)
            if keys is not None:
                use_client_keys(self._socket, keys)
            self._watch = HandshakeWatch(self._socket, self.endpoint, keys)
            self._poller = zmq.Poller()
            for each in (self._socket, self._watch.monitor):
                self._poller.register(each, zmq.POLLIN)
            self._socket.connect(self.endpoint)
        except BaseException:
            self._context.destroy(linger=0)
            raise

    def request(
        self,
        verb: str,
        args: Mapping[str, object] | None = None,
        *,
        dry_run: bool = False,
        if_view_rev: int | None = None,
        request_id: str | None = None,
    ) -> Reply:
        """Send a request and give its reply, a refusal too.

        Raises:
            ControlError: nobody answered in time, or what came is no reply; TOO_LARGE before anything is sent.
            AuthError: the node does not let us in; then make a new client.
        """
        request = Request(
            proto=PROTO,
            id=request_id or uuid.uuid4().hex,
            verb=verb,
            args=msgspec.Raw(msgspec.json.encode(dict(args or {}))),
            dry_run=dry_run,
            if_view_rev=if_view_rev,
        )
        part = encode_request(request)
        for _ in range(self._attempts):
            self._send(part)
            reply = self._await(request.id, time.monotonic() + self._timeout_s / self._attempts)
            if reply is not None:
                return reply
        other = "" if self._keys is None else f", and its key really {fingerprint(self._keys.server)}"
        raise ControlError(
            f"{self.endpoint} did not answer {verb} within {self._timeout_s:g} s; is the node running, is this its "
            f"control endpoint{other}?"
        )

    def call(
        self,
        verb: str,
        args: Mapping[str, object] | None = None,
        *,
        dry_run: bool = False,
        if_view_rev: int | None = None,
    ) -> dict[str, object]:
        """Send a request and give its result, {} if there is none.

        Raises:
            ControlError: refused, with the code; else as request(). AuthError: as request().
        """
        reply = self.request(verb, args, dry_run=dry_run, if_view_rev=if_view_rev)
        if not reply.ok:
            raise ControlError(f"{verb}: {reply.code}: {reply.message}", reply.code)
        return reply.result or {}

    def clock(self) -> ClockOffset:
        """How the node's clock stands to ours, by one exchange. Raises ControlError, AuthError as call()."""
        sent_ns = time.time_ns()
        result = self.call("time")
        back_ns = time.time_ns()
        try:
            there_ns, left_ns = (_nanoseconds(result[name]) for name in ("t_rx", "t_tx"))
        except (KeyError, msgspec.ValidationError) as error:
            raise ControlError(f"{self.endpoint} gave no time that can be read: {error}") from error
        offset_ns = ((there_ns - sent_ns) + (left_ns - back_ns)) // 2
        return ClockOffset(offset_ns=offset_ns, delay_ns=(back_ns - sent_ns) - (left_ns - there_ns))

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._context.destroy(linger=0)

    def __enter__(self) -> "ControlClient":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _send(self, part: bytes) -> None:
        try:
            self._socket.send(part, zmq.NOBLOCK)
        except zmq.Again as error:
            self._watch.check(_REASON_MS)  # who is refused loses the pipe a moment before the reason arrives
            raise ControlError(f"{self.endpoint} takes no more requests; is the node running?") from error

    def _await(self, request_id: str, deadline_s: float) -> Reply | None:
        """The reply with this id; older ones, of requests given up, are thrown away."""
        self._watch.check()
        while ready := dict(self._poller.poll(max(0, round((deadline_s - time.monotonic()) * 1000)))):
            if self._socket not in ready:
                self._watch.check()
                continue
            parts = self._socket.recv_multipart()
            reply = decode_reply(parts[-1])
            if reply.id == request_id:
                return reply
        return None


def _nanoseconds(pair: object) -> int:
    seconds, rest = msgspec.convert(pair, tuple[int, int])
    return seconds * _SECOND_NS + rest
