"""A student of few steps without guidance, from a model that takes many: it learns through its own sampler, on pairs.

Source: Martin Garcia et al. 2024, end-to-end finetuning of few-step diffusion.
"""

from torch import Tensor, nn

from gcd_model.config import ModelConfig
from gcd_model.diffusion import RenderOptions, Schedule, sample
from gcd_model.networks import Networks
from gcd_train.recipe import StudentRecipe, UNetRecipe
from gcd_train.training.draws import Draws
from gcd_train.training.export import Validation
from gcd_train.training.loop import Progress, StepLoss
from gcd_train.training.losses import frame_losses
from gcd_train.training.objective import Batch, BatchSource, UNetTask, draw_noise
from gcd_train.training.setup import Precision


def schedule_of(config: ModelConfig, steps: int) -> Schedule:
    """The shipped sampler's schedule for that many steps, without guidance."""
    return Schedule.of(config, RenderOptions(steps=steps, guidance=(1.0, 1.0)))


def sampled(denoiser: nn.Module, batch: Batch, noise: Tensor, schedule: Schedule) -> Tensor:
    """From noise to a sample, as the synthesizer does it; gradients reach the weights through all steps.

    Args:
        noise: unit, [N, C, h, w].
    Returns:
        Latents [N, C, h, w], scaled.
    """
    steps, start = schedule.steps, schedule.start(noise[None], 1)[0]
    return sample(lambda x, i: denoiser(x, x.new_full(x.shape[:1], steps[i].sigma), batch), start, steps)


class StudentTask(UNetTask):
    """See `Task`."""

    def __init__(
        self,
        networks: Networks,
        batches: BatchSource,
        validation: Validation,
        recipe: UNetRecipe,
        student: StudentRecipe,
        channel_weights: Tensor | None,
        precision: Precision,
        seed: int,
    ) -> None:
        """networks: the student's, of its own config. recipe: how batches are."""
        super().__init__(networks, batches, validation, recipe, channel_weights, precision, seed)
        self._steps = student.learned_steps or (networks.config.sampling.steps,)

    def step_loss(self, progress: Progress) -> StepLoss:
        """How far samples from fresh noise are from their pairs, in latents."""
        config, recipe = self._networks.config, self._recipe
        draws = Draws(self._seed, "student", progress.updates * recipe.parts + progress.part, self._precision.device)
        batch = self._batches.whole_clips(draws, recipe.clip_batch)
        schedule = schedule_of(config, self._steps[int(draws.below(len(self._steps), 1))])
        noise = draw_noise(draws, batch.target.shape, batch.frames, float(config.sampling.shared_noise))
        with self._precision.arithmetic():
            made = sampled(self._network, batch, noise, schedule)
        rows = frame_losses(made, batch.target, fraction=1.0, emphasis=batch.emphasis, channel_weights=self._weights)
        total = rows.mean()
        return StepLoss(total, {"latent": total.detach()}, batch.target.shape[0], batch.ids)
