"""Real videos: which frames become windows, what is shown of them, and what is said of bad ones."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import torch
from fake_model import FakeModel, traits_of
from tiny_world import ran, write_untrained

from gcd_model import CameraMount, SphericalDelta, Traits, load_synthesizer
from gcd_model.config import SMALL
from gcd_model.errors import OptionError
from gcd_model.geometry import Intrinsics
from gcd_model.traits import ASSUMED_SOURCE
from gcd_model.weights.card import FAMILIES, FamilyName
from gcd_train.errors import DataError
from gcd_train.look.gallery import (
    GalleryOptions,
    Windowed,
    find_videos,
    mounted,
    paths,
    read_windows,
    view_window,
)

T, H, W = 4, 32, 64


def traits(family: FamilyName = "kubric90") -> Traits:
    """Of a network that takes four small frames."""
    camera = FAMILIES[family].camera
    unet = SMALL.unet if camera != "none" else msgspec.structs.replace(SMALL.unet, camera_width=0)
    config = msgspec.structs.replace(SMALL, camera=camera, unet=unet, frames=T, height=H, width=W)
    return traits_of(config, family, uncertainty_scale=2.0)


def write_video(path: Path, frames: int, fps: float, *, size: tuple[int, int] = (W, H)) -> Path:
    """Frame n is as bright as 4 n."""
    path.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for number in range(frames):
        video.write(np.full((size[1], size[0], 3), 4 * number, np.uint8))
    video.release()
    return path


def numbers(window: Windowed) -> list[int]:
    """Which frames of such a video these are."""
    return [round(float(frame.mean()) / 4) for frame in window.pictures]


def windows_of(path: Path, options: GalleryOptions | None = None, family: str = "kubric90") -> tuple[Windowed, ...]:
    (video,) = find_videos([path])
    return read_windows(video, traits(family), options or GalleryOptions())


@pytest.mark.parametrize(
    ("fps", "family", "told", "expected"),
    [
        (24.0, "kubric90", 24.0, [0, 1, 2, 3]),
        (30.0, "kubric90", 24.0, [0, 1, 3, 4]),
        (20.0, "driving", 10.0, [0, 2, 4, 6]),
        (7.5, "driving", 5.0, [0, 2, 3, 5]),
    ],
)
def test_frames_come_at_the_highest_trained_rate(
    tmp_path: Path, fps: float, family: str, told: float, expected: list[int]
) -> None:
    (window,) = windows_of(write_video(tmp_path / "a.avi", 12, fps), GalleryOptions(windows=1), family)
    assert (window.fps, window.trained_rate) == (told, True)
    assert numbers(window) == expected


def test_windows_reach_from_the_start_to_the_end_and_do_not_overlap(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", 20, 10.0)
    choice = GalleryOptions(windows=3, start=0.2)
    assert [numbers(window) for window in windows_of(path, choice, "driving")] == [
        [2, 3, 4, 5],
        [9, 10, 11, 12],
        [16, 17, 18, 19],
    ]
    many = windows_of(path, GalleryOptions(windows=99), "driving")
    assert [number for window in many for number in numbers(window)] == list(range(20))


def test_a_folder_of_pictures_is_a_video_in_the_order_of_names(tmp_path: Path) -> None:
    for number in (11, 9, 10, 8):
        cv2.imwrite(str(tmp_path / f"im_{number}.png"), np.full((H, W, 3), 4 * number, np.uint8))
    (window,) = windows_of(tmp_path, GalleryOptions(rate=10.0), "driving")
    assert numbers(window) == [8, 9, 10, 11]
    with pytest.raises(DataError, match="give it with --rate"):
        windows_of(tmp_path)


@pytest.mark.parametrize(
    ("hfov", "width", "kept"),
    [(None, 64, None), (40.0, 64, 40.0), (100.0, 64, 53.13), (100.0, 128, 53.13), (40.0, 80, 32.5)],
)
def test_what_is_wider_than_trained_is_cut_off(
    tmp_path: Path, hfov: float | None, width: int, kept: float | None
) -> None:
    path = write_video(tmp_path / "a.avi", 6, 24.0, size=(width, H))
    window = windows_of(path, GalleryOptions(hfov_deg=hfov))[0]
    assert window.pictures.shape == (T, H, W, 3)
    assert window.hfov_deg == (None if kept is None else pytest.approx(kept, abs=1.5))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is no whole video file"),
        (b"just some text, renamed", "is no whole video file"),
        (b"\0\0\0\x18ftypmp42" + b"\0" * 64, "cannot be decoded"),
        (None, "a picture of 1 x 64 has no part"),
    ],
)
def test_what_is_no_video_or_too_narrow_is_refused_by_name(tmp_path: Path, content: bytes | None, said: str) -> None:
    path = tmp_path / "broken.mp4"
    if content is None:
        write_video(path.with_suffix(".avi"), 20, 10.0, size=(1, 64)).rename(path)
    else:
        path.write_bytes(content)
    with pytest.raises(DataError, match=rf"broken.mp4:? {said}"):
        windows_of(path, GalleryOptions(rate=10.0))


# --- views ------------------------------------------------------------------------------------------------------------


def a_window() -> Windowed:
    pictures = np.full((T, H, W, 3), 100, np.uint8)
    size = (W, H)
    return Windowed(
        video="a.mp4", name="a-0", number=0, start_s=0.0, pictures=pictures, fps=12.0, trained_rate=True, size=size
    )


def test_each_angle_is_a_row_below_the_input_and_samples_come_with_their_uncertainty() -> None:
    model = FakeModel(traits())
    angles = (SphericalDelta(azimuth_deg=40.0), SphericalDelta(elevation_deg=20.0, radius_m=1.0))
    options = GalleryOptions(angles=["40", "0,20,1"], samples=2)
    strips = view_window(model, a_window(), options)
    assert [path.goal_delta for path in model.paths] == list(angles)
    assert all(len(strip.frames) == T for strip in strips)
    assert np.array_equal(strips[1].frames[0], strips[0].frames[0])
    names = [strip.name for strip in strips]
    assert names[:3] == ["input", "az +40 el +0 r +0", "az +40 el +0 r +0 sample 2"]
    assert names[4:6] == ["az +0 el +20 r +1", "az +0 el +20 r +1 sample 2"]
    shown = re.fullmatch(r"uncertainty, white (\S+)", names[3])
    assert shown is not None
    assert float(shown[1]) == pytest.approx(2.0 * 0.05 * 100 / 255, abs=1e-3)  # scale x half the difference


def test_goals_are_counted_from_where_the_source_camera_stands() -> None:
    high = GalleryOptions(angles=["40"], source_elevation_deg=50.0)
    usual, told = (paths(traits(), each)[0][1] for each in (replace(high, source_elevation_deg=None), high))
    assert (usual.source, told.source) == (ASSUMED_SOURCE, high.source)
    assert not torch.allclose(usual.source_from_target[-1], told.source_from_target[-1], atol=0.5)
    with pytest.raises(OptionError):
        paths(traits("driving"), replace(high, angles=None))


def test_the_live_model_knows_its_mount_where_one_is_declared_and_its_lens_without() -> None:
    model = FakeModel(load_synthesizer("random:live", device="cpu").traits)
    assert mounted(model.traits, GalleryOptions(), None) is None
    assert mounted(model.traits, GalleryOptions(mount_tilt=4.0), 60.0) == CameraMount(tilt_deg=4.0, hfov_deg=60.0)
    assert mounted(traits(), GalleryOptions(mount_height=2.0), None) is None
    for window in (replace(a_window(), hfov_deg=60.0), a_window()):
        view_window(model, window, GalleryOptions())
    assert [clip.lens for clip in model.clips] == [Intrinsics.from_hfov(60.0, W, H), None]


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_untrained(tmp_path_factory.mktemp("weights"))


def test_the_command_shows_good_videos_and_names_bad_ones(tmp_path: Path, weights: Path) -> None:
    write_video(tmp_path / "in" / "a<b>.avi", 6, 10.0)
    (tmp_path / "in" / "bad.mp4").write_bytes(b"no video")
    out = tmp_path / "out"
    code, said = ran("gallery", tmp_path / "in", "--weights", weights, "--out", out)
    assert code == 0, said
    assert "bad.mp4 is no whole video file" in said
    page = (out / "index.html").read_text()
    assert "a&lt;b&gt;.avi, window 1" in page
    assert "bad.mp4 is no whole video file" in page
    named = set(re.findall(r'(?:href|src)="([^"]+)"', page))
    assert named == {"a_b-0.png", "a_b-0.mp4"}
    assert all((out / name).is_file() for name in named)
    sheet = cv2.imread(str(out / "a_b-0.png"))
    assert sheet is not None
    assert sheet.shape[0] >= 2 * H  # input, view


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (["--angles", "30,15"], 78, "takes no camera command"),
        (["--angles", "left"], 78, "--angles AZIMUTH,ELEVATION,RADIUS wants numbers"),
        (["--source-elevation-deg", "50"], 78, "has no use for --source-elevation-deg"),
        (["--source-radius", "-1"], 78, "radius must be positive"),
        ([], 66, "none of 1 videos can be shown"),
    ],
)
def test_what_cannot_be_shown_is_one_line(tmp_path: Path, weights: Path, more: list[str], code: int, said: str) -> None:
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    found, shown = ran("gallery", tmp_path / "bad.mp4", "--weights", weights, "--out", tmp_path / "out", *more)
    assert found == code
    assert said in shown
