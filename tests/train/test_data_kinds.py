"""What a recipe's [data] makes of folders: parts, samplings, and what is refused."""

import zipfile
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from cached_sets import CHOICE, CLIP, HEIGHT, WIDTH, cached
from tiny_scenes4d import CAMERAS, VIEWS, copy_scene, write_driving, write_kubric
from tiny_world import tiny_recipe

from gcd_model.config import ModelConfig
from gcd_model.geometry import CameraMount, driving_trajectory
from gcd_model.loading import random_weights
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES
from gcd_train.data.batches import CachedBatches
from gcd_train.data.open import RunData, open_data, sampling_of
from gcd_train.data.pairs import PairedClips
from gcd_train.data.paths import DrivingSampling, OrbitSampling
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import cameras_of
from gcd_train.recipe import LossRecipe, Recipe
from gcd_train.recipe_data import DataRecipe, FramesRecipe, OrbitRecipe
from gcd_train.recipe_files import load_recipe
from gcd_train.scenes.driving.world import driving_scene
from gcd_train.scenes.worlds import SCENE_WORLDS, CameraWay, SceneFormat, agree, pair_world
from gcd_train.training.setup import Draws, Precision, family_of, model_config

CONFIG = ModelConfig(frames=3, height=32, width=48)
KUBRIC = DataRecipe(kind="kubric4d", cameras=VIEWS, repeats=5)
DRIVING = DataRecipe(kind="parallel_domain4d", cameras=CAMERAS, repeats=5)


@pytest.fixture(scope="module")
def kubric(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kubric(tmp_path_factory.mktemp("kubric"), 3, 7, 2801, frames=8).parent


@pytest.fixture(scope="module")
def driving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_driving(tmp_path_factory.mktemp("driving"), 1, 2, 5, frames=5).parent


def recipe(data: DataRecipe, **unet: object) -> Recipe:
    told = msgspec.structs.replace(tiny_recipe().unet, **({"fps": 12.0} | unet))
    return tiny_recipe(data=data, unet=told)


def opened(told: Recipe, data: Path, valid: Path | None = None, family: str = "kubric90") -> RunData:
    return open_data(told, CONFIG, FAMILIES[family], data, valid)


def lengths(run: RunData) -> tuple[int, int]:
    """Clips to learn from and to measure on: five of each scene, and one."""
    return len(run.clips) // 5, len(run.valid)


def test_kubric_is_split_by_number(kubric: Path) -> None:
    run = opened(recipe(KUBRIC), kubric)
    assert lengths(run) == (2, 1)
    assert run.drawn is not None
    assert (run.clips.fps, run.valid.fps, run.valid.camera) == (12.0, 12.0, "spherical")
    source, target = run.valid.sample(0).source, run.valid.sample(0).target
    assert source.shape == target.shape == (3, 32, 48, 3)
    assert run.valid.sample(0).trajectory.frames == 3


def test_points_are_drawn_on_the_device_that_the_recipe_names(kubric: Path) -> None:
    on_gpu = recipe(msgspec.structs.replace(KUBRIC, splat_device="cuda"))
    if not torch.cuda.is_available():
        with pytest.raises(RecipeError, match=r"data\.splat_device"):
            opened(on_gpu, kubric)
        return
    there, here = (opened(told, kubric).valid.sample(0).target for told in (on_gpu, recipe(KUBRIC)))
    assert np.abs(there.astype(int) - here).mean() < 0.1


def test_the_last_scenes_are_held_out_where_the_recipe_says_so(kubric: Path) -> None:
    last = msgspec.structs.replace(KUBRIC, split="last", held_out=2)
    assert lengths(opened(recipe(last), kubric)) == (1, 2)
    with pytest.raises(DataError, match="0 to learn from and 3 to measure on; give --valid"):
        opened(recipe(msgspec.structs.replace(last, held_out=3)), kubric)


def test_a_folder_of_its_own_leaves_all_of_the_data_to_learn_from(kubric: Path, tmp_path: Path) -> None:
    copy_scene(kubric / "scn02801", tmp_path / "scn02802")
    assert lengths(opened(recipe(KUBRIC), kubric, tmp_path)) == (3, 1)


def test_a_scene_that_is_learned_from_is_never_measured_on(kubric: Path, tmp_path: Path) -> None:
    copy_scene(kubric / "scn02801", tmp_path / "scn02801")
    with pytest.raises(DataError, match="scn02801"):
        opened(recipe(KUBRIC), kubric, tmp_path)
    with pytest.raises(DataError, match="scn00003, scn00007, scn02801"):
        opened(recipe(KUBRIC), kubric, kubric)


def test_driving_is_split_by_its_file(driving: Path, tmp_path: Path) -> None:
    parts = {"train": ["scene_000001", "scene_000005"], "val": ["scene_000002"], "test": []}
    (tmp_path / "split.json").write_bytes(msgspec.json.encode(parts))
    named = msgspec.structs.replace(DRIVING, split_file=str(tmp_path / "split.json"))
    assert lengths(opened(recipe(named, fps=10.0), driving, family="driving")) == (2, 1)
    with pytest.raises(RecipeError, match=r"data\.split_file"):
        opened(recipe(DRIVING, fps=10.0), driving, family="driving")


def test_pairs_and_caches_want_something_to_measure_on(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="give --valid FOLDER"):
        opened(recipe(DataRecipe()), tmp_path)


def test_a_cache_is_read_with_the_encoders_that_made_it(driving: Path, tmp_path: Path) -> None:
    assert len(cached(tmp_path)) == 3
    data = msgspec.structs.replace(DRIVING, kind="cache", split="last", held_out=1)
    own = recipe(data, fps=10.0, source="cache", image_share=0.0, augmentation=0.02, loss=LossRecipe())
    model = msgspec.structs.replace(own.model, weights=CHOICE.weights)
    told = msgspec.structs.replace(own, model=model, vae=None, latents=None)
    networks = random_weights("driving", frames=CLIP).networks
    config = msgspec.structs.replace(networks.config, height=HEIGHT, width=WIDTH)
    run = open_data(told, config, FAMILIES["driving"], tmp_path, driving)
    precision = Precision(torch.device("cpu"), half=False, channels_last=False)
    batch = CachedBatches(run.drawn, networks, told.unet, precision, "gradual").batch(
        Draws(1, "unet", 0, torch.device("cpu")), 2
    )
    assert batch.target.shape[0] == 2 * CLIP
    assert len(batch.ids) == 2
    assert batch.wait_s is not None
    both = msgspec.structs.replace(told, data=msgspec.structs.replace(data, held_out=2))
    with pytest.raises(DataError, match="scene_000002"):
        open_data(both, config, FAMILIES["driving"], tmp_path, driving)
    with pytest.raises(RecipeError, match="made with other encoders"):
        CachedBatches(run.drawn, random_networks(networks.config, seed=9), told.unet, precision, "gradual")
    for change, name in (
        ({"modality": "semantic"}, "data.modality"),
        ({"move_time": 0}, "data.move_time"),
        ({"frames": FramesRecipe(strides=(1, 3))}, "data.frames.strides"),
        ({"frames": FramesRecipe(reverse=0.2, reach_last=True)}, "data.frames.reverse, data.frames.reach_last"),
    ):
        other = msgspec.structs.replace(told, data=msgspec.structs.replace(data, **change))
        with pytest.raises(RecipeError, match=f"the recipe's {name} wants another thing"):
            open_data(other, config, FAMILIES["driving"], tmp_path, driving)
    with pytest.raises(RecipeError, match="frozen autoencoder"):
        open_data(own, config, FAMILIES["driving"], tmp_path, driving)


def test_rates_and_orbits_that_do_not_fit_are_refused(kubric: Path) -> None:
    with pytest.raises(RecipeError, match=r"unet\.fps is 10"):
        opened(recipe(KUBRIC, fps=10.0), kubric)
    wide = msgspec.structs.replace(KUBRIC, orbit=OrbitRecipe(max_azimuth_deg=120.0))
    with pytest.raises(RecipeError, match="nobody could ask for the views beyond"):
        opened(recipe(wide), kubric)
    assert opened(recipe(wide), kubric, family="kubric180").drawn is not None


def test_what_is_left_out_of_the_sampling_is_as_released() -> None:
    orbit, path = sampling_of(recipe(KUBRIC), 14), sampling_of(recipe(DRIVING), 14)
    assert isinstance(orbit, OrbitSampling)
    assert isinstance(path, DrivingSampling)
    assert (orbit.frames.strides, orbit.frames.latest_start, orbit.frames.reverse) == ((1, 2, 3, 4), 6, 0.2)
    assert (path.frames.strides, path.frames.latest_start, path.frames.reverse) == ((1, 2), None, 0.0)
    assert not orbit.frames.reach_last
    assert orbit.elevation_deg == (0.0, 50.0)


def test_every_difference_of_the_release_can_be_chosen() -> None:
    other = msgspec.structs.replace(
        KUBRIC,
        path="direct",
        frames=FramesRecipe(strides=(2,), latest_start=0, reverse=0.0, reach_last=True),
        orbit=OrbitRecipe(elevation_deg=(0.0, 90.0)),
    )
    orbit = sampling_of(recipe(other), 14)
    assert isinstance(orbit, OrbitSampling)
    assert (orbit.move_time, orbit.elevation_deg) == (0, (0.0, 90.0))
    assert (orbit.frames.strides, orbit.frames.latest_start, orbit.frames.reverse) == ((2,), 0, 0.0)
    assert orbit.frames.reach_last
    slip = sampling_of(recipe(msgspec.structs.replace(other, move_time=13)), 14)
    assert isinstance(slip, OrbitSampling)
    assert slip.move_time == 13  # as the released file of the direct 180-degree model has it


# --- driving pairs, whose target camera moves to its goal or stands there from the first frame on --------------------

FORM = SceneFormat(width=48, height=32, frames=3, oversample=1)


def pair_folder(place: Path, path: CameraWay, first_seed: int = 0) -> Path:
    """A data folder that says what it is; its one clip is a name without pictures."""
    place.mkdir(parents=True)
    agree(place, pair_world(SCENE_WORLDS["driving"], FORM, path=path))
    with zipfile.ZipFile(place / f"shard-{first_seed:08d}-0001.zip", "w") as archive:
        archive.writestr(f"{first_seed:08d}/scene.json", "{}")
    return place


def opened_pairs(recipe: Recipe, data: Path, valid: Path) -> RunData:
    model = recipe.model
    return open_data(recipe, model_config(model), family_of(model), data, valid)


def test_a_direct_target_stands_where_a_gradual_one_arrives_and_the_source_is_the_same() -> None:
    gradual, direct = driving_scene(3, frames=3), driving_scene(3, frames=3, move_time=0)
    np.testing.assert_array_equal(direct.cameras["source"], gradual.cameras["source"])
    np.testing.assert_allclose(direct.cameras["target"][-1], gradual.cameras["target"][-1], atol=1e-9)
    between = np.linalg.inv(direct.cameras["source"]) @ direct.cameras["target"]
    np.testing.assert_allclose(between, np.repeat(between[-1:], 3, 0), atol=1e-6)
    assert not np.allclose(gradual.cameras["target"][0], direct.cameras["target"][0])


@pytest.mark.parametrize(("path", "goal"), [("gradual", 2), ("direct", 0)])
def test_clips_and_methods_follow_the_path_that_the_world_tells(path: CameraWay, goal: int, tmp_path: Path) -> None:
    clips = PairedClips.open(pair_folder(tmp_path / "data", path))
    wanted = driving_trajectory(frames=3, move_time=goal, mount=CameraMount()).source_from_target
    for trajectory in (clips.trajectory(0), cameras_of(clips, 0).trajectory):
        np.testing.assert_allclose(trajectory.source_from_target.numpy(), wanted.numpy(), atol=1e-9)
        assert trajectory.at_goal.index(True) == goal


def test_clips_of_both_paths_do_not_go_together(tmp_path: Path) -> None:
    pair_folder(tmp_path / "gradual", "gradual")
    pair_folder(tmp_path / "direct", "direct")
    with pytest.raises(DataError, match="camera and path"):
        PairedClips.open(tmp_path)


def test_a_recipe_for_the_other_path_is_refused(tmp_path: Path) -> None:
    recipe = load_recipe("package:study")
    data, valid = pair_folder(tmp_path / "train", "direct"), pair_folder(tmp_path / "valid", "direct", 1_000_000)
    with pytest.raises(DataError, match=r"goal in frame 0, the recipe's data\.path says frame 2"):
        opened_pairs(recipe, data, valid)
    direct = load_recipe("package:study", changes=["data.path=direct"])
    assert len(opened_pairs(direct, data, valid).clips) == 1


def test_image_to_video_takes_both_paths_and_no_scene_that_is_held_out(tmp_path: Path) -> None:
    for path in ("gradual", "direct"):
        pair_folder(tmp_path / "train" / path, path)
        pair_folder(tmp_path / "valid" / path, path, 1_000_000)
    recipe = load_recipe("package:study-pretrain")
    run = opened_pairs(recipe, tmp_path / "train", tmp_path / "valid")
    assert (len(run.clips), len(run.valid)) == (4, 4)
    with pytest.raises(DataError, match="share 1 scenes"):
        opened_pairs(recipe, tmp_path / "train", tmp_path / "train" / "direct")
