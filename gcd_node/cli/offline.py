"""`gcd-node synthesize` and `export`: one clip seen from another camera, and a checkpoint as ONNX graphs."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from typer import Argument, Option

from gcd_model import (
    Augmentation,
    EngineName,
    ExportPrecision,
    Quality,
    RenderOptions,
    SolverName,
    Traits,
    Trajectory,
    View,
    ViewSynthesizer,
    export_weights,
    load_synthesizer,
    visibility_of,
)
from gcd_node.cli.main import progress_bar, table
from gcd_node.cli.weights import FamilyOption, HeadWidth, ImageHeads
from gcd_node.errors import SourceError, UsageError
from gcd_node.image_io import write_npz
from gcd_node.messages import ontology
from gcd_node.offline import ClipRequest, OfflineClip, plan, read_clip, write_view
from gcd_node.sources import SourcePose

_view = partial(Option, rich_help_panel="The view")
_clip = partial(Option, rich_help_panel="The clip")
_sampling = partial(Option, rich_help_panel="Sampling")
_model = partial(Option, rich_help_panel="The model")
_mount = partial(Option, rich_help_panel="The camera's mount; what is left out is as the model was trained")
_depth = partial(Option, rich_help_panel="Depth from elsewhere, for the live model; for others it tells what was seen")

Input = Annotated[
    Path,
    Argument(metavar="INPUT", help="A video, a folder of pictures, or a still."),
]
AnyWeights = Annotated[
    str, Option(help="A checkpoint, a diffusers folder, an export, package:NAME, or random:FAMILY (noise).")
]
Out = Annotated[Path, Option(help="Folder for frames, video and pictures.")]

Azimuth = Annotated[float | None, _view(help="Destination minus source, to the camera's right.")]
Elevation = Annotated[float | None, _view(help="Destination minus source, up.")]
Radius = Annotated[float | None, _view(help="Destination minus source, away.")]
Poses = Annotated[Path | None, _view(help="The whole path instead: .npy of [T, 4, 4], source-from-target.")]
PathKind = Annotated[str | None, _view(help="gradual or direct; else as the checkpoint was trained.")]
MoveTime = Annotated[int | None, _view(help="Frame in which the goal is reached.")]
SourceElevation = Annotated[
    float | None, _view(help="Where an orbit's source camera stands, above its centre. Else 5.")
]
SourceRadius = Annotated[float | None, _view(help="Its distance to the scene's centre. Else 15.")]

MountHeight = Annotated[float | None, _mount(help="Camera above the ground, metres, for the live model.")]
MountForward = Annotated[float | None, _mount(help="Camera ahead of the vehicle's origin, metres.")]
MountLeft = Annotated[float | None, _mount(help="And to its left, metres.")]
MountTilt = Annotated[float | None, _mount(help="How far the camera looks down, degrees.")]
FieldOfView = Annotated[float | None, _mount(help="Horizontal field of view of the input, degrees.")]

Depth = Annotated[
    Path | None,
    _depth(help="A folder of 16-bit PNG in mm, .npy of [T, H, W] metres, a network as .onnx, or a pair's right video."),
]
DepthKind = Annotated[
    Literal["metric", "inverse"],
    _depth(help="What a network gives: metres, or relative inverse depth (state the mount)."),
]
Calibration = Annotated[Path | None, _depth(help="Of the stereo pair: JSON as DepthAI writes it.")]
Rectified = Annotated[bool, _depth("--rectified", help="The device has rectified the pair.")]
UnitM = Annotated[float, _depth(help="Metres in one unit of a radius, for models whose radius is none in metres.")]

Start = Annotated[int, _clip(help="First frame of the input.")]
Stride = Annotated[int, _clip(help="Take every so-many-th frame.")]
Fps = Annotated[float | None, _clip(help="Frame rate the network is told; else the clip's own.")]
Height = Annotated[int | None, _clip(help="Instead of the trained height.")]
Width = Annotated[int | None, _clip(help="Instead of the trained width.")]

QualityChoice = Annotated[
    Quality, _sampling(help="As the model was made for, or in fewer steps where it takes many; other options win.")
]
Steps = Annotated[int | None, _sampling(help="Denoising steps.")]
Solver = Annotated[SolverName | None, _sampling(help="Euler steps as published, or of second order.")]
Guidance = Annotated[
    tuple[float, float] | None, _sampling(metavar="FIRST LAST", help="Scale of the first and the last frame.")
]
GuidanceInterval = Annotated[
    tuple[float, float] | None,
    _sampling(metavar="LOW HIGH", help="Noise levels at which guidance applies; by default all."),
]
Seed = Annotated[int, _sampling(help="Of all random draws.")]
Samples = Annotated[int, _sampling(help="Draws of the view; with several, a picture shows where they differ.")]
MotionBucket = Annotated[float | None, _sampling(help="The motion number; else by the formula.")]
CondAug = Annotated[float | None, _sampling(help="Strength of the noise on the conditioning frames; else the model's.")]
Save = Annotated[Path | None, _sampling(help=".npz to write `latents` and `frames` to.")]

AdapterFile = Annotated[Path | None, _model("--adapter", help="Low-rank adapter trained on these weights.")]
Device = Annotated[str, _model(help="auto, cpu, cuda, cuda:1, ...")]
EngineChoice = Annotated[
    EngineName | None, _model("--engine", help="What computes: cuda for a GPU, onnxruntime for an export.")
]
Provider = Annotated[
    list[str] | None, _model(help="Execution provider of onnxruntime, by its own name; several, best first.")
]
Dtype = Annotated[str | None, _model(help="float32, bfloat16 or float16.")]


def synthesize(
    input_path: Input,
    weights: AnyWeights,
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
    clip = ClipRequest(start=start, stride=stride, fps=fps, height=height, width=width, unit_m=unit_m, depth=depth)
    clip = replace(clip, hfov_deg=hfov_deg, calibration=calibration, rectified=rectified, depth_kind=depth_kind)
    pose = _pose(source_elevation_deg, source_radius, (mount_height, mount_forward, mount_left, mount_tilt))
    clip = replace(clip, pose=pose)
    path = partial(plan, poses=poses, trajectory=trajectory, move_time=move_time, source=pose)
    path = partial(path, change=(azimuth_deg, elevation_deg, radius))
    options = RenderOptions(steps=steps, solver=solver, guidance=guidance, quality=quality, samples=samples, seed=seed)
    options = replace(options, guidance_interval=guidance_interval, motion_bucket=motion_bucket)
    load = partial(load_synthesizer, weights, adapter=adapter, family=family, device=device, dtype=dtype, engine=engine)
    load = partial(load, head_width=head_width, image_heads=image_heads, providers=provider or ())
    if save is not None and samples != 1:
        raise UsageError("--save holds one sample; leave out --samples")
    _write(out, save, *_rendered(input_path, clip, load, path, options, cond_aug))


def _pose(elevation_deg: float | None, radius: float | None, mount: tuple[float | None, ...]) -> SourcePose | None:
    """mount: height, forward and left in metres, tilt in degrees."""
    if all(number is None for number in (elevation_deg, radius, *mount)):
        return None
    height_m, forward_m, left_m, tilt_deg = mount
    sphere = {"elevation_deg": elevation_deg, "radius": radius}
    try:
        return SourcePose(**sphere, height_m=height_m, forward_m=forward_m, left_m=left_m, tilt_deg=tilt_deg)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _rendered(
    input_path: Path,
    clip: ClipRequest,
    load: Callable[[], ViewSynthesizer],
    path: Callable[..., Trajectory],
    options: RenderOptions,
    cond_aug: float | None,
) -> tuple[Traits, OfflineClip, View]:
    if not input_path.exists():
        raise SourceError(f"{input_path} does not exist; give a video, a folder of pictures or a still")
    with Console(stderr=True, markup=False).status("loading the weights"):
        model = load()
    traits = model.traits
    source = read_clip(input_path, clip, traits)
    trajectory = path(traits, mount=source.clip.mount)
    with progress_bar("encoding") as advance:
        features = model.encode(source.clip, Augmentation(strength=cond_aug, seed=options.seed))
        progress = partial(advance, "denoising")
        view = model.render(features, [trajectory], replace(options, progress=progress))[0]
    if view.visibility is None and source.clip.depth is not None:
        view = replace(view, visibility=visibility_of(source.clip, trajectory))
    console = Console(markup=False)
    if not traits.trained:
        console.print(f"{traits.name}: these weights are random, so the picture is noise.")
    for each in _assumed(clip, traits, source, trajectory):
        console.print(each, soft_wrap=True)
    return traits, source, view


def _write(out: Path, save: Path | None, traits: Traits, source: OfflineClip, view: View) -> None:
    written = write_view(out, source, view, ontology(traits))
    if save is not None:
        frames = view.video.permute(0, 2, 3, 1).contiguous()
        write_npz(save, {"latents": view.latents[0].numpy(), "frames": frames.numpy()})
        written.append(save)
    console = Console(markup=False)
    if traits.ood_threshold is not None and view.ood is not None and view.ood > traits.ood_threshold:
        console.print(
            f"To {traits.name} this is another world than the one it learned from ({view.ood:.2f}, its own are below "
            f"{traits.ood_threshold:.2f}): depth and classes are guesses.",
            soft_wrap=True,
        )
    for each in written:
        console.print(f"wrote {each}", soft_wrap=True)


def _assumed(clip: ClipRequest, traits: Traits, source: OfflineClip, trajectory: Trajectory) -> Iterator[str]:
    """What nobody stated of the source camera, and what it is taken to be."""
    start, pose = trajectory.source, clip.pose
    is_stated = pose is not None and (pose.on_vehicle or None not in (pose.elevation_deg, pose.radius))
    if start is not None and trajectory.delta is not None and not is_stated:
        yield (
            f"The source camera is taken to stand at an elevation of {start.elevation_deg:g} degrees and a radius of "
            f"{start.radius_m:g}; say where with --source-elevation-deg and --source-radius."
        )
    if traits.live and clip.hfov_deg is None and clip.calibration is None and source.hfov_deg is not None:
        yield f"The pictures are taken to be {source.hfov_deg:.4g} degrees wide; say it with --hfov-deg."


# Export.


def export(
    onnx: Annotated[
        Path,
        Option("--onnx", metavar="DIR", help="Folder to write; it appears whole or not at all.", show_default=False),
    ],
    weights: Annotated[
        str,
        Option(help="A checkpoint, a diffusers folder, package:NAME, or random:FAMILY (noise).", show_default=False),
    ],
    fp16: Annotated[
        bool,
        Option(
            "--fp16", rich_help_panel="Narrower numbers", help="Half precision, for GPUs; the decoder stays float32."
        ),
    ] = False,
    height: Annotated[int | None, Option(help="Instead of the trained height; the graphs take no other.")] = None,
    width: Annotated[int | None, Option(help="Instead of the trained width; the graphs take no other.")] = None,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    adapter: Annotated[Path | None, Option("--adapter", help="Low-rank adapter trained on these weights.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the export that is there.")] = False,
) -> None:
    """Write every network of a checkpoint as an ONNX graph of one size, with a manifest.

    `gcd-node synthesize --weights DIR` and `[model] weights` take the folder. Needs the extra `onnx`.
    """
    precision: ExportPrecision = "float16" if fp16 else "float32"
    with progress_bar("loading") as advance:
        manifest = export_weights(
            weights,
            onnx,
            precision=precision,
            height=height,
            width=width,
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            adapter=adapter,
            overwrite=overwrite,
            progress=advance,
        )
    console = Console(markup=False)
    rows = (
        (
            name,
            graph.precision,
            ", ".join(f"{each.name} {'x'.join(map(str, each.shape))}" for each in graph.inputs),
            f"{sum(file.size for file in graph.files) / 1e6:,.1f}",
        )
        for name, graph in manifest.graphs.items()
    )
    title = f"{manifest.card['gcd.name']}, {manifest.precision}, digest {manifest.sha256_12}"
    console.print(table(rows, ("graph", "precision", "takes", ">MB"), title))
    console.print(f"wrote {onnx}", soft_wrap=True)
