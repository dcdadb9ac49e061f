"""A student of few steps without guidance, from a model that takes many."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model import ModelConfig
from gcd_model.clip import RenderOptions
from gcd_model.diffusion import Schedule, sample
from gcd_model.networks import Networks
from gcd_train.errors import RecipeError
from gcd_train.recipe import SampleLossRecipe, StudentRecipe, UNetRecipe
from gcd_train.training.draws import Draws
from gcd_train.training.export import Validation
from gcd_train.training.loop import Progress, StepLoss
from gcd_train.training.losses import energy_l1, frame_losses, gradient_l1, ssim
from gcd_train.training.objective import Batch, BatchSource, Denoiser, denoiser_of, draw_noise
from gcd_train.training.optimiser import ParameterGroup
from gcd_train.training.setup import Precision
from gcd_train.training.trainable import keep_trained_alone


@dataclass(frozen=True, slots=True)
class Compared:
    """total: the weighted sum, a scalar. parts: what it is made of, for the log, without weights."""

    total: Tensor
    parts: dict[str, Tensor]


class SampleLoss:
    """The loss of a student.

    Pictures are compared with what the autoencoder makes of the true latents, so what it cannot draw is no fault of
    the student's, and no pictures have to be read. Raises RecipeError for losses the model has nothing to put in.
    """

    def __init__(
        self, networks: Networks, recipe: SampleLossRecipe, channel_weights: Tensor | None, precision: Precision
    ) -> None:
        if recipe.colours and not networks.config.semantic_classes:
            raise RecipeError("loss.colours is for models that paint classes, which this one does not; leave it out")
        self._networks, self._recipe, self._weights, self._precision = networks, recipe, channel_weights, precision
        colours = [kind.colour for kind in networks.config.semantic_classes]
        self._colours = torch.tensor(colours, device=precision.device).float() / 255
        if recipe.of_pictures:
            precision.placed(networks.decoder)

    def of(self, made: Tensor, batch: Batch, draws: Draws) -> Compared:
        """How far samples are from their pairs, mean over frames."""
        recipe, parts = self._recipe, dict[str, Tensor]()
        if recipe.latent:
            parts["latent"] = self._latent(made, batch)
        if recipe.of_pictures:
            parts |= self._pictures(made, batch, draws)
        if not parts:
            raise RecipeError("a paired loss that weighs nothing teaches nothing: give loss.latent, or another")
        total = torch.stack([getattr(recipe, name) * value for name, value in parts.items()]).sum()
        return Compared(total, {name: value.detach() for name, value in parts.items()})

    def _latent(self, made: Tensor, batch: Batch) -> Tensor:
        weights, emphasis = self._weights, batch.emphasis
        return frame_losses(made, batch.target, fraction=1.0, emphasis=emphasis, channel_weights=weights).mean()

    def _pictures(self, latents: Tensor, batch: Batch, draws: Draws) -> dict[str, Tensor]:
        recipe, run = self._recipe, min(self._recipe.frames, batch.frames)
        first = int(draws.below(batch.frames - run + 1, 1))
        made, true = (
            clips.unflatten(0, (-1, batch.frames))[:, first : first + run].flatten(0, 1)
            for clips in (latents, batch.target)
        )
        picture = self._decoded(made, run)
        with torch.no_grad():
            target = self._decoded(true, run)
        parts = dict[str, Tensor]()
        if recipe.l1:
            parts["l1"] = (picture - target).abs().mean()
        if recipe.gradient:
            parts["gradient"] = gradient_l1(picture, target)
        if recipe.ssim:
            parts["ssim"] = 1 - ssim(picture, target)
        if recipe.energy:
            parts["energy"] = energy_l1(picture, target)
        if recipe.colours:
            parts["colours"] = colour_loss(picture, target, self._colours, recipe.softness)
        return parts

    def _decoded(self, latents: Tensor, run: int) -> Tensor:
        with self._precision.arithmetic():
            rows = self._precision.frames(latents / self._networks.config.vae.scale)
            return self._networks.decoder(rows, run).float()


def colour_loss(pictures: Tensor, targets: Tensor, colours: Tensor, softness: float) -> Tensor:
    """Cross-entropy of the classes that colours stand for, mean over pixels.

        logits[k] = -|pixel - colour[k]|^2 / softness^2;  truth: the class whose colour is nearest in the target

    So a pixel between two colours, which stands for a third class or for none, costs more than its error in colour.
    Ours; the classes of a painted picture are those of the nearest colours, see `nearest_classes`.

    Args:
        pictures, targets: [N, 3, H, W] in [-1, 1]. colours: [K, 3] in [0, 1].
    """
    return F.cross_entropy(
        -_distances(pictures, colours) / softness**2, _distances(targets, colours).argmin(1), reduction="mean"
    )


def _distances(pictures: Tensor, colours: Tensor) -> Tensor:
    """Squared distance of each pixel to each colour, [N, K, H, W]."""
    pixels = (pictures + 1) / 2
    across = torch.einsum("nchw,kc->nkhw", pixels, colours)
    return (pixels**2).sum(1, keepdim=True) - 2 * across + (colours**2).sum(1)[:, None, None]


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
        recipe: UNetRecipe,
        student: StudentRecipe,
        loss: SampleLoss,
        precision: Precision,
        seed: int,
    ) -> None:
        """networks: the student's, of its own config. recipe: how batches are."""
        self._networks, self._batches, self._validation = networks, batches, validation
        self._recipe, self._loss, self._precision, self._seed = recipe, loss, precision, seed
        self._steps = student.learned_steps or (networks.config.sampling.steps,)
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
        recipe, number = self._recipe, progress.updates * self._recipe.parts + progress.part
        draws = Draws(self._seed, "paired", number, self._precision.device)
        batch = self._batches.whole_clips(draws, recipe.clip_batch)
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
