"""Runs of small models that do more than show a road, at a tiny size: steered orbits, and painted classes."""

from dataclasses import replace
from pathlib import Path
from threading import Event

import msgspec
import numpy as np
import pytest
import torch
from tiny_scenes4d import CAMERAS, write_driving
from tiny_world import FRAMES, HEIGHT, WIDTH, TinyClips, TinyOrbits, measured, rendered, tiny_recipe, trainer
from torch import Tensor

from gcd_model import Clip, load_synthesizer
from gcd_model.conditioning import micro_conditioning, spherical_features
from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import SphericalDelta
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES
from gcd_train.data.cache import EncodedRows
from gcd_train.data.latents import Encodings, LatentClips
from gcd_train.data.open import open_data
from gcd_train.data.sample import Clips, MadeClips, Sample, to_network, video_clips
from gcd_train.data.sample import painted as painted_clips
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import Budget, DataRecipe, FramesRecipe
from gcd_train.recipe_files import load_recipe
from gcd_train.training.losses import COLOUR_WEIGHTS, class_emphasis
from gcd_train.training.setup import Conditioner, Precision, family_of, mirrored_path, model_config, start_networks

CPU = torch.device("cpu")
PRECISION = Precision(CPU, half=False, channels_last=False)


def small_recipe(name: str, family: str, loss: dict[str, object]) -> Recipe:
    """The tiny recipe for another family, with still smaller networks and few updates."""
    tiny = tiny_recipe()
    assert tiny.vae is not None
    unet = msgspec.structs.replace(tiny.model.unet, multipliers=(1, 1, 1), embedding_width=16)
    vae = msgspec.structs.replace(tiny.model.vae, multipliers=(1, 1, 1))
    told = msgspec.structs.replace(tiny.unet.loss, **loss)
    return tiny_recipe(
        name=name,
        model=msgspec.structs.replace(tiny.model, camera=FAMILIES[family].camera, family=family, unet=unet, vae=vae),
        vae=msgspec.structs.replace(tiny.vae, budget=Budget(updates=2), normalise_at=0.5),
        unet=msgspec.structs.replace(
            tiny.unet,
            budget=Budget(updates=5),  # layers that start at zero let the camera's gradient through by and by
            optimiser=msgspec.structs.replace(tiny.unet.optimiser, warm_up=0),
            loss=told,
            fps=FAMILIES[family].fps,
        ),
    )


def orbit_recipe() -> Recipe:
    return small_recipe("tiny-orbits", "kubric90", {})


def painted_recipe() -> Recipe:
    return small_recipe("tiny-painted", "driving-semantic", {"class_weights": "driving"})


@pytest.fixture(scope="module")
def orbit_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests only read it."""
    path = tmp_path_factory.mktemp("orbits")
    trainer(path, orbit_recipe(), TinyOrbits(), TinyOrbits(1, seed=9)).run()
    return path


@pytest.fixture(scope="module")
def painted_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests only read it."""
    path = tmp_path_factory.mktemp("painted")
    trainer(path, painted_recipe(), painted_clips(TinyClips()), painted_clips(TinyClips(1, seed=9))).run()
    return path


@pytest.mark.slow
def test_a_run_on_orbits_ends_in_a_file_that_is_steered(orbit_run: Path) -> None:
    synthesizer = load_synthesizer(orbit_run / "tiny-orbits.safetensors", device="cpu")
    traits, clips = synthesizer.traits, TinyOrbits(1, seed=4)
    features = synthesizer.encode(Clip(video=to_network(clips.sample(0).source), fps=12.0))
    near, far = (traits.plan_view(SphericalDelta(azimuth_deg=azimuth)) for azimuth in (5.0, 60.0))
    first, second = synthesizer.render(features, [near, far])
    assert first.video.shape == (FRAMES, 3, HEIGHT, WIDTH)
    assert not torch.equal(first.video[-1], second.video[-1])
    assert traits.family is FAMILIES["kubric90"]
    assert set(measured(orbit_run)) == {"vae", "unet", "export"}


@pytest.mark.slow
def test_a_run_on_painted_clips_ends_in_a_file_that_makes_class_maps(painted_run: Path) -> None:
    view, traits = rendered(painted_run / "tiny-painted.safetensors")
    assert view.classes is not None
    assert view.classes.shape == (1, FRAMES, HEIGHT, WIDTH)
    assert traits.classes == DRIVING_CLASSES
    assert all(0 <= measured(painted_run)[stage]["miou_full"] <= 1 for stage in ("vae", "unet", "export"))


@pytest.mark.slow
def test_the_classes_of_a_driving_set_are_measured_and_end_in_the_weight_file(tmp_path: Path) -> None:
    places = write_driving(tmp_path / "set", 1, 2, frames=FRAMES + 1).parent
    data = DataRecipe(
        kind="parallel_domain4d",
        modality="semantic",
        cameras=CAMERAS,
        frames=FramesRecipe(strides=(1,), reach_last=True),
        split="last",
        held_out=1,
        repeats=2,
    )
    recipe = msgspec.structs.replace(painted_recipe(), data=data)
    opened = open_data(recipe, model_config(recipe.model), FAMILIES["driving-semantic"], places)
    truth = opened.valid.sample(0).target_classes
    assert [kind.name for kind in opened.valid.classes] == ["Car", "Road", "Sky", "Void"]
    assert set(np.unique(truth).tolist()) == {0, 1, 2, 3}
    trainer(tmp_path / "run", recipe, opened.clips, opened.valid).run()
    synthesizer = load_synthesizer(tmp_path / "run" / "tiny-painted.safetensors", device="cpu")
    assert synthesizer.traits.classes == opened.valid.classes
    found = measured(tmp_path / "run")
    assert all(0 <= found[stage]["miou_full"] <= 1 for stage in ("vae", "unet", "export"))


def mirrored(clips: Clips) -> Clips:
    """Clips as seen in a mirror."""

    def make(number: int) -> Sample:
        sample = clips.sample(number)
        path = mirrored_path(sample.trajectory)
        assert sample.target_classes is not None
        return replace(
            sample,
            source=sample.source[:, :, ::-1],
            target=sample.target[:, :, ::-1],
            target_classes=sample.target_classes[:, :, ::-1],
            source_from_target=path.source_from_target.numpy(),
            deltas=None if path.delta is None else path.delta.numpy(),
        )

    return MadeClips(
        make=make, seeds=clips.seeds, fps=clips.fps, camera=clips.camera, classes=clips.classes, origin="mirrored"
    )


def encoded(path: Path, recipe: Recipe, clips: Clips) -> LatentClips:
    """Latents of clips by a random autoencoder."""
    config = model_config(recipe.model)
    work = Encodings(
        recipe=msgspec.structs.replace(recipe, seed=1),
        config=config,
        family=FAMILIES[recipe.model.family],
        precision=PRECISION,
        clips=clips,
        folder=path,
        shared=None,
        stop=Event(),
    )
    work.encode(random_networks(config, seed=5))
    return LatentClips.open(path)


def row(clips: LatentClips, *, mirrored: bool) -> EncodedRows:
    """Frame 2 of clip 1."""
    return clips.rows(torch.tensor([1]), torch.tensor([2]), torch.tensor([mirrored]), CPU)


@pytest.mark.parametrize(
    ("recipe", "clips", "seen"),
    [
        (orbit_recipe(), TinyOrbits(), mirrored(TinyOrbits())),
        (painted_recipe(), painted_clips(TinyClips()), painted_clips(mirrored(TinyClips()))),
    ],
)
def test_a_mirrored_row_is_the_row_of_the_mirrored_scene(
    recipe: Recipe, clips: Clips, seen: Clips, tmp_path: Path
) -> None:
    one = row(encoded(tmp_path / "plain", recipe, clips), mirrored=True)
    other = row(encoded(tmp_path / "mirrored", recipe, seen), mirrored=False)
    assert torch.equal(one.source, other.source)
    assert torch.equal(one.target, other.target)
    assert torch.equal(one.motion, other.motion)
    assert_alike(one.camera, other.camera)
    assert_alike(one.emphasis, other.emphasis)


def assert_alike(one: Tensor | None, other: Tensor | None) -> None:
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        torch.testing.assert_close(one, other)


@pytest.mark.slow
def test_the_network_is_told_of_orbits_what_the_synthesizer_would_tell(orbit_run: Path) -> None:
    recipe, clips = orbit_recipe(), LatentClips.open(orbit_run / "latents")
    rows = clips.rows(torch.tensor([1]), torch.tensor([2]), torch.tensor([False]), CPU)
    config, path = model_config(recipe.model), TinyOrbits().trajectory(1)
    traits = load_synthesizer(orbit_run / "tiny-orbits.safetensors", device="cpu").traits
    told = micro_conditioning(12.0, traits.motion_bucket(path), 0.0, config.unet.vector_width)
    torch.testing.assert_close(
        Conditioner(config, recipe.unet, PRECISION).vector(torch.tensor([recipe.unet.fps]), rows.motion)[0], told
    )
    assert path.delta is not None
    assert rows.camera is not None
    assert torch.equal(rows.camera[0], spherical_features(path.delta)[2])


@pytest.mark.parametrize(
    ("name", "factor"), [("person", 7.0), ("cyclist", 7.0), ("truck", 3.0), ("own_car", 3.0), ("road", 1.0)]
)
def test_people_and_vehicles_of_our_world_count_as_published(name: str, factor: float) -> None:
    (colour,) = (kind.colour for kind in DRIVING_CLASSES if kind.name == name)
    painted_one = torch.tensor(colour).view(1, 3, 1, 1).expand(1, 3, 8, 8) / 127.5 - 1
    emphasis = class_emphasis(painted_one, COLOUR_WEIGHTS["driving"], (1, 1))
    assert emphasis.item() == pytest.approx(factor - 1)


@pytest.mark.parametrize(
    ("recipe", "clips", "words"),
    [
        (orbit_recipe(), TinyClips(), "no orbits"),
        (painted_recipe(), TinyOrbits(), "its own"),
    ],
)
def test_clips_of_the_other_kind_are_refused(recipe: Recipe, clips: Clips, words: str, tmp_path: Path) -> None:
    recipe = msgspec.structs.replace(recipe, unet=msgspec.structs.replace(recipe.unet, fps=clips.fps))
    with pytest.raises(DataError, match=words):
        trainer(tmp_path, recipe, clips, clips)


def test_a_mirrored_path_turns_the_other_way() -> None:
    path = TinyOrbits().trajectory(1)
    other = mirrored_path(path)
    assert path.delta is not None
    assert other.delta is not None
    assert torch.equal(other.delta[:, 0], -path.delta[:, 0])
    assert torch.equal(other.delta[:, 1:], path.delta[:, 1:])
    torch.testing.assert_close(other.source_from_target[:, 0, 3], -path.source_from_target[:, 0, 3])
    torch.testing.assert_close(mirrored_path(other).source_from_target, path.source_from_target)


# --- videos out of pairs: what is learned before views ----------------------------------------------------------------

SMALLER = ("model.unet.multipliers=[1,2,2]", "model.vae.width=16", "model.vae.multipliers=[1,1,2]", "log.valid_clips=1")


def study(name: str, *changes: str) -> Recipe:
    return load_recipe(f"package:{name}", small=True, changes=[*SMALLER, *changes])


def test_both_sides_of_a_pair_are_videos_that_begin_with_their_condition() -> None:
    pairs, orbits = TinyClips(2), TinyOrbits(1)
    videos = video_clips([pairs, orbits])
    assert len(videos) == 6
    for number in range(6):
        video = videos.sample(number)
        assert (video.source == video.target[0]).all()
        assert not (video.target == video.target[0]).all()
        assert (video.start, video.deltas, video.target_classes, video.visible) == (None, None, None, None)
        assert np.array_equal(video.source_from_target, np.tile(np.eye(4), (FRAMES, 1, 1)))
    shown = [videos.sample(number).target for number in (0, 1, 2, 5)]
    wanted = [pairs.sample(0).source, pairs.sample(0).target, orbits.sample(0).source, pairs.sample(1).target]
    assert all(np.array_equal(one, other) for one, other in zip(shown, wanted, strict=True))
    assert len(set(videos.seeds)) == 6


@pytest.mark.slow
def test_views_start_from_what_continues_pictures(tmp_path: Path) -> None:
    latents, other = tmp_path / "latents", TinyClips(2, seed=4)
    other.origin = "tiny direct"
    first = study("study-pretrain")
    videos = video_clips((TinyClips(2), other))
    trainer(tmp_path / "first", first, videos, videos, latents=latents).run()
    weights = tmp_path / "first" / "study-pretrain-small.safetensors"
    made = load_synthesizer(weights, device="cpu")
    assert made.traits.family is FAMILIES["svd"]
    before = {path: path.stat().st_mtime_ns for path in latents.rglob("*.safetensors")}
    assert len({path.parent for path in before}) == 1
    assert not (tmp_path / "first" / "latents").exists()
    then = study("study", f"model.weights={weights}")
    for folder in ("second", "third"):  # which share their latents
        trainer(tmp_path / folder, then, latents=latents).run("latents")
    after = {path: path.stat().st_mtime_ns for path in latents.rglob("*.safetensors")}
    assert before.items() < after.items()
    assert len({path.parent for path in after}) == 2
    start = start_networks(then.model, model_config(then.model), then.seed)
    assert torch.equal(start.unet.conv_out.weight, made.networks.unet.conv_out.weight.float())
    scratch = study("study", f"model.weights={weights}", "model.scratch=true")
    anew = start_networks(scratch.model, model_config(scratch.model), scratch.seed)
    assert not torch.equal(anew.unet.stem.weight, start.unet.stem.weight)
    assert torch.equal(anew.decoder.stem.weight, start.decoder.stem.weight)


def test_a_model_for_something_else_is_refused(tmp_path: Path) -> None:
    told = study("study-pretrain", "model.family=driving")
    with pytest.raises(RecipeError, match=r'give model\.family "svd"'):
        open_data(told, model_config(told.model), family_of(told.model), tmp_path, tmp_path)
