"""Laws of single stages that a whole run does not show."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from tiny_world import HEIGHT, WIDTH, Slope, loop_options, tiny_recipe
from torch import nn
from torch.testing import assert_close

from gcd_model.networks import Networks, random_networks
from gcd_train.errors import TrainError
from gcd_train.recipe_data import Budget, LogRecipe
from gcd_train.training.loop import Loop, Progress, StepLoss
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


class Clock:
    """A second passes whenever it is looked at."""

    def __init__(self) -> None:
        self._now = 0.0

    def __call__(self) -> float:
        self._now += 1.0
        return self._now


def test_a_budget_in_minutes_ends_by_the_clock_and_elapsed_time_is_part_of_the_state(tmp_path: Path) -> None:
    for minutes, updates in ((0.1, 6), (0.2, 12)):  # each update takes a second of this clock
        loop = Loop(Slope(), RunFolder(tmp_path), loop_options(Budget(minutes=minutes), clock=Clock()))
        assert loop.progress == Progress(updates - 6, pytest.approx(1 - 6 / updates))
        loop.run()
        assert loop.progress == Progress(updates, 1.0)


def test_a_loss_that_is_no_number_stops_the_run_and_is_not_saved(tmp_path: Path) -> None:
    loop = Loop(Slope(fails_at=3), RunFolder(tmp_path), loop_options(Budget(updates=5)))
    with pytest.raises(TrainError, match="lower the learning rate"):
        loop.run()
    assert not (tmp_path / "unet" / "states").exists()


def lines_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_a_run_measures_after_so_many_updates(tmp_path: Path) -> None:
    log = LogRecipe(log_s=1000.0, save_s=1000.0, measure_s=1e-9, measure_every=2)
    Loop(Slope(), RunFolder(tmp_path), loop_options(Budget(updates=5), log=log)).run()
    assert [line["updates"] for line in lines_of(tmp_path) if line["kind"] == "measured"] == [2, 4, 5]


def test_the_gradient_of_an_update_is_the_mean_over_its_parts_and_each_of_them_is_in_the_log(tmp_path: Path) -> None:
    class Parts(Slope):
        """Pulls the bias, which is 0 at first, to different places."""

        def step_loss(self, progress: Progress) -> StepLoss:
            loss = (self.module.bias - (1.0, 3.0, 8.0)[progress.part]).square().sum()
            return StepLoss(loss, {"early" if progress.part == 0 else "late": loss}, 1)

        def after_update(self, progress: Progress) -> bool:
            assert self.module.bias.grad is not None
            self.gradient = self.module.bias.grad.item()
            return False

    task = Parts()
    Loop(task, RunFolder(tmp_path), loop_options(Budget(updates=1), parts=3)).run()
    assert task.gradient == pytest.approx(2 * (0 - (1 + 3 + 8) / 3))
    line = lines_of(tmp_path)[0]
    assert (line["early"], line["late"]) == (1.0, (9.0 + 64.0) / 2)


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
