"""What a run learns from, where it computes and how often it reports, as a recipe states it."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Count: TypeAlias = Annotated[int, Meta(ge=1)]
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
StageName: TypeAlias = Literal["vae", "latents", "unet", "export"]
LiveStageName: TypeAlias = Literal["depth", "paint", "detail"]
AnyStageName: TypeAlias = StageName | LiveStageName


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


Parallel: TypeAlias = Literal["ddp", "fsdp"]


class ComputeRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where and how to compute.

    precision: of the networks' arithmetic while training on CUDA; weights and losses stay float32. The CPU always
    computes in float32.
    resident: keep the encoded clips in the device's memory.
    weights: what the trained weights, their gradients and plain optimisers' moments are kept in; "bfloat16" rounds
    stochastically (torchao) and keeps the moving average in float32.
    frozen: what weights that the U-Net stage does not train are kept in: encoders and, beside adapters, the U-Net;
    "bfloat16" halves their memory and computes in it.
    parallel: how the processes that `torchrun` starts share the U-Net stage: each with all weights ("ddp"), or each
    with its share of weights and moments ("fsdp"). Without torchrun there is one process, whatever it says.
    timeout_s: how long a process waits for the others before it gives up.
    checkpoint_activations: compute the U-Net's blocks anew in the backward pass instead of keeping what they made:
    all of them (true), or every n-th.
    compile: compile the U-Net's blocks (torch.compile); minutes at the start, faster afterwards.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    channels_last: bool = True
    resident: bool = False
    weights: Literal["float32", "bfloat16"] = "float32"
    frozen: Literal["float32", "bfloat16"] = "float32"
    parallel: Parallel = "ddp"
    timeout_s: Positive = 1800.0
    checkpoint_activations: bool | Annotated[int, Meta(ge=1)] = False
    compile: bool = False


class LogRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a run speaks. log_s: a line of the log. save_s: the state. measure_s: metrics and sample pictures.

    measure_every: measure after so many updates instead. valid_clips: held-out clips to measure on, always the same.
    tensorboard: write losses, metrics and samples for TensorBoard, too.
    keep: how many states are kept, the newest ones. keep_every: save after so many updates, too, and keep those states
    for ever. save: "async" writes states beside training.
    """

    log_s: Positive = 15.0
    save_s: Positive = 120.0
    measure_s: Positive = 300.0
    measure_every: Count | None = None
    valid_clips: Count = 4
    tensorboard: bool = False
    keep: Count = 3
    keep_every: Count | None = None
    save: Literal["sync", "async"] = "sync"


DataKind: TypeAlias = Literal["pairs", "kubric4d", "parallel_domain4d", "lerobot", "videos", "cache"]
Modality: TypeAlias = Literal["rgb", "semantic"]
DataTask: TypeAlias = Literal["views", "image-to-video"]
Bounds: TypeAlias = tuple[float, float]


class FramesRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which frames of a scene make a clip; what is left out is as released for the kind of data.

    strides: one of them is drawn (Kubric-4D 1 to 4, ParallelDomain-4D 1 and 2). latest_start: largest first frame
    (Kubric-4D 6). reverse: probability that a clip runs backwards (Kubric-4D 0.2). reach_last: let clips end with the
    scene's last frame, which an off-by-one in the release keeps out of reach.
    """

    strides: tuple[Count, ...] | None = None
    latest_start: Annotated[int, Meta(ge=0)] | None = None
    reverse: Share | None = None
    reach_last: bool = False


class OrbitRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cameras about the scene's centre; see `paths.OrbitSampling`.

    max_azimuth_deg, max_elevation_deg, max_radius_m: largest change from source to goal.
    azimuth_deg, elevation_deg, radius_m: where cameras may stand. The elevation is as released, also for the 180-degree
    models; the paper prints [0, 90] for those.
    """

    max_azimuth_deg: NotNegative = 90.0
    max_elevation_deg: NotNegative = 30.0
    max_radius_m: NotNegative = 3.0
    azimuth_deg: Bounds = (0.0, 360.0)
    elevation_deg: Bounds = (0.0, 50.0)
    radius_m: Bounds = (12.0, 18.0)


class LoaderRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How samples are made beside training.

    workers: processes, 0 for none; they are started anew (spawn), so that OpenGL works in them.
    """

    workers: Annotated[int, Meta(ge=0)] = 0


class LeRobotRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Pairs of calibrated cameras, at unet.fps; see `data.lerobot.LeRobotPairs`."""

    cameras: tuple[str, ...] | None = None
    calibration: str | None = None


class DataRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What --data holds, and how clips are drawn from it.

    kind: "pairs" of `gcd-train generate`; a set in the layout of "kubric4d" or "parallel_domain4d", published or
    ours; "lerobot" with calibrated cameras; own "videos" with poses; a latent "cache" (unet.source "cache").
    task: "views" of the source along the target camera's path; or "image-to-video", to start from: both sides of every
    pair are videos, each to be continued from its first frame, and nobody is told of cameras.
    modality: targets in colour, or painted by class.
    path: "gradual" moves all the way through the clip, "direct" stands at the goal from the first frame on.
    move_time: the frame in which a gradual move is done, the last if left out.
    exact: draw from the geometry that our own scenes keep, instead of from points. published: points with the
    approximations of the release (distance to depth, see `data.visibility`); otherwise without.
    splat_device: where points are drawn; "cuda" is the process's own GPU.
    cameras: views to draw points from, all published ones if left out.
    split, split_file, held_out: what is measured on where no --valid is given. "published": Kubric-4D by number (0-2799
    to learn from, 2800-2899 held out), ParallelDomain-4D by split_file. "last": the last held_out scenes or episodes.
    repeats: samples a scene gives before it is drawn anew.
    """

    kind: DataKind = "pairs"
    task: DataTask = "views"
    modality: Modality = "rgb"
    path: Literal["gradual", "direct"] = "gradual"
    move_time: Annotated[int, Meta(ge=0)] | None = None
    exact: bool = False
    published: bool = False
    splat_device: Literal["cpu", "cuda"] = "cpu"
    cameras: tuple[str, ...] | None = None
    split: Literal["published", "last"] = "published"
    split_file: str | None = None
    held_out: Count = 50
    repeats: Count = 400
    frames: FramesRecipe = FramesRecipe()
    orbit: OrbitRecipe = OrbitRecipe()
    loader: LoaderRecipe = LoaderRecipe()
    lerobot: LeRobotRecipe = LeRobotRecipe()

    def __post_init__(self) -> None:
        if self.task == "image-to-video" and (self.modality != "rgb" or self.kind == "cache"):
            raise ValueError('data.task "image-to-video" learns from videos in colour, and from no cache')

    def goal_frame(self, frames: int) -> int:
        """The frame of T in which the camera is at its goal: 0 for direct, T - 1 for gradual, or `move_time`."""
        if self.move_time is not None:
            return self.move_time
        return 0 if self.path == "direct" else frames - 1
