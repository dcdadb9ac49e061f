"""Pictures and videos that are written, and the demo's picture: every column in its place, colours explained."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from wire_messages import CLASSES

from gcd_model import hatched
from gcd_node.demo import moments
from gcd_node.errors import OutputError
from gcd_node.frame import Image
from gcd_node.image_io import legend, to_u8, write_arrays, write_png, write_video

SEEN = np.full((16, 24), 2, np.uint8)


def gradient(red: int = 200) -> Image:
    image = np.zeros((16, 24, 3), np.uint8)
    image[..., 0], image[..., 2] = red, np.arange(24) * 10
    return image


def test_to_u8_rounds_to_the_nearest_level_and_keeps_the_order_of_axes() -> None:
    video = np.zeros((2, 3, 4, 5), np.float32)
    video[1, 0, 2, 3], video[1, 1, 2, 3] = 100.6 / 255, 1.1
    pixels = to_u8(video)
    assert pixels.shape == (2, 4, 5, 3)
    assert pixels[1, 2, 3].tolist() == [101, 255, 0]


def test_png_and_mkv_are_lossless(tmp_path: Path) -> None:
    frames = [gradient(red) for red in (10, 90, 250)]
    write_png(tmp_path / "a" / "b.png", frames[0])
    assert np.array_equal(cv2.imread(str(tmp_path / "a" / "b.png"))[..., ::-1], frames[0])
    write_video(tmp_path / "v.mkv", frames, 10.0)
    capture = cv2.VideoCapture(str(tmp_path / "v.mkv"))
    assert all(np.array_equal(capture.read()[1][..., ::-1], frame) for frame in frames)


def test_what_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        write_png(tmp_path / "file" / "x.png", gradient())


@pytest.mark.parametrize(("width", "lines"), [(80, 3), (220, 2), (1000, 1)])
def test_a_legend_takes_as_many_lines_as_it_needs_and_drops_no_class(width: int, lines: int) -> None:
    picture = legend(CLASSES, width)
    assert picture.shape == (22 * lines, width, 3)
    for each in CLASSES:
        assert (picture == each.colour).all(axis=-1).sum() >= 14 * 14  # its whole swatch


# The demo's.


def test_what_arrived_whole_is_put_together_in_order_and_the_unseen_hatched(tmp_path: Path) -> None:
    pictures = {window: [gradient(10 * window + i) for i in range(2)] for window in (5, 2, 7)}
    for window, frames in pictures.items():
        write_arrays(tmp_path / "vis" / f"{window:06d}.npy", np.stack([SEEN, 0 * SEEN]))
        for i, frame in enumerate(frames):
            write_png(tmp_path / f"{window:06d}_{i:02d}.png", frame)
            write_png(tmp_path / "cls" / f"{window:06d}_{i:02d}.png", frame)
    (tmp_path / "vis" / "000007.npy").unlink()
    shown = list(moments(pictures, tmp_path))
    assert [int(view[0, 0, 0]) for _, view, _, _ in shown] == [20, 21, 50, 51]
    assert np.array_equal(shown[0][2], gradient(20))
    assert np.array_equal(shown[1][2], hatched(gradient(21), 0 * SEEN))
