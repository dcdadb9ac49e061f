"""Small messages for the tests of the wire side, and a real second process that reads them."""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gcd_client.images import VISIBILITY, GridLayers, encode_jpegs, grid_payload, payload_of
from gcd_client.protocol import (
    MAPS_PROTO,
    ClassRecord,
    EndHeader,
    EndMessage,
    GridHeader,
    GridMessage,
    ModelRecord,
    OriginHeader,
    PoseDelta,
    QualityRecord,
    SourcePoseRecord,
    SourceRecord,
    ViewHeader,
    ViewKind,
    ViewMessage,
    grid_topic,
    view_topic,
)
from gcd_client.subscriber import ReceivedView

BOOT = "0123456789abcdef" * 2
OTHER_BOOT = "f" * 32
READER = Path(__file__).with_name("reader_process.py")


def pixels(seed: int = 0, frames: int = 2, height: int = 4, width: int = 6, channels: int = 3) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (frames, height, width, channels), dtype=np.uint8)


def view_header(
    *,
    view_id: str = "top",
    window_id: int = 0,
    boot_id: str = BOOT,
    view_rev: int = 1,
    age_ms: float = 40.5,
    shape: tuple[int, ...] = (2, 4, 6, 3),
    t_publish_ns: int | None = None,
) -> ViewHeader:
    frames = shape[0]
    return ViewHeader(
        node_id="gcd",
        boot_id=boot_id,
        t_publish_ns=time.time_ns() if t_publish_ns is None else t_publish_ns,
        view_id=view_id,
        view_rev=view_rev,
        window_id=window_id,
        t_capture_ns=tuple(1_700_000_000_000_000_001 + 100_000_000 * i for i in range(frames)),
        t_capture_unc_us=500,
        clock="replay",
        t_infer_start_ns=1_700_000_001_000_000_000,
        t_infer_end_ns=1_700_000_001_999_999_999,
        age_ms=age_ms,
        valid_for_ms=60_000,
        src=SourceRecord(
            kind="file",
            id="drive.mp4",
            seq=tuple(range(frames)),
            dropped=0,
            fps_in=10.0,
            fps_cond=10.0,
            resize="released",
        ),
        frame_id=f"{view_id}_optical",
        src_frame_id="source_optical",
        pose=tuple(PoseDelta(az_deg=3.0 * i, el_deg=1.5, r=0.0) for i in range(frames)),
        source_from_view=tuple(tuple(float(i == j) for i in range(4) for j in range(4)) for _ in range(frames)),
        src_pose=SourcePoseRecord(el_deg=5.0, r=15.0, assumed=True),
        frame_role=("in_transit",) * (frames - 1) + ("at_goal",),
        intrinsics=(300.0, 0.0, 3.0, 0.0, 300.0, 2.0, 0.0, 0.0, 1.0),
        shape=shape,
        encoding="rgb8" if shape[3] == 3 else "mono8",
        quality=QualityRecord(nan_frames=0, ood=("fps",), steps=4, seed=7),
        model=ModelRecord(name="random", family="unknown", sha256_12="0" * 12, precision="float32", device="cpu"),
        cfg_digest="abcdef012345",
    )


def window(
    window_id: int = 0,
    *,
    view_id: str = "top",
    kind: ViewKind = "win",
    boot_id: str = BOOT,
    view_rev: int = 1,
    images: NDArray[np.uint8] | None = None,
    age_ms: float = 40.5,
) -> ViewMessage:
    images = pixels(window_id) if images is None else images
    header = view_header(
        view_id=view_id, window_id=window_id, boot_id=boot_id, view_rev=view_rev, age_ms=age_ms, shape=images.shape
    )
    return ViewMessage(topic=view_topic(view_id, kind), header=header, payload=payload_of(images))


def jpeg_window(window_id: int = 0, **changes: Any) -> ViewMessage:
    """Two frames as JPEG; changes: of the header."""
    drawn = pixels(window_id, height=16, width=24)
    payload, offsets = encode_jpegs(drawn, 90)
    header = replace(view_header(window_id=window_id, shape=drawn.shape), encoding="jpeg", offsets=offsets, **changes)
    return ViewMessage(topic="view/top/win", header=header, payload=payload)


CLASSES = (
    ClassRecord(id=0, name="sky", colour=(90, 160, 255)),
    ClassRecord(id=1, name="road", colour=(80, 80, 80)),
    ClassRecord(id=7, name="own_car", colour=(255, 128, 0)),
)


def numbers(seed: int = 0, frames: int = 2, height: int = 4, width: int = 6) -> NDArray[np.uint8]:
    """A class map of CLASSES, u8 [T, H, W]."""
    known = np.array([each.id for each in CLASSES], np.uint8)
    return np.random.default_rng(seed).choice(known, (frames, height, width))


def class_map(window_id: int = 0, *, view_id: str = "top", drawn: NDArray[np.uint8] | None = None) -> ViewMessage:
    drawn = numbers(window_id) if drawn is None else drawn
    header = view_header(view_id=view_id, window_id=window_id, shape=(*drawn.shape, 1))
    header = replace(header, encoding="class8", classes=CLASSES, range=(0, 7))
    return ViewMessage(topic=view_topic(view_id, "cls"), header=header, payload=payload_of(drawn))


def visibility(window_id: int = 0, *, seen: NDArray[np.uint8] | None = None) -> ViewMessage:
    """Of view top; drawn by chance."""
    seen = np.random.default_rng(window_id).integers(0, 3, (2, 4, 6), np.uint8) if seen is None else seen
    header = replace(view_header(window_id=window_id, shape=(*seen.shape, 1)), proto=MAPS_PROTO)
    header = replace(header, encoding="class8", classes=VISIBILITY, range=(0, 2))
    return ViewMessage(topic="view/top/vis", header=header, payload=payload_of(seen))


def depth(window_id: int = 0, *, inverse: NDArray[np.float16] | None = None) -> ViewMessage:
    """Of view top; drawn by chance, with holes."""
    if inverse is None:
        chance = np.random.default_rng(window_id)
        inverse = (chance.uniform(0.005, 3.3, (2, 4, 6)) * (chance.random((2, 4, 6)) > 0.2)).astype("<f2")
    header = replace(view_header(window_id=window_id, shape=(*inverse.shape, 1)), proto=MAPS_PROTO)
    header = replace(header, encoding="invdepth16", dtype="f16", range=(0, 65504))
    return ViewMessage(topic="view/top/depth", header=header, payload=payload_of(inverse.view(np.uint8)))


def cells() -> GridLayers:
    """Two rows of three: what is free, occupied and unknown, and what was seen of it."""
    return GridLayers(
        np.array([[0, 100, -1], [0, 100, -1]], np.int8),
        np.array([[2, 1, 1], [2, 2, 0]], np.uint8),
        np.array([[1, 7, 1], [1, 7, 0]], np.uint8),
        np.array([[0.125, 1.5, 0.25], [0, 2, 0]], np.float32),
        np.array([[0, 400, 900], [0, 0, 0]], np.uint16),
    )


def grid(layers: GridLayers | None = None, **changes: Any) -> GridMessage:
    """Grid `around` of CLASSES; changes: of the header."""
    layers, view = cells() if layers is None else layers, view_header(shape=(1, 4, 6, 3))
    shared = {name: getattr(view, name) for name in GridHeader.__struct_fields__ if hasattr(view, name)}
    own = {"view_id": "around", "frame_id": "base_link", "shape": (2, 3), "cell_m": 0.5, "origin_m": (-1.0, 2.0)}
    header = GridHeader(**shared | own | {"classes": CLASSES, "synthetic": False, "proto": "gcd/1.3"} | changes)
    return GridMessage(topic=grid_topic(header.view_id), header=header, payload=grid_payload(layers))


def end(*, view_id: str = "top", window_id: int = 0, boot_id: str = BOOT, kind: ViewKind = "win") -> EndMessage:
    header = EndHeader(
        node_id="gcd",
        boot_id=boot_id,
        t_publish_ns=time.time_ns(),
        view_id=view_id,
        view_rev=1,
        window_id=window_id,
        clock="replay",
    )
    return EndMessage(topic=view_topic(view_id, kind), header=header)


def received(message: ViewMessage, **how: Any) -> ReceivedView:
    """As a subscriber gives it."""
    said = {"age_ms": message.header.age_ms, "expired": False, "skipped": 0, "restarted": False}
    return ReceivedView(message=message, **said | how)


def origin(boot_id: str = BOOT) -> OriginHeader:
    return OriginHeader(node_id="gcd", boot_id=boot_id, t_publish_ns=time.time_ns())


def start_reader(endpoint: str, view: str, *options: str) -> "subprocess.Popen[str]":
    """A second Python that prints one JSON line for each view it receives, and one when the stream ends."""
    command = [sys.executable, str(READER), endpoint, view, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def lines_of(reader: "subprocess.Popen[str]") -> list[str]:
    """All lines of a reader that ends by itself."""
    out, _ = reader.communicate(timeout=20)
    assert reader.returncode == 0
    return out.splitlines()
