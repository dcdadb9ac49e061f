"""What is said on the control socket: requests, commands, replies (wire protocol, section 5). Verbs: control.verbs.

Pure: bytes in, types out. Whatever a peer sends becomes a `Command` or a `RequestError`, never another exception.
"""

import difflib
import enum
import re
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import msgspec
import msgspec.inspect
from msgspec import Meta

from gcd_node.control.verbs import VERBS, Arguments
from gcd_node.errors import ControlError, MessageError
from gcd_node.wire.header import PROTO, check_version
from gcd_node.wire.record_json import LARGEST_INTEGER, short

MAX_REQUEST = 64 * 1024
"""Bytes a request may have; ZeroMQ drops a peer that sends more."""

MAX_REPLY = 4 * 1024 * 1024
"""Bytes a client accepts as a reply."""

RequestId: TypeAlias = Annotated[str, Meta(pattern=r"^[!-~]{1,64}$(?!\n)")]


class Code(enum.StrEnum):
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

    @property
    def ok(self) -> bool:
        """Whether the request was done or begun."""
        return self in (Code.OK, Code.ACCEPTED)


class RequestError(ControlError):
    """A request that cannot be taken. request_id: "" if it could not be read. result: what would be allowed."""

    def __init__(self, message: str, code: Code, request_id: str = "", result: dict[str, object] | None = None) -> None:
        super().__init__(message, code)
        self.reason = code
        self.request_id = request_id
        self.result = result


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A request as it travels.

    id: chosen by who asks, new for each request; the same one within 60 s is a repeat and gets the same reply.
    dry_run: check everything, change nothing. if_view_rev: only if the view named still has this revision.
    """

    proto: str
    id: RequestId
    verb: str
    args: msgspec.Raw = msgspec.Raw(b"{}")
    dry_run: bool = False
    if_view_rev: Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)] | None = None


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """A reply as it travels; unknown keys are ignored, as a newer node may say more.

    ok: the code is OK or ACCEPTED. state: of the node's life. result: what was asked for, or what would be allowed.
    """

    id: str
    ok: bool
    code: Code
    message: str
    state: str
    result: dict[str, object] | None = None
    proto: str = PROTO


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """A request that was read and checked. args: the struct that VERBS names for the verb.

    if_view_rev: None, or the revision the view must still have; if it has another, the answer is WRONG_STATE with
    {"view_rev": the one it has} and nothing changes.
    """

    verb: str
    args: Arguments
    dry_run: bool = False
    if_view_rev: int | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What became of a command; `result` is plain JSON."""

    code: Code = Code.OK
    message: str = ""
    result: dict[str, object] | None = None

    @property
    def ok(self) -> bool:
        """Whether it was done or begun."""
        return self.code.ok


def parse_request(part: bytes) -> Request:
    """Read a request; its arguments are looked at by parse_command().

    Raises:
        RequestError: TOO_LARGE, BAD_JSON (not one JSON object), BAD_PROTO (another major version, or none), BAD_ARG.
    """
    if len(part) > MAX_REQUEST:
        raise RequestError(f"a request has at most {MAX_REQUEST} bytes, got {len(part)}", Code.TOO_LARGE)
    try:
        fields = msgspec.json.decode(part, type=dict[str, msgspec.Raw])
    except _MALFORMED as error:
        raise RequestError(f"a request is one JSON object in UTF-8: {_said(error)}", Code.BAD_JSON) from error
    request_id = _readable(fields.get("id"), RequestId)
    try:
        check_version(_readable(fields.get("proto"), str))
        return msgspec.json.decode(part, type=Request)
    except MessageError as error:
        raise RequestError(str(error), Code.BAD_PROTO, request_id) from error
    except _MALFORMED as error:
        raise RequestError(_explained(error, Request), Code.BAD_ARG, request_id) from error


def parse_command(request: Request) -> Command:
    """What a request asks for.

    Raises:
        RequestError: UNKNOWN_VERB, BAD_ARG, OUT_OF_RANGE; `result` says what is allowed:
            {"allowed": {NAME: [least, most]}}.
    """
    verb = VERBS.get(request.verb)
    if verb is None:
        known = _nearest(request.verb, list(VERBS))
        raise RequestError(f"there is no verb {short(request.verb)}; {known}", Code.UNKNOWN_VERB, request.id)
    if request.if_view_rev is not None and not verb.names_view:
        raise RequestError(f"{request.verb} names no view, so leave if_view_rev out", Code.BAD_ARG, request.id)
    try:
        given = msgspec.json.decode(request.args, type=dict[str, msgspec.Raw])
        if nothing := [name for name, value in given.items() if bytes(value).strip() == b"null"]:
            message = f"{short(nothing[0])} is null, as NaN becomes on some ways to JSON; leave out what you do not set"
            raise RequestError(message, Code.BAD_ARG, request.id)
        args = msgspec.json.decode(request.args, type=verb.arguments)
    except _MALFORMED as error:
        raise _refused(error, verb.arguments, request.id) from error
    return Command(verb=request.verb, args=args, dry_run=request.dry_run, if_view_rev=request.if_view_rev)


def encode_request(request: Request) -> bytes:
    """One JSON part, checked as a node will check it. Raises RequestError as parse_request()."""
    part = msgspec.json.encode(request)
    parse_request(part)
    return part


def decode_reply(part: bytes) -> Reply:
    """Inverse of the node's encoding. Raises ControlError for what is no reply, or another major version's."""
    try:
        reply = msgspec.json.decode(part, type=Reply)
        check_version(reply.proto)
    except (*_MALFORMED, MessageError) as error:
        raise ControlError(f"this is no reply of a gcd node: {_said(error)}; is it its control endpoint?") from error
    return reply


def text_arguments(verb: str) -> frozenset[str]:
    """Arguments of a verb that are text, so that a command line needs no quotes; none for an unknown verb."""
    if verb not in VERBS:
        return frozenset()
    return frozenset(each.encode_name for each in _fields(VERBS[verb].arguments) if _is_text(_inner(each.type)))


_MALFORMED = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_RANGE = re.compile(r"Expected `(?:int|float)` (?:>=|<=|>|<) \S+ - at `\$\.([^`\[]+)")
_UNKNOWN = re.compile(r"contains unknown field `([^`]*)`")
_Info: TypeAlias = msgspec.inspect.Type


def _readable(raw: msgspec.Raw | None, kind: object) -> str:
    """The text that `raw` holds, "" if it holds none of this kind."""
    try:
        return str(msgspec.json.decode(raw or b"", type=kind))
    except _MALFORMED:
        return ""


def _refused(error: Exception, kind: type[msgspec.Struct], request_id: str) -> RequestError:
    beyond = _RANGE.search(str(error))
    if beyond is None:
        return RequestError(_explained(error, kind), Code.BAD_ARG, request_id)
    name = beyond.group(1)
    result: dict[str, object] = {"allowed": {name: _interval(kind, name)}}
    return RequestError(_explained(error, kind), Code.OUT_OF_RANGE, request_id, result)


def _explained(error: Exception, kind: type[msgspec.Struct]) -> str:
    """What is wrong, with the nearest known key where an unknown one is named."""
    unknown = _UNKNOWN.search(str(error))
    if unknown is None:
        return _said(error).replace("`$.", "`")
    known = _nearest(unknown.group(1), list(kind.__struct_encode_fields__))
    return f"unknown argument {short(unknown.group(1))}; {known}"


def _nearest(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]}?"
    return f"known are {', '.join(known)}" if known else "this verb takes none"


def _said(error: Exception) -> str:
    return str(error)[:200]


def _fields(kind: type[msgspec.Struct]) -> tuple[msgspec.inspect.Field, ...]:
    info = msgspec.inspect.type_info(kind)
    return info.fields if isinstance(info, msgspec.inspect.StructType) else ()


def _interval(kind: type[msgspec.Struct], name: str) -> list[float | None]:
    """Lowest and highest value of an argument, None where there is no limit."""
    info = next(_inner(each.type) for each in _fields(kind) if each.encode_name == name)
    if isinstance(info, msgspec.inspect.TupleType):
        info = info.item_types[0]
    if not isinstance(info, msgspec.inspect.IntType | msgspec.inspect.FloatType):
        return [None, None]
    return [info.gt if info.ge is None else info.ge, info.lt if info.le is None else info.le]


def _inner(info: _Info) -> _Info:
    """The type beside None."""
    if isinstance(info, msgspec.inspect.UnionType):
        return next(each for each in info.types if not isinstance(each, msgspec.inspect.NoneType))
    return info


def _is_text(info: _Info) -> bool:
    return isinstance(info, msgspec.inspect.StrType | msgspec.inspect.LiteralType)
