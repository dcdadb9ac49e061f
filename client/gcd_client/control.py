"""Commands a node, or asks it: the other end of its control socket (docs/protocol.md, section 5).

    with ControlClient("ipc") as node:
        node.call("set_view", {"view": "top", "azimuth_deg": 30.0})

`request_async` and `call_async` do the same for asyncio. A client belongs to one thread.
"""

import enum
import time
import uuid
from collections.abc import Mapping
from typing import Annotated, TypeAlias

import msgspec
import zmq
from msgspec import Meta

from gcd_client.endpoints import Client, ClientKeys, Connection, Steps, fingerprint, resolve_endpoint
from gcd_client.protocol import LARGEST_INTEGER, PROTO, ClientError, MessageError, check_version

MAX_REQUEST = 64 * 1024  # bytes; ZeroMQ drops a peer that sends more
MAX_REPLY = 4 * 1024 * 1024
RequestId: TypeAlias = Annotated[str, Meta(pattern=r"^[!-~]{1,64}\Z")]
Args: TypeAlias = Mapping[str, object] | None
Rev: TypeAlias = int | None  # a view's revision
Result: TypeAlias = dict[str, object]
_REASON_MS = 1000


class Code(str, enum.Enum):
    """How a request ended. ACCEPTED: begun, an event tells how it ends."""

    OK = "OK"
    ACCEPTED = "ACCEPTED"
    BAD_JSON = "BAD_JSON"
    BAD_PROTO = "BAD_PROTO"
    UNKNOWN_VERB = "UNKNOWN_VERB"
    BAD_ARG = "BAD_ARG"
    OUT_OF_RANGE = "OUT_OF_RANGE"
    VIEW_FIXED = "VIEW_FIXED"
    UNKNOWN_VIEW = "UNKNOWN_VIEW"
    WRONG_STATE = "WRONG_STATE"
    BUSY = "BUSY"
    FORBIDDEN = "FORBIDDEN"
    TOO_LARGE = "TOO_LARGE"
    NOT_READY = "NOT_READY"
    INTERNAL = "INTERNAL"

    __str__ = str.__str__


class ControlError(ClientError):
    """A command was refused, or nobody answered. code: of the refusal; None: no answer."""

    def __init__(self, message: str, code: str | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.exit_code = 69 if code is None else 70


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """id: new for each request; the same within 60 s is a repeat and gets the same reply. dry_run: check everything,
    change nothing. if_view_rev: only if the view named still has this revision."""

    proto: str
    id: RequestId
    verb: str
    args: msgspec.Raw = msgspec.Raw(b"{}")
    dry_run: bool = False
    if_view_rev: Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)] | None = None


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """ok: the code is OK or ACCEPTED. state: of the node's lifecycle. result: the answer, or what is allowed."""

    id: str
    ok: bool
    code: Code
    message: str
    state: str
    result: Result | None = None
    proto: str = PROTO


def encode_request(request: Request) -> bytes:
    """One JSON part. Raises ControlError: TOO_LARGE."""
    part = msgspec.json.encode(request)
    if len(part) > MAX_REQUEST:
        raise ControlError(f"a request has at most {MAX_REQUEST} bytes, got {len(part)}", Code.TOO_LARGE)
    return part


def decode_reply(part: bytes) -> Reply:
    """Inverse of the node's encoding. Raises ControlError: no reply, or another major version's."""
    try:
        reply = msgspec.json.decode(part, type=Reply)
        check_version(reply.proto)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, MessageError) as error:
        raise ControlError(f"{error!s:.200}: this is no reply of a gcd node; is it its control endpoint?") from error
    return reply


class ControlClient(Client):
    """Sends one request at a time and waits for its reply.

    endpoint: "ipc" for the node on this machine, or ipc://PATH, tcp://HOST:PORT. keys: for a node that asks for them.
    timeout_s: how long to wait for a reply. attempts: how often the same request, under the same id, is sent in that
        time; the node carries it out once.

    Every request raises ControlError (no answer in time, or no reply; TOO_LARGE before anything is sent) and AuthError
    (the node refuses the connection; then make a new client).
    """

    def __init__(
        self, endpoint: str = "ipc", *, keys: ClientKeys | None = None, timeout_s: float = 2.0, attempts: int = 2
    ) -> None:
        self.endpoint = resolve_endpoint(endpoint, "control")
        self._keys, self._timeout_s, self._attempts = keys, timeout_s, max(1, attempts)
        self._connection = Connection(self.endpoint, zmq.DEALER, keys, {zmq.MAXMSGSIZE: MAX_REPLY})

    def request(
        self, verb: str, args: Args = None, *, dry_run: bool = False, if_view_rev: Rev = None, request_id: str = ""
    ) -> Reply:
        """Send a request and give its reply, a refusal too. request_id: to repeat a request; else a new one."""
        return self._connection.run(self._steps(verb, args, dry_run, if_view_rev, request_id))

    async def request_async(
        self, verb: str, args: Args = None, *, dry_run: bool = False, if_view_rev: Rev = None, request_id: str = ""
    ) -> Reply:
        """request() for asyncio."""
        return await self._connection.run_async(self._steps(verb, args, dry_run, if_view_rev, request_id))

    def call(self, verb: str, args: Args = None) -> Result:
        """Send a request and give its result, {}: none. Raises ControlError with the code of a refusal, too."""
        return _result(verb, self.request(verb, args))

    async def call_async(self, verb: str, args: Args = None) -> Result:
        """call() for asyncio."""
        return _result(verb, await self.request_async(verb, args))

    def _steps(self, verb: str, args: Args, dry_run: bool, if_view_rev: Rev, request_id: str) -> Steps[Reply]:
        raw, new_id = msgspec.Raw(msgspec.json.encode(dict(args or {}))), request_id or uuid.uuid4().hex
        request = Request(proto=PROTO, id=new_id, verb=verb, args=raw, dry_run=dry_run, if_view_rev=if_view_rev)
        part, connection = encode_request(request), self._connection
        for _ in range(self._attempts):
            try:
                connection.socket.send(part, zmq.NOBLOCK)
            except zmq.Again as error:
                connection.check(_REASON_MS)  # a refused client loses the pipe a moment before the reason arrives
                raise ControlError(f"{self.endpoint} takes no more requests; is the node running?") from error
            deadline_s = time.monotonic() + self._timeout_s / self._attempts
            while (yield from connection.wait(deadline_s)):
                reply = decode_reply(connection.socket.recv_multipart()[-1])
                if reply.id == new_id:  # others are of requests given up
                    return reply
        other = "" if self._keys is None else f", and its key really {fingerprint(self._keys.server)}"
        question = f"is the node running, is this its control endpoint{other}?"
        raise ControlError(f"{self.endpoint} did not answer {verb} within {self._timeout_s:g} s; {question}")


def _result(verb: str, reply: Reply) -> Result:
    if not reply.ok:
        raise ControlError(f"{verb}: {reply.code}: {reply.message}", reply.code)
    return reply.result or {}
