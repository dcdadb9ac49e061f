"""Whatever arrives from outside ends as something valid or as a documented error, and nothing of it stays.

GCD_MUTATIONS=100000 makes as many inputs for each parser; the default is a fraction. The same for logs is in
test_damaged_logs.py.
"""

import contextlib
import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from mutations import BYTE_PIECES, ROUNDS, TEXT_PIECES, Mutator, outcomes
from wire_messages import class_map, end, origin, pixels, view_header, window

from gcd_client.control import Reply, decode_reply
from gcd_client.images import colours, decode_jpegs, encode_jpegs, images
from gcd_client.protocol import (
    MAGIC,
    PREFIX,
    Message,
    MessageError,
    StatusMessage,
    ViewMessage,
    decode,
    encode,
    topic_key,
    view_topic,
)
from gcd_node.auth import load_clients
from gcd_node.config import parse_config, to_toml
from gcd_node.errors import ConfigError, NodeError, SourceError
from gcd_node.frame import load_lens
from gcd_node.sources.files import read_picture
from gcd_node.verbs import VERBS, Command, RequestError, parse_command

SETTINGS = settings(
    max_examples=max(30, ROUNDS // 16),
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
)
LAUNCH = sorted((Path(__file__).parents[2] / "launch").glob("*.toml"))

pytestmark = pytest.mark.timeout(max(120, ROUNDS // 10))


def jpeg_window() -> ViewMessage:
    drawn = np.stack([cv2.resize(each, (24, 16)) for each in pixels(3)])
    payload, offsets = encode_jpegs(drawn, 90)
    header = replace(view_header(shape=drawn.shape), encoding="jpeg", offsets=offsets)
    return ViewMessage(topic=view_topic("top", "win"), header=header, payload=payload)


def note(fields: dict[str, Any]) -> StatusMessage:
    return StatusMessage(topic="status", header=origin(), fields=fields)


def use(message: Message) -> str:
    """Do with a message what a reader does."""
    again = decode(encode(message))
    assert again == replace(message, sequence=again.sequence)
    if not isinstance(message, ViewMessage):
        return type(message).__name__
    try:
        drawn = images(message)
        assert drawn.shape == message.header.shape
        assert colours(message).shape == (*drawn.shape[:3], 3)
    except MessageError:
        return "pixels refused"
    return message.header.encoding


def without_checksum(part: bytes) -> bytes:
    """So that the checks behind the checksum are reached."""
    return part if len(part) < PREFIX.size else part[:56] + bytes(4) + part[60:]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=20,
)


def header_of(part: bytes) -> dict[str, Any]:
    return json.loads(part[PREFIX.size : PREFIX.size + 16 * struct.unpack_from("<H", part, 36)[0]])


HEADER_KEYS = st.sampled_from(sorted(header_of(encode(window()))))


def raw_message(topic: bytes, header: bytes, payload: bytes, flags: int) -> bytes:
    padded = header.ljust(-(-len(header) // 16) * 16)
    return PREFIX.pack(topic, MAGIC, len(padded) // 16, flags, len(payload), 0, 0, 0) + padded + payload


@SETTINGS
@given(
    topic=st.sampled_from([topic_key("view/top/win"), topic_key("status"), topic_key("src/frm"), bytes(32)]),
    changes=st.dictionaries(HEADER_KEYS | st.text(max_size=8), JSON, max_size=3),
    payload=st.binary(max_size=200),
    flags=st.integers(0, 15),
)
def test_any_header_ends_as_a_message_or_a_message_error(
    topic: bytes, changes: dict[str, Any], payload: bytes, flags: int
) -> None:
    header = json.dumps({**header_of(encode(window())), **changes}).encode()
    part = raw_message(topic, header[: 60 * 1024], payload, flags)
    with contextlib.suppress(MessageError):
        assert use(decode(part))


ARGUMENTS: dict[str, dict[str, object]] = {
    "set_view": {"view": "top", "azimuth_deg": 10.0, "elevation_deg": 5, "radius": 0.5},
    "remove_view": {"view": "top"},
    "set_param": {"steps": 4, "guidance": [1.0, 1.5], "seed": 7, "samples": 2, "jpeg_quality": 80, "publish": "jpeg"},
}


def request(verb: str, args: dict[str, object], **more: object) -> bytes:
    return json.dumps({"proto": "gcd/1.0", "id": "a1", "verb": verb, "args": args, **more}).encode()


def requests() -> list[bytes]:
    plain = [request(verb, ARGUMENTS.get(verb, {}), dry_run=True) for verb in VERBS]
    rigid = request("set_view", {"view": "top", "T_src_dst": [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]})
    return [*plain, rigid, request("set_view", {"view": "top", "kind": "orbit", "rate_deg_s": 1.0}, if_view_rev=3)]


def commanded(part: bytes) -> str:
    command = parse_command(part)
    assert isinstance(command, Command)
    return command.verb


@SETTINGS
@given(verb=st.sampled_from(sorted(VERBS)) | st.text(max_size=12), args=JSON, more=st.dictionaries(st.text(), JSON))
def test_any_json_ends_as_a_command_or_a_request_error(verb: str, args: object, more: dict[str, object]) -> None:
    part = json.dumps({"proto": "gcd/1.0", "id": "a1", "verb": verb, "args": args, **more}).encode()
    try:
        assert commanded(part) in VERBS
    except RequestError as error:
        told = Reply(
            id=error.request_id, ok=False, code=error.reason, message=str(error), state="", result=error.result
        )
        assert decode_reply(msgspec.json.encode(told)) == told  # and the refusal can be sent


CONFIG = b"""
node_id = "front"
strict = true
[source]
kind = "rtsp"
url = "rtsp://user:secret@camera/1"
width = 1280
pose = {elevation_deg = 5.0, radius = 15.0}
[model]
weights = "package:live-small"
guidance = [1.0, 1.5]
[view.top]
kind = "orbit"
rate_deg_s = 5.0
amplitude_deg = 30
[view."side"]
azimuth_deg = -1e1
[publish]
jpeg_quality = 75
[life]
idle_s = 2.5
"""
CAMERA = b'[source]\nkind = "v4l2"\ndevice = "/dev/video0"\n[model]\nweights = "random:kubric90"\n[view.top]\n'


def configured(part: bytes, changes: Sequence[str] = ()) -> str:
    config = parse_config(part, "launch.toml", changes)
    again = parse_config(to_toml(config).encode(), "again")
    assert (again.view, again.model, again.window) == (
        config.view,
        config.model,
        config.window,
    )  # passwords are hidden, so not the whole
    return config.source.kind


@SETTINGS
@given(
    changes=st.lists(
        st.text(max_size=30)
        | st.builds(
            "{}.{}={}".format,
            st.sampled_from(["source", "model", "view.top", "publish", "life", "health"]),
            st.text(max_size=8),
            st.text(max_size=12),
        )
    )
)
def test_any_change_ends_as_a_configuration_or_a_config_error(changes: list[str]) -> None:
    with contextlib.suppress(NodeError):
        assert configured(CONFIG, changes)


CLIENTS = b"""
[client.desk]
key = "rq:rM>}U?@Lns47E1%kR.o@n%FcmmsL/@{H8]yf7"
role = "operator"
[client.wall]
key = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID"
"""
LENS = b"""
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [433.5, 0.0, 322.25, 0.0, 432.75, 241.5, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients:
  data: [-0.35, 0.12, 1e-05, -2.5e-04, 0]
"""


def pictures(*suffixes: str) -> list[bytes]:
    def coded(suffix: str, width: int, height: int, *options: int) -> bytes:
        drawn = cv2.resize(pixels(5, frames=1)[0], (width, height))
        return cv2.imencode(suffix, drawn, options)[1].tobytes()

    others = coded(".jpg", 40, 8), coded(".jpg", 24, 16, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    return [*(coded(suffix, 24, 16) for suffix in suffixes), *others]


PICTURES = pictures(".jpg", ".png", ".bmp", ".webp", ".tiff")


def clients_of(path: Path) -> object:
    path.chmod(0o600)
    return load_clients(path)


def drawn(part: bytes) -> str:
    frames = decode_jpegs(part, (0, len(part)), (1, 16, 24, 3))
    assert frames.shape == (1, 16, 24, 3)
    return "frames"


def read_from(path: Path, part: bytes, read: Callable[[Path], object]) -> str:
    path.write_bytes(part)
    read(path)
    return "read"


STATUS = note({"state": "active", "level": 0, "reasons": [], "source": {"state": "streaming", "fps": 24.0}})
MESSAGES = [encode(each) for each in (window(), jpeg_window(), class_map(), end(), STATUS)]
CONFIGS = [CONFIG, CAMERA, *(path.read_bytes() for path in LAUNCH)]
ANY_PIECES = TEXT_PIECES + BYTE_PIECES


@pytest.mark.parametrize(
    ("read", "examples", "pieces", "error", "least_refused", "least_accepted"),
    [
        (lambda part, _: use(decode(part)), MESSAGES, ANY_PIECES, MessageError, 0.25, 0),
        (lambda part, _: use(decode(without_checksum(part))), MESSAGES, ANY_PIECES, MessageError, 0.25, 0.05),
        (lambda part, _: commanded(part), requests(), TEXT_PIECES, RequestError, 0.25, 0.05),
        (lambda part, _: configured(part), CONFIGS, TEXT_PIECES, ConfigError, 0.25, 0.05),
        (lambda part, path: read_from(path, part, clients_of), [CLIENTS], TEXT_PIECES, ConfigError, 0.02, 0),
        (lambda part, path: read_from(path, part, load_lens), [LENS], TEXT_PIECES, ConfigError, 0.02, 0.002),
        (lambda part, path: read_from(path, part, read_picture), PICTURES, BYTE_PIECES, SourceError, 0.02, 0.02),
        (lambda part, _: drawn(part), pictures(".jpg"), BYTE_PIECES, MessageError, 0.02, 0.02),
    ],
    ids=[
        "messages",
        "messages without checksum",
        "requests",
        "launch files",
        "clients",
        "lens",
        "picture",
        "jpeg view",
    ],
)
def test_what_was_tampered_with_ends_as_what_it_is_or_a_documented_error(
    tmp_path: Path,
    read: Callable[[bytes, Path], str],
    examples: list[bytes],
    pieces: Sequence[bytes],
    error: type[Exception],
    least_refused: float,
    least_accepted: float,
) -> None:
    """least_refused, least_accepted: shares, so that both ways are tried."""
    ended = outcomes(lambda part: read(part, tmp_path / "mutated"), Mutator(5, examples, pieces), error)
    assert ended["refused"] >= least_refused * ROUNDS
    assert ended.total() - ended["refused"] >= least_accepted * ROUNDS
