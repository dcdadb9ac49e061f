"""From a teacher's weight file to the config of its student, and what the shared parts of training are told."""

from dataclasses import dataclass

import msgspec

from gcd_model import FAMILIES, Family, ModelConfig
from gcd_model.errors import OptionError
from gcd_model.networks import LoadedWeights
from gcd_train.distillation.recipe import DistillRecipe, StudentRecipe
from gcd_train.errors import RecipeError
from gcd_train.recipe import LossRecipe, ModelRecipe, OptimiserRecipe, Recipe, UNetRecipe
from gcd_train.recipe.values import Budget
from gcd_train.start import loaded_base


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
    batches, told = recipe.batches, recipe.batches.augmentation
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
            model=model_recipe(recipe, teacher.family),
            compute=recipe.compute,
            log=recipe.log,
            latents=recipe.latents,
            unet=unet,
            export=recipe.export,
        )
    except (ValueError, OptionError) as error:
        raise RecipeError(f"the recipe cannot be run: {error}") from error


def model_recipe(recipe: DistillRecipe, family: Family) -> ModelRecipe:
    """Where the student starts, and which part of it learns."""
    student = recipe.student
    return ModelRecipe(weights=recipe.teacher.weights, family=family.name, train=student.train, lora=student.lora)


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
