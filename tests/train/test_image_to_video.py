"""Videos out of pairs: what is learned before views, from pictures, from latents and from samples of a data set."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_world import FRAMES, TinyClips, TinyOrbits, trainer

from gcd_model import load_synthesizer
from gcd_model.weights.card import FAMILIES
from gcd_train.data.open import DataPlaces, open_data
from gcd_train.data.sample import video_clips
from gcd_train.errors import RecipeError
from gcd_train.recipe import Recipe
from gcd_train.recipe_files import load_recipe
from gcd_train.training.setup import family_of, model_config, start_networks

CPU = torch.device("cpu")
SMALLER = ("model.unet.multipliers=[1,2,2]", "model.vae.width=16", "model.vae.multipliers=[1,1,2]", "log.valid_clips=1")


def recipe(name: str, *changes: str) -> Recipe:
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


# examples


def test_views_start_from_what_continues_pictures(tmp_path: Path) -> None:
    latents, other = tmp_path / "latents", TinyClips(2, seed=4)
    other.origin = "tiny direct"
    first = recipe("study-pretrain")
    videos = video_clips((TinyClips(2), other))
    trainer(tmp_path / "first", first, videos, videos, latents=latents).run()
    weights = tmp_path / "first" / "study-pretrain-small.safetensors"
    made = load_synthesizer(weights, device="cpu")
    assert made.traits.family is FAMILIES["svd"]
    before = {path: path.stat().st_mtime_ns for path in latents.rglob("*.safetensors")}
    assert len({path.parent for path in before}) == 1
    assert not (tmp_path / "first" / "latents").exists()
    then = recipe("study-gradual-pretrained", f"model.weights={weights}")
    for folder in ("second", "third"):  # which share their latents
        trainer(tmp_path / folder, then, latents=latents).run("latents")
    after = {path: path.stat().st_mtime_ns for path in latents.rglob("*.safetensors")}
    assert before.items() < after.items()
    assert len({path.parent for path in after}) == 2
    start = start_networks(then.model, model_config(then.model), then.seed)
    assert torch.equal(start.unet.conv_out.weight, made.networks.unet.conv_out.weight.float())
    scratch = recipe("study-gradual-scratch", f"model.weights={weights}")
    anew = start_networks(scratch.model, model_config(scratch.model), scratch.seed)
    assert not torch.equal(anew.unet.stem.weight, start.unet.stem.weight)
    assert torch.equal(anew.decoder.stem.weight, start.decoder.stem.weight)


def test_a_model_for_something_else_is_refused(tmp_path: Path) -> None:
    told = recipe("study-pretrain", "model.family=driving")
    with pytest.raises(RecipeError, match=r'give model\.family "svd"'):
        open_data(told, model_config(told.model), family_of(told.model), DataPlaces(data=tmp_path, valid=tmp_path))
