"""From requests (gcd_client.control) to checked commands, and what becomes of them. Verbs: control.verbs.

Pure: bytes in, types out. Whatever a peer sends becomes a `Command` or a `RequestError`, never another exception.
"""

import difflib
import re
from dataclasses import dataclass
from typing import TypeAlias

import msgspec
import msgspec.inspect

from gcd_client.control import MAX_REQUEST, Code, ControlError, Request, RequestId
from gcd_client.protocol import MessageError, check_version
from gcd_node.control.verbs import VERBS


class RequestError(ControlError):
    """A request that cannot be taken. request_id: "" if it could not be read. result: what would be allowed."""

    def __init__(self, message: str, code: Code, request_id: str = "", result: dict[str, object] | None = None) -> None:
        super().__init__(message, code)
        self.reason = code
        self.request_id = request_id
        self.result = result


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """A request that was read and checked. args: the struct that VERBS names for the verb.

    if_view_rev: None, or the revision the view must still have; if it has another, the answer is WRONG_STATE with
    {"view_rev": the one it has} and nothing changes.
    """

    verb: str
    args: msgspec.Struct
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
        return self.code in (Code.OK, Code.ACCEPTED)


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
        raise RequestError(f"there is no verb {request.verb!a:.60}; {known}", Code.UNKNOWN_VERB, request.id)
    if request.if_view_rev is not None and not verb.names_view:
        raise RequestError(f"{request.verb} names no view, so leave if_view_rev out", Code.BAD_ARG, request.id)
    try:
        given = msgspec.json.decode(request.args, type=dict[str, msgspec.Raw])
        if nothing := [name for name, value in given.items() if bytes(value).strip() == b"null"]:
            message = f"{nothing[0]!a:.60} is null, as NaN becomes on some ways to JSON; leave out what you do not set"
            raise RequestError(message, Code.BAD_ARG, request.id)
        args = msgspec.json.decode(request.args, type=verb.arguments)
    except _MALFORMED as error:
        raise _refused(error, verb.arguments, request.id) from error
    return Command(verb=request.verb, args=args, dry_run=request.dry_run, if_view_rev=request.if_view_rev)


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
    return f"unknown argument {unknown.group(1)!a:.60}; {known}"


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
