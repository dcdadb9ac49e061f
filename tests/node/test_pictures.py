from pathlib import Path

import cv2
import numpy as np
import pytest

from gcd_node.errors import OutputError
from gcd_node.pictures.files import (
    heat,
    scaled,
    side_by_side,
    spread,
    strip,
    to_u8,
    write_animation,
    write_frames,
    write_png,
    write_video,
)


def gradient(red: int = 200) -> np.ndarray:
    image = np.zeros((16, 24, 3), np.uint8)
    image[..., 0], image[..., 2] = red, np.arange(24) * 10
    return image


def test_to_u8_takes_levels_as_they_are_without_a_copy_if_they_lie_as_they_are_sent() -> None:
    levels = np.random.default_rng(0).integers(0, 256, (2, 4, 5, 3), np.uint8)
    assert np.shares_memory(to_u8(levels.transpose(0, 3, 1, 2)), levels)
    planar = np.ascontiguousarray(levels.transpose(0, 3, 1, 2))
    assert (to_u8(planar) == levels).all()


def test_to_u8_rounds_to_the_nearest_level_and_keeps_the_order_of_axes() -> None:
    video = np.zeros((2, 3, 4, 5), np.float32)
    video[1, 0, 2, 3] = 100.6 / 255
    pixels = to_u8(video)
    assert pixels.shape == (2, 4, 5, 3)
    assert pixels[1, 2, 3].tolist() == [101, 0, 0]
    assert to_u8(np.full((1, 3, 1, 1), 1.0, np.float32)).max() == 255


def test_a_png_keeps_its_colours(tmp_path: Path) -> None:
    write_png(tmp_path / "a" / "b.png", gradient())
    read = cv2.cvtColor(cv2.imread(str(tmp_path / "a" / "b.png")), cv2.COLOR_BGR2RGB)
    assert np.array_equal(read, gradient())


def test_mkv_is_lossless(tmp_path: Path) -> None:
    frames = [gradient(red) for red in (10, 90, 250)]
    write_video(tmp_path / "v.mkv", frames, 10.0)
    capture = cv2.VideoCapture(str(tmp_path / "v.mkv"))
    for frame in frames:
        good, read = capture.read()
        assert good
        assert np.array_equal(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), frame)


def test_what_cannot_be_written_is_an_error_that_names_the_path(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises((OutputError, OSError), match="file"):
        write_png(tmp_path / "file" / "x.png", gradient())


def test_side_by_side_and_strip_keep_every_picture() -> None:
    left, right = gradient(10), gradient(20)
    row = side_by_side(left, right)
    assert row.shape == (16, 24 + 4 + 24, 3)
    assert np.array_equal(row[:, :24], left)
    assert np.array_equal(row[:, -24:], right)
    assert strip([[left, right], [right, left]]).shape == (16 + 4 + 16, 52, 3)


@pytest.mark.parametrize(
    ("count", "wanted", "indices"), [(14, 7, [0, 2, 4, 7, 9, 11, 13]), (3, 7, [0, 1, 2]), (1, 7, [0])]
)
def test_spread_takes_first_and_last(count: int, wanted: int, indices: list[int]) -> None:
    assert spread(count, wanted) == indices


def test_heat_is_black_at_zero_and_brightest_at_the_top() -> None:
    picture = heat(np.array([[0.0, 0.25, 0.5]], np.float32), 0.5).sum(axis=-1)[0]
    assert picture[0] < 20
    assert picture[0] < picture[1] < picture[2]


def test_frames_are_numbered_from_zero(tmp_path: Path) -> None:
    assert write_frames(tmp_path, [gradient()] * 3) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0000.png", "0001.png", "0002.png"]


def test_a_moving_picture_plays_every_frame_at_its_rate_and_for_ever(tmp_path: Path) -> None:
    frames = [np.full((24, 40, 3), (level, 255 - level, 0), np.uint8) for level in (0, 120, 240)]
    write_animation(tmp_path / "new" / "a.webp", frames, 10.0)
    read, animation = cv2.imreadanimation(str(tmp_path / "new" / "a.webp"))
    assert read
    assert list(animation.durations) == [100, 100, 100]
    assert animation.loop_count == 0
    for frame, shown in zip(frames, animation.frames, strict=True):
        assert np.abs(shown[..., 2::-1].astype(int) - frame).max() < 12


def test_a_scaled_picture_keeps_its_shape() -> None:
    assert scaled(np.zeros((90, 160, 3), np.uint8), 80).shape == (45, 80, 3)
