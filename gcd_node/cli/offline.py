"""`gcd-node synthesize` and `export`: one clip seen from another camera, and a checkpoint as ONNX graphs."""

import inspect
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from typer import Argument, Option

from gcd_model import (
    Augmentation,
    RenderOptions,
    Traits,
    Trajectory,
    export_weights,
    load_synthesizer,
    visibility_of,
)
from gcd_node.cli.main import progress_bar
from gcd_node.cli.weights import FamilyOption, HeadWidth, ImageHeads
from gcd_node.config import EngineName, Quality, SolverName
from gcd_node.errors import SourceError, UsageError
from gcd_node.messages import ontology
from gcd_node.offline import ClipRequest, plan, read_clip, write_view
from gcd_node.preprocess import assumed_hfov_deg
from gcd_node.sources import SourcePose

_view = partial(Option, rich_help_panel="The view")
_clip = partial(Option, rich_help_panel="The clip")
_sampling = partial(Option, rich_help_panel="Sampling")
_model = partial(Option, rich_help_panel="The model")
_mount = partial(Option, rich_help_panel="The camera's mount; what is left out is as the model was trained")
_depth = partial(Option, rich_help_panel="Depth from elsewhere, for the live model; for others it tells what was seen")
Number = float | None
Count = int | None


@dataclass(frozen=True)
class Options:
    """What `gcd-node synthesize` takes."""

    input_path: Annotated[Path, Argument(metavar="INPUT", help="A video, a folder of pictures, or a still.")]
    weights: Annotated[
        str, Option(help="A checkpoint, a diffusers folder, an export, package:NAME, or random:FAMILY (noise).")
    ]
    out: Annotated[Path, Option(help="Folder for frames, video, pictures and arrays.")]

    azimuth_deg: Annotated[Number, _view(help="Destination minus source, to the camera's right.")] = None
    elevation_deg: Annotated[Number, _view(help="Destination minus source, up.")] = None
    radius: Annotated[Number, _view(help="Destination minus source, away.")] = None
    poses: Annotated[Path | None, _view(help="The whole path instead: .npy of [T, 4, 4], source-from-target.")] = None
    move_time: Annotated[Count, _view(help="Frame in which the goal is reached; 0 is direct. Else as trained.")] = None
    source_elevation_deg: Annotated[
        Number, _view(help="Where an orbit's source camera stands, above its centre. Else 5.")
    ] = None
    source_radius: Annotated[Number, _view(help="Its distance to the scene's centre. Else 15.")] = None

    mount_height: Annotated[Number, _mount(help="Camera above the ground, metres, for the live model.")] = None
    mount_forward: Annotated[Number, _mount(help="Camera ahead of the vehicle's origin, metres.")] = None
    mount_left: Annotated[Number, _mount(help="And to its left, metres.")] = None
    mount_tilt: Annotated[Number, _mount(help="How far the camera looks down, degrees.")] = None
    hfov_deg: Annotated[Number, _mount(help="Horizontal field of view of the input, degrees.")] = None

    depth: Annotated[
        Path | None,
        _depth(
            help="Folder of 16-bit PNG in mm, .npy of [T, H, W] metres, a network as .onnx, or a pair's right video."
        ),
    ] = None
    depth_kind: Annotated[
        Literal["metric", "inverse"],
        _depth(help="What a network gives: metres, or relative inverse depth (state the mount)."),
    ] = "metric"
    calibration: Annotated[Path | None, _depth(help="Of the stereo pair: JSON as DepthAI writes it.")] = None
    rectified: Annotated[bool, _depth("--rectified", help="The device has rectified the pair.")] = False
    unit_m: Annotated[
        float, _depth(help="Metres in one unit of a radius, for models whose radius is none in metres.")
    ] = 1.0

    start: Annotated[int, _clip(help="First frame of the input.")] = 0
    stride: Annotated[int, _clip(help="Take every so-many-th frame.")] = 1
    fps: Annotated[Number, _clip(help="Frame rate the network is told; else the clip's own.")] = None
    height: Annotated[Count, _clip(help="Instead of the trained height.")] = None
    width: Annotated[Count, _clip(help="Instead of the trained width.")] = None

    quality: Annotated[
        Quality, _sampling(help="As the model was made for, or in fewer steps where it takes many; other options win.")
    ] = "exact"
    steps: Annotated[Count, _sampling(help="Denoising steps.")] = None
    solver: Annotated[SolverName | None, _sampling(help="Euler steps as published, or of second order.")] = None
    guidance: Annotated[
        tuple[float, float] | None, _sampling(metavar="FIRST LAST", help="Scale of the first and the last frame.")
    ] = None
    guidance_interval: Annotated[
        tuple[float, float] | None,
        _sampling(metavar="LOW HIGH", help="Noise levels at which guidance applies; by default all."),
    ] = None
    seed: Annotated[int, _sampling(help="Of all random draws.")] = 0
    samples: Annotated[int, _sampling(help="Draws of the view.")] = 1
    motion_bucket: Annotated[Number, _sampling(help="The motion number; else by the formula.")] = None
    cond_aug: Annotated[
        Number, _sampling(help="Strength of the noise on the conditioning frames; else the model's.")
    ] = None

    family: FamilyOption = None
    device: Annotated[str, _model(help="auto, cpu, cuda, cuda:1, ...")] = "auto"
    engine: Annotated[EngineName | None, _model(help="What computes: cuda for a GPU, onnxruntime for an export.")] = (
        None
    )
    provider: Annotated[
        list[str] | None, _model(help="Execution provider of onnxruntime, by its own name; several, best first.")
    ] = None
    dtype: Annotated[str | None, _model(help="float32, bfloat16 or float16; float8 with --engine cuda.")] = None
    head_width: HeadWidth = None
    image_heads: ImageHeads = None
    adapter: Annotated[Path | None, _model("--adapter", help="Low-rank adapter trained on these weights.")] = None


def synthesize(**options: Any) -> None:
    """See one clip from another camera, offline: frames, video, class map, depth, and what was seen."""
    chosen = Options(**options)
    request = ClipRequest(**_of(chosen, ClipRequest), pose=_pose(chosen))
    drawing = RenderOptions(**_of(chosen, RenderOptions))
    if not chosen.input_path.exists():
        raise SourceError(f"{chosen.input_path} does not exist; give a video, a folder of pictures or a still")
    names = ("adapter", "family", "device", "dtype", "engine", "head_width", "image_heads")
    loading = {name: getattr(chosen, name) for name in names}
    with Console(stderr=True, markup=False).status("loading the weights"):
        model = load_synthesizer(chosen.weights, providers=chosen.provider or (), **loading)
    traits = model.traits
    clip = read_clip(chosen.input_path, request, traits)
    trajectory = plan(
        traits,
        change=(chosen.azimuth_deg, chosen.elevation_deg, chosen.radius),
        poses=chosen.poses,
        move_time=chosen.move_time,
        source=request.pose,
        mount=clip.mount,
    )
    with progress_bar("encoding") as advance:
        features = model.encode(clip, Augmentation(strength=chosen.cond_aug, seed=chosen.seed))
        view = model.render(features, [trajectory], replace(drawing, progress=partial(advance, "denoising")))[0]
    if view.visibility is None and clip.depth is not None:
        view = replace(view, visibility=visibility_of(clip, trajectory))
    write_view(chosen.out, clip, view, ontology(traits))
    console = Console(markup=False)
    for each in _notes(request, traits, trajectory, view.ood):
        console.print(each, soft_wrap=True)
    console.print(f"wrote {chosen.out}", soft_wrap=True)


synthesize.__signature__ = inspect.signature(Options)  # type: ignore[attr-defined]  what typer looks at


def _of(chosen: Options, kind: type[ClipRequest] | type[RenderOptions]) -> dict[str, Any]:
    """The options that go into one record: those of its names."""
    return {each.name: getattr(chosen, each.name) for each in fields(kind) if hasattr(chosen, each.name)}


def _pose(chosen: Options) -> SourcePose | None:
    pose = {
        "elevation_deg": chosen.source_elevation_deg,
        "radius": chosen.source_radius,
        "height_m": chosen.mount_height,
        "forward_m": chosen.mount_forward,
        "left_m": chosen.mount_left,
        "tilt_deg": chosen.mount_tilt,
    }
    if all(number is None for number in pose.values()):
        return None
    try:
        return SourcePose(**pose)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _notes(request: ClipRequest, traits: Traits, trajectory: Trajectory, ood: float | None) -> Iterator[str]:
    """What a reader of the view must know: what nobody stated of the source camera, and what is a guess."""
    start, pose = trajectory.source, request.pose
    is_stated = pose is not None and (pose.on_vehicle or None not in (pose.elevation_deg, pose.radius))
    if not traits.trained:
        yield f"{traits.name}: these weights are random, so the picture is noise."
    if start is not None and trajectory.delta is not None and not is_stated:
        yield (
            f"The source camera is taken to stand at an elevation of {start.elevation_deg:g} degrees and a radius of "
            f"{start.radius_m:g}; say where with --source-elevation-deg and --source-radius."
        )
    if traits.live and request.hfov_deg is None and request.calibration is None:
        hfov_deg = assumed_hfov_deg(pose)
        yield f"The pictures are taken to be {hfov_deg:.4g} degrees wide; say it with --hfov-deg."
    if traits.ood_threshold is not None and ood is not None and ood > traits.ood_threshold:
        yield (
            f"To {traits.name} this is another world than the one it learned from ({ood:.2f}, its own are below "
            f"{traits.ood_threshold:.2f}): depth and classes are guesses."
        )


# Export.


def export(
    onnx: Annotated[Path, Option("--onnx", metavar="DIR", help="Folder to write; it appears whole or not at all.")],
    weights: Annotated[str, Option(help="A checkpoint, a diffusers folder, package:NAME, or random:FAMILY (noise).")],
    fp16: Annotated[bool, Option("--fp16", help="Half precision, for GPUs; the decoder stays float32.")] = False,
    height: Annotated[Count, Option(help="Instead of the trained height; the graphs take no other.")] = None,
    width: Annotated[Count, Option(help="Instead of the trained width; the graphs take no other.")] = None,
    family: FamilyOption = None,
    head_width: HeadWidth = None,
    image_heads: ImageHeads = None,
    adapter: Annotated[Path | None, Option("--adapter", help="Low-rank adapter trained on these weights.")] = None,
    overwrite: Annotated[bool, Option("--overwrite", help="Replace the export that is there.")] = False,
) -> None:
    """Write every network of a checkpoint as an ONNX graph of one size, with a manifest.

    `gcd-node synthesize --weights DIR` and `[model] weights` take the folder. Needs the extra `onnx`.
    """
    with progress_bar("loading") as advance:
        manifest = export_weights(
            weights,
            onnx,
            precision="float16" if fp16 else "float32",
            height=height,
            width=width,
            family=family,
            head_width=head_width,
            image_heads=image_heads,
            adapter=adapter,
            overwrite=overwrite,
            progress=advance,
        )
    graphs = f"{', '.join(manifest.graphs)}; {manifest.precision}, digest {manifest.sha256_12}"
    Console(markup=False).print(f"wrote {onnx}: {manifest.card['gcd.name']}, {graphs}", soft_wrap=True)
