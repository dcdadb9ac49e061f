"""The message as bytes: round trips, refusals, and what a hostile sender can do (nothing but MessageError)."""

import ast
import dataclasses
import hashlib
import json
import math
import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from wire_messages import CLASSES, class_map, depth, end, numbers, origin, pixels, view_header, visibility, window

import gcd_node
from gcd_node.envelope import (
    MAGIC,
    PREFIX,
    EndMessage,
    Flags,
    NoteMessage,
    ViewMessage,
    colours,
    decode,
    depth_m,
    encode,
    images,
    inverse_depth,
    payload_of,
    topic_key,
    view_topic,
)
from gcd_node.errors import MessageError
from gcd_node.wire.jpeg import encode_frames

WIRE_FILES = ("wire/header", "wire/class_colours", "wire/record_json", "wire/endpoints", "wire/jpeg")
PLANNER_FILES = ("envelope", "subscriber", "errors", *WIRE_FILES)


def rebuilt(
    message: ViewMessage,
    changes: dict,
    *,
    removed: str = "",
    payload: bytes | None = None,
    topic: bytes = b"view/top/win",
) -> bytes:
    """The message with header keys changed and a right checksum."""
    part = encode(message)
    length = 16 * struct.unpack_from("<H", part, 36)[0]
    header = json.loads(part[64 : 64 + length])
    header = {key: value for key, value in (header | changes).items() if key != removed}
    body = part[64 + length :] if payload is None else payload
    return raw_part(json.dumps(header).encode(), body, topic=topic)


def raw_part(header: bytes, payload: bytes = b"", *, topic: bytes = b"view/top/win", flags: int = 5) -> bytes:
    header = header.ljust(-(-len(header) // 16) * 16)
    crc = zlib.crc32(header + payload)
    return PREFIX.pack(topic, MAGIC, len(header) // 16, flags, len(payload), 0, crc, 0) + header + payload


# Laws


@pytest.mark.parametrize("kind", ["win", "frm"])
def test_a_view_survives_the_round_trip(kind) -> None:
    message = dataclasses.replace(window(3, kind=kind), sequence=2**63 + 5)
    assert decode(encode(message)) == message


def test_a_deviation_survives_the_round_trip() -> None:
    grey = pixels(channels=1)
    header = dataclasses.replace(view_header(shape=grey.shape), scale=0.125)
    message = ViewMessage(topic="view/top/std", header=header, payload=payload_of(grey))
    assert decode(encode(message)) == message
    assert images(decode(encode(message))).shape == (2, 4, 6, 1)


def test_a_class_map_survives_the_round_trip_with_what_its_numbers_mean() -> None:
    message = dataclasses.replace(class_map(5), sequence=4)
    decoded = decode(encode(message))
    assert decoded == message
    assert decoded.header.classes == CLASSES
    assert np.array_equal(images(decoded), numbers(5)[..., None])


def test_visibility_survives_the_round_trip_and_says_what_its_numbers_mean() -> None:
    message = dataclasses.replace(visibility(5), sequence=4)
    decoded = decode(encode(message))
    assert decoded == message
    assert [(each.id, each.name) for each in decoded.header.classes] == [
        (0, "painted"),
        (1, "seen_before"),
        (2, "seen_now"),
    ]
    assert images(decoded).tobytes() == bytes(message.payload)


def test_inverse_depth_survives_the_round_trip() -> None:
    message = dataclasses.replace(depth(5), sequence=4)
    decoded = decode(encode(message))
    assert decoded == message
    assert np.array_equal(inverse_depth(decoded), np.frombuffer(message.payload, "<f2").reshape(2, 4, 6))
    assert np.array_equal(np.isnan(depth_m(decoded)), inverse_depth(decoded) == 0)
    assert np.allclose((depth_m(decoded) * inverse_depth(decoded))[inverse_depth(decoded) > 0], 1)
    with pytest.raises(MessageError, match="holds no levels"):
        images(decoded)
    with pytest.raises(MessageError, match="holds no depth"):
        inverse_depth(window())


def test_nearer_is_brighter_and_no_depth_is_black() -> None:
    shown = colours(depth(inverse=np.array([[[0, 0.005, 0.1, 1, 65504]]], "<f2")))[0, 0, :, 0]
    assert (np.diff(shown.astype(int)) > 0).all()
    assert shown[0] == 0


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_a_depth_that_is_none_is_refused_by_who_reads_it(value) -> None:
    message = decode(encode(depth(inverse=np.array([[[0.5, value]]], "<f2"))))
    with pytest.raises(MessageError, match="finite and not negative"):
        inverse_depth(message)


@pytest.mark.parametrize("message", [window(), class_map(), visibility(), depth()], ids=lambda message: message.topic)
@pytest.mark.parametrize("kind", ["win", "frm", "cls", "vis", "depth"])
def test_pixels_of_one_kind_are_never_taken_for_another(message, kind) -> None:
    alike = [{"win", "frm"}, {"cls", "vis"}, {"depth"}]  # by encoding
    fits = any({message.topic.rpartition("/")[2], kind} <= kinds for kinds in alike)
    part = encode(message)
    part = f"view/top/{kind}".encode().ljust(32, b"\0") + part[32:]
    assert fits != is_refused(part)


@pytest.mark.parametrize(
    ("kind", "sha256"),
    [
        ("win", "e4564807ad18c6fc688933f2957e2fd64ba91c727e5c063915a40615060d649d"),
        ("frm", "04c90adf59bea5033d3a08609a2880f3bb195205c535b3359aa66d1a3a6ce306"),
        ("std", "695a60e300d9f50a121a4bdac249135e80c812b5b64fecb521a31ba2cf73049c"),
        ("cls", "2c03da8265fd94e136b634c75ad7062444738b5452da7b45fded4bfb5030fbc5"),
    ],
)
def test_messages_of_protocol_1_0_stay_as_they_were_to_the_byte(kind, sha256) -> None:
    """Recorded from the last commit that knew these four kinds alone (a5c0278)."""
    grey = pixels(channels=1)
    header = dataclasses.replace(view_header(shape=grey.shape), scale=0.125)
    std = ViewMessage(topic="view/top/std", header=header, payload=payload_of(grey))
    message = {"cls": class_map(), "std": std}.get(kind) or window(kind=kind)
    header = dataclasses.replace(message.header, t_publish_ns=1_700_000_002_000_000_000)
    assert hashlib.sha256(encode(dataclasses.replace(message, header=header))).hexdigest() == sha256


def test_what_the_model_cannot_say_survives_as_none() -> None:
    header = dataclasses.replace(view_header(), pose=None, source_from_view=None, src_pose=None, intrinsics=None)
    message = ViewMessage(topic="view/top/win", header=header, payload=payload_of(pixels()))
    assert decode(encode(message)).header == header


def test_an_end_of_stream_survives_the_round_trip() -> None:
    message = end(window_id=9)
    decoded = decode(encode(message))
    assert isinstance(decoded, EndMessage)
    assert decoded == message
    assert decoded.flags == Flags.END_OF_STREAM | Flags.REPLAY_CLOCK


@pytest.mark.parametrize("topic", ["status", "event", "meta"])
def test_a_note_survives_the_round_trip(topic) -> None:
    message = NoteMessage(topic=topic, header=origin(), fields={"state": "active", "reasons": ["SRC_LOST"], "level": 2})
    decoded = decode(encode(message))
    assert isinstance(decoded, NoteMessage)
    assert dict(decoded.fields) == dict(message.fields)
    assert decoded.header == message.header


def test_images_are_the_published_bytes_and_read_only() -> None:
    shown = images(decode(bytearray(encode(window(images=pixels(5))))))
    assert np.array_equal(shown, pixels(5))
    assert not shown.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        shown[0, 0, 0, 0] = 1


def test_raw_images_share_the_received_bytes() -> None:
    part = encode(window())
    assert np.shares_memory(images(decode(part)), np.frombuffer(part, np.uint8))


@pytest.mark.parametrize("checked", [True, False])
def test_damage_anywhere_raises_nothing_but_message_errors(checked) -> None:
    chance = random.Random(20)
    whole = encode(window())
    refused = 0
    for _ in range(1500):
        part = bytearray(whole)
        for _ in range(chance.choice((1, 1, 2, 8))):
            part[chance.randrange(len(part))] ^= 1 << chance.randrange(8)
        if not checked:
            part[56:60] = bytes(4)  # no checksum: the header's own checks must hold
        refused += is_refused(bytes(part))
    assert refused > (1200 if checked else 300)


def test_truncation_anywhere_is_refused() -> None:
    whole = encode(window())
    assert all(is_refused(whole[:length]) for length in range(len(whole)))
    assert is_refused(whole + b"\0")


def is_refused(part: bytes) -> bool:
    try:
        decode(part)
    except MessageError:
        return True
    return False


def test_foreign_values_in_any_header_field_raise_nothing_but_message_errors() -> None:
    foreign = [None, True, -1, 0, 2**70, 1e308, "", "\ud800", [], {}, [[]], [None], [[1, 2]], [1] * 14, {"a": 1}]
    message = window()
    keys = json.loads(header_text(message))
    for key in keys:
        for value in foreign:
            is_refused(rebuilt(message, {key: value}))  # any other exception fails the test
    assert len(keys) > 30


def header_text(message: ViewMessage) -> bytes:
    part = encode(message)
    return part[64 : 64 + 16 * struct.unpack_from("<H", part, 36)[0]]


# The layout, byte by byte


def test_the_prefix_lies_where_the_protocol_says() -> None:
    message = dataclasses.replace(window(), sequence=258)
    part = encode(message)
    length = 16 * int.from_bytes(part[36:38], "little")
    assert part[:32] == b"view/top/win".ljust(32, b"\0")
    assert part[32:36] == b"GCD1"
    assert int.from_bytes(part[38:40], "little") == 0b101
    assert int.from_bytes(part[40:48], "little") == 2 * 4 * 6 * 3
    assert int.from_bytes(part[48:56], "little") == 258
    assert int.from_bytes(part[56:60], "little") == zlib.crc32(part[64:])
    assert part[60:64] == bytes(4)
    assert part[64 + length :] == pixels().tobytes()
    header = json.loads(part[64 : 64 + length].decode())
    assert header["t_capture"][1] == [1_700_000_000, 100_000_001]
    assert header["t_infer_end"] == [1_700_000_001, 999_999_999]
    assert header["proto"] == "gcd/1.0"
    assert header["pose"][1] == {"az_deg": 3.0, "el_deg": 1.5, "r": 0.0}
    assert len(header["T_src_dst"]) == 2
    assert len(header["K"]) == 9


def test_the_header_names_every_field_of_the_protocol() -> None:
    names = (
        "proto node_id boot_id view_id view_rev window_id t_capture t_capture_unc_us clock t_infer_start t_infer_end "
        "t_publish age_ms valid_for_ms src frame_id src_frame_id pose T_src_dst pose_units src_pose frame_role K "
        "distortion shape layout dtype encoding range synthetic quality model cfg_digest"
    )
    assert set(names.split()) == set(json.loads(header_text(window())))


def test_a_message_without_checksum_is_accepted() -> None:
    message = window()
    part = bytearray(encode(message))
    part[56:60] = bytes(4)
    assert decode(bytes(part)) == message


def test_reserved_bytes_and_unknown_flags_are_ignored() -> None:
    part = bytearray(encode(window()))
    part[60:64] = b"abcd"
    part[39] |= 0x80
    assert decode(bytes(part)).flags == Flags.PAYLOAD | Flags.REPLAY_CLOCK


def test_unknown_header_keys_and_a_newer_minor_are_ignored() -> None:
    message = window()
    decoded = decode(rebuilt(message, {"proto": "gcd/1.7", "novelty": {"deep": [1]}}))
    assert decoded.header == dataclasses.replace(message.header, proto="gcd/1.7")


# Class maps


def test_a_class_map_is_shown_in_the_colours_of_its_ontology() -> None:
    drawn = np.array([[[0, 1, 7], [7, 7, 0]]], np.uint8)
    shown = colours(class_map(drawn=drawn))
    of = {each.id: each.colour for each in CLASSES}
    assert [[tuple(pixel) for pixel in row] for row in shown[0].tolist()] == [[of[n] for n in row] for row in drawn[0]]
    assert not shown.flags.writeable


def test_pictures_are_shown_as_they_are_and_grey_levels_as_grey() -> None:
    assert np.array_equal(colours(window(images=pixels(2))), pixels(2))
    grey = pixels(3, channels=1)
    message = ViewMessage(topic="view/top/win", header=view_header(shape=grey.shape), payload=payload_of(grey))
    assert np.array_equal(colours(message), np.repeat(grey, 3, axis=-1))


def test_a_class_number_without_a_name_is_refused_when_shown() -> None:
    with pytest.raises(MessageError, match="3 class numbers of its ontology, got 2"):
        colours(class_map(drawn=np.array([[[0, 1, 2]]], np.uint8)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"classes": None}, "of encoding class8 needs `classes`"),
        ({"classes": []}, "name each number once"),
        ({"classes": [{"id": 1, "name": "a", "colour": [0, 0, 0]}] * 2}, "name each number once"),
        ({"classes": [{"id": 256, "name": "a", "colour": [0, 0, 0]}]}, "0 to 255"),
        ({"classes": [{"id": -1, "name": "a", "colour": [0, 0, 0]}]}, "0 to 255"),
        ({"classes": [{"id": 1, "name": "a", "colour": [0, 0, 256]}]}, "0 to 255"),
        ({"classes": [{"id": 1, "name": "a", "colour": [0, 0]}]}, "three colour levels"),
        ({"classes": [{"id": 1, "name": "a"}]}, "lacks 'colour'"),
        ({"encoding": "mono8"}, "classes belong to class8 alone"),
    ],
)
def test_an_ontology_that_says_nothing_clear_is_refused(changes, words) -> None:
    with pytest.raises(MessageError, match=words):
        decode(rebuilt(class_map(), changes, topic=b"view/top/cls"))


def test_damage_to_a_class_map_raises_nothing_but_message_errors() -> None:
    message, foreign = class_map(), [True, -1, 2**70, "", [], {}, [[]], [None], [{}], [{"id": "a"}], [1] * 3]
    for value in foreign:
        assert is_refused(rebuilt(message, {"classes": value}, topic=b"view/top/cls"))


# Refusals say what was wanted and what came


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"proto": "gcd/2.0"}, "gcd/1.x.*gcd/2.0"),
        ({"proto": 1}, "gcd/1.x"),
        ({"boot_id": "xyz"}, "32 lower-case hex"),
        ({"shape": [3, 4, 6, 3]}, "t_capture must have 1 or 3"),
        ({"shape": [2, 4, 7, 3]}, "needs 168 payload bytes, got 144"),
        ({"shape": [2, 4, 6]}, r"must be \[T, H, W, 3\]"),
        ({"shape": [2, -4, -6, 3]}, r"must be \[T, H, W, 3\]"),
        ({"encoding": "png"}, "must be one of rgb8, jpeg, class8, mono8"),
        ({"encoding": "jpeg"}, "offsets belong to jpeg"),
        ({"offsets": [0, 1, 2]}, "offsets belong to jpeg"),
        ({"dtype": "f32"}, "must be one of u8"),
        ({"view_id": "side"}, "must carry view_id top"),
        ({"view_rev": 1.5}, "integer below 2"),
        ({"view_rev": True}, "integer below 2"),
        ({"window_id": 2**53}, "integer below 2"),
        ({"t_publish": [1, 10**9]}, r"\[sec, nanosec\]"),
        ({"t_publish": 1_700_000_000}, "must be a list"),
        ({"frame_role": ["at_goal"]}, "frame_role must have 2"),
        ({"K": [1.0]}, "K must have 9"),
        ({"T_src_dst": [[1.0] * 16, [1.0]]}, "must have 16"),
        ({"pose": []}, "pose must have 2"),
        ({"src": []}, "must be an object"),
        ({"node_id": "a\nb"}, "printable"),
    ],
)
def test_a_wrong_header_value_is_named(changes, words) -> None:
    with pytest.raises(MessageError, match=words):
        decode(rebuilt(window(), changes))


@pytest.mark.parametrize("key", ["proto", "window_id", "t_capture", "src", "shape", "cfg_digest"])
def test_a_missing_header_key_is_named(key) -> None:
    with pytest.raises(MessageError, match=f"{key}|gcd/1.x"):
        decode(rebuilt(window(), {}, removed=key))


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"[]", "JSON object"),
        (b"{", "one JSON object"),
        (b"\xff\xfe", "UnicodeDecodeError"),
        (b"[" * 60_000, "one JSON object"),
        (b'{"age_ms": NaN}', "NaN is not JSON"),
        (b'{"age_ms": ' + b"9" * 5000 + b"}", "one JSON object"),
    ],
)
def test_a_header_that_is_no_json_object_is_refused(header, words) -> None:
    with pytest.raises(MessageError, match=words):
        decode(raw_part(header))


def test_another_magic_is_refused() -> None:
    part = bytearray(encode(window()))
    part[32:36] = b"GCD2"
    with pytest.raises(MessageError, match="magic must be b'GCD1', got b'GCD2'"):
        decode(bytes(part))


def test_a_damaged_payload_fails_the_checksum() -> None:
    part = bytearray(encode(window()))
    part[-1] ^= 1
    with pytest.raises(MessageError, match="checksum"):
        decode(bytes(part))


def test_sizes_are_bounded_before_anything_is_read() -> None:
    header = PREFIX.pack(b"view/top/win", MAGIC, 65535, 5, 0, 0, 0, 0)
    with pytest.raises(MessageError, match="at most 65536 bytes"):
        decode(header)
    with pytest.raises(MessageError, match="at most 100 bytes here, got 144"):
        decode(encode(window()), max_payload=100)
    with pytest.raises(MessageError, match="at most 67108864 bytes"):
        decode(PREFIX.pack(b"view/top/win", MAGIC, 0, 5, 2**64 - 1, 0, 0, 0))


@pytest.mark.parametrize(
    "topic",
    [
        *(b"", b"view/top", b"view/Top/win", b"view/top/win/", b"view//win", b"view/abcdefghijklmnopq/win"),
        *(b"src/win", b"view/top/win\0x", b"\xffiew/top/win", b"control"),
    ],
)
def test_a_topic_outside_the_protocol_is_refused(topic) -> None:
    with pytest.raises(MessageError, match="topic"):
        decode(raw_part(header_text(window()), pixels().tobytes(), topic=topic))


@pytest.mark.parametrize("flags", [0, 1, 4, 3, 7])
def test_flags_that_contradict_the_content_are_refused(flags) -> None:
    with pytest.raises(MessageError, match=r"flags|payload"):
        decode(raw_part(header_text(window()), pixels().tobytes(), flags=flags))


def test_a_header_that_json_cannot_say_is_refused_when_encoding() -> None:
    header = dataclasses.replace(view_header(), age_ms=float("nan"))
    with pytest.raises(MessageError, match="age_ms must be a finite number"):
        encode(ViewMessage(topic="view/top/win", header=header, payload=payload_of(pixels())))
    with pytest.raises(MessageError, match="plain JSON"):
        encode(NoteMessage(topic="status", header=origin(), fields={"fps": float("inf")}))
    with pytest.raises(MessageError, match="at most 65536"):
        encode(NoteMessage(topic="meta", header=origin(), fields={"text": "x" * 70_000}))


@pytest.mark.parametrize("view_id", ["", "Top", "a" * 17, "a-b", "a/b", "é"])
def test_a_view_id_outside_the_alphabet_is_refused(view_id) -> None:
    with pytest.raises(MessageError, match="view id"):
        view_topic(view_id, "win")


def test_no_topic_key_is_a_prefix_of_another() -> None:
    keys = [topic_key(name) for name in ("view/top/win", "view/topdown/win", "view/top2/win", "view/top/frm", "meta")]
    assert {len(key) for key in keys} == {32}
    assert len(set(keys)) == len(keys)


# JPEG


def smooth(height: int = 48, width: int = 64) -> np.ndarray:
    rows, columns = np.mgrid[0:height, 0:width]
    frame = np.stack([rows * 5, columns * 3, 255 - rows * 2], axis=-1).clip(0, 255).astype(np.uint8)
    return np.stack([frame, frame[::-1]])


def jpeg_message(shape=(2, 48, 64, 3)) -> ViewMessage:
    payload, offsets = encode_frames(smooth(), 90)
    header = dataclasses.replace(view_header(shape=(2, *shape[1:])), encoding="jpeg", offsets=offsets)
    return ViewMessage(topic="view/top/win", header=header, payload=payload)


def test_jpeg_frames_keep_their_colours_and_order() -> None:
    shown = images(decode(encode(jpeg_message())))
    assert np.abs(shown.astype(int) - smooth()).mean() < 2
    assert not shown.flags.writeable


def test_a_jpeg_of_another_size_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(MessageError, match=r"must be 48x60 .*got \(48, 64\)"):
        images(jpeg_message(shape=(2, 48, 60, 3)))


def test_damaged_jpegs_raise_nothing_but_message_errors() -> None:
    message = jpeg_message()
    chance = random.Random(3)
    for _ in range(60):
        payload = bytearray(message.payload)
        for _ in range(20):
            payload[chance.randrange(700)] = chance.randrange(256)
        try:
            shown = images(dataclasses.replace(message, payload=bytes(payload)))
        except MessageError:
            continue
        assert shown.shape == (2, 48, 64, 3)


@pytest.mark.parametrize("offsets", [[0, 5], [1, 5, 9], [0, 5, 5], [0, 9, 5], [], [0, 5, 10**9]])
def test_offsets_that_do_not_fit_are_refused(offsets) -> None:
    with pytest.raises(MessageError, match=r"offsets|payload"):
        decode(rebuilt(jpeg_message(), {"offsets": offsets}))


# What a planner imports


@pytest.mark.parametrize("name", PLANNER_FILES)
def test_planner_files_keep_to_python_3_10(name) -> None:
    source = (Path(gcd_node.__file__).parent / f"{name}.py").read_text()
    assert ast.parse(source, feature_version=(3, 10)).body
    assert not {"Self", "StrEnum", "assert_never", "tomllib", "ExceptionGroup"} & set(source.replace(",", " ").split())


# The page other languages are written from

PAGE = (Path(gcd_node.__file__).parent.parent / "docs" / "protocol.md").read_text()


def test_the_protocol_page_names_every_header_key() -> None:
    header = json.loads(header_text(jpeg_message()))
    nested = [*header["src"], *header["quality"], *header["model"], *header["pose"][0], *header["src_pose"]]
    classes = json.loads(header_text(class_map()))["classes"]
    assert [key for key in (*header, *nested, "scale", "classes", *classes[0]) if f"`{key}`" not in PAGE] == []


def test_the_example_on_the_protocol_page_is_a_message() -> None:
    part = bytes.fromhex(PAGE.split("```hex")[1].split("```")[0])
    message = decode(part)
    assert isinstance(message, EndMessage)
    assert (message.topic, message.sequence, message.header.window_id) == ("view/top/win", 3, 2)
    assert encode(message) == part
