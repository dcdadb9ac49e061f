"""The control socket: one thread owns the ROUTER and answers at once (wire protocol, section 5).

Who reaches it over ipc, or over loopback where no keys are set up, is an operator: it is this machine's own user.
Elsewhere the key decides. The client: gcd_client.control.
"""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeAlias

import msgspec
import zmq

from gcd_client.control import MAX_REPLY, MAX_REQUEST, Code, Reply
from gcd_client.protocol import ClientError
from gcd_node.auth import Client, EventSink, Role, ServerSecurity, SocketGuard, unbind
from gcd_node.errors import NodeError
from gcd_node.health import Level
from gcd_node.verbs import VERBS, Command, Outcome, RequestError, parse_command

_LOG = logging.getLogger(__name__)
_LINGER_MS = 500
_QUEUED = 16
_SECOND_NS = 1_000_000_000
_LARGEST_READ = 4 * MAX_REQUEST  # what is longer than a request is refused with a reason, up to here
_MALFORMED = (Code.BAD_JSON, Code.BAD_PROTO, Code.TOO_LARGE)
_KEEP_S, _OVERHEAD = 60.0, 500  # of a reply that is kept: seconds; bytes beside itself and its request
_MOST_BAD_PER_S, _MOST_PEERS = 20, 256
_LOCAL = Client(name="", role="operator")

AnswerSink: TypeAlias = Callable[[bytes, bytes, Client], None]
"""Gets every request, its reply as it was sent, and who asked; called in the control thread, returns at once."""


CommandHandler: TypeAlias = Callable[[Command, Role], Outcome]
"""Carries a command out, or begins it and says ACCEPTED: NodeCommands.handle. Called in the control thread, so it takes
a few ms at most. The role may use the verb, that is checked; `time` never comes here, and no repeat of a request."""


class ControlServer:
    """Answers requests until closed.

    state: the node's lifecycle state, for every reply. on_event: gets AUTH_DENIED, TOO_LARGE and CONTROL_FLOOD.
    on_answer: see AnswerSink. All are called from threads of this server. ignore_s: for how long a client that sends
    too much nonsense is ignored.

    Raises:
        EndpointError: the endpoint is in use or cannot be bound.
        ConfigError: the endpoint is none, or others than this machine could reach it without keys.
    """

    def __init__(
        self,
        endpoint: str,
        handle: CommandHandler,
        state: Callable[[], str],
        on_event: EventSink,
        on_answer: AnswerSink | None = None,
        *,
        security: ServerSecurity | None = None,
        ignore_s: float = 5.0,
    ) -> None:
        self._handle, self._state, self._on_event, self._on_answer = handle, state, on_event, on_answer
        self._ignore_s, self._flood = ignore_s, FloodGuard(ignore_s)
        self._kept: dict[Role, ReplyCache] = {  # apart, so that who only looks cannot push out an operator's
            "operator": ReplyCache(_KEEP_S, most_bytes=16 * 1024 * 1024),
            "viewer": ReplyCache(_KEEP_S, most_bytes=4 * 1024 * 1024),
        }
        self._closing = threading.Event()
        self.guard = SocketGuard(security, on_event)
        try:
            self._socket = self.guard.context.socket(zmq.ROUTER)
            self._socket.set(zmq.ROUTER_HANDOVER, 0)
            self._socket.set(zmq.MAXMSGSIZE, _LARGEST_READ)  # of each part; who sends more is disconnected
            for limit in (zmq.RCVHWM, zmq.SNDHWM):
                self._socket.set(limit, _QUEUED)
            self._socket.set(zmq.LINGER, 0)
            self.endpoint = self.guard.bind(self._socket, endpoint, "control")
        except BaseException:
            self.guard.close()
            raise
        self._security = security if self.endpoint.startswith("tcp://") else None
        self.thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """Stop answering; replies on their way get half a second to leave. A second call does nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        self.guard.wake()
        self.thread.join()
        self.guard.close()

    # What follows runs in the control thread alone.

    def _serve(self) -> None:
        try:
            while not self._closing.is_set():
                self.guard.wait()
                if self._socket.poll(0) and not self._closing.is_set():
                    try:
                        self._receive()
                    except Exception:
                        _LOG.exception("one request stays without a reply; the control socket goes on")
        except Exception:
            _LOG.exception("the control thread died")
        finally:
            unbind(self._socket, self.endpoint, _LINGER_MS)

    def _receive(self) -> None:
        received_ns = time.time_ns()
        peer, *parts = self._socket.recv_multipart(copy=False)
        if self._flood.ignores(peer.bytes, time.monotonic()):
            return
        client = self._client(parts[-1]) if parts else None
        if client is None:
            return
        reply, refusal = self._answer([part.bytes for part in parts], client, received_ns)
        if refusal is Code.TOO_LARGE:
            self._on_event("TOO_LARGE", Level.WARN, {"channel": "control"})
        if refusal in _MALFORMED and self._flood.bad(peer.bytes, time.monotonic()):
            self._on_event("CONTROL_FLOOD", Level.WARN, {"client": client.name, "ignored_s": self._ignore_s})
            return
        self._socket.send_multipart((peer.bytes, reply), zmq.NOBLOCK)  # to a peer that left: thrown away
        if self._on_answer is not None:
            self._on_answer(parts[0].bytes, reply, client)

    def _client(self, frame: zmq.Frame) -> Client | None:
        """Who sent this, by his key; None if the key was taken off the list since."""
        return _LOCAL if self._security is None else self._security.find_client(str(frame.get("User-Id")))

    def _answer(self, parts: list[bytes], client: Client, received_ns: int) -> tuple[bytes, Code | None]:
        """The reply to what arrived in one message at `received_ns` of the wall clock, and why it is no command; None
        if it is one."""
        request_id = ""
        try:
            if len(parts) != 1:
                raise RequestError(f"a request is one part, got {len(parts)}; use a DEALER socket", Code.BAD_JSON)
            command = parse_command(parts[0])
            request_id, needed = command.id, VERBS[command.verb].role
            if needed == "operator" and client.role != "operator":
                message = f"{command.verb} needs the operator role, {client.name or 'this client'} is a {client.role}"
                raise RequestError(message, Code.FORBIDDEN)
            cache, key = self._kept[needed], (client.name, command.id)
            try:
                reply = cache.find(key, parts[0], time.monotonic())
            except KeyError as error:
                message = f"the id {command.id} was used for another request; take a new one for each"
                raise RequestError(message, Code.BAD_ARG) from error
            if reply is None:
                reply = self._carried_out(command, client.role, received_ns)
                cache.keep(key, parts[0], reply, time.monotonic())
            return reply, None
        except RequestError as error:
            return self._encoded(error.request_id or request_id, _refusal(error)), error.reason

    def _carried_out(self, command: Command, role: Role, received_ns: int) -> bytes:
        try:
            if command.verb == "time":
                times = {"t_rx": divmod(received_ns, _SECOND_NS), "t_tx": divmod(time.time_ns(), _SECOND_NS)}
                return self._encoded(command.id, Outcome(result={**times}))
            return self._encoded(command.id, self._handle(command, role))
        except RequestError as error:
            outcome = _refusal(error)
        except (NodeError, ClientError) as error:
            outcome = Outcome(code=Code.INTERNAL, message=str(error))
        except Exception as error:
            _LOG.exception("%s failed", command.verb)
            message = f"{command.verb} failed: {type(error).__name__}; see the log"
            outcome = Outcome(code=Code.INTERNAL, message=message)
        return self._encoded(command.id, outcome)

    def _encoded(self, request_id: str, outcome: Outcome) -> bytes:
        """Raises NodeError: too long."""
        code = outcome.code
        ok, state = code in (Code.OK, Code.ACCEPTED), self._state()
        reply = Reply(id=request_id, ok=ok, code=code, message=outcome.message, state=state, result=outcome.result)
        part = msgspec.json.encode(reply)
        if len(part) > MAX_REPLY:
            raise NodeError(f"the result has {len(part)} bytes, a reply at most {MAX_REPLY}")
        return part


def _refusal(error: RequestError) -> Outcome:
    return Outcome(code=error.reason, message=str(error), result=error.result)


class ReplyCache:
    """Replies of the last seconds, so that a request sent twice is carried out once. Time: monotonic seconds.

    The key says who asked and under which id; the same id for another request is no repeat.
    """

    def __init__(self, seconds: float, most_bytes: int) -> None:
        self._seconds, self._most_bytes = seconds, most_bytes
        self._kept: OrderedDict[Hashable, tuple[bytes, bytes, float]] = OrderedDict()  # request, reply, until
        self._bytes = 0

    def find(self, key: Hashable, request: bytes, now_s: float) -> bytes | None:
        """The reply to the same request under this key, None if there is none.

        Raises:
            KeyError: the key was used for another request.
        """
        while self._kept and next(iter(self._kept.values()))[2] <= now_s:
            self._drop_oldest()
        if key not in self._kept:
            return None
        before, reply, _ = self._kept[key]
        if before != request:
            raise KeyError(key)
        return reply

    def keep(self, key: Hashable, request: bytes, reply: bytes, now_s: float) -> None:
        """Remember a reply; the oldest make way when it gets too much."""
        self._kept[key] = request, reply, now_s + self._seconds
        self._bytes += len(request) + len(reply) + _OVERHEAD
        while self._bytes > self._most_bytes:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        _, (request, reply, _) = self._kept.popitem(last=False)
        self._bytes -= len(request) + len(reply) + _OVERHEAD


class FloodGuard:
    """Ignores a peer for `ignore_s` that sends more than 20 malformed requests in a second. Time: monotonic seconds."""

    def __init__(self, ignore_s: float) -> None:
        self._ignore_s = ignore_s
        self._bad: OrderedDict[bytes, tuple[float, int]] = OrderedDict()
        """Since when each peer sent so many, or is ignored; those that were bad last are at the end."""

    def ignores(self, peer: bytes, now_s: float) -> bool:
        """Whether to throw away what this peer sends."""
        since_s, count = self._bad.get(peer, (now_s, 0))
        return count > _MOST_BAD_PER_S and now_s - since_s < self._ignore_s

    def bad(self, peer: bytes, now_s: float) -> bool:
        """Count a malformed request; True if the peer is ignored from now on."""
        since_s, count = self._bad.pop(peer, (now_s, 0))
        if now_s - since_s > 1.0:
            since_s, count = now_s, 0
        is_flood = count == _MOST_BAD_PER_S
        self._bad[peer] = (now_s if is_flood else since_s, count + 1)
        if len(self._bad) > _MOST_PEERS:  # who is ignored is forgotten last
            del self._bad[min(self._bad, key=lambda each: self.ignores(each, now_s))]
        return is_flood
