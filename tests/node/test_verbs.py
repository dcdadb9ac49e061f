"""Requests and replies as bytes: what is read, what is refused, and that nothing else can happen."""

import json

import pytest

from gcd_client.protocol import PROTO
from gcd_node.verbs import VERBS, RequestError, parse_command

IDENTITY = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
EXAMPLES: dict[str, dict[str, object]] = {
    "set_view": {"view": "top", "kind": "orbit", "azimuth_deg": 10, "rate_deg_s": 5, "amplitude_deg": 30},
    "set_pose": {"view": "top", "pose": [0, -2, -3, 0, 0, 0, 1]},
    "remove_view": {"view": "top"},
    "set_param": {"steps": 5, "guidance": [1, 1.5], "seed": 7, "publish": "jpeg", "jpeg_quality": 80},
}


def wire(verb: str, args: object = None, **more: object) -> bytes:
    return json.dumps({"proto": PROTO, "id": "a1", "verb": verb, "args": args or {}, **more}).encode()


def refused(part: bytes) -> RequestError:
    with pytest.raises(RequestError) as caught:
        parse_command(part)
    return caught.value


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_is_read_as_its_own_struct(verb: str) -> None:
    command = parse_command(wire(verb, EXAMPLES.get(verb)))
    assert command.verb == verb
    assert type(command.args) is VERBS[verb].arguments


# What is refused, and how it is said


@pytest.mark.parametrize("proto", ["gcd/2.0", "", None, "gcd/1.0\n"])
def test_f16_another_protocol_is_bad_proto_and_keeps_the_id(proto: object) -> None:
    error = refused(json.dumps({"proto": proto, "id": "a1", "verb": "hello"}).encode())
    assert (error.code, error.request_id) == ("BAD_PROTO", "a1")


@pytest.mark.parametrize("request_id", ["", "x" * 65, "a\n", 7, "é"])
def test_an_id_is_short_and_printable(request_id: object) -> None:
    error = refused(json.dumps({"proto": PROTO, "id": request_id, "verb": "hello"}).encode())
    assert (error.code, error.request_id) == ("BAD_ARG", "")


def test_f14_an_unknown_verb_names_the_nearest() -> None:
    error = refused(wire("set_veiw"))
    assert error.code == "UNKNOWN_VERB"
    assert "set_view" in str(error)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ({}, "view"),
        ({"view": "top\n"}, "view"),
        ({"view": "top", "azimut_deg": 1}, "azimuth_deg"),
        ({"view": "top", "azimuth_deg": "30"}, "azimuth_deg"),
        ({"view": "top", "azimuth_deg": None}, "azimuth_deg"),
        ({"view": "top", "kind": "spiral"}, "kind"),
        ({"view": "top", "T_src_dst": IDENTITY[:15]}, "T_src_dst"),
        ({"view": "top", "T_src_dst": IDENTITY, "radius": 1}, "radius, or"),
        ({"view": "top", "source_from_view": IDENTITY}, "source_from_view"),
        ({"view": "top", "kind": "orbit"}, "rate_deg_s"),
        ({"view": "top", "rate_deg_s": 3}, "rate_deg_s"),
        ([], "array"),
    ],
)
def test_f14_a_wrong_argument_is_bad_arg_and_named(args: object, says: str) -> None:
    error = refused(json.dumps({"proto": PROTO, "id": "a1", "verb": "set_view", "args": args}).encode())
    assert error.code == "BAD_ARG"
    assert says in str(error)


@pytest.mark.parametrize(
    ("args", "arg", "allowed"),
    [
        ({"steps": 0}, "steps", [1, 1000]),
        ({"steps": 1001}, "steps", [1, 1000]),
        ({"jpeg_quality": 49}, "jpeg_quality", [50, 100]),
        ({"seed": -1}, "seed", [0, 2**53 - 1]),
        ({"seed": 2**53}, "seed", [0, 2**53 - 1]),
        ({"guidance": [1.0, -0.5]}, "guidance", [0, 100]),
    ],
)
def test_f14_out_of_range_gives_the_allowed_interval(args: dict[str, object], arg: str, allowed: list[int]) -> None:
    error = refused(wire("set_param", args))
    assert (error.code, error.result) == ("OUT_OF_RANGE", {"allowed": {arg: allowed}})


def test_if_view_rev_goes_with_a_view_alone() -> None:
    assert parse_command(wire("remove_view", {"view": "a"}, if_view_rev=2)).if_view_rev == 2
    assert refused(wire("activate", if_view_rev=2)).code == "BAD_ARG"
