"""The verbs of the control socket: what each takes, who may use it, and how a request becomes a command.

Pure: bytes in, types out. Whatever a peer sends becomes a `Command` or a `RequestError`, never another exception
(wire protocol, section 5).
"""

import contextlib
import difflib
import functools
import re
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import UNSET, Meta, UnsetType

from gcd_client.control import MAX_REQUEST, Code, ControlError, Request, RequestId
from gcd_client.protocol import LARGEST_INTEGER, MessageError, check_version
from gcd_node.auth import Role
from gcd_node.sources import Positive
from gcd_node.view_config import Matrix, Pose, ViewConfig, pose_matrix

ViewName: TypeAlias = Annotated[str, Meta(pattern=r"^[a-z0-9_]{1,16}$(?!\n)")]
_Scale: TypeAlias = Annotated[float, Meta(ge=0, le=100)]


class SetView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Replace a view as a whole: as in a launch file, what is left out has its default, whatever it was before.

    view: its id. kind, azimuth_deg, elevation_deg, radius, position_m, look_at_m, rate_deg_s, amplitude_deg: as in
        [view.*].
    source_from_view: 16 numbers, row-major 4x4, rigid, instead of the three differences; `T_src_dst` on the wire.
    """

    view: ViewName
    kind: Literal["fixed", "orbit"] = "fixed"
    azimuth_deg: float | UnsetType = UNSET
    elevation_deg: float | UnsetType = UNSET
    radius: float | UnsetType = UNSET
    position_m: tuple[float, float, float] | UnsetType = UNSET
    look_at_m: tuple[float, float, float] | UnsetType = UNSET
    source_from_view: Matrix | UnsetType = msgspec.field(default=UNSET, name="T_src_dst")
    rate_deg_s: float | UnsetType = UNSET
    amplitude_deg: Positive | UnsetType = UNSET

    def __post_init__(self) -> None:
        self.to_config()

    def to_config(self) -> ViewConfig:
        """The view as a launch file states it. Raises ValueError as ViewConfig."""
        stated: dict[str, Any] = msgspec.to_builtins(self)  # what is unset is left out
        del stated["view"]
        if "T_src_dst" in stated:
            stated |= {"kind": "pose", "pose": stated.pop("T_src_dst")}
        return ViewConfig(**stated)


class SetPose(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Put a view at a rigid pose.

    pose: as in [view.*] of kind "pose": x, y, z and a quaternion x, y, z, w, or 16 numbers, row-major 4x4, in the
        source camera's axes.
    """

    view: ViewName
    pose: Pose

    def __post_init__(self) -> None:
        pose_matrix(self.pose)

    def to_config(self) -> ViewConfig:
        """The view as a launch file states it."""
        return ViewConfig(kind="pose", pose=self.pose)


class AlignView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Let the pose of a canonical view follow a source camera that was moved; an event tells how that went."""

    view: ViewName


class RemoveView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Stop publishing a view."""

    view: ViewName


class SetParam(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Change how views are drawn and sent; what is left out stays.

    steps, guidance, seed, samples: as in [model]. jpeg_quality: as in [publish]. publish: its `encoding`.
    """

    steps: Annotated[int, Meta(ge=1, le=1000)] | UnsetType = UNSET
    guidance: tuple[_Scale, _Scale] | UnsetType = UNSET
    seed: Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)] | UnsetType = UNSET
    samples: Annotated[int, Meta(ge=1, le=64)] | UnsetType = UNSET
    jpeg_quality: Annotated[int, Meta(ge=50, le=100)] | UnsetType = UNSET
    publish: Literal["rgb8", "jpeg"] | UnsetType = UNSET

    def __post_init__(self) -> None:
        if not msgspec.to_builtins(self):
            raise ValueError(f"nothing to change; name one of {', '.join(self.__struct_fields__)}")


@dataclass(frozen=True, kw_only=True, slots=True)
class Verb:
    """What a verb takes, and who may use it: a viewer's verbs change nothing, an operator may use all of them."""

    arguments: type[msgspec.Struct]
    role: Role

    @property
    def names_view(self) -> bool:
        """Whether `if_view_rev` goes with it."""
        return "view" in self.arguments.__struct_fields__


def _without_arguments(role: Role, **verbs: str) -> dict[str, Verb]:
    """verbs: names and what they do."""
    found: dict[str, Verb] = {}
    for name, about in verbs.items():
        title, doc = name.title().replace("_", ""), {"__doc__": about}
        arguments = msgspec.defstruct(title, [], namespace=doc, frozen=True, forbid_unknown_fields=True)
        found[name] = Verb(arguments=arguments, role=role)
    return found


VERBS: Mapping[str, Verb] = types.MappingProxyType(
    {
        **_without_arguments(
            "viewer",
            hello="Who answers: node, boot, version, and the role of who asks.",
            describe="Verbs and their arguments, the views this checkpoint allows, limits.",
            state="State of the node, of its source and of its model.",
            stats="The status message, now.",
            time="The node's clock when the request came and when the reply left.",
            views="Every view with its pose and revision.",
            get_config="The configuration in force, without passwords.",
            get_calib="Intrinsics of the source and of the views.",
        ),
        **_without_arguments(
            "operator",
            configure="Check the configuration and load the model.",
            activate="Open the source and publish views.",
            deactivate="Close the source, keep the model.",
            cleanup="Let go of the model.",
            shutdown="End the process in order.",
            record_start="Begin to record.",
            record_stop="Finish the recording.",
        ),
        "set_view": Verb(arguments=SetView, role="operator"),
        "set_pose": Verb(arguments=SetPose, role="operator"),
        "align_view": Verb(arguments=AlignView, role="operator"),
        "remove_view": Verb(arguments=RemoveView, role="operator"),
        "set_param": Verb(arguments=SetParam, role="operator"),
    }
)


@functools.cache
def schemas() -> Mapping[str, dict[str, Any]]:
    """Role and JSON schema of every verb's arguments, for `describe`."""
    return {
        name: {"role": verb.role, "args": msgspec.json.schema(verb.arguments), "if_view_rev": verb.names_view}
        for name, verb in VERBS.items()
    }


def _properties(verb: str) -> dict[str, Any]:
    """JSON schema of each argument of a known verb."""
    return next(iter(schemas()[verb]["args"]["$defs"].values())).get("properties", {})


def text_arguments(verb: str) -> frozenset[str]:
    """Arguments of a verb that are text, so that a command line needs no quotes; none for an unknown verb."""
    known = _properties(verb) if verb in VERBS else {}
    return frozenset(name for name, kind in known.items() if "enum" in kind or kind.get("type") == "string")


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """What became of a command; `result` is plain JSON."""

    code: Code = Code.OK
    message: str = ""
    result: dict[str, object] | None = None


class RequestError(ControlError):
    """A request that cannot be taken. request_id: "" if it could not be read. result: what would be allowed."""

    def __init__(self, message: str, code: Code, request_id: str = "", result: dict[str, object] | None = None) -> None:
        super().__init__(message, code)
        self.reason, self.request_id, self.result = code, request_id, result


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """A request that was read and checked. args: the struct that VERBS names for the verb.

    if_view_rev: None, or the revision the view must still have; if it has another, the answer is WRONG_STATE with
    {"view_rev": the one it has} and nothing changes.
    """

    id: str = ""
    verb: str
    args: msgspec.Struct
    dry_run: bool = False
    if_view_rev: int | None = None


class _Head(msgspec.Struct):
    """What is looked at before the rest of a request."""

    proto: Any = None
    id: Any = None


_MALFORMED = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_RANGE = re.compile(r"Expected `(?:int|float)` (?:>=|<=|>|<) \S+ - at `\$\.([^`\[]+)")
_UNKNOWN = re.compile(r"contains unknown field `([^`]*)`")


def parse_command(part: bytes) -> Command:
    """What a request asks for.

    Raises:
        RequestError: TOO_LARGE, BAD_JSON (not one JSON object), BAD_PROTO (another major version, or none),
            UNKNOWN_VERB, BAD_ARG, OUT_OF_RANGE; `result` says what is allowed: {"allowed": {NAME: [least, most]}}.
    """
    if len(part) > MAX_REQUEST:
        raise RequestError(f"a request has at most {MAX_REQUEST} bytes, got {len(part)}", Code.TOO_LARGE)
    try:
        head = msgspec.json.decode(part, type=_Head)
    except _MALFORMED as error:
        raise RequestError(f"a request is one JSON object in UTF-8: {error!s:.200}", Code.BAD_JSON) from error
    request_id = ""
    with contextlib.suppress(msgspec.ValidationError):
        request_id = msgspec.convert(head.id, RequestId)
    try:
        check_version(head.proto)
        request = msgspec.json.decode(part, type=Request)
    except MessageError as error:
        raise RequestError(str(error), Code.BAD_PROTO, request_id) from error
    except _MALFORMED as error:
        raise RequestError(_explained(error, Request), Code.BAD_ARG, request_id) from error
    verb = VERBS.get(request.verb)
    if verb is None:
        known = _nearest(request.verb, tuple(VERBS))
        raise RequestError(f"there is no verb {request.verb!a:.60}; {known}", Code.UNKNOWN_VERB, request.id)
    if request.if_view_rev is not None and not verb.names_view:
        raise RequestError(f"{request.verb} names no view, so leave if_view_rev out", Code.BAD_ARG, request.id)
    try:
        args = msgspec.json.decode(request.args, type=verb.arguments)
    except _MALFORMED as error:
        message, beyond = _explained(error, verb.arguments), _RANGE.search(str(error))
        if beyond is None:
            raise RequestError(message, Code.BAD_ARG, request.id) from error
        allowed: dict[str, object] = {"allowed": {beyond[1]: _interval(_properties(request.verb)[beyond[1]])}}
        raise RequestError(message, Code.OUT_OF_RANGE, request.id, allowed) from error
    return Command(
        id=request.id, verb=request.verb, args=args, dry_run=request.dry_run, if_view_rev=request.if_view_rev
    )


def _explained(error: Exception, kind: type[msgspec.Struct]) -> str:
    """What is wrong, with the nearest known key where an unknown one is named."""
    unknown = _UNKNOWN.search(str(error))
    if unknown is None:
        return f"{error!s:.200}".replace("`$.", "`")
    return f"unknown argument {unknown[1]!a:.60}; {_nearest(unknown[1], kind.__struct_encode_fields__)}"


def _nearest(name: str, known: tuple[str, ...]) -> str:
    if near := difflib.get_close_matches(name, known, n=1, cutoff=0.5):
        return f"did you mean {near[0]}?"
    return f"known are {', '.join(known)}" if known else "this verb takes none"


def _interval(schema: dict[str, Any]) -> list[float | None]:
    """Lowest and highest value of an argument, None where there is no limit."""
    number = next(iter(schema.get("prefixItems", ())), schema)
    least, most = ("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum")
    return [next((number[name] for name in names if name in number), None) for names in (least, most)]
