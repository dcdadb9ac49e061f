"""A student of few steps without guidance, from a model that takes many."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model import FAMILIES, Family, ModelConfig
from gcd_model.clip import RenderOptions
from gcd_model.diffusion import Schedule, sample
from gcd_model.errors import OptionError
from gcd_model.networks import LoadedWeights, Networks
from gcd_model.weights.adapter import base_digest
from gcd_train.data.latents import EncodedClips
from gcd_train.errors import RecipeError
from gcd_train.recipe import LossRecipe, ModelRecipe, OptimiserRecipe, Recipe, UNetRecipe
from gcd_train.recipe_data import AnyStageName, Budget
from gcd_train.training.distill_recipe import BatchRecipe, DistillRecipe, PairedRecipe, SampleLossRecipe, StudentRecipe
from gcd_train.training.draws import Draws
from gcd_train.training.export import Validation
from gcd_train.training.loop import Progress, StepLoss
from gcd_train.training.losses import energy_l1, frame_losses, gradient_l1, ssim
from gcd_train.training.objective import Batch, BatchSource, Denoiser, denoiser_of, draw_noise
from gcd_train.training.optimiser import ParameterGroup
from gcd_train.training.run import RunInputs, Trainer
from gcd_train.training.setup import Precision, digest_of, loaded_base
from gcd_train.training.trainable import keep_trained_alone


@dataclass(frozen=True, kw_only=True, slots=True)
class Teacher:
    """What a weight file says of itself. config: the teacher's own. move_time: frame in which the goal is reached."""

    config: ModelConfig
    family: Family
    move_time: int


def teacher_of(recipe: DistillRecipe) -> Teacher:
    """Read the teacher's card.

    Raises:
        RecipeError: nobody says what family it is of, or its camera goes another way than [data] says.
        CheckpointError: the file is missing or cannot be read.
    """
    loaded = loaded_base(recipe.teacher.weights)
    teacher = Teacher(config=loaded.diffusion.config, family=_family(recipe, loaded), move_time=loaded.move_time)
    goal = recipe.data.goal_frame(teacher.config.frames)
    if teacher.move_time != goal:
        raise RecipeError(
            f"{recipe.teacher.weights} is at its goal in frame {teacher.move_time}, the recipe's [data] says frame "
            f"{goal}; set data.path, or data.move_time"
        )
    return teacher


def student_config(teacher: ModelConfig, recipe: StudentRecipe) -> ModelConfig:
    """The teacher's networks, sampled in the student's steps and without guidance.

    Raises RecipeError for noise levels that do not fall.
    """
    sampling = teacher.sampling
    high, low = recipe.sigma_max or sampling.sigma_max, recipe.sigma_min or sampling.sigma_min
    if recipe.steps > 1 and low >= high:
        raise RecipeError(f"student.sigma_min must be below sigma_max, got {low:g} and {high:g}; change one of them")
    changed = msgspec.structs.replace(sampling, steps=recipe.steps, sigma_max=high, sigma_min=low, guidance=(1.0, 1.0))
    return msgspec.structs.replace(teacher, sampling=changed)


def as_training(recipe: DistillRecipe, teacher: Teacher) -> Recipe:
    """The distillation as far as a training says it: what data, encoders and batches are told.

    Raises RecipeError for what a training would refuse, too.
    """
    batches, told, student = recipe.batches, recipe.batches.augmentation, recipe.student
    unet = UNetRecipe(
        budget=Budget(updates=1),
        optimiser=OptimiserRecipe(rate=1.0),
        source=batches.source,
        clip_batch=batches.clip_batch,
        accumulate=batches.accumulate,
        dropout=0.0,
        augmentation=teacher.config.sampling.augmentation if told is None else told,
        fps=batches.fps,
        motion_bucket=batches.motion_bucket,
        loss=LossRecipe(class_weights=recipe.paired.loss.class_weights),
    )
    try:
        return Recipe(
            name=recipe.name,
            seed=recipe.seed,
            data=recipe.data,
            model=ModelRecipe(
                weights=recipe.teacher.weights, family=teacher.family.name, train=student.train, lora=student.lora
            ),
            compute=recipe.compute,
            log=recipe.log,
            latents=recipe.latents,
            unet=unet,
            export=recipe.export,
        )
    except (ValueError, OptionError) as error:
        raise RecipeError(f"the recipe cannot be run: {error}") from error


def _family(recipe: DistillRecipe, loaded: LoadedWeights) -> Family:
    named = recipe.teacher.family
    if named is None and loaded.family is not None:
        return loaded.family
    family = None if named is None else FAMILIES.get(named)
    if family is None:
        raise RecipeError(
            f"teacher.family must be one of {', '.join(FAMILIES)}, as {recipe.teacher.weights} does not tell; "
            f"got {named!r}"
        )
    return family


@dataclass(frozen=True, slots=True)
class Compared:
    """total: the weighted sum, a scalar. parts: what it is made of, for the log, without weights."""

    total: Tensor
    parts: dict[str, Tensor]


class SampleLoss:
    """The paired loss of one stage.

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


class Distiller(Trainer):
    """A training whose denoiser learns through its own sampler, from where its teacher stands."""

    denoiser_stage: AnyStageName = "paired"

    def __init__(self, inputs: RunInputs, recipe: DistillRecipe, teacher: Teacher) -> None:
        """inputs: with the recipe that `as_training` makes. Raises RecipeError as `Trainer`, and `student_config`."""
        self._paired, self._taken = recipe.paired, recipe.batches
        super().__init__(inputs, student_config(teacher.config, recipe.student))

    def _identity(self, networks: Networks) -> str:
        model = self._recipe.model
        told = digest_of(self._recipe.seed, self._config.sampling, model.train, model.lora)
        return f"{base_digest(networks.state_dict())}-{told}"

    def _train(self, networks: Networks, batches: BatchSource, clips: EncodedClips | None, identity: str) -> None:
        recipe, precision = self._paired, self._precision
        weights = self._weights(clips) if recipe.loss.sensitivity else None
        loss = SampleLoss(networks, recipe.loss, weights, precision)
        seed = self._recipe.seed
        task = PairedTask(networks, batches, self._validation(), recipe, self._taken, loss, precision, seed)
        self._loop(task, "paired", recipe, identity, self._taken.accumulate)
