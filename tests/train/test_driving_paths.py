"""Driving pairs whose target camera stands at its goal from the first frame on, beside those where it moves there."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from gcd_model.geometry import CameraMount, driving_trajectory
from gcd_train.data.open import DataPlaces, RunData, open_data
from gcd_train.data.pairs import PairedClips
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import cameras_of
from gcd_train.recipe import Recipe
from gcd_train.recipe_files import load_recipe
from gcd_train.scenes.driving.world import driving_scene
from gcd_train.scenes.worlds import (
    SCENE_WORLDS,
    CameraWay,
    SceneFormat,
    agree,
    pair_world,
)
from gcd_train.training.setup import family_of, model_config

FORM = SceneFormat(width=48, height=32, frames=3, oversample=1)


def folder(place: Path, path: CameraWay, first_seed: int = 0) -> Path:
    """A data folder that says what it is; its one clip is a name without pictures."""
    place.mkdir(parents=True)
    agree(place, pair_world(SCENE_WORLDS["driving"], FORM, path=path))
    with zipfile.ZipFile(place / f"shard-{first_seed:08d}-0001.zip", "w") as archive:
        archive.writestr(f"{first_seed:08d}/scene.json", "{}")
    return place


def opened(recipe: Recipe, data: Path, valid: Path) -> RunData:
    model = recipe.model
    return open_data(recipe, model_config(model), family_of(model), DataPlaces(data=data, valid=valid))


def test_a_direct_target_stands_where_a_gradual_one_arrives_and_the_source_is_the_same() -> None:
    gradual, direct = driving_scene(3, frames=3), driving_scene(3, frames=3, move_time=0)
    np.testing.assert_array_equal(direct.cameras["source"], gradual.cameras["source"])
    np.testing.assert_allclose(direct.cameras["target"][-1], gradual.cameras["target"][-1], atol=1e-9)
    between = np.linalg.inv(direct.cameras["source"]) @ direct.cameras["target"]
    np.testing.assert_allclose(between, np.repeat(between[-1:], 3, 0), atol=1e-6)
    assert not np.allclose(gradual.cameras["target"][0], direct.cameras["target"][0])


@pytest.mark.parametrize(("path", "goal"), [("gradual", 2), ("direct", 0)])
def test_clips_and_methods_follow_the_path_that_the_world_tells(path: CameraWay, goal: int, tmp_path: Path) -> None:
    clips = PairedClips.open(folder(tmp_path / "data", path))
    wanted = driving_trajectory(frames=3, move_time=goal, mount=CameraMount()).source_from_target
    for trajectory in (clips.trajectory(0), cameras_of(clips, 0).trajectory):
        np.testing.assert_allclose(trajectory.source_from_target.numpy(), wanted.numpy(), atol=1e-9)
        assert trajectory.at_goal.index(True) == goal


def test_clips_of_both_paths_do_not_go_together(tmp_path: Path) -> None:
    folder(tmp_path / "gradual", "gradual")
    folder(tmp_path / "direct", "direct")
    with pytest.raises(DataError, match="camera and path"):
        PairedClips.open(tmp_path)


def test_a_recipe_for_the_other_path_is_refused(tmp_path: Path) -> None:
    recipe = load_recipe("package:study-gradual-scratch")
    data, valid = folder(tmp_path / "train", "direct"), folder(tmp_path / "valid", "direct", 1_000_000)
    with pytest.raises(DataError, match=r"goal in frame 0, the recipe's data\.path says frame 2"):
        opened(recipe, data, valid)
    direct = load_recipe("package:study-direct-scratch")
    assert len(opened(direct, data, valid).clips) == 1


def test_image_to_video_takes_both_paths_and_no_scene_that_is_held_out(tmp_path: Path) -> None:
    for path in ("gradual", "direct"):
        folder(tmp_path / "train" / path, path)
        folder(tmp_path / "valid" / path, path, 1_000_000)
    recipe = load_recipe("package:study-pretrain")
    run = opened(recipe, tmp_path / "train", tmp_path / "valid")
    assert (len(run.clips), len(run.valid)) == (4, 4)
    with pytest.raises(DataError, match="share 1 scenes"):
        opened(recipe, tmp_path / "train", tmp_path / "train" / "direct")
