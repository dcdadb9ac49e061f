"""Adversarial matching of the distribution of latents, held by the paired loss.

    student:  paired + weight * (-critic(sample));    critic:  hinge of true latents and samples

Both learn in every update, each by its own gradients: the student's do not reach the critic, nor the critic's the
student. What is true are the pairs' own targets, so the student is not bound to its teacher's faults.

Source: as in `critic`; true data beside a loss that distils as in Sauer et al. 2023, "Adversarial Diffusion
Distillation".
"""

from collections.abc import Sequence
from pathlib import Path

from torch import nn

from gcd_model.networks import Networks
from gcd_train.batches import BatchSource
from gcd_train.distillation.critic import Critic, fooling_loss, heard, looked_at, telling_loss, trained_of
from gcd_train.distillation.recipe import BatchRecipe, MatchingRecipe
from gcd_train.distillation.sample_losses import SampleLoss
from gcd_train.distillation.student import drawn_steps, sampled, schedule_of, start_of
from gcd_train.draws import Draws
from gcd_train.loop import Progress, StepLoss
from gcd_train.objective import Denoiser, denoiser_of
from gcd_train.precision import Precision
from gcd_train.schedule import ParameterGroup
from gcd_train.trained_part import keep_trained_alone
from gcd_train.validation import Validation


class StudentAndCritic(nn.Module):
    """All that is saved; the student under the names it has in `Networks`."""

    def __init__(self, student: Denoiser, critic: Critic) -> None:
        super().__init__()
        self.unet, self.class_head, self.camera, self.critic = student.unet, student.class_head, student.camera, critic


class MatchingTask:
    """See `Task`."""

    def __init__(
        self,
        networks: Networks,
        critic: Critic,
        batches: BatchSource,
        validation: Validation,
        recipe: MatchingRecipe,
        taken: BatchRecipe,
        loss: SampleLoss,
        precision: Precision,
        seed: int,
    ) -> None:
        """networks: the student's, of its own config. taken: how batches are."""
        self._networks, self._batches, self._validation = networks, batches, validation
        self._recipe, self._taken, self._loss = recipe, taken, loss
        self._precision, self._seed = precision, seed
        self._steps = recipe.steps or (networks.config.sampling.steps,)
        self._denoiser, self._critic = precision.placed(denoiser_of(networks)), precision.placed(critic)
        self._both = StudentAndCritic(self._denoiser, critic)
        keep_trained_alone(self._both)

    @property
    def module(self) -> nn.Module:
        """Student and critic."""
        return self._both

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """The student at the recipe's rate, the critic at its own."""
        student = [parameter for parameter in self._denoiser.parameters() if parameter.requires_grad]
        told = ParameterGroup(parameters=trained_of(self._critic), factor=self._recipe.critic.rate)
        return [ParameterGroup(parameters=student), told]

    def step_loss(self, progress: Progress) -> StepLoss:
        """Both losses in one sum, as neither reaches what the other trains."""
        taken, recipe = self._taken, self._recipe
        number = progress.updates * taken.accumulate + progress.part
        draws = Draws(self._seed, "matching", number, self._precision.device)
        batch = self._batches.whole_clips(draws, taken.clip_batch)
        config, critic = self._networks.config, self._critic
        schedule = schedule_of(config, drawn_steps(self._steps, draws))
        start, (noise, sigma) = start_of(batch, config, draws), looked_at(batch, recipe.critic, draws)
        with self._precision.arithmetic():
            made = sampled(self._denoiser, batch, start, schedule)
            fooling = fooling_loss(heard(critic, made.latents, noise, sigma, batch))
            true = critic(batch.target, noise, sigma, batch)
            told = critic(made.latents.detach(), noise, sigma, batch)
            telling = telling_loss(true, told)
        compared = self._loss.of(made, batch, draws)
        weight = recipe.weight if progress.updates >= recipe.critic.start else 0.0
        parts = {**compared.parts, "fooling": fooling.detach(), "telling": telling.detach()}
        parts |= {"word_of_true": true.detach().mean(), "word_of_made": told.detach().mean()}
        return StepLoss(compared.total + weight * fooling + telling, parts, batch.target.shape[0], batch.ids)

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        """Held-out clips through the shipped synthesizer, in the student's own steps."""
        return self._validation.measure(self._networks, picture)
