"""A student of few steps: its sampler, its losses, and whole distillations at a tiny size."""

from copy import deepcopy
from pathlib import Path

import msgspec
import pytest
import torch
from fake_model import traits_of
from tiny_world import FRAMES, HEIGHT, WIDTH, TinyClips, measured, saved, smaller, trainer

from gcd_model import Clip, RenderOptions, load_synthesizer
from gcd_model.config import SVD_14
from gcd_model.networks import Networks, random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import load_weights, read_adapter, save_weights
from gcd_train.data.batches import SampleBatches
from gcd_train.data.sample import to_network
from gcd_train.errors import RecipeError
from gcd_train.recipe import OptimiserRecipe, Recipe, StudentRecipe, UNetRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe
from gcd_train.training.objective import Batch, denoiser_of, sampled, schedule_of
from gcd_train.training.setup import Draws, Precision, loaded_base, run_config, student_config

CPU = Precision.of(ComputeRecipe(device="cpu"))


def tiny(teacher: Path, **changes: object) -> Recipe:
    table = {
        "name": "tiny-student",
        "seed": 5,
        "model": {"weights": str(teacher), "train": "lora", "lora": {"rank": 2}},
        "student": {"steps": 2, "sigma_min": 1.0, "learned_steps": [1, 2]},
        "compute": {"device": "cpu"},
        "log": {"valid_clips": 1},
        "latents": {"augmentation": 0.02},
        "unet": {
            "budget": {"updates": 2},
            "optimiser": {"rate": 1e-3},
            "ema": {"limit": 0.9},
            "clip_batch": 1,
            "dropout": 0.0,
            "loss": {"sensitivity": True},
        },
    }
    return msgspec.convert({**table, **changes}, Recipe)


@pytest.fixture(scope="module")
def teacher(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of a tiny driving model; tests only read them."""
    config = smaller(FRAMES, HEIGHT, WIDTH)
    path = tmp_path_factory.mktemp("teacher") / "teacher.safetensors"
    save_weights(
        random_networks(config, seed=0), path, Card(name="t", config=config, family=FAMILIES["driving"], move_time=3)
    )
    return path


@pytest.fixture(scope="module")
def networks(teacher: Path) -> Networks:
    """The teacher's, in float32."""
    return loaded_base(str(teacher)).networks.float()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, teacher: Path) -> Path:
    """A finished distillation; tests only read it."""
    path = tmp_path_factory.mktemp("run")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    trainer(path, tiny(teacher)).run()
    torch.set_num_threads(threads)
    return path


@pytest.fixture(scope="module")
def batch(networks: Networks) -> Batch:
    """One clip, encoded anew."""
    recipe = UNetRecipe(
        budget=Budget(updates=1), optimiser=OptimiserRecipe(rate=1.0), source="pixels", dropout=0.0, augmentation=0.0
    )
    return SampleBatches(TinyClips(1), networks, recipe, FAMILIES["driving"], CPU).batch(
        Draws(1, "batch", 0, CPU.device), 1
    )


def test_the_student_samples_in_training_as_the_synthesizer_does(networks: Networks, batch: Batch) -> None:
    noise = torch.randn(batch.target.shape, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        made = sampled(denoiser_of(deepcopy(networks).train()), batch, noise, schedule_of(networks.config, 3))
    synthesizer = Synthesizer(deepcopy(networks), traits_of(networks.config, "driving"))
    features = synthesizer.encode(Clip(video=to_network(TinyClips(1).sample(0).source), fps=10.0))
    options = RenderOptions(steps=3, initial_noise=noise)
    view = synthesizer.render(features, [TinyClips(1).trajectory(0)], options)[0]
    assert torch.allclose(made, view.latents[0], atol=2e-4)


def test_gradients_go_through_every_step_of_the_sampler(networks: Networks, batch: Batch) -> None:
    denoiser = denoiser_of(deepcopy(networks).requires_grad_(True).train())
    schedule = schedule_of(student_config(networks.config, StudentRecipe(steps=3, sigma_min=1.0)), 3)
    seen: list[torch.Tensor] = []
    denoiser.register_forward_hook(lambda _module, _given, made: seen.append(made))
    made = sampled(denoiser, batch, torch.zeros_like(batch.target), schedule)
    gradients = torch.autograd.grad(made.square().sum(), seen)
    assert len(seen) == 3
    assert all(gradient.abs().max() > 0 for gradient in gradients)


def test_a_student_has_its_own_steps_and_no_guidance() -> None:
    config = student_config(SVD_14, StudentRecipe(steps=4, sigma_min=0.5))
    sampling = config.sampling
    assert (sampling.steps, sampling.sigma_min, sampling.guidance) == (4, 0.5, (1.0, 1.0))
    assert schedule_of(config, 4).branches == 1
    with pytest.raises(RecipeError, match="below sigma_max"):
        student_config(config, StudentRecipe(steps=2, sigma_min=900.0))


@pytest.mark.slow
def test_a_distillation_ends_in_a_weight_file_that_takes_the_students_steps(run: Path) -> None:
    synthesizer = load_synthesizer(run / "tiny-student.safetensors", device="cpu")
    sampling = synthesizer.traits.config.sampling
    assert (sampling.steps, sampling.sigma_min, sampling.guidance) == (2, 1.0, (1.0, 1.0))
    steps: list[tuple[int, int]] = []
    features = synthesizer.encode(Clip(video=to_network(TinyClips(1).sample(0).source), fps=10.0))
    options = RenderOptions(progress=lambda done, of: steps.append((done, of)))
    synthesizer.render(features, [synthesizer.traits.plan_view()], options)
    assert steps == [(1, 2), (2, 2)]
    assert synthesizer.traits.trained


@pytest.mark.slow
def test_a_distillation_says_what_it_measures(run: Path) -> None:
    found = measured(run)
    assert set(found) == {"unet", "export"}
    assert all(5 < line["psnr"] < 60 for line in found.values())
    assert '"latent": ' in (run / "metrics.jsonl").read_text()


@pytest.mark.slow
def test_the_student_is_exported_as_weights_and_as_an_adapter(run: Path, teacher: Path) -> None:
    paired = saved(run / "unet", "unet").best
    adapter = read_adapter(run / "tiny-student-adapter.safetensors")
    assert adapter.tensors.keys() == paired.keys()
    assert all(torch.equal(adapter.tensors[name], paired[name]) for name in paired)
    shipped = load_weights(run / "tiny-student.safetensors").networks.state_dict()
    start = loaded_base(str(teacher)).networks.state_dict()
    changed = {name for name, value in shipped.items() if not torch.equal(value, start[name].half())}
    assert changed == {f"{name.removesuffix('.up')}.weight" for name in paired if name.endswith(".up")}


def test_a_student_learns_without_dropout(teacher: Path) -> None:
    with pytest.raises(msgspec.ValidationError, match=r"\[student\]"):
        tiny(teacher, unet={"budget": {"updates": 1}, "optimiser": {"rate": 1.0}})


def test_a_teacher_whose_camera_goes_another_way_is_refused(teacher: Path) -> None:
    with pytest.raises(RecipeError, match="at its goal in frame 3"):
        run_config(tiny(teacher, data={"path": "direct"}))
