"""Laws of single stages that a whole run does not show."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event

import msgspec
import pytest
import torch
from tiny_world import HEIGHT, WIDTH, tiny_recipe
from torch import nn
from torch.testing import assert_close

from gcd_model.networks import Networks, random_networks
from gcd_train.errors import TrainError
from gcd_train.recipe import OptimiserRecipe, VAERecipe
from gcd_train.recipe_data import Budget, LogRecipe
from gcd_train.training.loop import Loop, LoopOptions, Progress, StepLoss, Task
from gcd_train.training.monitor import RunFolder
from gcd_train.training.setup import model_config
from gcd_train.training.vae import normalise_latents, start_from_components


def networks() -> Networks:
    return random_networks(model_config(tiny_recipe().model), seed=5)


def test_normalising_gives_unit_latents_and_changes_no_picture_inside() -> None:
    pair = networks()
    frames = torch.randn(2, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)).clamp(-1, 1)
    with torch.no_grad():
        before = pair.target_encoder(frames)
        picture = pair.decoder.stem(before.mean)
        values = before.mean.transpose(0, 1).flatten(1)
        mean, std = values.mean(1), values.std(1)
        normalise_latents(pair.target_encoder, pair.decoder, mean, std)
        after = pair.target_encoder(frames)
        same = pair.decoder.stem(after.mean)
    assert_close(after.mean.transpose(0, 1).flatten(1).mean(1), torch.zeros_like(mean), atol=1e-4, rtol=0)
    assert_close(after.mean.transpose(0, 1).flatten(1).std(1), torch.ones_like(std), atol=1e-4, rtol=0)
    assert_close(after.log_variance, before.log_variance - 2 * std.log()[:, None, None], atol=1e-4, rtol=1e-4)
    assert_close(same[..., 1:-1, 1:-1], picture[..., 1:-1, 1:-1], atol=1e-4, rtol=1e-4)


class Parabola(Task):
    """A task with one number to learn; its loss can go wrong."""

    def __init__(self, fails_at: int | None = None) -> None:
        super().__init__(nn.Linear(1, 1, bias=False))
        self.x = self.module.get_parameter("weight")
        nn.init.ones_(self.x)
        self._fails_at = fails_at

    def step_loss(self, progress: Progress) -> StepLoss:
        loss = (self.x**2 if progress.updates != self._fails_at else self.x * torch.inf).sum()
        return StepLoss(loss, {"square": loss}, 1)

    def measure(self, picture: Path) -> dict[str, float]:
        return {"x": self.x.item()}


class Clock:
    """A second passes whenever it is looked at."""

    def __init__(self) -> None:
        self._now = 0.0

    def __call__(self) -> float:
        self._now += 1.0
        return self._now


def options(budget: Budget, clock: Clock) -> LoopOptions:
    return LoopOptions(
        stage="vae",
        identity="x",
        table=VAERecipe(budget=budget, optimiser=OptimiserRecipe(rate=0.1)),
        log=LogRecipe(log_s=1000.0, save_s=1000.0, measure_s=1000.0),
        stop=Event(),
        frames_per_clip=4,
        clock=clock,
    )


def test_a_budget_in_minutes_ends_by_the_clock(tmp_path: Path) -> None:
    loop = Loop(Parabola(), RunFolder(tmp_path), options(Budget(minutes=0.2), Clock()))
    loop.run()
    assert loop.progress == Progress(12, 1.0)  # each update takes a second of this clock


def test_elapsed_time_is_part_of_the_state(tmp_path: Path) -> None:
    Loop(Parabola(), RunFolder(tmp_path), options(Budget(minutes=0.1), Clock())).run()
    longer = Loop(Parabola(), RunFolder(tmp_path), options(Budget(minutes=0.2), Clock()))
    assert longer.progress == Progress(6, pytest.approx(0.5))


def test_a_loss_that_is_no_number_stops_the_run_and_is_not_saved(tmp_path: Path) -> None:
    loop = Loop(Parabola(fails_at=3), RunFolder(tmp_path), options(Budget(updates=5), Clock()))
    with pytest.raises(TrainError, match="lower the learning rate"):
        loop.run()
    assert not (tmp_path / "vae" / "states").exists()


def test_a_run_measures_after_so_many_updates(tmp_path: Path) -> None:
    log = LogRecipe(log_s=1000.0, save_s=1000.0, measure_s=1e-9, measure_every=2)
    Loop(Parabola(), RunFolder(tmp_path), replace(options(Budget(updates=5), Clock()), log=log)).run()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [line["updates"] for line in lines if line["kind"] == "measured"] == [2, 4, 5]


class Distances(Parabola):
    """Its parts pull the number to different places; keeps the gradient of each update."""

    def __init__(self, places: Sequence[float]) -> None:
        super().__init__()
        self.gradients: list[float] = []
        self._places = places

    def step_loss(self, progress: Progress) -> StepLoss:
        loss = (self.x - self._places[progress.part]).square().sum()
        return StepLoss(loss, {"distance": loss}, 1)

    def after_update(self, progress: Progress) -> bool:
        assert self.x.grad is not None
        self.gradients.append(self.x.grad.item())
        return False


def test_the_gradient_of_an_update_is_the_mean_over_its_parts(tmp_path: Path) -> None:
    task = Distances([0.0, 3.0, 9.0])
    Loop(task, RunFolder(tmp_path), replace(options(Budget(updates=1), Clock()), parts=3)).run()
    assert task.gradients == [pytest.approx(2 * (1 - (0 + 3 + 9) / 3))]


def test_a_part_of_the_loss_that_the_last_batch_lacks_stays_in_the_log(tmp_path: Path) -> None:
    class Changing(Distances):
        def step_loss(self, progress: Progress) -> StepLoss:
            loss = super().step_loss(progress)
            return loss if progress.part else replace(loss, parts={"early": loss.total})

    Loop(Changing([0.0, 3.0]), RunFolder(tmp_path), replace(options(Budget(updates=1), Clock()), parts=2)).run()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert (lines[0]["early"], lines[0]["distance"]) == (1.0, 4.0)


def test_a_linear_path_starts_as_the_best_linear_code() -> None:
    config = model_config(tiny_recipe().model)
    config = msgspec.structs.replace(config, vae=msgspec.structs.replace(config.vae, linear=True))
    pair, block = random_networks(config, seed=5), config.vae.down_factor
    frames = torch.randn(6, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)).cumsum(-1) / 8
    pixels = nn.functional.pixel_unshuffle(frames, block).movedim(1, -1).flatten(0, 2)
    with torch.no_grad():
        start_from_components(pair.target_encoder, pair.decoder, frames)
        latents = pair.target_encoder(frames).mean
        decoded = pair.decoder(latents, None)
    centred = pixels - pixels.mean(0)
    kept = torch.linalg.svdvals(centred)[: config.vae.latent_channels]
    lost = float(centred.square().sum() - kept.square().sum())
    assert float((decoded - frames).square().sum()) == pytest.approx(lost, rel=1e-3)
    spread = latents.transpose(0, 1).flatten(1).std(1)
    assert_close(spread, torch.ones_like(spread), atol=1e-2, rtol=0)
