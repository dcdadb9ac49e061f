"""The control socket: one thread owns the ROUTER and answers at once (wire protocol, section 5).

Who reaches it over ipc, or over loopback where no keys are set up, is an operator: it is this machine's own user.
Elsewhere the key decides.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, TypeAlias

import msgspec
import zmq

from gcd_client.control import MAX_REPLY, MAX_REQUEST, Code, Reply, Request
from gcd_client.protocol import ClientError
from gcd_node.auth import Client, EventSink, Role, ServerSecurity, SocketGuard, unbind
from gcd_node.binding import own_endpoint
from gcd_node.control.limits import FloodGuard, ReplyCache
from gcd_node.control.message import Command, Outcome, RequestError, parse_command, parse_request
from gcd_node.control.verbs import VERBS
from gcd_node.errors import NodeError

_LOG = logging.getLogger(__name__)
_TICK_MS = 50
_LINGER_MS = 500
_QUEUED = 16
_SECOND_NS = 1_000_000_000
_LARGEST_READ = 4 * MAX_REQUEST  # what is longer than a request is refused with a reason, up to here
_MALFORMED = (Code.BAD_JSON, Code.BAD_PROTO, Code.TOO_LARGE)
_LOCAL = Client(name="", role="operator")


AnswerSink: TypeAlias = Callable[[bytes, bytes, Client], None]
"""Gets every request, its reply as it was sent, and who asked; called in the control thread, returns at once."""


class Commands(Protocol):
    """Who carries commands out."""

    def handle(self, command: Command, role: Role) -> Outcome:
        """Do it, or begin it and say ACCEPTED. Called in the control thread: never blocks longer than a few ms.

        `role` may say the verb, that is checked; `time` never comes here, and no repeat of a request.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class ControlOptions:
    """Where to listen, who may connect over tcp, and how much a client may ask.

    keep_s: how long a request's id is remembered. bad_per_s: more malformed requests in a second, and the client is
    ignored for ignore_s.
    """

    endpoint: str = "ipc"
    security: ServerSecurity | None = None
    keep_s: float = 60.0
    bad_per_s: int = 20
    ignore_s: float = 5.0


class ControlServer:
    """Answers requests until closed. Use it as a context manager.

    state: the node's lifecycle state, for every reply. on_event: gets AUTH_DENIED, TOO_LARGE and CONTROL_FLOOD, each
    with its fields. on_answer: see AnswerSink. All are called from threads of this server.

    Raises:
        EndpointError: the endpoint is in use or cannot be bound.
        ConfigError: the endpoint is none, or others than this machine could reach it without keys.
    """

    def __init__(
        self,
        options: ControlOptions,
        commands: Commands,
        state: Callable[[], str],
        on_event: EventSink,
        on_answer: AnswerSink | None = None,
    ) -> None:
        self._on_event, self._on_answer = on_event, on_answer
        self._answers = Answers(commands, state, options.keep_s)
        self._flood = FloodGuard(options.bad_per_s, options.ignore_s)
        self._ignore_s = options.ignore_s
        self._closing = threading.Event()
        self._context = zmq.Context()
        self._guard = SocketGuard(self._context, options.security, on_event)
        try:
            self._socket = _router(self._context)
            self.endpoint = self._guard.bind(self._socket, own_endpoint(options.endpoint, "control"), "control")
        except BaseException:
            self._guard.close()
            self._context.destroy(linger=0)
            raise
        self._security = options.security if self.endpoint.startswith("tcp://") else None
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._thread.start()

    def dead_threads(self) -> list[str]:
        """Threads of this server that have died."""
        alive = {"control": self._thread.is_alive(), "control authentication": self._guard.alive}
        return [] if self._closing.is_set() else [name for name, lives in alive.items() if not lives]

    def close(self) -> None:
        """Stop answering; replies on their way get half a second to leave. A second call does nothing."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join()
        self._guard.close()
        self._context.term()

    def __enter__(self) -> "ControlServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    # What follows runs in the control thread alone.

    def _serve(self) -> None:
        try:
            while not self._closing.is_set():
                self._guard.report_failures()
                if self._socket.poll(_TICK_MS):
                    self._receive_safely()
        except Exception:
            _LOG.exception("the control thread died")
        finally:
            unbind(self._socket, self.endpoint, _LINGER_MS)

    def _receive_safely(self) -> None:
        try:
            self._receive()
        except Exception:
            _LOG.exception("one request stays without a reply; the control socket goes on")

    def _receive(self) -> None:
        received_ns = time.time_ns()
        peer, *parts = self._socket.recv_multipart(copy=False)
        if self._flood.ignores(peer.bytes, time.monotonic()):
            return
        client = self._client(parts[-1]) if parts else None
        if client is None:
            return
        answer = self._answers.answer([part.bytes for part in parts], client, received_ns)
        if answer.code is Code.TOO_LARGE:
            _LOG.warning("TOO_LARGE: refused a request of %d bytes", len(parts[0]))
            self._on_event("TOO_LARGE", {"level": 1, "channel": "control"})
        if answer.code in _MALFORMED and self._flood.bad(peer.bytes, time.monotonic()):
            _LOG.warning("CONTROL_FLOOD: a client sends nonsense and is ignored for %g s", self._ignore_s)
            self._on_event("CONTROL_FLOOD", {"level": 1, "client": client.name, "ignored_s": self._ignore_s})
            return
        self._socket.send_multipart((peer.bytes, answer.part), zmq.NOBLOCK)  # to a peer that left: thrown away
        if self._on_answer is not None:
            self._on_answer(parts[0].bytes, answer.part, client)

    def _client(self, frame: zmq.Frame) -> Client | None:
        """Who sent this, by his key; None if the key was taken off the list since."""
        return _LOCAL if self._security is None else self._security.find_client(str(frame.get("User-Id")))


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """A reply as bytes. code: why it could not be read as a request; None if it could."""

    part: bytes
    code: Code | None = None


class Answers:
    """Turns requests into replies; knows no socket. One thread uses it."""

    def __init__(self, commands: Commands, state: Callable[[], str], keep_s: float) -> None:
        self._commands, self._state = commands, state
        self._kept: dict[Role, ReplyCache] = {  # apart, so that who only looks cannot push out an operator's
            "operator": ReplyCache(keep_s, most=4096, most_bytes=16 * 1024 * 1024),
            "viewer": ReplyCache(keep_s, most=1024, most_bytes=4 * 1024 * 1024),
        }

    def answer(self, parts: list[bytes], client: Client, received_ns: int) -> Answer:
        """The reply to what arrived in one message, at `received_ns` of the wall clock. Never raises."""
        try:
            if len(parts) != 1:
                raise RequestError(f"a request is one part, got {len(parts)}; use a DEALER socket", Code.BAD_JSON)
            request = parse_request(parts[0])
            return Answer(part=self._reply(request, parts[0], client, received_ns))
        except RequestError as error:
            outcome = Outcome(code=error.reason, message=str(error), result=error.result)
            return Answer(part=self._encoded(error.request_id, outcome), code=error.reason)

    def _reply(self, request: Request, part: bytes, client: Client, received_ns: int) -> bytes:
        """Raises RequestError."""
        command = parse_command(request)
        needed = VERBS[command.verb].role
        if needed == "operator" and client.role != "operator":
            message = f"{command.verb} needs the operator role, {client.name or 'this client'} is a {client.role}"
            raise RequestError(message, Code.FORBIDDEN, request.id)
        cache, key = self._kept[needed], (client.name, request.id)
        try:
            kept = cache.find(key, part, time.monotonic())
        except KeyError as error:
            message = f"the id {request.id} was used for another request; take a new one for each"
            raise RequestError(message, Code.BAD_ARG, request.id) from error
        if kept is not None:
            return kept
        reply = self._encoded(request.id, self._outcome(command, client.role, received_ns))
        cache.keep(key, part, reply, time.monotonic())
        return reply

    def _outcome(self, command: Command, role: Role, received_ns: int) -> Outcome:
        if command.verb == "time":
            return Outcome(result={"t_rx": divmod(received_ns, _SECOND_NS), "t_tx": divmod(time.time_ns(), _SECOND_NS)})
        try:
            return self._commands.handle(command, role)
        except RequestError as error:
            return Outcome(code=error.reason, message=str(error), result=error.result)
        except (NodeError, ClientError) as error:
            return Outcome(code=Code.INTERNAL, message=str(error))
        except Exception as error:
            _LOG.exception("%s failed", command.verb)
            return Outcome(code=Code.INTERNAL, message=f"{command.verb} failed: {type(error).__name__}; see the log")

    def _encoded(self, request_id: str, outcome: Outcome) -> bytes:
        try:
            part = self._written(request_id, outcome)
        except (TypeError, ValueError, RecursionError, OverflowError):
            _LOG.exception("a result is not plain JSON")
            return self._written(request_id, Outcome(code=Code.INTERNAL, message="the result is not plain JSON"))
        if len(part) > MAX_REPLY:
            message = f"the result has {len(part)} bytes, a reply at most {MAX_REPLY}"
            return self._written(request_id, Outcome(code=Code.INTERNAL, message=message))
        return part

    def _written(self, request_id: str, outcome: Outcome) -> bytes:
        reply = Reply(
            id=request_id,
            ok=outcome.ok,
            code=outcome.code,
            message=outcome.message,
            state=self._state(),
            result=outcome.result,
        )
        return msgspec.json.encode(reply)


def _router(context: "zmq.Context[zmq.Socket[bytes]]") -> "zmq.Socket[bytes]":
    socket = context.socket(zmq.ROUTER)
    socket.set(zmq.ROUTER_HANDOVER, 0)
    socket.set(zmq.MAXMSGSIZE, _LARGEST_READ)  # of each part; libzmq hangs up on whoever sends more
    socket.set(zmq.RCVHWM, _QUEUED)
    socket.set(zmq.SNDHWM, _QUEUED)
    socket.set(zmq.LINGER, 0)
    return socket
