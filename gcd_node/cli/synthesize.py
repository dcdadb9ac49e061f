"""`gcd-node synthesize`: one clip, one view, offline."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text
from typer import Argument, Option

from gcd_model import (
    Augmentation,
    EngineName,
    Quality,
    RenderOptions,
    SolverName,
    SphericalDelta,
    Traits,
    ViewSynthesizer,
    load_synthesizer,
)
from gcd_node.cli.weights import FamilyOption, HeadWidth, ImageHeads
from gcd_node.errors import UsageError
from gcd_node.messages import ontology
from gcd_node.offline_clip import ClipRequest, read_clip, with_depth
from gcd_node.preprocess import assumed_hfov_deg, require_usable, stated_mount
from gcd_node.source_config import SourcePose
from gcd_node.sources.depth import OnnxDepth
from gcd_node.synthesize import (
    InjectedNoise,
    ViewRequest,
    plan,
    read_noise,
    render,
    require_input,
    save_arrays,
    write_view,
)

_VIEW, _CLIP, _SAMPLING, _MODEL = "The view", "The clip", "Sampling", "The model"
_DEPTH = "Depth from elsewhere, for the live model; for others it tells what was seen"
_MOUNT = "The camera's mount; what is left out is as the model was trained"

Input: TypeAlias = Annotated[
    Path,
    Argument(metavar="INPUT", help="A video, a folder of pictures, a still, or .npy: float32 [T, H, W, 3] in 0..1."),
]
Weights: TypeAlias = Annotated[
    str, Option(help="A checkpoint, a diffusers folder, an export, package:NAME, or random:FAMILY (noise).")
]
Out: TypeAlias = Annotated[Path, Option(help="Folder for frames, video and pictures.")]
Azimuth: TypeAlias = Annotated[
    float | None, Option(help="Destination minus source, to the camera's right.", rich_help_panel=_VIEW)
]
Elevation: TypeAlias = Annotated[float | None, Option(help="Destination minus source, up.", rich_help_panel=_VIEW)]
Radius: TypeAlias = Annotated[float | None, Option(help="Destination minus source, away.", rich_help_panel=_VIEW)]
Poses: TypeAlias = Annotated[
    Path | None, Option(help="The whole path instead: .npy of [T, 4, 4], source-from-target.", rich_help_panel=_VIEW)
]
PathKind: TypeAlias = Annotated[
    str | None, Option(help="gradual or direct; else as the checkpoint was trained.", rich_help_panel=_VIEW)
]
MoveTime: TypeAlias = Annotated[int | None, Option(help="Frame in which the goal is reached.", rich_help_panel=_VIEW)]
SourceElevation: TypeAlias = Annotated[
    float | None, Option(help="Where an orbit's source camera stands, above its centre. Else 5.", rich_help_panel=_VIEW)
]
SourceRadius: TypeAlias = Annotated[
    float | None, Option(help="Its distance to the scene's centre. Else 15.", rich_help_panel=_VIEW)
]
MountHeight: TypeAlias = Annotated[
    float | None,
    Option(help="Camera above the ground, metres, for the live model.", rich_help_panel=_MOUNT),
]
MountForward: TypeAlias = Annotated[
    float | None, Option(help="Camera ahead of the vehicle's origin, metres.", rich_help_panel=_MOUNT)
]
MountLeft: TypeAlias = Annotated[float | None, Option(help="And to its left, metres.", rich_help_panel=_MOUNT)]
MountTilt: TypeAlias = Annotated[
    float | None, Option(help="How far the camera looks down, degrees.", rich_help_panel=_MOUNT)
]
FieldOfView: TypeAlias = Annotated[
    float | None, Option(help="Horizontal field of view of the input, degrees.", rich_help_panel=_MOUNT)
]
Depth: TypeAlias = Annotated[
    Path | None,
    Option(
        help="A folder of 16-bit PNG in mm, .npy of [T, H, W] metres, a network as .onnx, or a pair's right video.",
        rich_help_panel=_DEPTH,
    ),
]
DepthKind: TypeAlias = Annotated[
    Literal["metric", "inverse"],
    Option(help="What a network gives: metres, or relative inverse depth (state the mount).", rich_help_panel=_DEPTH),
]
Calibration: TypeAlias = Annotated[
    Path | None, Option(help="Of the stereo pair: JSON as DepthAI writes it.", rich_help_panel=_DEPTH)
]
Rectified: TypeAlias = Annotated[
    bool, Option("--rectified", help="The device has rectified the pair.", rich_help_panel=_DEPTH)
]
UnitM: TypeAlias = Annotated[
    float,
    Option(help="Metres in one unit of a radius, for models whose radius is none in metres.", rich_help_panel=_DEPTH),
]
Start: TypeAlias = Annotated[int, Option(help="First frame of the input.", rich_help_panel=_CLIP)]
Stride: TypeAlias = Annotated[int, Option(help="Take every so-many-th frame.", rich_help_panel=_CLIP)]
Fps: TypeAlias = Annotated[
    float | None, Option(help="Frame rate the network is told; else the clip's own.", rich_help_panel=_CLIP)
]
Height: TypeAlias = Annotated[int | None, Option(help="Instead of the trained height.", rich_help_panel=_CLIP)]
Width: TypeAlias = Annotated[int | None, Option(help="Instead of the trained width.", rich_help_panel=_CLIP)]
QualityChoice: TypeAlias = Annotated[
    Quality,
    Option(
        help="As the model was made for, or in fewer steps where it takes many; other options win.",
        rich_help_panel=_SAMPLING,
    ),
]
Steps: TypeAlias = Annotated[int | None, Option(help="Denoising steps.", rich_help_panel=_SAMPLING)]
Solver: TypeAlias = Annotated[
    SolverName | None, Option(help="Euler steps as published, or of second order.", rich_help_panel=_SAMPLING)
]
Guidance: TypeAlias = Annotated[
    tuple[float, float] | None,
    Option(metavar="FIRST LAST", help="Scale of the first and the last frame.", rich_help_panel=_SAMPLING),
]
GuidanceInterval: TypeAlias = Annotated[
    tuple[float, float] | None,
    Option(
        metavar="LOW HIGH", help="Noise levels at which guidance applies; by default all.", rich_help_panel=_SAMPLING
    ),
]
Seed: TypeAlias = Annotated[int, Option(help="Of all random draws.", rich_help_panel=_SAMPLING)]
Samples: TypeAlias = Annotated[
    int, Option(help="Draws of the view; with several, a picture shows where they differ.", rich_help_panel=_SAMPLING)
]
MotionBucket: TypeAlias = Annotated[
    float | None, Option(help="The motion number; else by the formula.", rich_help_panel=_SAMPLING)
]
CondAug: TypeAlias = Annotated[
    float | None,
    Option(help="Strength of the noise on the conditioning frames; else the model's.", rich_help_panel=_SAMPLING),
]
Noise: TypeAlias = Annotated[
    Path | None, Option(help=".npz with `initial` and `augmentation` instead of draws.", rich_help_panel=_SAMPLING)
]
Save: TypeAlias = Annotated[
    Path | None, Option(help=".npz to write `latents` and `frames` to.", rich_help_panel=_SAMPLING)
]
AdapterFile: TypeAlias = Annotated[
    Path | None, Option("--adapter", help="Low-rank adapter trained on these weights.", rich_help_panel=_MODEL)
]
Device: TypeAlias = Annotated[str, Option(help="auto, cpu, cuda, cuda:1, ...", rich_help_panel=_MODEL)]
EngineChoice: TypeAlias = Annotated[
    EngineName | None,
    Option("--engine", help="What computes: cuda for a GPU, onnxruntime for an export.", rich_help_panel=_MODEL),
]
Provider: TypeAlias = Annotated[
    list[str] | None,
    Option(help="Execution provider of onnxruntime, by its own name; several, best first.", rich_help_panel=_MODEL),
]
Dtype: TypeAlias = Annotated[str | None, Option(help="float32, bfloat16 or float16.", rich_help_panel=_MODEL)]


def synthesize(
    input_path: Input,
    weights: Weights,
    out: Out,
    azimuth_deg: Azimuth = None,
    elevation_deg: Elevation = None,
    radius: Radius = None,
    poses: Poses = None,
    trajectory: PathKind = None,
    move_time: MoveTime = None,
    source_elevation_deg: SourceElevation = None,
    source_radius: SourceRadius = None,
    mount_height: MountHeight = None,
    mount_forward: MountForward = None,
    mount_left: MountLeft = None,
    mount_tilt: MountTilt = None,
    hfov_deg: FieldOfView = None,
    depth: Depth = None,
    calibration: Calibration = None,
    rectified: Rectified = False,
    depth_kind: DepthKind = "metric",
    unit_m: UnitM = 1.0,
    start: Start = 0,
    stride: Stride = 1,
    fps: Fps = None,
    height: Height = None,
    width: Width = None,
    quality: QualityChoice = "exact",
    steps: Steps = None,
    solver: Solver = None,
    guidance: Guidance = None,
    guidance_interval: GuidanceInterval = None,
    seed: Seed = 0,
    samples: Samples = 1,
    motion_bucket: MotionBucket = None,
    cond_aug: CondAug = None,
    noise: Noise = None,
    save: Save = None,
    family: FamilyOption = None,
    device: Device = "auto",
    engine: EngineChoice = None,
    provider: Provider = None,
    dtype: Dtype = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    adapter: AdapterFile = None,
) -> None:
    """See one clip from another camera, offline: frames, video, class map, depth, and what was seen."""
    clip = ClipRequest(start=start, stride=stride, fps=fps, height=height, width=width, hfov_deg=hfov_deg)
    measured = _Depth(place=depth, calibration=calibration, rectified=rectified, kind=depth_kind, unit_m=unit_m)
    source = _pose((source_elevation_deg, source_radius), (mount_height, mount_forward, mount_left, mount_tilt))
    wanted = _view((azimuth_deg, elevation_deg, radius), poses, trajectory, move_time, source)
    injected = InjectedNoise() if noise is None else read_noise(noise)
    named = RenderOptions(steps=steps, solver=solver, guidance=guidance, guidance_interval=guidance_interval)
    sampler = replace(named, quality=quality)
    options = replace(sampler, samples=samples, seed=seed, motion_bucket=motion_bucket, initial_noise=injected.initial)
    load = partial(load_synthesizer, weights, adapter=adapter, family=family, device=device, dtype=dtype, engine=engine)
    load = partial(load, head_width=head_width, image_heads=image_heads, providers=provider or ())
    augmentation = Augmentation(strength=cond_aug, seed=seed, noise=injected.augmentation)
    _run(_Order(load, weights, input_path, measured.request(clip), wanted, options, augmentation, measured), out, save)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Depth:
    """Where depth comes from: pictures, a network, or with a calibration the right video of a pair."""

    place: Path | None
    calibration: Path | None
    rectified: bool
    kind: Literal["metric", "inverse"]
    unit_m: float

    def __post_init__(self) -> None:
        if not 0 < self.unit_m < math.inf:
            raise UsageError(f"--unit-m must be a positive number of metres, got {self.unit_m:g}")
        if self.calibration is not None and self.place is None:
            raise UsageError("--calibration is of a stereo pair; give its right video as --depth, or leave it out")

    @property
    def network(self) -> Path | None:
        """The ONNX file, if it is one."""
        is_network = self.place is not None and self.place.suffix == ".onnx" and self.calibration is None
        return self.place if is_network else None

    def request(self, clip: ClipRequest) -> ClipRequest:
        """The clip with the depth that is read beside it."""
        if self.network is not None:
            return clip
        if self.calibration is None:
            return replace(clip, depth=self.place, rectified=self.rectified)
        return replace(clip, right=self.place, calibration=self.calibration, rectified=self.rectified)


def _require_possible(input_path: Path, save: Path | None, samples: int) -> None:
    """What is cheaper to know before the weights are loaded."""
    if save is not None and samples != 1:
        raise UsageError("--save holds one sample; leave out --samples")
    require_input(input_path)


@dataclass(frozen=True, slots=True)
class _Order:
    load: Callable[[], ViewSynthesizer]
    weights: str
    input_path: Path
    clip: ClipRequest
    view: ViewRequest
    options: RenderOptions
    augmentation: Augmentation
    depth: _Depth


def _run(order: _Order, out: Path, save: Path | None) -> None:
    _require_possible(order.input_path, save, order.options.samples)
    with Console(stderr=True, markup=False).status(Text(f"loading {order.weights}")):
        model = order.load()
    traits = model.traits
    require_usable(order.view.source, traits)
    source = read_clip(order.input_path, _with_field_of_view(order, traits), traits)
    mount = stated_mount(order.view.source, source.hfov_deg, traits)
    source = replace(source, clip=replace(source.clip, mount=mount))
    if order.depth.network is not None:
        scale = mount if order.depth.kind == "inverse" else None
        source = with_depth(source, OnnxDepth(order.depth.network, kind=order.depth.kind, scale=scale))
    if source.clip.depth is not None:
        source = replace(source, clip=replace(source.clip, depth=source.clip.depth / order.depth.unit_m))
    path = plan(model, order.view, mount)
    with _progress() as progress:
        options = replace(order.options, progress=_Steps(progress))
        view = render(model, source, path, options, order.augmentation)
    console = Console(markup=False)
    if not traits.trained:
        console.print(f"{traits.name}: these weights are random, so the picture is noise.")
    for written in write_view(out, source, view, ontology(traits)):
        console.print(f"wrote {written}", soft_wrap=True)
    if save is not None:
        save_arrays(save, view)
        console.print(f"wrote {save}", soft_wrap=True)


def _with_field_of_view(order: _Order, traits: Traits) -> ClipRequest:
    """The clip with the lens that its depth and the live model need: as stated, measured, or else as trained."""
    clip = order.clip
    measured = order.depth.place is not None
    if measured and not (traits.live or traits.knows_camera):
        raise UsageError(f"{traits.name} takes no depth; leave --depth out")
    if order.depth.unit_m != 1.0 and (not measured or traits.live):
        raise UsageError("--unit-m is about depth beside a published checkpoint; leave it out")
    needed = measured or traits.live
    if clip.hfov_deg is not None and not needed:
        raise UsageError(f"{traits.name} has no use for --hfov-deg; leave it out")
    if not needed or clip.right is not None or clip.hfov_deg is not None:
        return clip
    trained = None if traits.family is None else traits.family.hfov_deg
    hfov_deg = assumed_hfov_deg(order.view.source) if traits.live else trained
    if hfov_deg is None:
        raise UsageError(f"nobody knows the field of view that depth needs, {traits.name} neither; give --hfov-deg")
    return replace(clip, hfov_deg=hfov_deg)


def _view(
    change: tuple[float | None, float | None, float | None],
    poses: Path | None,
    trajectory: str | None,
    move_time: int | None,
    source: SourcePose | None,
) -> ViewRequest:
    """change: azimuth and elevation in degrees and radius."""
    delta = None
    if any(number is not None for number in change):
        azimuth_deg, elevation_deg, radius = (number or 0.0 for number in change)
        delta = SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius)
    return ViewRequest(delta=delta, poses=poses, trajectory=trajectory, move_time=move_time, source=source)


def _pose(sphere: tuple[float | None, ...], mount: tuple[float | None, ...]) -> SourcePose | None:
    if all(number is None for number in (*sphere, *mount)):
        return None
    elevation_deg, radius = sphere
    height_m, forward_m, left_m, tilt_deg = mount
    try:
        return SourcePose(
            elevation_deg=elevation_deg,
            radius=radius,
            height_m=height_m,
            forward_m=forward_m,
            left_m=left_m,
            tilt_deg=tilt_deg,
        )
    except ValueError as error:
        raise UsageError(str(error)) from error


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    console = Console(stderr=True, markup=False)
    return Progress(*columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal)


class _Steps:
    """Shows encoding first, then denoising steps."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._task = progress.add_task("encoding", total=None)

    def __call__(self, done: int, steps: int) -> None:
        """As RenderOptions.progress."""
        self._progress.update(self._task, description="denoising", completed=done, total=steps)
