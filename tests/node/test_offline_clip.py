from pathlib import Path

import numpy as np
import pytest
from fakes import HEIGHT, WIDTH, traits

from gcd_model import Clip, OptionError
from gcd_node.errors import TooShortError, UsageError
from gcd_node.image_io import write_png, write_video
from gcd_node.offline import ClipRequest, read_clip


def numbered(count: int, height: int = 2 * HEIGHT, width: int = 2 * WIDTH) -> list[np.ndarray]:
    return [np.full((height, width, 3), 10 * i % 250, np.uint8) for i in range(count)]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    write_video(tmp_path / "v.mkv", numbered(24), 24.0)
    return tmp_path / "v.mkv"


def read(path: Path, family: str = "kubric90", **request: object) -> Clip:
    return read_clip(path, ClipRequest(**request), traits(family))  # type: ignore[arg-type]


def levels(clip: Clip) -> list[int]:
    return [round((float(frame[0, 0, 0]) + 1) * 127.5) for frame in clip.video]


def test_a_video_goes_to_the_trained_size_and_the_range_of_the_model(video: Path) -> None:
    clip = read(video)
    assert clip.video.shape == (14, 3, HEIGHT, WIDTH)
    assert levels(clip) == [10 * i for i in range(14)]
    assert clip.video[1].unique().tolist() == pytest.approx([10 / 127.5 - 1])
    assert clip.fps == 24.0


def test_start_and_stride_count_frames_of_the_input(video: Path) -> None:
    assert levels(read(video, start=5)) == [10 * i for i in range(5, 19)]
    write_video(video, numbered(41), 24.0)
    clip = read(video, start=1, stride=3)
    assert levels(clip) == [10 * i % 250 for i in range(1, 41, 3)]
    assert clip.fps == 8.0


def test_the_label_is_what_the_user_says_and_a_foreign_rate_is_kept_and_said(
    video: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert read(video, fps=7.5).fps == 7.5
    assert read(video, "driving").fps == 24.0
    assert "24 frames per second" in caplog.text


def test_another_size_may_be_asked_for(video: Path) -> None:
    assert read(video, height=2 * HEIGHT, width=2 * WIDTH).video.shape == (14, 3, 2 * HEIGHT, 2 * WIDTH)
    with pytest.raises(OptionError):
        read(video, height=HEIGHT + 1, width=WIDTH)
    with pytest.raises(UsageError):
        read(video, height=HEIGHT)


@pytest.mark.parametrize(("request_", "found"), [({"stride": 2}, 12), ({"start": 500}, 0)])
def test_too_few_frames_is_an_error_with_the_count(video: Path, request_: dict[str, int], found: int) -> None:
    with pytest.raises(TooShortError, match=f"n={found}"):
        read(video, **request_)


def test_a_still_is_repeated_and_a_folder_read_in_order(tmp_path: Path) -> None:
    write_png(tmp_path / "s.png", numbered(5)[4])
    still = read(tmp_path / "s.png")
    assert (levels(still), still.fps) == ([40] * 14, 12.0)
    for index, picture in enumerate(numbered(15)):
        write_png(tmp_path / "folder" / f"{index}.png", picture)
    assert levels(read(tmp_path / "folder", start=1)) == [10 * i for i in range(1, 15)]
