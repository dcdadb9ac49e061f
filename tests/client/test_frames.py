"""Pushed frames as bytes and back."""

import cv2
import numpy as np
import pytest

from gcd_client.frames import PUSH_KEY, decode_frame, encode_frame
from gcd_client.protocol import MessageError, pack

WHO = "0123456789abcdef" * 2
STAMP_NS = 1_764_000_000_123_456_789
IMAGE = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
DEPTH = np.linspace(0.5, 9, 48, dtype=np.float32).reshape(6, 8)
POSE = np.eye(4) + 0.25


@pytest.mark.parametrize("checksum", [True, False])
@pytest.mark.parametrize("depth", [None, DEPTH, DEPTH.astype(np.float64), np.full((3, 4), np.nan, np.float16)])
@pytest.mark.parametrize("odometry", [None, POSE])
def test_a_frame_survives_the_way(checksum: bool, depth: np.ndarray | None, odometry: np.ndarray | None) -> None:
    found = decode_frame(encode_frame(WHO, 7, IMAGE, STAMP_NS, depth, odometry, checksum=checksum))
    assert (found.pusher, found.seq, found.stamp_ns) == (WHO, 7, STAMP_NS)
    assert np.array_equal(found.image, IMAGE)
    for sent, come, kind in ((depth, found.depth, np.float32), (odometry, found.odometry, np.float64)):
        assert (sent is None) == (come is None)
        if sent is not None and come is not None:
            assert come.dtype == kind
            assert np.array_equal(come, sent.astype(kind), equal_nan=True)


def test_a_picture_that_is_no_whole_block_of_memory_is_sent_as_it_looks() -> None:
    turned = IMAGE[::-1, ::2]
    assert np.array_equal(decode_frame(encode_frame(WHO, 0, turned, STAMP_NS)).image, turned)


def test_a_jpeg_is_passed_on_and_decoded_there() -> None:
    grey = np.full((32, 48, 3), 90, np.uint8)
    found = decode_frame(encode_frame(WHO, 0, cv2.imencode(".jpg", grey)[1].tobytes(), STAMP_NS, DEPTH))
    assert np.abs(found.image.astype(int) - 90).max() <= 2
    assert found.depth is not None


def test_what_no_frame_is_made_of_is_refused_where_it_is_pushed() -> None:
    for image, depth, odometry in (
        (IMAGE.astype(np.float32), None, None),
        (IMAGE[..., 0], None, None),
        (np.zeros((0, 8, 3), np.uint8), None, None),
        (b"no jpeg", None, None),
        (IMAGE, (1000 * DEPTH).astype(np.uint16), None),
        (IMAGE, DEPTH[None], None),
        (IMAGE, None, np.eye(3)),
        (IMAGE, None, np.eye(4, dtype=int)),
    ):
        with pytest.raises(MessageError, match="must be"):
            encode_frame(WHO, 0, image, STAMP_NS, depth, odometry)


def header(text: bytes, payload: bytes = b"x" * 64) -> bytes:
    return pack(PUSH_KEY, 1, 0, text, payload)


def test_headers_that_promise_what_is_not_there_are_refused() -> None:
    for text in (
        b"{}",
        b"[" * 5000,
        b"\xff",
        b'{"proto":"gcd/2.0","pusher":"%s","stamp":[1,0],"shape":[4,4,3],"encoding":"rgb8"}' % WHO.encode(),
        b'{"proto":"gcd/1.2","pusher":"%s","stamp":[1,0],"shape":[4,4,3],"encoding":"rgb8"}' % WHO.encode(),
        b'{"proto":"gcd/1.2","pusher":"%s","stamp":[1,-1],"shape":[4,4,3],"encoding":"rgb8"}' % WHO.encode(),
        b'{"proto":"gcd/1.2","pusher":"%s","stamp":[1,0],"shape":[65535,65535,3],"encoding":"jpeg"}' % WHO.encode(),
        b'{"proto":"gcd/1.2","pusher":"%s","stamp":[1,0],"shape":[1,1,3],"encoding":"jpeg","depth":[9,9]}'
        % WHO.encode(),
    ):
        with pytest.raises(MessageError):
            decode_frame(header(text))
