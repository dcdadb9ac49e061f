"""Frames that other methods saved: found in every layout, checked, and scored as they are."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from driving_plane import PlaneClips, seen_of

from gcd_train.data.files import FileFault
from gcd_train.errors import DataError
from gcd_train.evaluation.predictors import SavedFrames, to_pictures

FRAMES, HEIGHT, WIDTH = 3, 32, 48
KEY = "scn02900.sample_02"
PLANE = PlaneClips.make(1, frames=FRAMES, height=HEIGHT, width=WIDTH)
CLIP = PLANE[0]
SEEN = seen_of(CLIP, key=KEY)


def save(folder: Path, video: np.ndarray = CLIP.target, *, first: int = 0, suffix: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(video, start=first):
        assert cv2.imwrite(str(folder / f"{number:04d}{suffix}"), np.ascontiguousarray(frame[..., ::-1]))


def save_video(path: Path, video: np.ndarray = CLIP.target) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = (video.shape[2], video.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, size)
    for frame in video:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def predicted(folder: Path) -> list[torch.Tensor]:
    made = SavedFrames(name="other", folder=folder).predict(SEEN)
    assert all(draw.classes is None for draw in made.draws)
    return [draw.video for draw in made.draws if draw.video is not None]


def assert_target(draws: list[torch.Tensor], count: int = 1) -> None:
    assert len(draws) == count
    assert all(torch.equal(draw, to_pictures(CLIP.target)) for draw in draws)


@pytest.mark.parametrize("first", [0, 1])
def test_pictures_in_the_clips_folder_are_its_only_draw(tmp_path: Path, first: int) -> None:
    save(tmp_path / KEY, first=first)
    assert_target(predicted(tmp_path))


def test_each_samples_folder_is_a_draw_in_the_order_of_its_number(tmp_path: Path) -> None:
    for number in range(11):
        save(tmp_path / KEY / f"sample_{number}", CLIP.target // (number + 1))
    save(tmp_path / KEY / "target")
    save(tmp_path / KEY / "source", CLIP.source)
    draws = predicted(tmp_path)
    assert [torch.equal(d, to_pictures(CLIP.target // n)) for n, d in enumerate(draws, 1)] == [True] * 11
    (tmp_path / KEY / "sample_4").rename(tmp_path / KEY / "sample_14")
    with pytest.raises(DataError, match="one is missing"):
        predicted(tmp_path)


@pytest.mark.parametrize("place", [f"{KEY}.mp4", f"{KEY}/sample_0.mp4", "extra/t_000_n0_c02_scn02900_fs0_pred_s0.mp4"])
def test_videos_are_read_too(tmp_path: Path, place: str) -> None:
    save_video(tmp_path / place)
    (draw,) = predicted(tmp_path)
    assert draw.shape == (FRAMES, 3, HEIGHT, WIDTH)
    assert (draw - to_pictures(CLIP.target)).abs().mean() < 0.05


@pytest.mark.parametrize("rest", ["_fs2_fr12_az30_el5_rd0", ""])
@pytest.mark.parametrize("inside", ["extra", ""])
def test_outputs_of_the_papers_script_are_found_by_scene_and_trajectory(tmp_path: Path, inside: str, rest: str) -> None:
    wrong = CLIP.target // 2
    for control, scene in (("_c00", "scn02900"), ("_c02", "scn02901"), ("_c12", "scn02900"), ("", "scn02900")):
        save(tmp_path / inside / f"kg90_000_n0{control}_{scene}{rest}_pred_s0", wrong)
    for sample in (0, 1):
        save(tmp_path / inside / f"kg90_007_n0_c02_scn02900{rest}_pred_s{sample}")
    save(tmp_path / inside / "kg90_007_n0_c02_scn02900{rest}_gt", wrong)
    assert_target(predicted(tmp_path), count=2)


def test_a_clip_that_is_not_there_is_named_with_what_was_looked_for(tmp_path: Path) -> None:
    save(tmp_path / "another")
    (tmp_path / KEY).mkdir()
    with pytest.raises(DataError, match=f"holds no frames for clip {KEY}: wanted {KEY}/0000.png"):
        predicted(tmp_path)


@pytest.mark.parametrize("second", [f"{KEY}/sample_0", f"{KEY}/frames", "extra/a_c02_scn02900_fs2_pred_s0"])
def test_a_clip_that_lies_there_twice_is_refused(tmp_path: Path, second: str) -> None:
    save(tmp_path / KEY)
    save(tmp_path / second, CLIP.target // 2)
    with pytest.raises(DataError, match=f"holds clip {KEY} several times: .*; keep one"):
        predicted(tmp_path)


def test_clips_that_lie_there_beside_those_of_the_set_are_named(tmp_path: Path) -> None:
    save(tmp_path / KEY)
    save(tmp_path / "more" / "sample_0")
    save_video(tmp_path / "most.mp4")
    save(tmp_path / "extra" / "a_c00_scn02900_fs2_pred_s0")
    save(tmp_path / "anyview" / "frames")
    (tmp_path / "notes").mkdir()
    save_video(tmp_path / "a_c00_scn02900_fs2_gal.mp4")
    assert SavedFrames(name="other", folder=tmp_path).beside([KEY]) == ["anyview", "more", "most"]


@pytest.mark.parametrize("place", [f"{KEY}/sample_", "t_c02_scn02900_pred_s"])
def test_a_draw_that_is_empty_is_refused(tmp_path: Path, place: str) -> None:
    save(tmp_path / f"{place}0")
    (tmp_path / f"{place}1").mkdir()
    with pytest.raises(DataError, match=f"{place}1 holds no frames"):
        predicted(tmp_path)


def test_another_length_or_size_is_refused_not_resized(tmp_path: Path) -> None:
    save(tmp_path / "short" / KEY, CLIP.target[:2])
    with pytest.raises(DataError, match=f"holds 2 frames, clip {KEY} has 3"):
        predicted(tmp_path / "short")
    save(tmp_path / "small" / KEY, CLIP.target[:, ::2])
    with pytest.raises(DataError, match="frame 0 is 48 x 16, the target 48 x 32"):
        predicted(tmp_path / "small")


def test_a_damaged_picture_or_video_is_named(tmp_path: Path) -> None:
    save(tmp_path / "a" / KEY)
    (tmp_path / "a" / KEY / "0001.png").write_bytes(b"none")
    with pytest.raises(FileFault, match=r"0001\.png"):
        predicted(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / f"{KEY}.mp4").write_bytes(b"none")
    with pytest.raises(DataError, match=f"{KEY}.mp4 is no whole video file"):
        predicted(tmp_path / "b")


def test_painted_frames_become_class_maps_by_the_nearest_colour(tmp_path: Path) -> None:
    colours = np.array([kind.colour for kind in PLANE.classes], np.int64)
    painted = (colours[CLIP.target_classes] + np.array([6, -6, 5])).clip(0, 255).astype(np.uint8)
    save(tmp_path / KEY, painted)
    made = SavedFrames(name="other", folder=tmp_path, painted=PLANE.classes).predict(SEEN)
    assert made.video is None
    assert np.array_equal(made.classes.numpy(), CLIP.target_classes)
