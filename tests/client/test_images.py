"""Pixels of messages: raw, JPEG, class maps, visibility, inverse depth."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from wire_messages import CLASSES, cells, class_map, depth, grid, pixels, view_header, window

from gcd_client.images import GridLayers, colours, decode_jpegs, depth_m, encode_jpegs, images, inverse_depth, layers
from gcd_client.protocol import MessageError, ViewMessage, decode, encode


def test_raw_images_are_the_received_bytes_and_read_only() -> None:
    part = encode(window(images=pixels(5)))
    shown = images(decode(part))
    assert np.array_equal(shown, pixels(5))
    assert np.shares_memory(shown, np.frombuffer(part, np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        shown[0, 0, 0, 0] = 1


def test_inverse_depth_and_metres_agree() -> None:
    message = depth(5)
    inverse, metres = inverse_depth(message), depth_m(message)
    assert np.array_equal(inverse, np.frombuffer(message.payload, "<f2").reshape(2, 4, 6))
    assert np.array_equal(np.isnan(metres), inverse == 0)
    assert np.allclose((metres * inverse)[inverse > 0], 1)
    with pytest.raises(MessageError):
        images(message)
    with pytest.raises(MessageError):
        inverse_depth(window())


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_a_depth_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(MessageError, match="finite and not negative"):
        inverse_depth(depth(inverse=np.array([[[0.5, value]]], "<f2")))


def test_nearer_is_brighter_and_no_depth_is_black() -> None:
    shown = colours(depth(inverse=np.array([[[0, 0.005, 0.1, 1, 65504]]], "<f2")))[0, 0, :, 0]
    assert (np.diff(shown.astype(int)) > 0).all()
    assert shown[0] == 0


def test_cells_of_a_grid_come_back_as_they_were_sent() -> None:
    message = decode(encode(grid()))
    for sent, read in zip(cells(), layers(message), strict=True):
        assert (sent.dtype, sent.tolist()) == (read.dtype, read.tolist())


@pytest.mark.parametrize(
    ("layer", "value"),
    [("occupancy", 50), ("visibility", 3), ("visibility", 0), ("classes", 9), ("height_m", math.nan)],
)
def test_cells_that_contradict_themselves_are_refused(layer: str, value: float) -> None:
    broken = cells()._asdict()
    broken[layer] = np.full_like(broken[layer], value)
    with pytest.raises(MessageError):
        layers(grid(GridLayers(**broken)))


def test_a_class_map_is_shown_in_the_colours_of_its_ontology() -> None:
    drawn = np.array([[[0, 1, 7], [7, 7, 0]]], np.uint8)
    shown = colours(class_map(drawn=drawn))
    of = {each.id: each.colour for each in CLASSES}
    assert [[tuple(pixel) for pixel in row] for row in shown[0].tolist()] == [[of[n] for n in row] for row in drawn[0]]
    with pytest.raises(MessageError, match="got 2"):
        colours(class_map(drawn=np.array([[[0, 1, 2]]], np.uint8)))


# JPEG


def smooth() -> np.ndarray:
    rows, columns = np.mgrid[0:48, 0:64]
    frame = np.stack([rows * 5, columns * 3, 255 - rows * 2], axis=-1).clip(0, 255).astype(np.uint8)
    return np.stack([frame, frame[::-1]])


def jpeg_message(width: int = 64) -> ViewMessage:
    payload, offsets = encode_jpegs(smooth(), 90)
    header = replace(view_header(shape=(2, 48, width, 3)), encoding="jpeg", offsets=offsets)
    return ViewMessage(topic="view/top/win", header=header, payload=payload)


def test_jpeg_frames_keep_their_colours_and_order() -> None:
    shown = images(decode(encode(jpeg_message())))
    assert np.abs(shown.astype(int) - smooth()).mean() < 2
    assert not shown.flags.writeable


def test_a_jpeg_of_another_size_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(MessageError, match=r"\(48, 60\), got \(48, 64\)"):
        images(jpeg_message(width=60))


@pytest.mark.parametrize("coded", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\x00\x00" * 9, b"\x89PNG" + bytes(99)])
def test_what_is_no_jpeg_is_refused(coded: bytes) -> None:
    with pytest.raises(MessageError):
        decode_jpegs(coded, (0, len(coded)), (1, 48, 64, 3))
