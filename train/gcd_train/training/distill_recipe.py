"""What a distillation does, as a recipe file states it (TOML): every option is named here, with its meaning."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gcd_train.errors import RecipeError
from gcd_train.recipe import ClassWeightsName, EmaRecipe, ExportRecipe, LatentsRecipe, LoraRecipe, OptimiserRecipe
from gcd_train.recipe_data import (
    Budget,
    ComputeRecipe,
    Count,
    DataRecipe,
    DistillStageName,
    LogRecipe,
    NotNegative,
    Positive,
)
from gcd_train.recipe_files import DISTILLATIONS, TEACHER, checked_recipe, read_merged, require_known


class TeacherRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whom to learn from.

    weights: a weight file of any layout, or package:NAME. family: how it is used, where the file does not tell.
    """

    weights: str
    family: str | None = None


class StudentRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What comes out: the teacher's networks with another sampler, and no guidance.

    steps: of the sampler that ships; the teacher's own where its U-Net stays. sigma_max, sigma_min: its first and last
    noise level; left out as the teacher has them. train: all of the U-Net and what steers it, or adapters beside it, as
    [student.lora] says.
    """

    steps: Count = 1
    sigma_max: Positive | None = None
    sigma_min: Positive | None = None
    train: Literal["all", "lora"] = "all"
    lora: LoraRecipe = LoraRecipe()


class BatchRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which clips an update is made of; see `UNetRecipe`, whose words these are.

    augmentation: left out, as strong as the teacher is used with.
    """

    source: Literal["latents", "pixels", "cache"] = "latents"
    clip_batch: Count = 2
    accumulate: Count = 1
    augmentation: NotNegative | None = None
    fps: Positive = 10.0
    motion_bucket: float = 127.0


class SampleLossRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a student's sample is compared with its pair in; each is a weight, and what weighs nothing is not computed.

    latent: squared error of latents; sensitivity weighs channels by what the decoder makes of them, where encoded clips
    say so. class_weights: emphasis by colour there, see `LossRecipe`.
    l1, gradient, ssim, energy: of decoded pictures, see `picture_losses`; `frames` consecutive ones of each clip.
    colours: cross-entropy of the classes that decoded colours stand for, for models that paint classes; softness is the
    distance of colours (of 0 to 1) at which it becomes unsure.
    """

    latent: NotNegative = 1.0
    sensitivity: bool = True
    class_weights: ClassWeightsName = "none"
    l1: NotNegative = 0.0
    gradient: NotNegative = 0.0
    ssim: NotNegative = 0.0
    energy: NotNegative = 0.0
    colours: NotNegative = 0.0
    softness: Positive = 0.15
    frames: Count = 4

    @property
    def of_pictures(self) -> bool:
        """Whether anything has to be decoded."""
        return any((self.l1, self.gradient, self.ssim, self.energy, self.colours))


class PairedRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Finetuning through the student's own sampler, on pairs.

    steps: numbers of sampler steps, of which each update draws one; left out, the student's own alone.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    steps: tuple[Count, ...] | None = None
    loss: SampleLossRecipe = SampleLossRecipe()


class DistillRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole recipe of a distillation; a table that is left out leaves its stage out.

    seed: every random draw follows from it, the stage and the update.
    """

    name: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9-]{0,40}$")]
    seed: int = 0
    teacher: TeacherRecipe
    student: StudentRecipe = StudentRecipe()
    data: DataRecipe = DataRecipe()
    compute: ComputeRecipe = ComputeRecipe()
    log: LogRecipe = LogRecipe()
    latents: LatentsRecipe | None = None
    batches: BatchRecipe = BatchRecipe()
    paired: PairedRecipe
    export: ExportRecipe = ExportRecipe()

    def __post_init__(self) -> None:
        if (self.batches.source == "latents") != (self.latents is not None):
            raise ValueError('batches.source "latents" and a table [latents] go together: give both or neither')

    @property
    def stages(self) -> tuple[DistillStageName, ...]:
        """The steps of a run, in their order."""
        tables: tuple[DistillStageName, ...] = ("latents", "paired", "export")
        return tuple(name for name in tables if getattr(self, name) is not None)


def packaged_distillations() -> list[str]:
    """Names of the recipes that ship."""
    return sorted(file.stem for file in DISTILLATIONS.glob("*.toml"))


def load_distillation(source: str | Path, changes: Sequence[str] = ()) -> DistillRecipe:
    """Read a recipe: a path, or `package:NAME`, on top of the bases it names.

    changes: `KEY=VALUE` each, on top of all, such as `student.steps=4`.

    Raises:
        RecipeError: as `load_recipe`; for a recipe that trains instead of distilling, too.
    """
    read = read_merged(source)
    if TEACHER not in read.table:
        shipped = ", ".join(f"package:{each}" for each in packaged_distillations())
        raise RecipeError(
            f"{read.place} names no [teacher], so it is no distillation; train it with `gcd-train train`, or take one "
            f"of {shipped}"
        )
    require_known(read.table, DistillRecipe.__struct_fields__, read.place)
    return checked_recipe(read.table, read.place, DistillRecipe, changes)
