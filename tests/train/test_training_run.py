"""Whole runs of all stages at a tiny size."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest
import torch
from tiny_world import (
    FRAMES,
    HEIGHT,
    WIDTH,
    After,
    TinyClips,
    assert_same_states,
    measured,
    rendered,
    saved,
    tiny_recipe,
    trainer,
)

from gcd_model import load_synthesizer
from gcd_train.data.cache import write_index
from gcd_train.data.latents import LatentClips
from gcd_train.errors import DataError, Interrupted, RecipeError, RunError
from gcd_train.recipe_data import Budget, StageName
from gcd_train.training.setup import model_config, sampled_as_trained


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests only read it."""
    path = tmp_path_factory.mktemp("run")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    trainer(path).run()
    torch.set_num_threads(threads)
    return path


def test_a_run_ends_in_a_weight_file_that_renders(run: Path) -> None:
    view, traits = rendered(run / "tiny.safetensors")
    assert view.video.shape == (FRAMES, 3, HEIGHT, WIDTH)
    assert traits.family is not None
    assert (traits.family.name, traits.move_time, traits.trained) == ("driving", FRAMES - 1, True)


def test_the_weight_file_holds_the_averaged_weights_in_half_precision(run: Path) -> None:
    networks = load_synthesizer(run / "tiny.safetensors", device="cpu", dtype="float16").networks
    average = saved(run / "unet", "unet").average
    assert torch.equal(networks.unet.conv_out.weight, average["unet.conv_out.weight"].half())


def test_every_stage_writes_metrics_and_samples(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    found = measured(run)
    assert set(found) == {"vae", "unet", "export"}
    assert all(5 < line["psnr"] < 60 for line in found.values())
    assert {line["stage"] for line in lines if line["kind"] == "loss"} == {"vae", "unet"}
    for stage in ("vae", "unet"):
        assert len(list((run / stage / "samples").glob("*.png"))) == 1
    assert found["export"]["bytes"] == (run / "tiny.safetensors").stat().st_size


@pytest.mark.slow
def test_a_finished_run_does_nothing_but_export_again(run: Path) -> None:
    before = {
        path: path.stat().st_mtime_ns
        for path in run.rglob("*")
        if path.parent.name == "latents" or path.name == "state.json"
    }
    trainer(run).run()
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_latents_have_zero_mean_and_unit_spread(run: Path) -> None:
    clips = LatentClips.open(run / "latents")
    every = torch.arange(2).repeat_interleave(FRAMES), torch.arange(FRAMES).repeat(2), torch.zeros(2 * FRAMES).bool()
    values, meta = clips.rows(*every, torch.device("cpu")).target.movedim(1, 0).flatten(1), clips.meta
    assert values.mean(1).abs().max() < 1.0
    assert 0.3 < values.std(1).min() <= values.std(1).max() < 3.0
    assert sum(meta.sensitivity) / len(meta.sensitivity) == pytest.approx(1.0)


def folder_with(run: Path, path: Path, *parts: str) -> Path:
    """A run folder that shares finished stages with another."""
    path.mkdir(parents=True, exist_ok=True)
    for part in parts:
        (path / part).symlink_to(run / part)
    return path


@pytest.mark.parametrize(("stage", "at"), [("vae", 2), pytest.param("unet", 5, marks=pytest.mark.slow)])
def test_a_resumed_stage_equals_an_uninterrupted_one_bit_for_bit(
    run: Path, tmp_path: Path, stage: StageName, at: int
) -> None:
    torch.set_num_threads(1)
    path = folder_with(run, tmp_path / "again", *(("vae", "latents") if stage == "unet" else ()))
    with pytest.raises(Interrupted, match=f"update {at}"):
        trainer(path, stop=After(at + 1)).run(stage)  # asked once before the first update, then after each
    assert saved(path / stage, stage).note.updates == at
    trainer(path).run(stage)
    assert_same_states(path, run, stage)


def test_encoding_goes_on_where_it_stopped(run: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    path = folder_with(run, tmp_path / "again", "vae")
    with pytest.raises(Interrupted, match="clip 1 of 2"):
        trainer(path, stop=After(1)).run("latents")
    with pytest.raises(RunError, match="no finished latents"):
        LatentClips.open(path / "latents")
    trainer(path, clips=TinyClips(3)).run("latents")  # the data has grown; the run keeps the clips it began with
    every = torch.arange(2).repeat_interleave(FRAMES), torch.arange(FRAMES).repeat(2), torch.arange(2 * FRAMES) % 2 > 0
    one, other = (LatentClips.open(folder / "latents").rows(*every, torch.device("cpu")) for folder in (path, run))
    assert torch.equal(one.source, other.source)
    assert torch.equal(one.target, other.target)


def test_a_longer_budget_trains_on(run: Path, tmp_path: Path) -> None:
    path = folder_with(run, tmp_path / "again", "latents")
    shutil.copytree(run / "vae" / "states", path / "vae" / "states")
    recipe = tiny_recipe()
    assert recipe.vae is not None
    longer = msgspec.structs.replace(recipe.vae, budget=Budget(updates=7))
    trainer(path, recipe=tiny_recipe(vae=longer)).run("vae")
    assert saved(path / "vae", "vae").note.updates == 7
    with pytest.raises(RunError, match="another autoencoder"):
        trainer(path, recipe=tiny_recipe(vae=longer)).run("unet")


def test_a_state_of_another_seed_is_not_resumed(run: Path, tmp_path: Path) -> None:
    path = folder_with(run, tmp_path / "again", "vae")
    with pytest.raises(RunError, match="another model, seed"):
        trainer(path, recipe=tiny_recipe(seed=4)).run("vae")


def test_the_shipped_sampler_is_that_of_the_recipe_and_starts_where_something_was_trained() -> None:
    recipe = tiny_recipe()
    changed = msgspec.structs.replace(
        recipe.unet, augmentation=0.05, noise=msgspec.structs.replace(recipe.unet.noise, shared=0.0)
    )
    config = model_config(recipe.model)
    assert sampled_as_trained(config, recipe.unet).sampling == config.sampling
    sampling = sampled_as_trained(config, changed).sampling
    assert (sampling.augmentation, sampling.shared_noise) == (0.05, False)
    noise = msgspec.structs.replace(recipe.unet.noise, fixed_share=1.0, fixed_sigma=40.0)
    with pytest.raises(RecipeError, match="trains sigma 40 alone"):
        sampled_as_trained(config, msgspec.structs.replace(recipe.unet, noise=noise))


def test_a_stage_wants_the_one_before_it_and_the_recipe_to_have_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="--stage vae"):
        trainer(tmp_path).run("unet")
    model = msgspec.structs.replace(tiny_recipe().model, weights="none.safetensors")
    with pytest.raises(RecipeError, match="no stage 'vae'"):
        trainer(tmp_path, recipe=tiny_recipe(vae=None, model=model)).run("vae")


def test_clips_of_another_size_are_refused(run: Path, tmp_path: Path) -> None:
    path = folder_with(run, tmp_path / "again", "vae")
    recipe = tiny_recipe()
    larger = msgspec.structs.replace(recipe.model, width=2 * WIDTH)
    with pytest.raises(DataError, match="4 frames of 128x32"):
        trainer(path, recipe=tiny_recipe(model=larger)).run("latents")


@pytest.mark.parametrize("lost", ["statistics", "index"])
def test_a_kill_while_latents_are_written_loses_nothing(lost: str, run: Path, tmp_path: Path) -> None:
    path = folder_with(run, tmp_path / "again", "vae")
    shutil.copytree(run / "latents", path / "latents")
    meta = LatentClips.open(run / "latents").meta
    begun = msgspec.structs.replace(meta, sensitivity=())
    write_index(path / "latents", begun if lost == "statistics" else msgspec.structs.replace(begun, shards=()))
    trainer(path).run("latents")
    assert LatentClips.open(path / "latents").meta == meta


def test_weights_of_two_runs_are_never_exported_together(run: Path, tmp_path: Path) -> None:
    other, path = tmp_path / "other", folder_with(run, tmp_path / "mixed", "latents", "unet")
    shorter = msgspec.structs.replace(tiny_recipe().vae, budget=Budget(updates=2))
    trainer(other, recipe=tiny_recipe(vae=shorter)).run("vae")
    (path / "vae").symlink_to(other / "vae")
    with pytest.raises(RunError, match="belongs to another"):
        trainer(path).run("export")
    assert not (path / "tiny.safetensors").exists()


def test_a_stage_killed_before_its_last_measurement_measures_when_run_again(run: Path, tmp_path: Path) -> None:
    path = folder_with(run, tmp_path / "again", "latents")
    shutil.copytree(run / "vae" / "states", path / "vae" / "states")
    trainer(path).run("vae")
    assert len(list((path / "vae" / "samples").glob("*.png"))) == 1


def test_clips_the_model_or_the_latents_do_not_fit_are_refused_before_training(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder_with(run, tmp_path / "again", "vae", "latents")
    monkeypatch.setattr(TinyClips, "origin", "another world")
    with pytest.raises(RunError, match="of other clips"):
        trainer(path).run("unet")
    monkeypatch.setattr(TinyClips, "fps", 5.0)
    with pytest.raises(DataError, match="the clips have 5"):
        trainer(tmp_path)


def unet_of(path: Path, *, compiled: bool, recompute: bool = False) -> dict[str, torch.Tensor]:
    """The U-Net's state after all updates of the tiny recipe; the stages before it are taken as they lie there."""
    recipe = tiny_recipe()
    compute = msgspec.structs.replace(recipe.compute, compile=compiled, checkpoint_activations=recompute)
    for stage in ("vae", "latents", "unet"):
        trainer(path, msgspec.structs.replace(recipe, compute=compute)).run(stage)
    return saved(path / "unet", "unet").module


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_compiled_blocks_learn_what_plain_ones_do(tmp_path: Path) -> None:
    """Single frames, then whole clips; also where blocks forget and compute anew."""
    torch.set_num_threads(1)
    plain = unet_of(tmp_path / "plain", compiled=False)
    for recompute in (False, True):
        folder = tmp_path / f"compiled-{recompute}"
        folder.mkdir()
        for stage in ("vae", "latents"):
            (folder / stage).symlink_to(tmp_path / "plain" / stage)
        compiled = unet_of(folder, compiled=True, recompute=recompute)
        assert compiled.keys() == plain.keys()  # a plain run can go on with it
        for name, weight in plain.items():
            torch.testing.assert_close(compiled[name], weight, rtol=1e-3, atol=1e-4, msg=name)
