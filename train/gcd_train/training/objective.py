"""What the U-Net learns, through the networks that are shipped: the diffusion objective, and a student's.

Source: Van Hoorick et al. 2024 (GCD), section 3: noise level per clip, v-prediction, conditioning dropped per frame,
conditioning augmentation in pixel space; x0-prediction, fixed noise levels, shared noise and the class map are ours.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from gcd_model.conditioning import CameraEmbedder
from gcd_model.config import ModelConfig, Prediction
from gcd_model.diffusion import RenderOptions, Schedule, preconditioning, sample
from gcd_model.networks import Networks
from gcd_model.unet import VideoUNet
from gcd_train.recipe import FocalBlendName, LossRecipe, NoiseRecipe, StudentRecipe, UNetRecipe
from gcd_train.training.export import Validation
from gcd_train.training.loop import Progress, StepLoss, Task
from gcd_train.training.losses import PLAIN_BLEND, RELEASED_BLEND, FocalBlend, edm_weight, focal_fraction, frame_losses
from gcd_train.training.setup import Draws, Precision
from gcd_train.training.trainable import keep_trained_alone, plain_weights

_BLENDS: dict[FocalBlendName, FocalBlend] = {"released": RELEASED_BLEND, "plain": PLAIN_BLEND}


class Denoiser(nn.Module):
    """U-Net and camera embedder under the names they have in `Networks`."""

    def __init__(self, unet: VideoUNet, prediction: Prediction, camera: CameraEmbedder | None = None) -> None:
        super().__init__()
        self.unet, self.camera = unet, camera
        self.prediction: Prediction = prediction

    def forward(self, noisy: Tensor, sigma: Tensor, batch: "Batch") -> Tensor:
        """D(x, sigma).

        Args:
            noisy: [N, C, h, w]. sigma: [N].
        Returns:
            [N, C, h, w], float32.
        """
        levels = preconditioning(sigma, self.prediction)
        camera = None if self.camera is None or batch.camera is None else self.camera.proj(batch.camera)
        plan = self.unet.plan(levels.c_noise[None], batch.vector, camera, batch.tokens)
        scaled, image_mode = _column(levels.c_in) * noisy, batch.frames == 1
        if torch.is_grad_enabled() and noisy.device.type == "cpu" and not self.unet.stem.weight.requires_grad:
            # torch's group norm crashes on a CPU where channels-last pictures need no gradient and its weights do
            scaled.requires_grad_()
        raw = self.unet(scaled, batch.condition, *plan.step(0), image_mode=image_mode).float()
        return _column(levels.c_skip) * noisy + _column(levels.c_out) * raw


def denoiser_of(networks: Networks) -> Denoiser:
    """What is trained to denoise: U-Net and camera embedder."""
    return Denoiser(networks.unet, networks.config.prediction, networks.camera)


@dataclass(frozen=True, kw_only=True, slots=True)
class Batch:
    """N rows, time fastest: whole clips of `frames` frames, or unrelated frames with `frames` 1.

    target: [N, C, h, w], scaled latents. condition: [N, C', h, w]. vector: [N, V]. tokens: [N, D] or None.
    emphasis: [N, 1, h, w] of `class_emphasis`, or None.
    camera: [N, F], the features a model with camera control is steered by, see `CameraEmbedder`; None without.
    ids: what the rows were made from, one name a clip, for messages. wait_s: seconds that were waited for the data,
    None where it was not measured.
    """

    target: Tensor
    condition: Tensor
    vector: Tensor
    tokens: Tensor | None
    emphasis: Tensor | None
    frames: int
    camera: Tensor | None = None
    ids: tuple[str, ...] = ()
    wait_s: float | None = None


class BatchSource(Protocol):
    """Where batches come from, see `data.batches`. A batch follows from its draws alone."""

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """`count` random clips; or single frames of as many, which encoded clips alone offer."""
        ...


def draw_sigma(draws: Draws, clips: int, recipe: NoiseRecipe) -> Tensor:
    """One noise level a clip, [B]: exp(log_mean + log_std * n), or the fixed one. Source: Karras et al. 2022."""
    sigma = torch.exp(recipe.log_mean + recipe.log_std * draws.normal(clips))
    fixed = draws.chance(recipe.fixed_share, clips)
    return torch.where(fixed, torch.full_like(sigma, recipe.fixed_sigma), sigma)


def draw_noise(draws: Draws, shape: torch.Size, frames: int, shared: float) -> Tensor:
    """Unit noise [N, C, h, w], of whose variance the frames of a clip have the given share in common."""
    own = draws.normal(*shape)
    if shared == 0 or frames == 1:
        return own
    common = draws.normal(shape[0] // frames, *shape[1:]).repeat_interleave(frames, dim=0)
    return shared**0.5 * common + (1 - shared) ** 0.5 * own


def drop_streams(
    condition: Tensor, tokens: Tensor | None, frames: int, draws: Draws, recipe: UNetRecipe
) -> tuple[Tensor, Tensor | None]:
    """Condition channels [N, C', h, w] and image tokens [N, D], set to zero where the network is to do without.

    Per frame and each stream by itself, as released, or per clip, or both streams together: `dropout_per`,
    `dropout_joint`. What is told of camera, rate and motion always stays.
    """
    if recipe.dropout == 0:
        return condition, tokens
    each = frames if recipe.dropout_per == "clip" else 1

    def drawn() -> Tensor:
        """Whether a row is kept, [N]."""
        return ~draws.chance(recipe.dropout, condition.shape[0] // each).repeat_interleave(each)

    kept = drawn()
    dropped = condition * _column(kept).to(condition.dtype)
    if tokens is None:
        return dropped, None
    return dropped, tokens * (kept if recipe.dropout_joint else drawn())[:, None].to(tokens.dtype)


def diffusion_loss(
    denoiser: nn.Module,
    batch: Batch,
    draws: Draws,
    precision: Precision,
    *,
    noise: NoiseRecipe,
    loss: LossRecipe,
    channel_weights: Tensor | None,
    step: int,
) -> StepLoss:
    """The loss of one batch: mean over frames of w(sigma) * frame loss.

    denoiser: a Denoiser, or what wraps one. channel_weights: [C] or None. step: updates of the optimiser so far, for
    the focal schedule.
    """
    sigma = draw_sigma(draws, batch.target.shape[0] // batch.frames, noise).repeat_interleave(batch.frames)
    unit = draw_noise(draws, batch.target.shape, batch.frames, noise.shared)
    with precision.arithmetic():
        denoised = denoiser(batch.target + _column(sigma) * unit, sigma, batch)
    fraction = focal_fraction(step, final=loss.focal_fraction, steps=loss.focal_steps) if loss.focal else 1.0
    rows = frame_losses(
        denoised,
        batch.target,
        fraction=fraction,
        emphasis=batch.emphasis,
        channel_weights=channel_weights,
        blend=_BLENDS[loss.focal_blend],
    )
    total = (rows * edm_weight(sigma, loss.weight_limit)).mean()
    parts = {"latent": total.detach()}
    if batch.wait_s is not None:
        parts["wait_s"] = total.new_tensor(batch.wait_s)
    return StepLoss(total, parts, batch.target.shape[0], batch.ids)


def _column(values: Tensor) -> Tensor:
    return values.view(-1, 1, 1, 1)


class UNetTask(Task):
    """Trains the U-Net to denoise, or a student, which takes few steps without guidance, through its own sampler.

    channel_weights: [C] of the latents, or None.
    Source of the student: Martin Garcia et al. 2024, end-to-end finetuning of few-step diffusion.
    """

    module: Denoiser

    def __init__(
        self,
        networks: Networks,
        batches: BatchSource,
        validation: Validation,
        recipe: UNetRecipe,
        channel_weights: Tensor | None,
        precision: Precision,
        seed: int,
        student: StudentRecipe | None = None,
    ) -> None:
        super().__init__(precision.placed(denoiser_of(networks)))
        self._networks, self._batches, self._validation = networks, batches, validation
        self._recipe, self._weights, self._precision, self._seed = recipe, channel_weights, precision, seed
        self._student = student
        keep_trained_alone(self.module)

    def step_loss(self, progress: Progress) -> StepLoss:
        """The diffusion loss on single frames or on whole clips; of a student, see `_student_loss`."""
        recipe, stage = self._recipe, "unet" if self._student is None else "student"
        draws = Draws(self._seed, stage, progress.updates * recipe.parts + progress.part, self._precision.device)
        single = progress.share < recipe.image_share
        batch = self._batches.batch(draws, recipe.image_batch if single else recipe.clip_batch, single=single)
        if self._student is not None:
            return self._student_loss(self._student, batch, draws)
        return diffusion_loss(
            self.network,
            batch,
            draws,
            self._precision,
            noise=recipe.noise,
            loss=recipe.loss,
            channel_weights=self._weights,
            step=progress.updates,
        )

    def _student_loss(self, student: StudentRecipe, batch: Batch, draws: Draws) -> StepLoss:
        """How far samples from fresh noise are from their pairs, in latents."""
        config = self._networks.config
        steps = student.learned_steps or (config.sampling.steps,)
        schedule = schedule_of(config, steps[int(draws.below(len(steps), 1))])
        noise = draw_noise(draws, batch.target.shape, batch.frames, float(config.sampling.shared_noise))
        with self._precision.arithmetic():
            made = sampled(self.network, batch, noise, schedule)
        rows = frame_losses(made, batch.target, fraction=1.0, emphasis=batch.emphasis, channel_weights=self._weights)
        total = rows.mean()
        return StepLoss(total, {"latent": total.detach()}, batch.target.shape[0], batch.ids)

    def measure(self, picture: Path) -> dict[str, float]:
        """Held-out clips through the shipped synthesizer."""
        return self._validation.measure(self._networks, picture)

    def gather(self) -> None:
        """See `Task`."""
        plain_weights(self._networks)


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
