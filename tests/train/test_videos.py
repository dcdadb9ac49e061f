"""Own videos with poses: pictures come back with the path between their cameras, and what is wrong is named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from tiny_scenes4d import edit_json
from tiny_world import tiny_recipe

from gcd_model.config import ModelConfig
from gcd_model.weights.card import FAMILIES
from gcd_train.data.files import FileFault
from gcd_train.data.open import RunData, open_data
from gcd_train.data.videos import CAMERA_FILE, FilmedPairs, filmed_scenes
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe_data import DataRecipe

WIDTH, HEIGHT, FPS, FRAMES, CLIP = 64, 48, 20, 16, 4
LEFT, RIGHT = "left.mp4", "right.mp4"
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()


def pose(x: float) -> list[list[float]]:
    return [[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def film(path: Path, hue: int, frames: int = FRAMES, size: tuple[int, int] = (WIDTH, HEIGHT), fps: float = FPS) -> None:
    """A flat picture that gets brighter from frame to frame, but for the channel `hue`."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for number in range(frames):
        picture = np.full((size[1], size[0], 3), 8 * number % 256, np.uint8)
        picture[..., hue] = 120
        writer.write(picture)
    writer.release()


def scene(folder: Path, zoom: float = 1.0) -> Path:
    """The left camera stands still, the right one moves; its focal length is `zoom` times the left one's."""
    folder.mkdir(parents=True)
    film(folder / LEFT, 0)
    film(folder / RIGHT, 1)
    lens = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}
    right = {**lens, "fx": 60.0 * zoom, "fy": 60.0 * zoom}
    cameras = {
        LEFT: {**lens, "world_from_camera": [pose(0.0)]},
        RIGHT: {**right, "world_from_camera": [pose(1.0 + 0.1 * number) for number in range(FRAMES)]},
    }
    (folder / CAMERA_FILE).write_text(json.dumps({"fps": FPS, "cameras": cameras}))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return scene(tmp_path / "set" / "first")


def pairs(folder: Path, fps: float = FPS / 2, frames: int = CLIP) -> FilmedPairs:
    return FilmedPairs(filmed_scenes(folder), size=(48, 32), frames=frames, fps=fps, repeats=10)


def test_both_sides_show_the_frames_whose_poses_they_have(folder: Path) -> None:
    samples = pairs(folder)
    for index in range(4):
        sample = samples.sample(index)
        numbers = np.array(sample.frame_numbers)
        assert (np.diff(numbers) == 2).all()
        for side in (sample.source, sample.target):
            assert side.shape == (CLIP, 32, 48, 3)
            assert np.abs(side[..., 0].mean((1, 2)) - 8 * numbers).max() < 6  # red is neither camera's hue
        moved = sample.source_from_target[:, 0, 3]
        rightwards = sample.source[0, 0, 0].argmax() == 2  # blue, so the left camera is the source
        np.testing.assert_allclose(moved if rightwards else -moved, 1.0 + 0.1 * numbers, atol=1e-9)
    assert samples.skips.total == 0
    again = pairs(folder).sample(3)
    np.testing.assert_array_equal(again.target, samples.sample(3).target)


def test_a_clip_deep_in_a_video_has_its_own_frames(folder: Path) -> None:
    for name, hue in ((LEFT, 0), (RIGHT, 1)):
        film(folder / name, hue, frames=240)
    edited(lambda told: told["cameras"][RIGHT].update(world_from_camera=[pose(1.0)]))(folder)
    for index in range(5):
        sample = pairs(folder).sample(index)
        wanted = 8 * np.array(sample.frame_numbers) % 256
        assert np.abs(sample.source[..., 0].mean((1, 2)) - wanted).max() < 6
    assert max(pairs(folder).sample(index).frame_numbers[0] for index in range(5)) > 100


def test_of_two_lenses_both_sides_have_the_narrower_one(tmp_path: Path) -> None:
    folder = scene(tmp_path / "zoomed", zoom=2.0)
    square = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    square[HEIGHT // 4 : -HEIGHT // 4, WIDTH // 4 : -WIDTH // 4] = 255  # what the narrower lens sees of the wider one's
    writer = cv2.VideoWriter(str(folder / LEFT), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (WIDTH, HEIGHT))
    for _ in range(FRAMES):
        writer.write(square)
    writer.release()
    sample = pairs(folder).sample(0)
    white = max((sample.source, sample.target), key=lambda side: float(side[..., 0].mean()))
    assert white[:, 2:-2, 2:-2].min() > 200


def opened(data: Path, valid: Path | None = None, seed: int = 0, **changes: Any) -> RunData:
    told = {"kind": "videos", "held_out": 1, "repeats": 3, **changes}
    recipe = tiny_recipe(data=DataRecipe(**told), unet=msgspec.structs.replace(tiny_recipe().unet, fps=FPS / 2))
    recipe = msgspec.structs.replace(recipe, seed=seed)
    config = ModelConfig(frames=CLIP, height=32, width=48)
    return open_data(recipe, config, FAMILIES["manipulation"], data, valid)


def test_runs_that_draw_other_clips_share_no_latents(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "set" / "second")
    first, again, other = (opened(tmp_path / "set", seed=seed).clips.origin for seed in (1, 1, 2))
    assert first == again != other


def test_the_last_scene_is_held_out_and_none_is_on_both_sides(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="hold out fewer"):
        opened(tmp_path / "set")
    shutil.copytree(folder, tmp_path / "set" / "second")
    run = opened(tmp_path / "set")
    assert (len(run.clips), len(run.valid), run.valid.fps) == (3, 1, FPS / 2)
    assert run.drawn is not None
    with pytest.raises(DataError, match="first"):
        opened(tmp_path / "set", folder)


def edited(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], object]:
    return lambda folder: edit_json(folder / CAMERA_FILE, change)


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "no JSON": (lambda folder: (folder / CAMERA_FILE).write_text("{"), "no camera file"),
    "an unknown field": (edited(lambda told: told["cameras"][LEFT].update(k1=0.1)), "k1"),
    "one camera": (edited(lambda told: told["cameras"].pop(RIGHT)), "source and a target"),
    "no lens": (edited(lambda told: told["cameras"][LEFT].update(fx=-1.0)), LEFT),
    "a pose that mirrors": (edited(lambda told: told["cameras"][LEFT].update(world_from_camera=[MIRROR])), LEFT),
    "no pose": (edited(lambda told: told["cameras"][LEFT].update(world_from_camera=[])), "no camera file"),
    "a row too few": (edited(lambda told: told["cameras"][LEFT].update(world_from_camera=[pose(0)[:3]])), LEFT),
    "poses of other frames": (edited(lambda told: told["cameras"][RIGHT]["world_from_camera"].pop()), "15 poses"),
    "a video elsewhere": (edited(lambda told: told["cameras"].update({"../x.mp4": told["cameras"][LEFT]})), "outside"),
    "a missing video": (lambda folder: (folder / LEFT).unlink(), "is missing"),
    "a damaged video": (lambda folder: (folder / LEFT).write_bytes(b"no video"), "no video"),
    "another size": (lambda folder: film(folder / LEFT, 0, size=(32, 32)), "32 x 32"),
    "another rate": (lambda folder: film(folder / LEFT, 0, fps=10), "10 frames a second"),
    "another length": (lambda folder: film(folder / LEFT, 0, frames=12), "same moments"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_folder_is_named_with_what_is_wrong(name: str, folder: Path) -> None:
    spoil, said = WRONG[name]
    spoil(folder)
    with pytest.raises(FileFault, match=said):
        filmed_scenes(folder.parent)


def test_a_folder_of_something_else_and_clips_that_do_not_fit_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=CAMERA_FILE):
        filmed_scenes(tmp_path / "empty")
    with pytest.raises(DataError, match="16 frames"):
        pairs(folder, fps=FPS, frames=17)
    with pytest.raises(RecipeError, match="no stride"):
        pairs(folder, fps=15)
