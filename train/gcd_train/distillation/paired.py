"""Finetuning through the student's own sampler, on pairs."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from gcd_model import ModelConfig
from gcd_model.clip import RenderOptions
from gcd_model.diffusion import Schedule, sample
from gcd_model.networks import Networks
from gcd_train.batches import BatchSource
from gcd_train.distillation.recipe import BatchRecipe, PairedRecipe
from gcd_train.distillation.sample_losses import SampleLoss
from gcd_train.draws import Draws
from gcd_train.loop import Progress, StepLoss
from gcd_train.objective import Batch, Denoiser, denoiser_of, draw_noise
from gcd_train.precision import Precision
from gcd_train.schedule import ParameterGroup
from gcd_train.trained_part import keep_trained_alone
from gcd_train.validation import Validation


def schedule_of(config: ModelConfig, steps: int) -> Schedule:
    """The shipped sampler's schedule for that many steps, without guidance."""
    return Schedule.of(config, RenderOptions(steps=steps, guidance=(1.0, 1.0)))


def start_of(batch: Batch, config: ModelConfig, draws: Draws) -> Tensor:
    """Unit noise to start from, [N, C, h, w]; one draw for all frames of a clip where the model is sampled so."""
    return draw_noise(draws, batch.target.shape, batch.frames, float(config.sampling.shared_noise))


def drawn_steps(numbers: Sequence[int], draws: Draws) -> int:
    """One of the numbers of steps."""
    return numbers[int(draws.below(len(numbers), 1))]


def sampled(denoiser: Denoiser, batch: Batch, noise: Tensor, schedule: Schedule) -> Tensor:
    """From noise to a sample, as the synthesizer does it; gradients reach the weights through all steps.

    Args:
        noise: unit, [N, C, h, w].
    Returns:
        Latents [N, C, h, w], scaled.
    """
    levels: list[float] = schedule.sigmas.tolist()

    def denoise(x: Tensor, step: int) -> Tensor:
        sigma = torch.full(x.shape[:1], levels[step], device=x.device)
        return denoiser(x, sigma, batch)

    return sample(denoise, schedule.start(noise[None], 1)[0], schedule.steps)


class PairedTask:
    """See `Task`."""

    def __init__(
        self,
        networks: Networks,
        batches: BatchSource,
        validation: Validation,
        recipe: PairedRecipe,
        taken: BatchRecipe,
        loss: SampleLoss,
        precision: Precision,
        seed: int,
    ) -> None:
        """networks: the student's, of its own config. taken: how batches are."""
        self._networks, self._batches, self._validation = networks, batches, validation
        self._taken, self._loss, self._precision, self._seed = taken, loss, precision, seed
        self._steps = recipe.steps or (networks.config.sampling.steps,)
        self._denoiser = precision.placed(denoiser_of(networks))
        keep_trained_alone(self._denoiser)

    @property
    def module(self) -> nn.Module:
        """U-Net and camera embedder."""
        return self._denoiser

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """Everything that can be trained."""
        trained = [parameter for parameter in self._denoiser.parameters() if parameter.requires_grad]
        return [ParameterGroup(parameters=trained)]

    def step_loss(self, progress: Progress) -> StepLoss:
        """How far samples from fresh noise are from their pairs."""
        taken, number = self._taken, progress.updates * self._taken.accumulate + progress.part
        draws = Draws(self._seed, "paired", number, self._precision.device)
        batch = self._batches.whole_clips(draws, taken.clip_batch)
        schedule = schedule_of(self._networks.config, drawn_steps(self._steps, draws))
        with self._precision.arithmetic():
            made = sampled(self._denoiser, batch, start_of(batch, self._networks.config, draws), schedule)
        compared = self._loss.of(made, batch, draws)
        return StepLoss(compared.total, compared.parts, batch.target.shape[0], batch.ids)

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        """Held-out clips through the shipped synthesizer, in the student's own steps."""
        return self._validation.measure(self._networks, picture)
