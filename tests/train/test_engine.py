"""Blocks that compute twice, and how an update is shared out; without starting processes."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import pytest
import torch
from tiny_world import After, tiny_recipe
from torch import nn
from torch.testing import assert_close
from two_processes import FRAMES, LOG, UPDATES, Noise, Task, options, recipe_of

from gcd_model.networks import random_networks
from gcd_model.unet import VideoUNet
from gcd_train.errors import Interrupted
from gcd_train.recipe import OptimiserRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe
from gcd_train.recipe_files import load_recipe, packaged_recipes
from gcd_train.training.checkpoint import newest_weights
from gcd_train.training.distributed import ALONE, Engine, Processes, processes_of, recompute_blocks, stages_of
from gcd_train.training.loop import Loop, Progress, StepLoss
from gcd_train.training.loop import Task as BaseTask
from gcd_train.training.monitor import RunFolder
from gcd_train.training.setup import Draws, Precision, model_config


def gradients(unet: VideoUNet) -> tuple[dict[str, torch.Tensor], int]:
    """The gradient of each weight, and how often a block was computed."""
    runs: list[int] = []
    watched = [stage.res.register_forward_pre_hook(lambda *_: runs.append(1)) for stage in stages_of(unet)]
    batch = Noise().batch(Draws(0, "x", 0, torch.device("cpu")), 1)
    plan = unet.plan(torch.ones(1, FRAMES), batch.vector, None, None)
    unet(batch.target, batch.condition, *plan.step(0)).square().mean().backward()
    for hook in watched:
        hook.remove()
    found = {name: weight.grad for name, weight in unet.named_parameters() if weight.grad is not None}
    unet.zero_grad(set_to_none=True)
    return found, len(runs)


def test_blocks_computed_anew_give_the_same_gradients_under_the_same_names() -> None:
    unet = random_networks(model_config(tiny_recipe().model), seed=2).unet
    plain, once = gradients(unet)
    names, blocks = list(unet.state_dict()), len(stages_of(unet))
    recompute_blocks(unet, 2)
    again, runs = gradients(unet)
    assert list(unet.state_dict()) == names
    assert (once, runs) == (blocks, blocks + blocks // 2)
    assert_close(again, plain, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("parts", "count"), [(6, 3), (14, 4), (24, 7), (2, 5)])
def test_every_batch_of_an_update_counts_once_and_all_processes_compute_equally_many(parts: int, count: int) -> None:
    shares = [Processes(rank, count).batches(parts) for rank in range(count)]
    assert sorted(part for share in shares for part, counts in share if counts) == list(range(parts))
    assert {len(share) for share in shares} == {-(-parts // count)}


@pytest.mark.parametrize("name", [name for name in packaged_recipes() if name.startswith(("kubric-", "pardom-"))])
def test_a_published_recipe_runs_as_it_ships_on_one_to_eight_processes(name: str) -> None:
    recipe = load_recipe(f"package:{name}")
    for count in (1, 2, 4, 7, 8):
        rounds = {len(Processes(rank, count).batches(recipe.unet.parts)) for rank in range(count)}
        assert rounds == {-(-recipe.unet.batch // count)}  # clip by clip: no process waits for more than one


def test_without_torchrun_there_is_one_process_whatever_the_recipe_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    with processes_of(ComputeRecipe(parallel="fsdp")) as processes:
        assert processes is ALONE
        assert (processes.first, processes.several) == (True, False)


def test_a_recipe_of_bfloat16_weights_computes_gradients_in_them() -> None:
    task = Task(recipe_of())
    task._precision = Precision.of(ComputeRecipe(device="cpu", weights="bfloat16"))  # pyright: ignore
    Engine(compute=ComputeRecipe(weights="bfloat16")).prepare(task.module)
    task.step_loss(Progress(UPDATES, 1.0)).total.backward()
    trained = [weight for group in task.parameter_groups() for weight in group.parameters]
    assert {weight.dtype for weight in trained} == {torch.bfloat16}
    assert all(torch.isfinite(weight.grad).all() for weight in trained if weight.grad is not None)


class Square(BaseTask):
    """64 x 64 numbers to learn, enough for 8-bit moments; one shape, as torchao compiles its step for each."""

    module: nn.Linear

    def __init__(self) -> None:
        super().__init__(nn.Linear(64, 64, bias=False))
        nn.init.eye_(self.module.weight)

    def step_loss(self, progress: Progress) -> StepLoss:
        inputs = torch.randn(8, 64, generator=torch.Generator().manual_seed(progress.updates))
        with torch.autocast("cpu", torch.bfloat16):
            loss = (self.module(inputs) + inputs).float().square().mean()
        return StepLoss(loss, {"square": loss}, 8)

    def measure(self, picture: Path) -> dict[str, float]:
        return {}


def square_trained(path: Path, kind: Any, weights: Any, stop_at: int | None) -> torch.Tensor:
    task, stop = Square(), Event() if stop_at is None else After(stop_at + 1)
    table = msgspec.structs.replace(
        recipe_of().unet, budget=Budget(updates=6), optimiser=OptimiserRecipe(rate=1e-3, kind=kind)
    )
    chosen = replace(options(ALONE, stop, LOG, weights=weights), table=table)
    with suppress(Interrupted):
        Loop(task, RunFolder(path), chosen).run()
    return task.module.weight.detach()


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("kind", "weights"), [("adam8bit", "float32"), ("adam", "bfloat16"), ("adamw8bit", "bfloat16")]
)
def test_a_run_with_torchaos_optimisers_resumes_to_the_same_bits(tmp_path: Path, kind: Any, weights: Any) -> None:
    """Compiles torchao's step: a minute on a CPU."""
    whole = square_trained(tmp_path / "whole", kind, weights, None)
    square_trained(tmp_path / "resumed", kind, weights, 3)
    resumed = square_trained(tmp_path / "resumed", kind, weights, None)
    assert torch.equal(resumed, whole)
    assert (whole - torch.eye(64)).abs().max() > 1e-3
    assert newest_weights(tmp_path / "resumed" / "unet", "unet") is not None  # read by one that has no optimiser
