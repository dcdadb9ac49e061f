"""What a training run does, as a recipe file states it (TOML): every option is named here, with its meaning."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_model.config import CameraControl, SplatDepth
from gcd_model.live.config import LiveConfig
from gcd_train.recipe_data import (
    Budget,
    ComputeRecipe,
    Count,
    DataRecipe,
    LiveStageName,
    LogRecipe,
    NotNegative,
    Positive,
    Share,
)

OptimiserKind: TypeAlias = Literal["adam", "adamw", "adam8bit", "adamw8bit"]


class OptimiserRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The optimiser and its learning rate.

    warm_up: updates from 0 to `rate`. flat: share of the budget at `rate`; then down to `final` times the rate.
    clip: largest norm of the whole gradient, left out for none.
    kind: "adam8bit" and "adamw8bit" keep their moments in 8 bits (torchao). Adam adds the weight decay to the gradient,
    AdamW takes it off the weights; published is Adam with none.
    """

    kind: OptimiserKind = "adamw"
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


class StageRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the tables of all stages that train state."""

    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None = None


TrainedPart: TypeAlias = Literal["all", "temporal", "lora"]


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
    scale: Positive | None = None
    shared: bool | None = None
    linear: bool | None = None


class LoraRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Low-rank adapters on the U-Net's attention and feed-forward layers; see gcd_train.training.trainable.

    rank: inner width. alpha: the adapter counts alpha / rank times; left out, as much as rank.
    stem: train the U-Net's first convolution in full, too. camera: the camera embedder and its layers in the U-Net.
    """

    rank: Count = 32
    alpha: Positive | None = None
    stem: bool = False
    camera: bool = True


class ModelRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which networks: a named set-up, and what differs; where they start, and which part of them is trained.

    camera: how the network is steered; left out as the base has it, for the paper's networks as the family has it.
    prediction: what the network says, left out as the base has it; "v" is the paper's. steps: of the sampler that
    ships, left out as the base has it.
    weights: a weight file to start from, of any layout; left out, everything starts at random. scratch: take the
    autoencoder and the image tower from it alone; the U-Net and what steers it start at random. See
    gcd_train.training.setup.
    train: what the U-Net stage trains: "all" of the U-Net and what steers it, as published; "temporal", of the U-Net
    only what works across frames; "lora", adapters as [model.lora] says.
    splat: also show the network the source's points as the target camera sees them, with depth that is "given" by the
    data or "estimated" from pictures. Weights without such channels are taken, and compute at first what they did.
    family: how it is used, see docs/launch-file.md. frames, height, width: trained length and size in pixels, left out
    as the base has them.
    """

    base: Literal["plain-small", "svd-14", "small"] = "plain-small"
    camera: CameraControl | None = None
    prediction: Literal["v", "x0"] | None = None
    steps: Count | None = None
    weights: str | None = None
    scratch: bool = False
    splat: SplatDepth = "none"
    train: TrainedPart = "all"
    lora: LoraRecipe = LoraRecipe()
    family: str = "driving"
    frames: Count | None = None
    height: Count | None = None
    width: Count | None = None
    unet: UNetChanges = UNetChanges()
    vae: VAEChanges = VAEChanges()

    def __post_init__(self) -> None:
        if self.train == "lora" and (self.weights is None or self.scratch):
            raise ValueError('model.train "lora" adds to a trained U-Net: give model.weights, and leave scratch out')
        if self.splat != "none" and (self.train == "temporal" or (self.train == "lora" and not self.lora.stem)):
            raise ValueError(
                'model.splat enters by the first convolution, which this trains not: take model.train "all", or '
                '"lora" with model.lora.stem = true'
            )


class VAERecipe(StageRecipe, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The autoencoder, on crops of source and target frames.

    pool: clips to learn from, drawn once and kept decoded in memory (2 MB each at 192x128).
    crop: pixels a side. clips, frames: crops a batch, consecutive frames of each.
    image_share: share of the budget with as many unrelated crops instead, the decoder's temporal layers left out.
    gradient, ssim, kl: weights of the gradient L1, of 1 - SSIM and of the Kullback-Leibler term beside the L1.
    normalise_at: share of the budget after which mean and spread of the latents are folded into the weights.
    """

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


FocalBlendName: TypeAlias = Literal["released", "plain"]
ClassWeightsName: TypeAlias = Literal["none", "parallel-domain", "driving"]


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
    """The diffusion loss.

    weight_limit: upper bound of the noise level's weight (s^2 + 1) / s^2.
    focal: keep the hardest elements of a frame; focal_fraction of them from update focal_steps on.
    focal_blend: "released" counts the hardest 0.9 and all 0.1, class weights half before and half after the choice;
    "plain" is the mean of the hardest of the class-weighted error, as the paper describes it.
    class_weights: emphasis by colour in semantic pictures, persons 7 times and vehicles 3 times, in the colours of
    ParallelDomain-4D or of our driving world. sensitivity: weigh latent channels by what the decoder
    makes of them.
    """

    weight_limit: Positive | None = None
    focal: bool = True
    focal_steps: Count = 5000
    focal_fraction: Share = 0.1
    focal_blend: FocalBlendName = "released"
    class_weights: ClassWeightsName = "none"
    sensitivity: bool = False


class UNetRecipe(StageRecipe, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The U-Net.

    source: "latents" reads what the latents stage wrote, "pixels" encodes every batch anew with fresh noise, "cache"
    reads a latent cache (`gcd-train cache`).
    image_share: share of the budget with single frames, the temporal layers left out; then whole clips.
    image_batch: frames of such a batch. clip_batch: clips computed at once. accumulate: so many times, for one update;
    or batch: clips of one update altogether, a multiple of clip_batch.
    dropout: probability that the network sees zeros in place of what it is given of the source's pictures: latents
    and image token. dropout_per: drawn for each frame, as released, or once a clip. dropout_joint: one draw for both
    streams, instead of one each as released.
    augmentation: noise strength on source frames, what the network is told and, with "pixels", what it gets.
    fps, motion_bucket: what the network is told where the clip or its camera path does not say it.
    """

    source: Literal["latents", "pixels", "cache"] = "latents"
    image_share: Share = 0.0
    image_batch: Count = 16
    clip_batch: Count = 3
    accumulate: Count = 1
    batch: Count | None = None
    noise: NoiseRecipe = NoiseRecipe()
    loss: LossRecipe = LossRecipe()
    dropout: Share = 0.1
    dropout_per: Literal["frame", "clip"] = "frame"
    dropout_joint: bool = False
    augmentation: NotNegative = 0.02
    fps: Positive = 10.0
    motion_bucket: float = 127.0

    def __post_init__(self) -> None:
        if self.batch is None:
            return
        if self.batch % self.clip_batch:
            raise ValueError(f"a batch of {self.batch} clips is no multiple of clip_batch, {self.clip_batch}")
        if self.accumulate != 1:
            raise ValueError("an update's clips are told by batch or by accumulate: give one of them")

    @property
    def parts(self) -> int:
        """Batches of `clip_batch` clips that make one update."""
        return self.accumulate if self.batch is None else self.batch // self.clip_batch


class StudentRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A distillation: model.weights are the teacher's, whose networks learn through another sampler, without
    guidance, by the squared error of latents with the emphasis and sensitivity that unet.loss says.

    steps: of the sampler that ships. sigma_max, sigma_min: its first and last noise level; left out as the teacher has
    them. learned_steps: numbers of steps, of which each update draws one; left out, the student's own alone.
    """

    steps: Count = 1
    sigma_max: Positive | None = None
    sigma_min: Positive | None = None
    learned_steps: tuple[Count, ...] | None = None


class ExportRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Weight files that a run writes at its end, each under the recipe's name.

    layouts: "gcd-node" is our `.safetensors`; "gcd-ckpt" the `.ckpt` of the released code, for the paper's networks
    alone. dtype: what weights are stored in; the `.ckpt` is always float32.
    """

    layouts: tuple[Literal["gcd-node", "gcd-ckpt"], ...] = ("gcd-node",)
    dtype: Literal["float16", "bfloat16", "float32"] = "float16"

    def __post_init__(self) -> None:
        if "gcd-node" not in self.layouts:
            raise ValueError('export.layouts must name "gcd-node", which is what a run is measured with at its end')


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole recipe file; a table that is left out leaves its stage out.

    seed: every random draw follows from it, the stage and the update.
    """

    name: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9-]{0,40}$")]
    seed: int = 0
    data: DataRecipe = DataRecipe()
    model: ModelRecipe = ModelRecipe()
    compute: ComputeRecipe = ComputeRecipe()
    log: LogRecipe = LogRecipe()
    vae: VAERecipe | None = None
    latents: LatentsRecipe | None = None
    unet: UNetRecipe
    student: StudentRecipe | None = None
    export: ExportRecipe = ExportRecipe()

    def __post_init__(self) -> None:
        if self.unet.source != "latents" and self.unet.image_share:
            raise ValueError('unet.source "pixels" and a latent cache take whole clips only; set image_share to 0')
        if self.unet.source == "latents" and self.latents is None:
            raise ValueError('unet.source "latents" needs a [latents] table')
        if self.unet.source == "latents" and self.latents is not None:
            given, told = self.latents.augmentation, self.unet.augmentation
            if given != told:
                raise ValueError(f"latents.augmentation is {given:g}, but unet.augmentation tells the network {told:g}")
        if self.vae is None and self.model.weights is None:
            raise ValueError("a random autoencoder teaches nothing: give a [vae] table, or model.weights to start from")
        if self.vae is not None and self.model.train != "all":
            raise ValueError(
                f'model.train "{self.model.train}" builds on given weights, whose autoencoder must stay: leave [vae] '
                'out (without = ["vae"])'
            )
        if self.student is not None and (
            self.model.weights is None or self.vae is not None or self.unet.dropout or self.unet.image_share
        ):
            raise ValueError(
                "a [student] learns whole clips of a teacher, and is used without guidance: give model.weights, leave "
                "out [vae], and set unet.dropout and unet.image_share to 0"
            )
        if self.model.splat != "none" and self.data.task == "image-to-video":
            raise ValueError('data.task "image-to-video" has no target cameras to splat for: leave model.splat out')
        if (self.data.kind == "cache") != (self.unet.source == "cache"):
            raise ValueError('a latent cache is read with both data.kind "cache" and unet.source "cache"')


class LiveStage(StageRecipe, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long a stage trains and how.

    batch: frames (depth) or views (paint, detail) of a batch. parts: batches an update, which the processes that
    `torchrun` starts share; of the detail, one. small_share: so much of its time depth and paint learn from pictures
    of half the size, at a quarter of the cost.
    """

    batch: Count = 8
    parts: Count = 1
    small_share: Share = 0.6
    ema: EmaRecipe | None = EmaRecipe(limit=0.998, horizon=0.15)


class LiveRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A live model's training.

    weights: a live weight file to begin from, at random without. keep: stages that are left as it has them.
    exact_every, learned_every: of the clips, every so many-th has its inputs worked out by exact and by learned depth.
    workers: processes that work out inputs; 0 for none but this one.
    """

    kind: Literal["live"]
    name: str
    seed: int = 1
    model: LiveConfig = LiveConfig()
    weights: str | None = None
    keep: frozenset[LiveStageName] = frozenset()
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: Annotated[int, Meta(ge=0)] = 0
    depth: LiveStage
    exact_every: Count = 4
    learned_every: Count = 1
    paint: LiveStage
    detail: LiveStage
    log: LogRecipe = LogRecipe()

    def __post_init__(self) -> None:
        if self.keep and self.weights is None:
            raise ValueError(f"keep = {sorted(self.keep)} needs weights, a live weight file that has them")
        if self.detail.parts != 1:
            raise ValueError(f"the detail stage takes one batch an update, got detail.parts = {self.detail.parts}")
