"""Pairs of clips on a stage: cut from one simulation, seen along orbits, told so that a model can be steered."""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from box_world import STAGE as FAST_STAGE
from box_world import box_object
from box_world import stage as fast_stage
from headless import drawn, needs_egl
from tiny_world import TinyOrbits, ran

from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import CameraMount, driving_trajectory
from gcd_train.data.pairs import PairedClips
from gcd_train.data.sample import painted as painted_clips
from gcd_train.data.splits import require_apart
from gcd_train.errors import DataError, RecipeError, RenderError
from gcd_train.scenes.description import Scene
from gcd_train.scenes.pair_writer import orbit_draw, write_shard
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneFormat, World, agree, pair_world, read_world


def stage(seed: int, frames: int) -> Scene:
    """A floor with a box that creeps over it and stays in view."""
    scene = fast_stage(seed, frames)
    return replace(scene, poses=scene.poses * np.array([1, 1, 1, 0.05], np.float32))


STAGE = replace(FAST_STAGE, make=stage)
TINY = SceneFormat(width=48, height=32, frames=3, oversample=1)
ORBITS = pair_world(STAGE, TINY)


@pytest.fixture(autouse=True, scope="module")
def stage_is_a_world() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SCENE_WORLDS, "stage", STAGE)
        patch.setitem(SCENE_WORLDS, "other", replace(STAGE, name="other"))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes 0 and 1 of the stage, three clips each."""
    return written(tmp_path_factory.mktemp("orbits"), ORBITS, range(6))


def written(folder: Path, world: World, seeds: range) -> Path:
    """A data folder with these clips in one shard."""
    folder.mkdir(parents=True, exist_ok=True)
    agree(folder, world)
    write_shard(folder, world, seeds)
    return folder


def told(clips: PairedClips, number: int) -> dict[str, np.ndarray]:
    """Poses as the shard keeps them, rounded to a millionth."""
    path, name = clips.places[number]
    with zipfile.ZipFile(path) as archive:
        poses = json.loads(archive.read(f"{name}/scene.json"))["world_from_camera"]
    return {camera: np.array(rows) for camera, rows in poses.items()}


@needs_egl
def test_a_clip_shows_its_time_steps_from_its_cameras(folder: Path) -> None:
    clips = PairedClips.open(folder)
    clip, numbers = clips[4], list(clips.orbit(4).frame_numbers)
    scene = stage(1, STAGE.frames)
    cut = replace(scene, poses=scene.poses[numbers], focus=scene.focus[numbers], cameras=told(clips, 4))
    assert clip.source_instances.max() == 7
    for name, view in drawn(cut, 48, 32).items():
        apart = getattr(clip, name).astype(int) - view.rgb
        assert np.abs(apart).mean() < 0.05  # poses on disk are rounded
        assert not getattr(clip, f"{name}_classes").any()


@needs_egl
def test_the_trajectory_is_the_way_between_the_cameras_on_disk(folder: Path) -> None:
    clips = PairedClips.open(folder)
    for number in range(len(clips)):
        path, poses, orbit = clips.trajectory(number), told(clips, number), clips.orbit(number)
        assert np.ptp(poses["source"], axis=0).max() == 0
        between = np.linalg.inv(poses["source"]) @ poses["target"]
        np.testing.assert_allclose(path.source_from_target.numpy(), between, atol=1e-4)
        assert path.source is not None
        assert path.delta is not None
        assert (path.source.azimuth_deg, path.source.elevation_deg, path.source.radius_m) == (0.0, *orbit.start[1:])
        np.testing.assert_allclose(path.delta[-1].numpy(), orbit.change)
        assert not path.delta[0].any()


@needs_egl
def test_a_clip_does_not_depend_on_those_beside_it(folder: Path, tmp_path: Path) -> None:
    alone = PairedClips.open(written(tmp_path, ORBITS, range(4, 5)))
    beside = PairedClips.open(folder)
    assert (alone.seeds[0], alone.orbit(0)) == (beside.seeds[4], beside.orbit(4))
    for kind in ("source", "target", "target_depth", "source_instances"):
        np.testing.assert_array_equal(getattr(alone[0], kind), getattr(beside[4], kind))


def test_paths_take_every_second_frame_and_differ_between_worlds() -> None:
    scene = stage(0, STAGE.frames)
    draws = [orbit_draw(scene, ORBITS, seed) for seed in range(30)]
    assert all((np.diff(draw.frame_numbers) == 2).all() and draw.fps == 12.0 for draw in draws)
    assert len({draw.frame_numbers[0] for draw in draws}) > 10
    elsewhere = orbit_draw(scene, msgspec.structs.replace(ORBITS, name="other"), 0)
    assert elsewhere.start != draws[0].start


# examples


@needs_egl
def test_no_scene_is_on_both_sides_of_a_split(folder: Path, tmp_path: Path) -> None:
    training = PairedClips.open(folder)
    fewer = pair_world(STAGE, TINY, clips_per_scene=1)
    for name, world, seeds, shared in (
        ("same scene, another clip", ORBITS, range(5, 6), True),
        ("cut otherwise", fewer, range(1, 2), True),
        ("another scene", fewer, range(2, 3), False),
        ("another world", msgspec.structs.replace(ORBITS, name="other"), range(1), False),
    ):
        held_out = PairedClips.open(written(tmp_path / name, world, seeds))
        if shared:
            with pytest.raises(DataError, match="stage 1"):
                require_apart(PairedClips((training.world,), training.places[3:]).scenes, held_out.scenes)
        else:
            require_apart(training.scenes, held_out.scenes)


@needs_egl
def test_clips_of_several_folders_alternate(folder: Path, tmp_path: Path) -> None:
    written(tmp_path / "b", msgspec.structs.replace(ORBITS, name="other"), range(2))
    first, both = PairedClips.open(folder), PairedClips.open([folder, tmp_path / "b"])
    assert len(both) == 8
    names = [both.scene(number)[0] for number in range(8)]
    assert [names[:4].count(name) for name in ("stage", "other")] == [3, 1]
    assert len(set(both.seeds)) == 8
    assert set(first.seeds) < set(both.seeds)
    assert both.origin != first.origin
    other = names.index("other")
    alone = PairedClips.open(tmp_path / "b")
    np.testing.assert_array_equal(both.sample(other).target, alone.sample(0).target)
    np.testing.assert_array_equal(both.trajectory(other).delta, alone.trajectory(0).delta)
    assert [clips.scene(3) for clips in (both, PairedClips.open([folder, tmp_path / "b"], limit=4))] == [
        both.scene(3)
    ] * 2


@needs_egl
def test_a_folder_of_folders_is_all_of_them(folder: Path, tmp_path: Path) -> None:
    for name in ("stage", "other"):
        written(tmp_path / name, msgspec.structs.replace(ORBITS, name=name), range(2))
    within = PairedClips.open(tmp_path)
    assert within.origin == PairedClips.open([tmp_path / "other", tmp_path / "stage"]).origin
    assert {world.name for world in within.worlds} == {"stage", "other"}
    with pytest.raises(DataError, match="given twice"):
        PairedClips.open([folder, folder])


@needs_egl
def test_folders_that_differ_do_not_go_together(folder: Path, tmp_path: Path) -> None:
    wider = pair_world(STAGE, replace(TINY, width=64))
    written(tmp_path / "wider", wider, range(1))
    with pytest.raises(DataError, match="do not go together"):
        PairedClips.open([folder, tmp_path / "wider"])


@needs_egl
def test_painted_clips_show_classes_where_others_show_colours(tmp_path: Path) -> None:
    clips = PairedClips.open(written(tmp_path, pair_world(SCENE_WORLDS["driving"], TINY), range(1)))
    painted = painted_clips(clips)
    with pytest.raises(DataError, match="need"):
        painted_clips(TinyOrbits())
    shown, sample = painted.sample(0), clips.sample(0)
    colours = np.array([kind.colour for kind in DRIVING_CLASSES], np.uint8)
    np.testing.assert_array_equal(shown.source, sample.source)
    np.testing.assert_array_equal(shown.target, colours[sample.target_classes])
    assert painted.origin != clips.origin
    expected = driving_trajectory(frames=3, move_time=2, mount=clips.mount).source_from_target
    np.testing.assert_array_equal(shown.source_from_target, expected)


def test_things_keep_clear_of_the_cameras() -> None:
    scene = stage(0, STAGE.frames)
    beside = with_thing(scene, at=(15.0, 0.0, 1.0))
    for seed in range(20):
        draw = orbit_draw(beside, ORBITS, seed)
        eyes = np.concatenate([draw.world_from_source[None, :3, 3], draw.world_from_target[:, :3, 3]])
        assert np.linalg.norm(eyes - (15.0, 0.0, 1.0), axis=-1).min() >= 1.0 + 3**0.5
    with pytest.raises(RenderError, match="no path"):
        orbit_draw(with_thing(scene, at=(0.0, 0.0, 1.0), side=40.0), ORBITS, 0)


def with_thing(scene: Scene, at: tuple[float, float, float], side: float = 2.0) -> Scene:
    """The scene with a cube that stands there, as far as metadata tells."""
    return replace(
        scene, objects=(box_object("cube", 1, 1, (side, side, side), np.tile((*at, 0.0), (scene.frames, 1))),)
    )


def test_worlds_that_give_no_such_clips_are_refused() -> None:
    with pytest.raises(RecipeError, match="up to 30"):
        pair_world(STAGE, SceneFormat(frames=40))
    assert pair_world(STAGE, SceneFormat(frames=30)).frames == 30


@needs_egl
def test_the_command_makes_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(SCENE_WORLDS, "drop", replace(STAGE, name="drop"))
    data = tmp_path / "data"
    size = "--width 48 --height 32 --frames 3 --oversample 1 --workers 1"
    line = f"generate drop {data} --pairs --first-seed 5 {size}".split()
    code, said = ran(*line, "--clips", "4")
    assert code == 0, said
    clips = PairedClips.open(data)
    assert clips.seeds[:4] == [15, 16, 17, 18]
    assert clips.scene(3) == ("drop", 6)


def test_a_folder_of_another_edition_has_another_origin(tmp_path: Path) -> None:
    agree(tmp_path, pair_world(SCENE_WORLDS["driving"], SceneFormat()))
    world = read_world(tmp_path)
    assert world == pair_world(SCENE_WORLDS["driving"], SceneFormat())
    clips = PairedClips((world,), ((tmp_path, "00000000"),))
    assert (clips.camera, clips.mount, clips.scene(0)) == ("none", CameraMount(), ("driving", 0))
    grown = PairedClips((msgspec.structs.replace(world, edition=world.edition + 1),), clips.places)
    assert grown.origin != clips.origin


@needs_egl
@pytest.mark.slow
@pytest.mark.parametrize("world", ["drop", "tabletop"])
def test_real_scenes_show_their_things_to_both_cameras(world: str, tmp_path: Path) -> None:
    """Simulates, which takes a second or two: things are in both views, and no camera stands in one or below ground."""
    pairs = pair_world(SCENE_WORLDS[world], replace(TINY, frames=14))
    clips = PairedClips.open(written(tmp_path, pairs, range(3)))
    for number in range(3):
        clip, poses = clips[number], told(clips, number)
        assert ((clip.source_instances > 0).mean((1, 2)) > 0.01).all()
        for side in ("source", "target"):
            seen = getattr(clip, f"{side}_depth")
            assert seen[seen > 0].min() > 1.0
            assert poses[side][:, 2, 3].min() > 0.0
