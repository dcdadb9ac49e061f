"""What a training run does, as a recipe file states it (TOML): every option is named here, with its meaning."""

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_model import explain_settings_error
from gcd_train.errors import RecipeError

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Count: TypeAlias = Annotated[int, Meta(ge=1)]
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
StageName: TypeAlias = Literal["vae", "latents", "unet", "decoder", "export"]

PACKAGED = Path(__file__).parent / "recipes"
"""Where the recipes that ship with the package lie."""


class Budget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long a stage trains: a number of updates, or minutes of wall time (measurements not counted)."""

    updates: Count | None = None
    minutes: Positive | None = None

    def __post_init__(self) -> None:
        if (self.updates is None) == (self.minutes is None):
            raise ValueError("a budget is either updates or minutes: give one of them")

    def share(self, updates: int, seconds: float) -> float:
        """How much of it is used, 0 to 1."""
        used = updates / self.updates if self.updates is not None else seconds / (60 * (self.minutes or 1.0))
        return min(used, 1.0)


class OptimiserRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The optimiser and its learning rate.

    warm_up: updates from 0 to `rate`. flat: share of the budget at `rate`; then down to `final` times the rate.
    clip: largest norm of the whole gradient, left out for none.
    """

    kind: Literal["adam", "adamw"] = "adamw"
    rate: Positive
    betas: tuple[Share, Share] = (0.9, 0.999)
    weight_decay: NotNegative = 0.0
    warm_up: Annotated[int, Meta(ge=0)] = 0
    flat: Share = 0.0
    final: Share = 1.0
    shape: Literal["linear", "cosine"] = "linear"
    clip: Positive | None = None


class EmaRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The average of the weights that is measured and exported. See `ema_decay`.

    limit: largest decay. horizon: length of the average as a share of the updates so far; left out, the ramp
    (1 + k) / (10 + k).
    """

    limit: Share = 0.999
    horizon: Positive | None = None


class VAERecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autoencoder, on crops of source and target frames.

    pool: clips to learn from, drawn once and kept decoded in memory (2 MB each at 192x128).
    crop: pixels a side. clips, frames: crops a batch, consecutive frames of each.
    image_share: share of the budget with as many unrelated crops instead, the decoder's temporal layers left out.
    gradient, ssim, kl: weights of the gradient L1, of 1 - SSIM and of the Kullback-Leibler term beside the L1.
    normalise_at: share of the budget after which mean and spread of the latents are folded into the weights.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    pool: Count = 800
    crop: Count = 64
    clips: Count = 8
    frames: Count = 4
    image_share: Share = 0.0
    gradient: NotNegative = 0.7
    ssim: NotNegative = 0.15
    kl: NotNegative = 1e-4
    normalise_at: Share = 0.6


class LatentsRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Every clip encoded once, so that the U-Net need not.

    limit: clips to take, all that are there if left out; fixed when the stage starts.
    flip: encode the mirrored clips, too. augmentation: strength of the noise on the source frames (pixels in [-1, 1]).
    sample: draw targets from the posterior instead of taking its mean.
    """

    limit: Count | None = None
    flip: bool = True
    augmentation: NotNegative = 0.0
    sample: bool = False


class NoiseRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise levels, one a clip: log-normal, or the fixed one with probability `fixed_share`.

    shared: share of the noise's variance that the frames of a clip have in common.
    """

    log_mean: float = 1.0
    log_std: NotNegative = 1.6
    fixed_share: Share = 0.0
    fixed_sigma: Positive = 80.0
    shared: Share = 0.0


class LossRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The diffusion loss and, for a model with a class head, its cross-entropy.

    weight_limit: upper bound of the noise level's weight (s^2 + 1) / s^2.
    focal: keep the hardest elements of a frame; focal_fraction of them from update focal_steps on.
    class_weights: emphasis by colour in semantic pictures. sensitivity: weigh latent channels by what the decoder
    makes of them. class_map: weight of the class head's cross-entropy; its class weights are frequency^-class_power.
    class_from_sigma: the class head learns from noise levels of at least this.
    """

    weight_limit: Positive | None = None
    focal: bool = True
    focal_steps: Count = 5000
    focal_fraction: Share = 0.1
    class_weights: Literal["none", "parallel-domain"] = "none"
    sensitivity: bool = False
    class_map: NotNegative = 0.0
    class_power: NotNegative = 0.35
    class_from_sigma: NotNegative = 0.0


class UNetRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The U-Net and the class head.

    source: "latents" reads what the latents stage wrote, "pixels" encodes every batch anew with fresh noise.
    image_share: share of the budget with single frames, the temporal layers left out; then whole clips.
    image_batch: frames of such a batch. clip_batch: clips of a batch. accumulate: batches an update.
    dropout: probability, for each frame and each stream by itself, that the network sees zeros.
    augmentation: noise strength on source frames, what the network is told and, with "pixels", what it gets.
    fps, motion_bucket: what the network is told.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    source: Literal["latents", "pixels"] = "latents"
    image_share: Share = 0.0
    image_batch: Count = 16
    clip_batch: Count = 3
    accumulate: Count = 1
    noise: NoiseRecipe = NoiseRecipe()
    loss: LossRecipe = LossRecipe()
    dropout: Share = 0.1
    augmentation: NotNegative = 0.02
    fps: Positive = 10.0
    motion_bucket: float = 127.0


class DecoderRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The plane-mix decoder, on frozen predictions of the U-Net.

    clips: how many clips to predict beforehand. batch: frames a batch, drawn as runs of `run` consecutive frames.
    gradient, ssim: weights beside the L1. class_map: weight of the refined class map's cross-entropy.
    finetune_vae: train the autoencoder's decoder, too, at vae_rate times the rate; wants a run above 1.
    """

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None
    clips: Count = 400
    batch: Count = 8
    run: Count = 1
    gradient: NotNegative = 0.4
    ssim: NotNegative = 0.4
    class_map: NotNegative = 0.1
    class_power: NotNegative = 0.35
    finetune_vae: bool = False
    vae_rate: Positive = 0.1

    def __post_init__(self) -> None:
        if self.batch % self.run:
            raise ValueError(f"a batch of {self.batch} frames cannot be drawn as runs of {self.run}")
        if self.finetune_vae and self.run == 1:
            raise ValueError("finetune_vae decodes clips, also across frames: give a run above 1")


class UNetChanges(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What differs from the base model's U-Net; see gcd_model.config.UNetConfig. None keeps."""

    width: Count | None = None
    multipliers: tuple[int, ...] | None = None
    attention: tuple[bool, ...] | None = None
    blocks_per_level: Count | None = None
    embedding_width: Count | None = None
    head_width: Count | None = None


class VAEChanges(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What differs from the base model's autoencoder; see gcd_model.config.VAEConfig. None keeps."""

    width: Count | None = None
    multipliers: tuple[int, ...] | None = None
    blocks_per_level: Count | None = None


class ModelRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which networks: a named set-up, and what differs.

    prediction: what the network says, left out as the base has it; "v" is the paper's.
    weights: a weight file to start from; left out, everything starts at random. family: how it is used, see
    `gcd-train families`. frames, height, width: trained length and size in pixels, left out as the base has them.
    """

    base: Literal["driving-small", "svd-14", "small"] = "driving-small"
    prediction: Literal["v", "x0"] | None = None
    weights: str | None = None
    family: str = "driving"
    frames: Count | None = None
    height: Count | None = None
    width: Count | None = None
    unet: UNetChanges = UNetChanges()
    vae: VAEChanges = VAEChanges()


class ComputeRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where and how to compute.

    precision: of the networks' arithmetic while training on CUDA; weights and losses stay float32. The CPU always
    computes in float32.
    resident: keep the encoded clips in the device's memory.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    channels_last: bool = True
    resident: bool = False


class LogRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a run speaks. log_s: a line of the log. save_s: the state. measure_s: metrics and sample pictures.

    valid_clips: held-out clips to measure on.
    """

    log_s: Positive = 15.0
    save_s: Positive = 120.0
    measure_s: Positive = 300.0
    valid_clips: Count = 4


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole recipe file; a table that is left out leaves its stage out.

    seed: every random draw follows from it, the stage and the update.
    """

    name: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9-]{0,40}$")]
    seed: int = 0
    model: ModelRecipe = ModelRecipe()
    compute: ComputeRecipe = ComputeRecipe()
    log: LogRecipe = LogRecipe()
    vae: VAERecipe | None = None
    latents: LatentsRecipe | None = None
    unet: UNetRecipe
    decoder: DecoderRecipe | None = None

    def __post_init__(self) -> None:
        if self.unet.source == "latents" and self.latents is None:
            raise ValueError('unet.source "latents" needs a [latents] table')
        if self.unet.source == "latents" and self.latents is not None:
            given, told = self.latents.augmentation, self.unet.augmentation
            if given != told:
                raise ValueError(f"latents.augmentation is {given:g}, but unet.augmentation tells the network {told:g}")
        if self.decoder is not None and self.latents is None:
            raise ValueError("[decoder] works on encoded clips and needs a [latents] table")
        if self.vae is None and self.model.weights is None:
            raise ValueError("a random autoencoder teaches nothing: give a [vae] table, or model.weights to start from")

    @property
    def stages(self) -> tuple[StageName, ...]:
        """The steps of a run, in their order."""
        there: dict[StageName, bool] = {
            "vae": self.vae is not None,
            "latents": self.latents is not None,
            "unet": True,
            "decoder": self.decoder is not None,
            "export": True,
        }
        return tuple(name for name, wanted in there.items() if wanted)


def load_recipe(source: str | Path) -> Recipe:
    """Read a recipe: a path, or `package:NAME`.

    Raises:
        RecipeError: missing, not TOML, an unknown key (the nearest known one is named), a value out of range.
    """
    kind, _, name = str(source).partition(":")
    path = PACKAGED / f"{name}.toml" if kind == "package" else Path(source)
    try:
        text = path.read_bytes()
    except OSError as error:
        there = ", ".join(sorted(f"package:{file.stem}" for file in PACKAGED.glob("*.toml")))
        raise RecipeError(
            f"cannot read the recipe {path}: {error.strerror}; give a TOML file, or one of {there}"
        ) from error
    return parse_recipe(text, str(path))


def parse_recipe(text: bytes, name: str) -> Recipe:
    """Read a recipe file's content; `name` is for the message. Raises RecipeError as `load_recipe`."""
    try:
        return msgspec.toml.decode(text, type=Recipe)
    except msgspec.ValidationError as error:
        raise RecipeError(f"{name}: {explain_settings_error(str(error), Recipe)}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RecipeError(f"{name} is not valid TOML: {error}") from error
