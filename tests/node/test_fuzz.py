"""Whatever arrives from outside ends as something valid or as a documented error, and nothing of it stays.

GCD_MUTATIONS=100000 makes as many inputs for each parser; the default is a fraction. The same for logs is in
test_robot_logs.py.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from mutations import BYTE_PIECES, ROUNDS, TEXT_PIECES, Mutator, outcomes
from wire_messages import (
    BOOT,
    class_map,
    depth,
    end,
    grid,
    jpeg_window,
    origin,
    pixels,
    view_header,
    visibility,
    window,
)

from gcd_client.control import Code, Reply, Request, encode_request
from gcd_client.frames import decode_frame, encode_frame
from gcd_client.images import colours, decode_jpegs, grid_payload, images, layers
from gcd_client.protocol import (
    PREFIX,
    PROTO,
    EndMessage,
    GridMessage,
    Message,
    MessageError,
    OriginHeader,
    StatusMessage,
    StatusTopic,
    ViewMessage,
    decode,
    encode,
)
from gcd_node.auth import load_clients
from gcd_node.config import parse_config, to_toml
from gcd_node.errors import ConfigError, SourceError
from gcd_node.frame import load_lens
from gcd_node.sources.files import read_picture
from gcd_node.verbs import VERBS, RequestError, parse_command
from gcd_node.viewer.feed import parse_request

pytestmark = pytest.mark.timeout(max(120, ROUNDS // 10))


def use(message: Message) -> str:
    """Do with a message what a reader does."""
    again = decode(encode(message))
    assert again == replace(message, sequence=again.sequence)
    if isinstance(message, GridMessage):
        try:
            assert grid_payload(layers(message)) == message.payload
        except MessageError:
            return "cells refused"
    if not isinstance(message, ViewMessage):
        return type(message).__name__
    try:
        drawn = images(message)
        assert drawn.shape == message.header.shape
        assert colours(message).shape == (*drawn.shape[:3], 3)
    except MessageError:
        return "pixels refused"
    return message.header.encoding


def status() -> StatusMessage:
    fields = {"state": "active", "level": 0, "reasons": [], "source": {"state": "streaming", "fps": 24.0}}
    return StatusMessage(topic="status", header=origin(), fields=fields)


def read_message(part: bytes, _: Path) -> str:
    return use(decode(part))


def read_message_without_checksum(part: bytes, _: Path) -> str:
    """So that the checks behind the checksum are reached."""
    return use(decode(part if len(part) < PREFIX.size else part[:56] + bytes(4) + part[60:]))


def read_frame(part: bytes, _: Path) -> str:
    return str(decode_frame(part).image.dtype)


def read_page(part: bytes, _: Path) -> str:
    return parse_request(part.decode(errors="replace")).type


def request(verb: str, args: object, **more: object) -> bytes:
    return json.dumps({"proto": "gcd/1.0", "id": "a1", "verb": verb, "args": args, **more}).encode()


ARGUMENTS: dict[str, dict[str, object]] = {
    "set_view": {"view": "top", "azimuth_deg": 10.0, "elevation_deg": 5, "radius": 0.5},
    "remove_view": {"view": "top"},
    "align_view": {"view": "top"},
    "set_param": {"steps": 4, "guidance": [1.0, 1.5], "seed": 7, "samples": 2, "jpeg_quality": 80, "publish": "jpeg"},
}
REQUESTS = [
    *(request(verb, ARGUMENTS.get(verb, {}), dry_run=True) for verb in VERBS),
    request("set_view", {"view": "top", "T_src_dst": np.eye(4).flatten().tolist()}),
    request("set_view", {"view": "top", "kind": "orbit", "rate_deg_s": 1.0}, if_view_rev=3),
]


CONFIG = b"""
node_id = "front"
strict = true
source = {kind = "rtsp", url = "rtsp://user:secret@camera/1", pose = {elevation_deg = 5.0, radius = 15.0}}
model = {weights = "package:live-small", guidance = [1.0, 1.5]}
life = {idle_s = 2.5}
[view.top]
kind = "orbit"
rate_deg_s = 5.0
amplitude_deg = 30
[view."side"]
azimuth_deg = -1e1
[publish]
jpeg_quality = 75
"""
LAUNCH = [path.read_bytes() for path in sorted((Path(__file__).parents[2] / "launch").glob("*.toml"))]
CHANGES = [b"model.steps=4\nview.top.azimuth_deg=-3.5\nnode_id=side", b'source.url="rtsp://x"\nlife.nice = 3']
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


def read_launch_file(part: bytes, _: Path, changes: Sequence[str] = ()) -> str:
    config = parse_config(part, "launch.toml", changes)
    again = parse_config(to_toml(config).encode(), "again")  # passwords are hidden, so not the whole is the same
    assert (again.view, again.model, again.window) == (config.view, config.model, config.window)
    return config.source.kind


def read_changes(part: bytes, path: Path) -> str:
    return read_launch_file(CONFIG, path, part.decode(errors="replace").splitlines())


def read_file(path: Path, part: bytes, read: Callable[[Path], object]) -> str:
    path.write_bytes(part)
    path.chmod(0o600)
    read(path)
    return "read"


def read_jpeg(part: bytes, _: Path) -> str:
    assert decode_jpegs(part, (0, len(part)), (1, 16, 24, 3)).shape == (1, 16, 24, 3)
    return "frames"


def picture(suffix: str, width: int = 24, height: int = 16, *options: int) -> bytes:
    return cv2.imencode(suffix, cv2.resize(pixels(5, frames=1)[0], (width, height)), options)[1].tobytes()


JPEGS = [picture(".jpg"), picture(".jpg", 40, 8), picture(".jpg", 24, 16, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)]
PICTURES = [*JPEGS, *map(picture, (".png", ".bmp", ".webp", ".tiff"))]
MESSAGES = [encode(each) for each in (window(), jpeg_window(), class_map(), end(), status(), grid())]
FRAMES = [
    encode_frame(BOOT, 0, pixels(5, frames=1)[0], 5, np.ones((4, 6), np.float32), np.eye(4), checksum=False),
    encode_frame(BOOT, 0, JPEGS[0], 5),
]
PAGE = [
    b'{"type": "ask", "id": 5, "verb": "set_view", "args": {"view": "top"}}',
    b'{"type": "watch", "view": "top"}',
    b'{"type": "hello", "token": "abc"}',
]
ANY = TEXT_PIECES + BYTE_PIECES
READ = ["message", "unchecked", "frame", "page", "request", "launch", "changes", "clients", "lens", "picture", "jpeg"]


@pytest.mark.parametrize(
    ("read", "examples", "pieces", "error", "least_refused", "least_accepted"),
    [
        (read_message, MESSAGES, ANY, MessageError, 0.25, 0),
        (read_message_without_checksum, MESSAGES, ANY, MessageError, 0.25, 0.05),
        (read_frame, FRAMES, ANY, MessageError, 0.25, 0.05),
        (read_page, PAGE, TEXT_PIECES, MessageError, 0.25, 0.05),
        (lambda part, _: parse_command(part).verb, REQUESTS, TEXT_PIECES, RequestError, 0.25, 0.05),
        (read_launch_file, [CONFIG, *LAUNCH], TEXT_PIECES, ConfigError, 0.25, 0.05),
        (read_changes, CHANGES, TEXT_PIECES, ConfigError, 0.25, 0.05),
        (lambda part, path: read_file(path, part, load_clients), [CLIENTS], TEXT_PIECES, ConfigError, 0.02, 0),
        (lambda part, path: read_file(path, part, load_lens), [LENS], TEXT_PIECES, ConfigError, 0.02, 0.002),
        (lambda part, path: read_file(path, part, read_picture), PICTURES, BYTE_PIECES, SourceError, 0.02, 0.02),
        (read_jpeg, JPEGS, BYTE_PIECES, MessageError, 0.02, 0.02),
    ],
    ids=READ,
)
@pytest.mark.slow
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


# Every kind of message, byte for byte as since 1.0 (headers of views since 1.3): SHA-256 of recorded bytes.


STAMP_NS = 1_700_000_002_123_456_789
ORIGIN = OriginHeader(node_id="gcd", boot_id=BOOT, t_publish_ns=STAMP_NS)


def stamped(message: ViewMessage | GridMessage | EndMessage) -> Message:
    return replace(message, header=replace(message.header, t_publish_ns=STAMP_NS), sequence=7)


def view(topic: str, size: int, **changes: object) -> Message:
    """changes: of the header."""
    name = topic.split("/")
    header = view_header(view_id="src" if name[0] == "src" else "top", shape=changes.pop("shape", (2, 4, 6, 3)))
    payload = bytes(range(size)) or bytes(int(np.prod(header.shape)))
    return stamped(ViewMessage(topic=topic, header=replace(header, **changes), payload=payload))


def note(topic: StatusTopic) -> StatusMessage:
    fields = {"state": "active", "level": 1, "reasons": ["SRC_STALLED"], "numbers": {"a": 1.5, "é": None, "b": True}}
    return StatusMessage(topic=topic, header=ORIGIN, fields=fields, sequence=3)


GOLDEN: dict[str, tuple[Message, str]] = {
    "win": (stamped(window()), "4d12cf4ff755ac91"),
    "frm": (stamped(window(kind="frm", images=np.zeros((1, 4, 6, 3), np.uint8))), "89de8e59abd3d1f1"),
    "jpeg": (view("view/top/win", 100, encoding="jpeg", offsets=(0, 40, 100)), "ea0fe3b62a00cc41"),
    "std": (view("view/top/std", 0, shape=(2, 4, 6, 1), scale=0.25), "7cb36ae925cf0efc"),
    "cls": (stamped(class_map()), "5283ef0584cae2e3"),
    "vis": (stamped(visibility()), "132f81b0965b5552"),
    "depth": (stamped(depth()), "c3882be336048266"),
    "src": (view("src/frm", 0, shape=(1, 4, 6, 3)), "00aa41f3f299f889"),
    "grid": (stamped(grid()), "f681bdf734d009c6"),
    "end": (stamped(end()), "8ab29cecdf73e2a2"),
    "status": (note("status"), "78b8489d084c92e7"),
    "event": (note("event"), "8de3aded17024dc4"),
    "meta": (note("meta"), "81d85d73b0b94257"),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_a_message_is_the_recorded_bytes(name: str) -> None:
    message, recorded = GOLDEN[name]
    assert hashlib.sha256(encode(message)).hexdigest()[:16] == recorded


def test_a_request_and_a_reply_are_the_recorded_bytes() -> None:
    arguments = msgspec.Raw(b'{"view":"top","azimuth_deg":30.0}')
    request = Request(proto=PROTO, id="a1", verb="set_view", args=arguments, if_view_rev=2)
    reply = Reply(id="a1", ok=True, code=Code.OK, message="", state="active", result={"view_rev": 3})
    assert (
        encode_request(request)
        == b'{"proto":"gcd/1.0","id":"a1","verb":"set_view","args":{"view":"top","azimuth_deg":30.0},"if_view_rev":2}'
    )
    assert (
        msgspec.json.encode(reply)
        == b'{"id":"a1","ok":true,"code":"OK","message":"","state":"active","result":{"view_rev":3},"proto":"gcd/1.0"}'
    )
