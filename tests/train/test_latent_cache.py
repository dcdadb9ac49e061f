"""The latent cache: what is kept, that it survives anything, and that a clip read back is the clip encoded."""

import errno
import os
import pickle
import signal
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from cached_sets import (
    CHOICE,
    CLIP,
    FRAMES,
    HEIGHT,
    PLAN,
    WIDTH,
    FakePictures,
    cached,
    killed_run,
    tiny_encoders,
    tiny_identity,
)
from tiny_scenes4d import CAMERAS, write_driving
from tiny_world import ran, tiny_recipe
from torch.testing import assert_close

from gcd_model.loading import random_weights
from gcd_train.data.batches import CachedBatches
from gcd_train.data.cache import (
    CachedLatents,
    CacheIndex,
    ClipPlace,
    ClipPlan,
    log_variance_codes,
    log_variance_of,
    read_index,
)
from gcd_train.data.cache_writer import CacheJob, DrivingPictures
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.pictures import PictureOptions
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.files import only_writer
from gcd_train.recipe import LossRecipe
from gcd_train.training.setup import Draws, Precision

CPU = torch.device("cpu")


def draws(number: int = 0) -> Draws:
    return Draws(1, "test", number, CPU)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("cache")
    cached(made)
    return made


# what is kept


@pytest.mark.parametrize(("paths", "targets"), [(("gradual",), 504), (("direct",), 49), (("gradual", "direct"), 517)])
def test_a_published_scene_needs_so_many_target_pictures(paths: tuple[str, ...], targets: int) -> None:
    plan = ClipPlan(paths=paths)  # pyright: ignore[reportArgumentType]
    pairs = plan.pairs(50, range(50))
    assert (len(plan.clips(50, range(50))), len(pairs)) == (36 + 23, targets)
    assert {time for time, _ in pairs} == set(range(49))  # as published, the last frame is never reached


# a clip read back


@pytest.mark.parametrize("place", [ClipPlace(0, 1), ClipPlace(3, 1), ClipPlace(1, 2)])
def test_a_cached_clip_is_what_the_encoders_make_of_it(folder: Path, place: ClipPlace) -> None:
    clip = CachedLatents.open(folder).clip("scene_000002", place, "gradual")
    encoders, pictures = tiny_encoders(), FakePictures()
    moments = [pictures.moment("scene_000002", time, (i,)) for i, time in enumerate(PLAN.times(place))]
    with torch.no_grad():
        source, target = (
            torch.cat([to_network(getattr(moment, side)) for moment in moments]) for side in ("source", "target")
        )
        mean = encoders.target(target).mean * 0.18215
        tokens, plain = encoders.tokens(source), encoders.condition(source)
    assert_close(clip.target, mean, atol=1e-3, rtol=2e-3)  # float16
    assert tokens is not None
    assert clip.tokens is not None
    assert_close(clip.tokens, tokens, atol=1e-3, rtol=2e-3)
    assert (clip.source - plain).abs().max() < 0.2  # the noise that the encoder saw
    assert not torch.equal(clip.source, plain)


def test_noise_copies_are_drawn_for_each_frame_and_repeat_with_the_seed(folder: Path) -> None:
    cache, place = CachedLatents.open(folder), ClipPlace(0, 1)
    drawn = [cache.clip("scene_000001", place, "gradual", draws(n)) for n in range(12)]
    again = cache.clip("scene_000001", place, "gradual", draws(0))
    assert torch.equal(drawn[0].source, again.source)
    assert torch.equal(drawn[0].target, again.target)
    for frame in range(CLIP):
        assert len({rows.source[frame].numpy().tobytes() for rows in drawn}) == 2  # copies
    assert len({rows.source.numpy().tobytes() for rows in drawn}) > 2  # mixed anew in every clip
    assert len({rows.target.numpy().tobytes() for rows in drawn}) == 12  # samples of the posterior


def test_log_variances_survive_one_byte() -> None:
    values = torch.linspace(-30, 20, 1001)
    back = log_variance_of(log_variance_codes(values))
    assert (back - values).abs().max() <= 0.0981
    assert ((0.5 * back).exp() / (0.5 * values).exp() - 1).abs().max() < 0.051


def test_semantic_targets_keep_their_class_emphasis(tmp_path: Path) -> None:
    cached(tmp_path, FakePictures(scenes=("a",)), emphasis=True)
    clip = CachedLatents.open(tmp_path).clip("a", ClipPlace(0, 1), "gradual")
    assert clip.emphasis is not None
    assert clip.emphasis.shape == (CLIP, 1, *clip.target.shape[-2:])


def test_drawn_places_follow_the_published_odds(folder: Path) -> None:
    cache = CachedLatents.open(folder)
    places = [cache.drawn_place(draws(n)) for n in range(300)]
    strides = [place.stride for _, place in places]
    assert 100 < strides.count(2) < 200  # stride first, then start: alike likely although it has fewer starts
    assert {scene for scene, _ in places} == set(cache.scenes)
    assert {place.start for _, place in places if place.stride == 1} == set(range(FRAMES - CLIP))


def test_batches_tell_each_clip_its_own_frame_rate(folder: Path) -> None:
    cache = CachedLatents.open(folder)
    unet = msgspec.structs.replace(
        tiny_recipe().unet, image_share=0.0, augmentation=0.02, loss=LossRecipe(), dropout=0.0
    )
    networks = random_weights("driving", frames=CLIP).networks
    precision = Precision(CPU, half=False, channels_last=False)
    source = CachedBatches(cache, networks, unet, precision, "gradual")
    batch = source.batch(draws(), 6)
    assert batch.target.shape == batch.condition.shape == (6 * CLIP, 4, HEIGHT // 8, WIDTH // 8)
    assert batch.tokens is not None
    assert batch.tokens.shape[0] == 6 * CLIP
    assert batch.emphasis is None
    per_clip = batch.vector.unflatten(0, (6, CLIP))
    assert bool((per_clip == per_clip[:, :1]).all())
    assert len(set(per_clip[:, 0].sum(-1).tolist())) == 2  # 10 and 5 frames a second
    again = source.batch(draws(), 6)
    assert torch.equal(batch.target, again.target)
    assert torch.equal(batch.condition, again.condition)


def test_a_job_travels_to_another_process(tmp_path: Path) -> None:
    write_driving(tmp_path, 3, frames=2)
    data = ParallelDomain4D(tmp_path, cameras=CAMERAS)
    pictures = DrivingPictures(data, CLIP, PictureOptions(size=(WIDTH, HEIGHT)))
    job = CacheJob(folder=tmp_path, pictures=pictures, choice=CHOICE, identity=tiny_identity())
    arrived = pickle.loads(pickle.dumps(job))
    assert arrived.identity == job.identity
    here, there = (each.pictures.moment("scene_000003", 1, (0, 2)) for each in (job, arrived))
    assert np.array_equal(here.source, there.source)
    assert np.array_equal(here.target, there.target)
    assert here.target.shape == (2, HEIGHT, WIDTH, 3)
    apart = np.abs(here.target.astype(int) - here.source).mean(axis=(1, 2, 3))
    assert apart[0] < 0.5 * apart[1]  # the path begins where the source stands


# what goes wrong


def test_a_run_killed_at_any_moment_goes_on_to_the_same_result(tmp_path: Path, folder: Path) -> None:
    wanted = _lasting(folder)
    for moment in (5, 7):  # a shard that the index does not know; half a shard beside a known one
        halfway = tmp_path / str(moment)
        assert killed_run(halfway, moment) == -signal.SIGKILL
        done = {name for name in _lasting(halfway) if name != "index.json"}
        assert len(done) < 3
        cached(halfway)
        assert _lasting(halfway) == wanted
        assert list(halfway.glob(".*.partial")) == []


def _lasting(folder: Path) -> dict[str, object]:
    """Every file's content; of the index without the seconds."""
    found: dict[str, object] = {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}
    index = read_index(folder, CacheIndex)
    if index is not None:
        scenes = {name: msgspec.structs.replace(entry, seconds=0.0) for name, entry in index.scenes.items()}
        found["index.json"] = (index.identity, scenes)
    return found


@pytest.mark.parametrize("damage", ["changed", "cut", "gone"])
def test_a_damaged_shard_is_refused_by_name_and_made_again(tmp_path: Path, damage: str) -> None:
    pictures = FakePictures(scenes=("scene_000001",))
    cached(tmp_path, pictures)
    shard = tmp_path / "scene_000001.safetensors"
    whole = shard.read_bytes()
    if damage == "gone":
        shard.unlink()
    else:
        shard.write_bytes(whole[:-9] + (b"" if damage == "cut" else bytes(9)))
    with pytest.raises(DataError, match=r"scene_000001\.safetensors .*gcd-train cache"):
        CachedLatents.open(tmp_path).clip("scene_000001", ClipPlace(0, 1), "gradual")
    assert [step.item for step in cached(tmp_path, pictures)] == ["scene_000001"]
    assert shard.read_bytes() == whole


def test_frames_that_cannot_be_read_are_named_and_their_clips_left_out(tmp_path: Path) -> None:
    pictures = FakePictures(broken=frozenset({("scene_000000", 3), *(("scene_000001", t) for t in range(FRAMES))}))
    steps = {step.item: step for step in cached(tmp_path, pictures)}
    entry, failed = steps["scene_000000"].value, steps["scene_000001"]
    assert entry is not None
    assert entry.missing == {"3": "scene_000000/rgb/yaw-0/3.png is cut"}
    assert failed.value is None
    assert "none of" in str(failed.error)
    cache = CachedLatents.open(tmp_path)
    assert "scene_000001" not in cache.scenes
    assert cache.clips("scene_000000") == [ClipPlace(0, 1), ClipPlace(0, 2)]
    with pytest.raises(DataError, match="no gradual clip of scene_000000"):
        cache.clip("scene_000000", ClipPlace(1, 1), "gradual")


def test_a_cache_made_otherwise_is_refused_and_says_what_differs(tmp_path: Path) -> None:
    cached(tmp_path, FakePictures(scenes=("a",)))
    with pytest.raises(RunError, match=r"copies 2, now 3"):
        cached(tmp_path, copies=3)
    with pytest.raises(RunError, match=r"encoders .* now 'other'"):
        cached(tmp_path, encoders="other")


@pytest.mark.parametrize(
    ("pictures", "identity", "said"),
    [
        ({}, {"encoders": "other"}, "copy the same file there"),
        ({}, {"height": 2 * HEIGHT}, f"{2 * HEIGHT} x {WIDTH}"),
        ({"length": 2}, {}, "a: 2 frames are too few for a clip"),
    ],
)
def test_a_scene_that_cannot_be_cached_is_named_with_why(
    pictures: dict[str, int], identity: dict[str, object], said: str, tmp_path: Path
) -> None:
    (step,) = cached(tmp_path, FakePictures(scenes=("a",), **pictures), **identity)
    assert said in str(step.error)


def test_two_runs_never_write_to_one_folder(tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(RunError, match="another run"):
        cached(tmp_path)


def test_a_disk_that_fills_up_names_the_shard_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, real, calls = FakePictures(scenes=("a",)), os.fsync, []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) == 2:  # the index went well, the shard does not
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    monkeypatch.setattr("gcd_train.files.os.fsync", full)
    (step,) = cached(tmp_path, pictures)
    assert "a.safetensors: No space left on device" in str(step.error)
    assert [path.name for path in tmp_path.iterdir() if path.name != ".lock"] == ["index.json"]
    assert cached(tmp_path, pictures)[0].error is None


# the command


def test_the_command_caches_a_set_in_the_published_layout_and_then_has_nothing_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = ParallelDomain4D.__init__.__kwdefaults__
    monkeypatch.setattr(ParallelDomain4D.__init__, "__kwdefaults__", usual | {"cameras": CAMERAS})
    scene = write_driving(tmp_path / "set", 3, frames=16)
    broken = scene / "rgb" / "camera0" / f"{10 * 0 + 5:018d}.png"
    broken.write_bytes(broken.read_bytes()[:40])
    where = (tmp_path / "set", "--out", tmp_path / "cache")
    told = ("cache", *where, "--weights", "random:driving", "--copies", 1, "--path", "direct")
    code, said = ran(*told)
    assert code == 0
    assert "scene_000003" in said
    assert "1 frames missing" in said
    assert "a scene" in said
    cache = CachedLatents.open(tmp_path / "cache")
    assert str(broken) in cache.index.scenes["scene_000003"].missing["0"]
    (place,) = cache.clips("scene_000003")
    clip = cache.clip("scene_000003", place, "direct")
    config = tiny_encoders().networks.config
    assert clip.source.shape == (14, 4, config.height // 8, config.width // 8)
    written = (tmp_path / "cache" / "scene_000003.safetensors").stat().st_mtime_ns
    code, said = ran(*told)
    assert (code, "1/1" in said) == (0, True)
    assert (tmp_path / "cache" / "scene_000003.safetensors").stat().st_mtime_ns == written
    code, said = ran(*told, "--seed", 1)
    assert (code, "seed 0, now 1" in said) == (RunError.exit_code, True)


def test_a_part_of_the_set_wants_its_split_file(tmp_path: Path) -> None:
    write_driving(tmp_path, 3, frames=1)
    told = ("cache", tmp_path, "--weights", "random:driving", "--out", tmp_path / "cache", "--split", "train")
    code, said = ran(*told)
    assert (code, "both --split and --split-file" in said) == (RecipeError.exit_code, True)
    split = tmp_path / "split.json"
    split.write_text('{"train": ["scene_000001"], "val": [], "test": []}')
    code, said = ran(*told, "--split-file", split)
    assert (code, "no scene of the list or split" in said) == (DataError.exit_code, True)


def test_a_folder_without_a_cache_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no cached scene"):
        CachedLatents.open(tmp_path)
    (tmp_path / "index.json").write_text("{}")
    with pytest.raises(RunError, match=r"index\.json cannot be used"):
        CachedLatents.open(tmp_path)


def test_on_the_direct_path_every_target_is_seen_from_the_goal(folder: Path) -> None:
    cache = CachedLatents.open(folder)
    direct, gradual = (cache.clip("scene_000000", ClipPlace(2, 1), path) for path in ("direct", "gradual"))  # pyright: ignore
    assert torch.equal(direct.target[-1], gradual.target[-1])
    assert not torch.equal(direct.target[0], gradual.target[0])
    later = cache.clip("scene_000000", ClipPlace(0, 1), "direct")
    assert torch.equal(direct.target[0], later.target[2])  # the same moment, whatever clip it is in
