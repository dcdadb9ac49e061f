"""One clip, one view, offline: what `gcd-node synthesize` reads, plans and writes.

A video, folder, still or stereo pair becomes one clip of T frames. Its depth, where there is any, goes the way
of its pictures: the same frames, crop and size.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_client.images import paint
from gcd_client.protocol import ClassRecord
from gcd_model import CameraMount, Clip, Intrinsics, SphericalDelta, Traits, Trajectory, View, hatched
from gcd_node.errors import DepthError, SourceError, TooShortError, UsageError
from gcd_node.frame import Image
from gcd_node.image_io import legend, read_npy, spread, strip, to_u8, write_arrays, write_png, write_video
from gcd_node.preprocess import Fit, assumed_hfov_deg, require_usable, stated_mount, stated_sphere, to_clip_tensor
from gcd_node.sources import SourcePose
from gcd_node.sources.depth import DepthPicture, OnnxDepth, clean_depth
from gcd_node.sources.files import PICTURES, ImageFolder, VideoFile, list_pictures, read_depth, read_picture
from gcd_node.sources.stereo import StereoDepth

_LOG = logging.getLogger(__name__)
_RATE_TOLERANCE = 0.05
_STRIP_FRAMES = 7
_Frame = TypeVar("_Frame")


# The clip.


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipRequest:
    """Which frames of the input, at what size, under which frame rate, from which camera, and with which depth.

    start, stride: in frames of the input. fps: what the network is told; else worked out.
    height, width: else the trained size.
    pose: of the source camera, if stated.
    hfov_deg: horizontal field of view of the input's pictures, if known; not of a stereo pair.
    depth: of the input's frames: a folder of 16-bit pictures in millimetres, .npy of [T, H, W] metres, a network as
        .onnx, or with a calibration the right video of a stereo pair.
    calibration: of the pair, as DepthAI writes it. rectified: the device has rectified both.
    depth_kind: what a network gives. unit_m: metres in one unit of the model's radius.
    """

    start: int = 0
    stride: int = 1
    fps: float | None = None
    height: int | None = None
    width: int | None = None
    pose: SourcePose | None = None
    hfov_deg: float | None = None
    depth: Path | None = None
    calibration: Path | None = None
    rectified: bool = False
    depth_kind: Literal["metric", "inverse"] = "metric"
    unit_m: float = 1.0

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1:
            raise UsageError(f"--start must be 0 or more and --stride 1 or more, got {self.start} and {self.stride}")
        if (self.height is None) != (self.width is None):
            raise UsageError("--height and --width go together; give both or none")
        if not 0 < self.unit_m < math.inf:
            raise UsageError(f"--unit-m must be a positive number of metres, got {self.unit_m:g}")
        if (self.calibration is not None and self.depth is None) or (self.rectified and self.calibration is None):
            raise UsageError("--calibration and --rectified are of a stereo pair; give its right video as --depth")
        if self.calibration is not None and self.hfov_deg is not None:
            raise UsageError("--calibration says how wide a stereo pair's pictures are; leave --hfov-deg out")


def read_clip(path: Path, request: ClipRequest, traits: Traits) -> Clip:
    """Read T frames of an input.

    Raises:
        SourceError: missing, empty, damaged, undecodable. TooShortError: fewer frames than a clip needs.
        OptionError: a size the network cannot take. UsageError: what the model has no use for.
        DepthError: the depth does not belong to the pictures, or there is none. ConfigError: a calibration of no pair.
    """
    require_usable(request.pose, traits)
    hfov_deg, source = _hfov_deg(request, traits), request.depth
    width, height = request.width or traits.config.width, request.height or traits.config.height
    traits.check_size(height, width)
    images, fps = _pictures(path, request, traits.config.frames)
    is_network = source is not None and source.suffix == ".onnx" and request.calibration is None
    depth: list[DepthPicture] = []
    if source is not None and request.calibration is not None:
        right, right_fps = _pictures(source, request, traits.config.frames)
        if fps != right_fps:
            raise SourceError(
                f"{path} runs at {fps}, {source} at {right_fps} frames per second; give one recording's two"
            )
        stereo = StereoDepth.from_depthai(
            request.calibration,
            size=(width, height),
            rectified=request.rectified,
        )
        pairs, lens = [stereo(*pair) for pair in zip(images, right, strict=True)], stereo.lens
        pictures, depth = np.stack([picture for picture, _ in pairs]), [each for _, each in pairs]
    else:
        (high, wide), fit = images[0].shape[:2], Fit(width=width, height=height, allow_upscale=True)
        pictures = np.stack([fit.image(image) for image in images])
        lens = None if hfov_deg is None else fit.intrinsics(Intrinsics.from_hfov(hfov_deg, wide, high))
        if source is not None and not is_network:
            chosen = _stated_depth(source, request, len(images))
            depth = [fit.depth(clean_depth(each, (high, wide))) for each in chosen]
    mount = stated_mount(request.pose, None if lens is None else lens.hfov_deg, traits)
    if source is not None and is_network:
        network = OnnxDepth(source, kind=request.depth_kind, scale=mount if request.depth_kind == "inverse" else None)
        depth = [network(picture) for picture in pictures]
    if depth and not any(each.any() for each in depth):
        raise DepthError("the depth of every frame is all holes; look at what measured it, or leave it out")
    return Clip(
        video=torch.from_numpy(to_clip_tensor(pictures)),
        fps=_label(request, fps, traits),
        lens=lens,
        mount=mount,
        depth=torch.from_numpy(np.stack(depth)) / request.unit_m if depth else None,
    )


def _hfov_deg(request: ClipRequest, traits: Traits) -> float | None:
    """The field of view that depth and the live model need: as stated, measured, or else as trained."""
    measured = request.depth is not None
    if measured and not (traits.live or traits.knows_camera):
        raise UsageError(f"{traits.name} takes no depth; leave --depth out")
    if request.unit_m != 1.0 and (not measured or traits.live):
        raise UsageError("--unit-m is about depth beside a published checkpoint; leave it out")
    if not measured and not traits.live and traits.splat == "none":
        if request.hfov_deg is not None:
            raise UsageError(f"{traits.name} has no use for --hfov-deg; leave it out")
        return None
    if request.calibration is not None or request.hfov_deg is not None:
        return request.hfov_deg
    trained = None if traits.family is None else traits.family.hfov_deg
    hfov_deg = assumed_hfov_deg(request.pose) if traits.live else trained
    if hfov_deg is None:
        raise UsageError(f"nobody knows the field of view that depth needs, {traits.name} neither; give --hfov-deg")
    return hfov_deg


def _pictures(path: Path, request: ClipRequest, frames: int) -> tuple[list[Image], float | None]:
    """T pictures and the input's frame rate, None if it has none."""
    if path.is_dir():
        return _strided((frame.image for frame in ImageFolder(path, fps=1.0).frames()), request, frames, path), None
    if path.suffix.lower() in PICTURES:
        return [read_picture(path)] * frames, None
    video = VideoFile(path)
    images = _strided((frame.image for frame in video.frames()), request, frames, path)
    return images, video.info.fps_nominal


def _stated_depth(path: Path, request: ClipRequest, frames: int) -> list[NDArray[Any]]:
    """Of the chosen frames, as they are in the files, [H, W]."""
    if path.is_dir():
        return [read_depth(each) for each in _strided(iter(list_pictures(path)), request, frames, path)]
    array = read_npy(path, "a folder of 16-bit pictures, a network as .onnx, or depth [T, H, W] in metres as .npy")
    if array.ndim != 3:
        raise SourceError(f"{path} must hold depth [T, H, W] in metres, got {array.dtype} {list(array.shape)}")
    return _strided(iter(array), request, frames, path)


def _strided(images: Iterator[_Frame], request: ClipRequest, frames: int, path: Path) -> list[_Frame]:
    last = request.start + (frames - 1) * request.stride
    chosen = list(islice(images, request.start, last + 1, request.stride))
    if len(chosen) < frames:
        raise TooShortError(
            f"TOO_SHORT n={len(chosen)}: {path} gives {len(chosen)} of {frames} frames from --start {request.start} "
            f"with --stride {request.stride}; start earlier, take a smaller stride, or give a longer clip"
        )
    return chosen


def _label(request: ClipRequest, source_fps: float | None, traits: Traits) -> float:
    """The frame rate the network is told: as asked, else the clip's own (the trained one it stands for)."""
    if request.fps is not None:
        return request.fps
    if source_fps is None:
        return traits.fps
    own = source_fps / request.stride
    nearest = min(traits.rates, key=lambda rate: abs(own - rate), default=own)
    if abs(own / nearest - 1) <= _RATE_TOLERANCE:
        return nearest
    rates = ", ".join(f"{rate:g}" for rate in traits.rates)
    _LOG.warning("the clip runs at %g frames per second; %s was trained at %s", own, traits.name, rates)
    return own


# The view.


def plan(
    traits: Traits,
    *,
    change: Sequence[float | None] = (),
    poses: Path | None = None,
    move_time: int | None = None,
    source: SourcePose | None = None,
    mount: CameraMount | None = None,
) -> Trajectory:
    """The camera path.

    Args:
        change: azimuth and elevation in degrees and radius, destination minus source.
        poses: the whole path instead, .npy of [T, 4, 4] source-from-target.
        move_time: the frame in which the goal is reached; else as trained.
        source, mount: where the source camera stands, if stated.
    Raises:
        UsageError: options that contradict each other.
        SourceError: a file of no poses. PoseError and its kind: see Traits.plan_view and Traits.plan_poses.
    """
    sphere, delta = stated_sphere(source), None
    if any(number is not None for number in change):
        azimuth_deg, elevation_deg, radius = (number or 0.0 for number in change)
        delta = SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius)
    if poses is None:
        return traits.plan_view(delta, source=sphere, move_time=move_time, mount=mount)
    if delta is not None or move_time is not None:
        raise UsageError("--poses states the whole path; leave out the angles and --move-time")
    path = read_npy(poses, "a .npy file of [T, 4, 4]")
    if path.ndim != 3 or path.shape[1:] != (4, 4) or path.dtype.kind not in "fiu":
        raise SourceError(f"poses in {poses} must be numbers [T, 4, 4], got {path.dtype} {list(path.shape)}")
    return traits.plan_poses(torch.from_numpy(path.astype(np.float64)), source=sphere)


def write_view(out: Path, clip: Clip, view: View, classes: Sequence[ClassRecord]) -> None:
    """Write a view; see `gcd-node synthesize`. classes: of its class map, empty if there is none. Raises OutputError.

    The first sample goes to frames/ and view.mp4, further ones to frames_s1/, view_s1.mp4, and so on. view.npz holds
    what there is of: latents [S, T, C, h, w], std [T, H, W] of several samples, classes [S, T, H, W] with class_ids,
    class_names and class_colours, visibility and inverse_depth [T, H, W].
    """
    for number, sample in enumerate(view.samples):
        ending, frames = f"_s{number}" if number else "", to_u8(sample.numpy())
        for index, frame in enumerate(frames):
            write_png(out / f"frames{ending}" / f"{index:04d}.png", frame)
        write_video(out / f"view{ending}.mp4", list(frames), clip.fps)
    pictures = to_u8(view.video.numpy())
    rows: list[Image] = [to_u8((clip.video.add(1) / 2).numpy()), pictures]
    if view.visibility is not None:
        rows.append(hatched(pictures, view.visibility.numpy()))
        write_video(out / "seen.mp4", list(rows[-1]), clip.fps)
    arrays: dict[str, NDArray[Any]] = {}
    if view.classes is not None:
        rows.append(paint(view.classes[0].numpy(), classes))
        arrays["class_ids"] = np.array([each.id for each in classes], np.uint8)
        arrays["class_names"] = np.array([each.name for each in classes])
        arrays["class_colours"] = np.array([each.colour for each in classes], np.uint8)
    for name in ("latents", "std", "classes", "visibility", "inverse_depth"):
        if (values := getattr(view, name)) is not None:
            arrays[name] = values.numpy()
    write_arrays(out / "view.npz", arrays)
    shown = strip([[row[i] for i in spread(len(pictures), _STRIP_FRAMES)] for row in rows])
    write_png(out / "strip.png", np.concatenate([shown, legend(classes, shown.shape[1])]) if classes else shown)
