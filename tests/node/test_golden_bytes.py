"""Every kind of message, byte for byte as it has been since 1.0 (and 1.1 for maps): SHA-256 of recorded bytes."""

import hashlib

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from wire_messages import BOOT, class_map, depth, end, view_header, visibility, window

from gcd_client.control import Code, Reply, Request, encode_request
from gcd_client.protocol import (
    PROTO,
    EndMessage,
    Message,
    OriginHeader,
    StatusMessage,
    StatusTopic,
    ViewMessage,
    encode,
)

STAMP_NS = 1_700_000_002_123_456_789
ORIGIN = OriginHeader(node_id="gcd", boot_id=BOOT, t_publish_ns=STAMP_NS)


def stamped(message: ViewMessage | EndMessage) -> Message:
    return replace(message, header=replace(message.header, t_publish_ns=STAMP_NS), sequence=7)


def jpeg() -> ViewMessage:
    payload = bytes(range(100))
    header = replace(view_header(), encoding="jpeg", offsets=(0, 40, 100))
    return ViewMessage(topic="view/top/win", header=header, payload=payload)


def spread() -> ViewMessage:
    header = replace(view_header(shape=(2, 4, 6, 1)), scale=0.25)
    return ViewMessage(topic="view/top/std", header=header, payload=bytes(48))


def preview() -> ViewMessage:
    header = view_header(view_id="src", shape=(1, 4, 6, 3))
    return ViewMessage(topic="src/frm", header=header, payload=bytes(72))


def note(topic: StatusTopic) -> StatusMessage:
    fields = {"state": "active", "level": 1, "reasons": ["SRC_STALLED"], "numbers": {"a": 1.5, "é": None, "b": True}}
    return StatusMessage(topic=topic, header=ORIGIN, fields=fields, sequence=3)


MESSAGES: dict[str, tuple[Message, str]] = {
    "win": (stamped(window()), "6f9c25e8e887e5dd"),
    "frm": (stamped(window(kind="frm", images=np.zeros((1, 4, 6, 3), np.uint8))), "a2d48a39d5e10f7d"),
    "jpeg": (stamped(jpeg()), "3dfe1948ac65e671"),
    "std": (stamped(spread()), "c3b614c9d4032aa6"),
    "cls": (stamped(class_map()), "20282abcca4d372a"),
    "vis": (stamped(visibility()), "0bf890c50f60cad5"),
    "depth": (stamped(depth()), "03e65644266df55a"),
    "src": (stamped(preview()), "c1f9e5a5e28ef029"),
    "end": (stamped(end()), "8ab29cecdf73e2a2"),
    "status": (note("status"), "78b8489d084c92e7"),
    "event": (note("event"), "8de3aded17024dc4"),
    "meta": (note("meta"), "81d85d73b0b94257"),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_the_recorded_bytes(name: str) -> None:
    message, recorded = MESSAGES[name]
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
