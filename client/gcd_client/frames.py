"""Pushes frames of a camera that somebody else owns into a node whose source is `push` (docs/cameras.md, protocol 3.1).

    with FramePusher("ipc") as pusher:
        pusher.push(image, stamp_ns)

What a frame is made of, as bytes and back, stands here too: the node reads it with decode_frame().
"""

import math
import uuid
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import zmq
from msgspec import Meta
from numpy.typing import NDArray

from gcd_client.endpoints import Client, ClientKeys, Connection, resolve_endpoint
from gcd_client.images import decode_jpegs, jpeg_size
from gcd_client.protocol import (
    HAS_PAYLOAD,
    MAX_PAYLOAD,
    PUSH_PROTO,
    TOPIC_BYTES,
    MessageError,
    Nanosec,
    Record,
    Whole,
    check_version,
    pack,
    unpack,
)

MAX_PIXELS = 64_000_000
PUSH_KEY = b"push".ljust(TOPIC_BYTES, b"\0")
_SECOND_NS = 1_000_000_000
_POSE_BYTES = 128
_RECONNECT_MS = 1000
Side = Annotated[int, Meta(ge=1, le=65535)]


class FrameHeader(Record, frozen=True, kw_only=True, omit_defaults=True):
    """Describes a payload: 16 doubles if `odometry`, then the floats of `depth` [H, W], then the image.

    pusher: new with every FramePusher. stamp: mid-exposure, UTC, seconds and nanoseconds. shape: [H, W, 3].
    """

    proto: str
    pusher: Annotated[str, Meta(pattern=r"^[0-9a-f]{32}\Z")]
    stamp: tuple[Whole, Nanosec]
    shape: tuple[Side, Side, Literal[3]]
    encoding: Literal["rgb8", "jpeg"]
    depth: tuple[Side, Side] | None = None
    odometry: bool = False


@dataclass(frozen=True, kw_only=True)
class PushedFrame:
    """A frame as it was pushed; what depth and odometry hold is not checked.

    pusher, seq: who pushed it, and his number of it, gaps where he skipped some. stamp_ns: UTC. image: u8 [H, W, 3],
    RGB, read-only. depth: float32 [h, w], metres. odometry: float64 [4, 4], world_from_camera, metres.
    """

    pusher: str
    seq: int
    stamp_ns: int
    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    odometry: NDArray[np.float64] | None = None


class FramePusher(Client):
    """Sends frames to one node and never waits for it. For one thread.

    endpoint: "ipc" for the node on this machine, or ipc://PATH, tcp://HOST:PORT. keys: for a node that asks for them.
    skipped: frames that were not sent, because the node was not there or still busy with those before.
    """

    def __init__(self, endpoint: str = "ipc", *, keys: ClientKeys | None = None) -> None:
        self.endpoint, self.skipped = resolve_endpoint(endpoint, "frames"), 0
        self._id, self._seq = uuid.uuid4().hex, 0
        options: dict[int, int] = {zmq.SNDHWM: 1, zmq.IMMEDIATE: 1, zmq.RECONNECT_IVL_MAX: _RECONNECT_MS}
        self._connection = Connection(self.endpoint, zmq.PUSH, keys, options)

    def push(
        self,
        image: NDArray[np.uint8] | bytes,
        stamp_ns: int,
        depth: NDArray[Any] | None = None,
        odometry: NDArray[Any] | None = None,
    ) -> bool:
        """Send a frame; whether it left.

        Args:
            image: u8 [H, W, 3], RGB; or a JPEG file's bytes, which the node decodes.
            stamp_ns: middle of the exposure, UTC, as time.time_ns() and ROS stamps are.
            depth: [H, W] metres along the camera's axis at the picture's pixels, of its shape; 0 or NaN is a hole.
            odometry: [4, 4], world_from_camera, rigid, metres, camera axes x right, y down, z ahead.
        Raises:
            MessageError: an array of another type or shape. AuthError: the node refuses the connection; then make a new
            pusher.
        """
        self._connection.check()
        self._seq += 1
        remote = self.endpoint.startswith("tcp://")
        part = encode_frame(self._id, self._seq - 1, image, stamp_ns, depth, odometry, checksum=remote)
        try:
            self._connection.socket.send(part, zmq.NOBLOCK, copy=False)
        except zmq.Again:
            self.skipped += 1
            return False
        return True


def encode_frame(
    pusher: str,
    seq: int,
    image: NDArray[np.uint8] | bytes,
    stamp_ns: int,
    depth: NDArray[Any] | None = None,
    odometry: NDArray[Any] | None = None,
    *,
    checksum: bool = True,
) -> bytes:
    """One ZeroMQ part. Arguments and errors as of FramePusher.push()."""
    payload = [] if odometry is None else [_plain(odometry, "odometry", "<f8", (4, 4))]
    payload += [] if depth is None else [_plain(depth, "depth", "<f4", (None, None))]
    if isinstance(image, bytes):
        payload.append(memoryview(image))
        height, width = jpeg_size(image) or (0, 0)
    else:
        payload.append(_plain(image, "image", "u1", (None, None, 3)))
        height, width = image.shape[:2]
    if height * width == 0:
        raise MessageError("an image given as bytes must be a JPEG file's")
    header = FrameHeader(
        proto=PUSH_PROTO,
        pusher=pusher,
        stamp=divmod(int(stamp_ns), _SECOND_NS),
        shape=(height, width, 3),
        encoding="jpeg" if isinstance(image, bytes) else "rgb8",
        depth=None if depth is None else depth.shape[:2],
        odometry=odometry is not None,
    )
    return pack(PUSH_KEY, HAS_PAYLOAD, seq, msgspec.json.encode(header), *payload, checksum=checksum)


def _plain(array: NDArray[Any], name: str, kind: str, sides: tuple[int | None, ...]) -> memoryview:
    """An array's bytes as they are sent. sides: its shape, None for any length. Raises MessageError."""
    right = array.dtype == np.uint8 if kind == "u1" else np.issubdtype(array.dtype, np.floating)
    fits = len(sides) == array.ndim and all(side in (None, array.shape[i]) for i, side in enumerate(sides))
    if not (right and fits and array.size > 0):
        expected = f"{'u8' if kind == 'u1' else 'floats'} {['any' if side is None else side for side in sides]}"
        raise MessageError(f"{name} must be {expected}, got {array.dtype} {list(array.shape)}")
    return np.ascontiguousarray(array, kind).data.cast("B")


def decode_frame(part: bytes | memoryview, max_payload: int = MAX_PAYLOAD) -> PushedFrame:
    """Inverse of encode_frame(); raw pictures, depth and odometry are views into `part`.

    Raises MessageError: no frame, damaged, or of another major version. SetupError: a JPEG, and cv2 is not installed.
    """
    key, flags, seq, text, payload = unpack(part, max_payload)
    if key != PUSH_KEY or flags & 0b111 != HAS_PAYLOAD:
        raise MessageError(f"a pushed frame has the topic push and a payload, got {key.rstrip(bytes(1))!a:.40}")
    try:
        header = msgspec.json.decode(text, type=FrameHeader)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"header of a pushed frame: {str(error)!a:.200}") from error
    check_version(header.proto)
    start = _POSE_BYTES * header.odometry
    end = start + 4 * (0 if header.depth is None else header.depth[0] * header.depth[1])
    pixels = payload[end:]
    if header.shape[0] * header.shape[1] > MAX_PIXELS:
        raise MessageError(f"a picture has at most {MAX_PIXELS} pixels, got {list(header.shape)}")
    if len(payload) <= end or (header.encoding == "rgb8" and len(pixels) != math.prod(header.shape)):
        raise MessageError(f"{len(payload)} payload bytes do not fit a frame of {list(header.shape)}")
    if header.encoding == "jpeg":
        image = decode_jpegs(pixels, (0, len(pixels)), (1, *header.shape))[0]
    else:
        image = np.frombuffer(pixels, np.uint8).reshape(header.shape)
    return PushedFrame(
        pusher=header.pusher,
        seq=seq,
        stamp_ns=header.stamp[0] * _SECOND_NS + header.stamp[1],
        image=image,
        depth=None if header.depth is None else np.frombuffer(payload[start:end], "<f4").reshape(header.depth),
        odometry=np.frombuffer(payload[:start], "<f8").reshape(4, 4) if header.odometry else None,
    )
