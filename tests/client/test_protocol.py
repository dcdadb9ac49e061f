"""Messages as bytes: round trips, the layout, and what a hostile sender can do (nothing but MessageError)."""

import json
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from wire_messages import class_map, depth, end, grid, origin, pixels, view_header, visibility, window

from gcd_client.images import payload_of
from gcd_client.protocol import (
    MAGIC,
    PREFIX,
    DataMessage,
    EndMessage,
    Message,
    MessageError,
    StatusMessage,
    ViewMessage,
    decode,
    encode,
    topic_key,
    view_topic,
)

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()


def spread() -> ViewMessage:
    grey = pixels(channels=1)
    header = replace(view_header(shape=grey.shape), scale=0.125)
    return ViewMessage(topic="view/top/std", header=header, payload=payload_of(grey))


def jpeg(offsets: tuple[int, ...] = (0, 40, 100)) -> ViewMessage:
    header = replace(view_header(), encoding="jpeg", offsets=offsets)
    return ViewMessage(topic="view/top/win", header=header, payload=bytes(100))


def status(fields: Mapping[str, Any]) -> StatusMessage:
    return StatusMessage(topic="status", header=origin(), fields=fields)


def unknown_camera() -> ViewMessage:
    header = replace(view_header(), pose=None, source_from_view=None, src_pose=None, intrinsics=None)
    return ViewMessage(topic="view/top/win", header=header, payload=payload_of(pixels()))


MESSAGES: dict[str, Message] = {
    "win": replace(window(3), sequence=2**63 + 5),
    "frm": window(3, kind="frm"),
    "std": spread(),
    "cls": class_map(5),
    "vis": visibility(5),
    "depth": depth(5),
    "jpeg": jpeg(),
    "no camera": unknown_camera(),
    "end": end(window_id=9),
    "grid": grid(),
    "grid end": EndMessage(topic="grid/around", header=replace(end().header, view_id="around", proto="gcd/1.3")),
    "status": status({"state": "active", "reasons": ["SRC_LOST"], "level": 2, "t_infer_start": "any field is allowed"}),
}


def split(part: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and payload of a message."""
    start = 64 + 16 * struct.unpack_from("<H", part, 36)[0]
    return json.loads(part[64:start]), part[start:]


def raw(header: bytes, payload: bytes = b"", *, topic: bytes = b"view/top/win", flags: int = 5) -> bytes:
    """A message of any content, with a right checksum."""
    header = header.ljust(-(-len(header) // 16) * 16)
    crc = zlib.crc32(header + payload)
    return PREFIX.pack(topic, MAGIC, len(header) // 16, flags, len(payload), 0, crc, 0) + header + payload


def changed(message: DataMessage, changes: Mapping[str, Any], *, removed: str = "") -> bytes:
    """The message with other header values."""
    header, payload = split(encode(message))
    header = {key: value for key, value in (header | changes).items() if key != removed}
    return raw(json.dumps(header).encode(), payload, topic=message.topic.encode())


def is_refused(part: bytes) -> bool:
    try:
        decode(part)
    except MessageError:
        return True
    return False


# Laws


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_survives_the_round_trip(name: str) -> None:
    assert decode(encode(MESSAGES[name])) == MESSAGES[name]


@pytest.mark.parametrize("message", [window(), class_map(), visibility(), depth()], ids=lambda message: message.topic)
@pytest.mark.parametrize("kind", ["win", "frm", "cls", "vis", "depth"])
def test_pixels_of_one_kind_are_never_taken_for_another(message: ViewMessage, kind: str) -> None:
    alike = [{"win", "frm"}, {"cls", "vis"}, {"depth"}]  # by encoding
    fits = any({message.topic.rpartition("/")[2], kind} <= kinds for kinds in alike)
    part = encode(message)
    assert fits != is_refused(f"view/top/{kind}".encode().ljust(32, b"\0") + part[32:])


def test_truncation_anywhere_is_refused() -> None:
    whole = encode(window())
    assert all(is_refused(whole[:length]) for length in range(len(whole)))
    assert is_refused(whole + b"\0")


@pytest.mark.parametrize("message", [window(), class_map(), jpeg()], ids=lambda message: message.header.encoding)
def test_foreign_values_in_any_header_field_raise_nothing_but_message_errors(message: ViewMessage) -> None:
    foreign = [None, True, -1, 0, 2**70, 10**400, 1e308, "", "\ud800", [], {}, [[]], [None], [[1, 2]], [1] * 14]
    for key in split(encode(message))[0]:
        for value in foreign:
            is_refused(changed(message, {key: value}))  # any other exception fails the test


# The layout, byte by byte


def test_the_prefix_lies_where_the_protocol_says() -> None:
    part = encode(replace(window(), sequence=258))
    length = 16 * int.from_bytes(part[36:38], "little")
    assert part[:32] == b"view/top/win".ljust(32, b"\0")
    assert part[32:36] == b"GCD1"
    assert int.from_bytes(part[38:40], "little") == 0b101
    assert int.from_bytes(part[40:48], "little") == 2 * 4 * 6 * 3
    assert int.from_bytes(part[48:56], "little") == 258
    assert int.from_bytes(part[56:60], "little") == zlib.crc32(part[64:])
    assert part[60:64] == bytes(4)
    assert part[64 + length :] == pixels().tobytes()


def test_checksum_reserved_bytes_and_unknown_flags_may_be_anything_a_later_minor_makes_of_them() -> None:
    message = window()
    part = bytearray(encode(message))
    part[56:64] = bytes(4) + b"abcd"
    part[39] |= 0x80
    assert decode(bytes(part)) == message


def test_unknown_header_keys_and_a_newer_minor_are_ignored() -> None:
    message = window()
    decoded = decode(changed(message, {"proto": "gcd/1.7", "novelty": {"deep": [1]}}))
    assert decoded.header == replace(message.header, proto="gcd/1.7")


def test_no_topic_key_is_a_prefix_of_another() -> None:
    keys = {topic_key(name) for name in ("view/top/win", "view/topdown/win", "view/top2/win", "view/top/frm", "meta")}
    assert [len(key) for key in keys] == [32] * 5


# What is refused

CLASS = {"id": 1, "name": "a", "colour": [0, 0, 0]}
BAD_VALUES: dict[str, list[Any]] = {
    "proto": ["gcd/2.0", 1],
    "boot_id": ["xyz", "A" * 32],
    "shape": [[3, 4, 6, 3], [2, 4, 7, 3], [2, 4, 6], [2, -4, -6, 3], [2, 4, 6, 1], [2.0, 4, 6, 3]],
    "encoding": ["png", "jpeg", "class8", "invdepth16"],
    "offsets": [[0, 1, 2]],
    "dtype": ["f32", "f16"],
    "view_id": ["side"],
    "view_rev": [1.5, 1.0, True, "1"],
    "window_id": [2**53, -(2**53)],
    "age_ms": [2**53, True, "1.0"],
    "t_publish": [[1, 10**9], [1, -1], [2**53, 0], [1.0, 0], [1, 0, 0], 1_700_000_000],
    "t_capture": [[[1, 2, 3], [4, 5]], [[1, 2]] * 3],
    "src": [[], {"kind": "file"}],
    "clock": ["sundial"],
    "frame_role": [["at_goal"], ["at_goal", "lost"]],
    "K": [[1.0], [1.0] * 8 + [None]],
    "T_src_dst": [[[1.0] * 16, [1.0]], [[1.0] * 16]],
    "pose": [[]],
    "range": [[0]],
    "synthetic": [1],
    "distortion": [None],
    "node_id": ["a\nb", "\ud800"],
    "frame_id": ["\u2028"],
    "quality": [{"nan_frames": 0, "ood": ["f\0s"], "steps": 1, "seed": 1}],
    "classes": [[CLASS]],
}
BAD_CLASSES = [
    CLASS | change
    for change in ({"id": 256}, {"id": -1}, {"colour": [0, 0, 256]}, {"colour": [0, 0]}, {"name": "\x7f"})
]
BAD_OFFSETS = ([0, 5], [1, 5, 100], [0, 100, 100], [0, 101, 100], [-5, 0, 100], [], [0, 5, 10**9], None)
BAD_HEADERS: list[tuple[DataMessage, str, Any]] = [
    *((window(), key, value) for key, values in BAD_VALUES.items() for value in values),
    *((class_map(), "classes", classes) for classes in (None, [], {}, [CLASS, CLASS], [{"id": 1, "name": "a"}])),
    *((class_map(), "classes", [each]) for each in BAD_CLASSES),
    *((jpeg(), "offsets", offsets) for offsets in BAD_OFFSETS),
    (spread(), "scale", None),
    *((grid(), "shape", shape) for shape in ([3, 3], [6], [2, 3, 1], [2, -3])),
    *((grid(), "cell_m", cell_m) for cell_m in (0, -1.0, None)),
    *((grid(), key, value) for key, value in (("view_id", "other"), ("origin_m", [0.0]), ("classes", [CLASS, CLASS]))),
    (grid(), "t_capture", [[1, 2], [3, 4]]),
]


@pytest.mark.parametrize(("message", "key", "value"), BAD_HEADERS, ids=lambda value: str(value)[:30])
def test_a_wrong_header_value_is_refused(message: DataMessage, key: str, value: object) -> None:
    with pytest.raises(MessageError):
        decode(changed(message, {key: value}))


@pytest.mark.parametrize("key", ["proto", "window_id", "t_publish", "t_capture", "src", "shape", "cfg_digest"])
def test_a_missing_header_key_is_refused(key: str) -> None:
    with pytest.raises(MessageError):
        decode(changed(window(), {}, removed=key))


HEADER_TEXTS = [
    *(b"", b"[]", b"1", b"null", b"{", b"\xff\xfe", b'{"a": "\xff"}', b"[" * 60_000, b'{"a":' * 12_000),
    *(b'{"age_ms": NaN}', b'{"zzz": Infinity}', b'{"age_ms": 1e999}', b'{"age_ms": ' + b"9" * 5000 + b"}"),
    b'{"zzz": ' + b"9" * 5000 + b"}",
]


@pytest.mark.parametrize("text", HEADER_TEXTS, ids=lambda text: text[:20])
@pytest.mark.parametrize("topic", [b"view/top/win", b"status"])
def test_a_header_that_is_no_json_object_is_refused(text: bytes, topic: bytes) -> None:
    header = json.dumps(split(encode(window()))[0]).encode()
    whole = text if not text.startswith(b'{"') else header[:-1] + b", " + text[1:]
    with pytest.raises(MessageError):
        decode(raw(whole, topic=topic, flags=0 if topic == b"status" else 5))


def test_an_error_says_what_came_in_one_short_printable_line() -> None:
    with pytest.raises(MessageError) as caught:
        decode(changed(window(), {"clock": "\x1b[31m" + "x" * 50_000}))
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400


def test_sizes_are_bounded_before_anything_is_read() -> None:
    assert is_refused(PREFIX.pack(b"view/top/win", MAGIC, 65535, 5, 0, 0, 0, 0))
    assert is_refused(PREFIX.pack(b"view/top/win", MAGIC, 0, 5, 2**64 - 1, 0, 0, 0))
    with pytest.raises(MessageError, match="max_payload"):
        decode(encode(window()), max_payload=100)


def test_a_topic_outside_the_protocol_is_refused() -> None:
    for topic in (
        *(b"", b"view/top", b"view/Top/win", b"view/top/win/", b"view//win", b"view/abcdefghijklmnopq/win"),
        *(b"src/win", b"view/src/frm", b"view/top/win\0x", b"\xffiew/top/win", b"control"),
    ):
        header, payload = split(encode(window()))
        assert is_refused(raw(json.dumps(header).encode(), payload, topic=topic))


@pytest.mark.parametrize("flags", [0, 1, 2, 4, 3, 6, 7])
def test_flags_that_contradict_the_content_are_refused(flags: int) -> None:
    header, payload = split(encode(window()))
    assert is_refused(raw(json.dumps(header).encode(), payload, flags=flags))


@pytest.mark.parametrize("view_id", ["", "Top", "a" * 17, "a-b", "a/b", "é", "src", "a\n"])
def test_a_view_id_outside_the_alphabet_is_refused(view_id: str) -> None:
    with pytest.raises(MessageError, match="view id"):
        view_topic(view_id, "win")


def test_what_a_header_cannot_hold_is_refused_when_encoding() -> None:
    for message in (
        ViewMessage(topic="view/top/win", header=replace(view_header(), age_ms=float("nan")), payload=bytes(144)),
        ViewMessage(topic="view/top/win", header=replace(view_header(), age_ms=np.float32(1)), payload=bytes(144)),
        status({"fps": float("inf")}),
        status({"fps": object()}),
        status({"text": "x" * 70_000}),
    ):
        with pytest.raises(MessageError):
            encode(message)


# The page other languages are written from


def test_the_protocol_page_names_every_header_key() -> None:
    header = split(encode(jpeg()))[0]
    nested = [*header["src"], *header["quality"], *header["model"], *header["pose"][0], *header["src_pose"]]
    classes, cells = split(encode(class_map()))[0]["classes"], split(encode(grid()))[0]
    assert [key for key in (*header, *nested, "scale", "classes", *classes[0], *cells) if f"`{key}`" not in PAGE] == []


def test_the_example_on_the_protocol_page_is_a_message() -> None:
    part = bytes.fromhex(PAGE.split("```hex")[1].split("```")[0])
    message = decode(part)
    assert isinstance(message, EndMessage)
    assert (message.topic, message.sequence, message.header.window_id) == ("view/top/win", 3, 2)
    assert encode(message) == part
