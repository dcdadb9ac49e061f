"""One clip, one view, offline: what `gcd-node synthesize` reads, plans, renders and writes.

A video, folder, still or stereo pair becomes one clip of T frames. Its depth, where there is any, goes the way
of its pictures: the same frames, crop and size.
"""

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_client.images import VISIBILITY, paint
from gcd_client.protocol import ClassRecord
from gcd_model import CameraMount, Clip, Intrinsics, SphericalDelta, Traits, Trajectory, View, hatched
from gcd_node.errors import DepthError, SourceError, TooShortError, UsageError
from gcd_node.frame import Image
from gcd_node.image_io import (
    legend,
    read_npy,
    side_by_side,
    spread,
    strip,
    to_u8,
    write_npz,
    write_png,
    write_video,
)
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
    depth: of the input's frames: a folder of 16-bit pictures in millimetres, one such picture of a still, .npy of
        [T, H, W] metres, a network as .onnx, or with a calibration the right video of a stereo pair.
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
        if self.calibration is not None and self.depth is None:
            raise UsageError("--calibration is of a stereo pair; give its right video as --depth, or leave it out")
        if self.calibration is not None and self.hfov_deg is not None:
            raise UsageError("--calibration says how wide a stereo pair's pictures are; leave --hfov-deg out")
        if self.rectified and self.calibration is None:
            raise UsageError("--rectified is about a stereo pair; give --depth and --calibration, or leave it out")

    @property
    def network(self) -> Path | None:
        """The depth network, if that is where depth comes from."""
        depth = self.depth
        return depth if depth is not None and depth.suffix == ".onnx" and self.calibration is None else None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class OfflineClip:
    """The clip as the model takes it, and its pictures, u8 [T, H, W, 3], for showing.

    hfov_deg: horizontal field of view of these, None if nobody knows.
    """

    clip: Clip
    pictures: Image
    hfov_deg: float | None


def read_clip(path: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    """Read T frames of an input.

    Raises:
        SourceError: missing, empty, damaged, undecodable. TooShortError: fewer frames than a clip needs.
        OptionError: a size the network cannot take. UsageError: what the model has no use for.
        DepthError: the depth does not belong to the pictures, or there is none. ConfigError: a calibration of no pair.
    """
    require_usable(request.pose, traits)
    request = _with_lens(request, traits)
    if request.calibration is not None:
        source = _from_pair(path, request, traits)
    else:
        source = _from_pictures(path, request, traits)
    mount, depth = stated_mount(request.pose, source.hfov_deg, traits), source.clip.depth
    if request.network is not None:
        scale = mount if request.depth_kind == "inverse" else None
        network = OnnxDepth(request.network, kind=request.depth_kind, scale=scale)
        depth = _stacked([network(picture) for picture in source.pictures])
    depth = None if depth is None else depth / request.unit_m
    return replace(source, clip=replace(source.clip, mount=mount, depth=depth))


def _with_lens(request: ClipRequest, traits: Traits) -> ClipRequest:
    """With the field of view that depth and the live model need: as stated, measured, or else as trained."""
    measured = request.depth is not None
    if measured and not (traits.live or traits.knows_camera):
        raise UsageError(f"{traits.name} takes no depth; leave --depth out")
    if request.unit_m != 1.0 and (not measured or traits.live):
        raise UsageError("--unit-m is about depth beside a published checkpoint; leave it out")
    needed = measured or traits.live
    if request.hfov_deg is not None and not needed:
        raise UsageError(f"{traits.name} has no use for --hfov-deg; leave it out")
    if not needed or request.calibration is not None or request.hfov_deg is not None:
        return request
    trained = None if traits.family is None else traits.family.hfov_deg
    hfov_deg = assumed_hfov_deg(request.pose) if traits.live else trained
    if hfov_deg is None:
        raise UsageError(f"nobody knows the field of view that depth needs, {traits.name} neither; give --hfov-deg")
    return replace(request, hfov_deg=hfov_deg)


def _from_pictures(path: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    width, height = _size(request, traits)
    images, source_fps = _pictures(path, request, traits.config.frames)
    fit = Fit(width=width, height=height, allow_upscale=True)
    fitted = np.stack([fit.image(image) for image in images])
    lens = None
    if request.hfov_deg is not None:
        lens = fit.intrinsics(Intrinsics.from_hfov(request.hfov_deg, images[0].shape[1], images[0].shape[0]))
    still = not path.is_dir() and path.suffix.lower() in PICTURES
    depth = [fit.depth(each) for each in _stated_depth(request, images[0].shape[:2], len(images), still=still)]
    clip = Clip(
        video=torch.from_numpy(to_clip_tensor(fitted)),
        fps=_label(request, source_fps, traits),
        lens=lens,
        depth=_stacked(depth) if depth else None,
    )
    return OfflineClip(clip=clip, pictures=fitted, hfov_deg=None if lens is None else lens.hfov_deg)


def _from_pair(path: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    """Pictures are the left camera's, rectified."""
    right, calibration = request.depth, request.calibration
    assert right is not None, "a calibration comes with the right video"
    assert calibration is not None, "it is a pair"
    size, frames = _size(request, traits), traits.config.frames
    (left, fps), (other, other_fps) = (_pictures(each, request, frames) for each in (path, right))
    if fps != other_fps:
        raise SourceError(f"{path} runs at {fps}, {right} at {other_fps} frames per second; give one recording's two")
    stereo = StereoDepth.from_depthai(
        calibration,
        size=size,
        rectified=request.rectified,
    )
    pairs = [stereo(*pair) for pair in zip(left, other, strict=True)]
    pictures = np.stack([picture for picture, _ in pairs])
    clip = Clip(
        video=torch.from_numpy(to_clip_tensor(pictures)),
        fps=_label(request, fps, traits),
        lens=stereo.lens,
        depth=_stacked([depth for _, depth in pairs]),
    )
    return OfflineClip(clip=clip, pictures=pictures, hfov_deg=stereo.lens.hfov_deg)


def _size(request: ClipRequest, traits: Traits) -> tuple[int, int]:
    """Width and height. Raises OptionError."""
    height = traits.config.height if request.height is None else request.height
    width = traits.config.width if request.width is None else request.width
    traits.check_size(height, width)
    return width, height


def _pictures(path: Path, request: ClipRequest, frames: int) -> tuple[list[Image], float | None]:
    """T pictures and the input's frame rate, None if it has none."""
    if path.is_dir():
        return _strided((frame.image for frame in ImageFolder(path, fps=1.0).frames()), request, frames, path), None
    if path.suffix.lower() in PICTURES:
        return [read_picture(path)] * frames, None
    video = VideoFile(path)
    images = _strided((frame.image for frame in video.frames()), request, frames, path)
    return images, video.info.fps_nominal


def _stated_depth(
    request: ClipRequest, shape: tuple[int, ...], frames: int, *, still: bool = False
) -> list[DepthPicture]:
    """Of the chosen frames, as large as the input's pictures, [H, W]; empty without. still: they are one picture."""
    path, (high, wide) = request.depth, shape
    if path is None or request.network is not None:
        return []
    chosen: list[NDArray[Any]]
    if path.is_dir():
        chosen = [read_depth(each) for each in _strided(iter(list_pictures(path)), request, frames, path)]
    elif path.suffix.lower() == ".npy":
        array = read_npy(path, "depth [T, H, W] in metres as .npy")
        if array.ndim != 3:
            raise SourceError(f"{path} must hold depth [T, H, W] in metres, got {array.dtype} {list(array.shape)}")
        chosen = _strided(iter(array), request, frames, path)
    elif still:
        chosen = [read_depth(path)] * frames
    else:
        raise SourceError(
            f"{path} is the depth of one frame, wanted that of {frames}; give a folder or [T, H, W] as .npy"
        )
    return [clean_depth(each, (high, wide)) for each in chosen]


def _stacked(depth: list[DepthPicture]) -> torch.Tensor:
    """[T, H, W]. Raises DepthError if there is none in it."""
    stacked = np.stack(depth)
    if not stacked.any():
        raise DepthError("the depth of every frame is all holes; look at what measured it, or leave it out")
    return torch.from_numpy(stacked)


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
    if request.fps is None and source_fps is None:
        return traits.fps
    own = request.fps or (source_fps or 0.0) / request.stride
    near = [rate for rate in traits.rates if abs(own / rate - 1) <= _RATE_TOLERANCE]
    if not near and traits.rates:
        rates = ", ".join(f"{rate:g}" for rate in traits.rates)
        _LOG.warning("the clip runs at %g frames per second; %s was trained at %s", own, traits.name, rates)
    if request.fps is not None or not near:
        return own
    return min(near, key=lambda rate: abs(own - rate))


# The view.


def plan(
    traits: Traits,
    *,
    change: Sequence[float | None] = (),
    poses: Path | None = None,
    trajectory: str | None = None,
    move_time: int | None = None,
    source: SourcePose | None = None,
    mount: CameraMount | None = None,
) -> Trajectory:
    """The camera path.

    Args:
        change: azimuth and elevation in degrees and radius, destination minus source.
        poses: the whole path instead, .npy of [T, 4, 4] source-from-target.
        trajectory: "gradual" or "direct", or else move_time.
        source, mount: where the source camera stands, if stated.
    Raises:
        UsageError: options that contradict each other, or an unknown kind of trajectory.
        SourceError: a file of no poses. PoseError and its kind: see Traits.plan_view and Traits.plan_poses.
    """
    sphere, delta = stated_sphere(source), None
    if any(number is not None for number in change):
        azimuth_deg, elevation_deg, radius = (number or 0.0 for number in change)
        delta = SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius)
    if poses is not None:
        if delta is not None or trajectory is not None or move_time is not None:
            raise UsageError("--poses states the whole path; leave out the angles, --trajectory and --move-time")
        path = read_npy(poses, "a .npy file of [T, 4, 4]")
        if path.ndim != 3 or path.shape[1:] != (4, 4) or path.dtype.kind not in "fiu":
            raise SourceError(f"poses in {poses} must be numbers [T, 4, 4], got {path.dtype} {list(path.shape)}")
        return traits.plan_poses(torch.from_numpy(path.astype(np.float64)), source=sphere)
    if trajectory is not None and move_time is not None:
        raise UsageError("--trajectory and --move-time say the same thing twice; give one of them")
    times = {None: move_time, "gradual": traits.config.frames - 1, "direct": 0}
    if trajectory not in times:
        raise UsageError(f"--trajectory is gradual or direct, got {trajectory!r}")
    return traits.plan_view(delta, source=sphere, move_time=times[trajectory], mount=mount)


def write_view(out: Path, source: OfflineClip, view: View, classes: Sequence[ClassRecord]) -> list[Path]:
    """Write frames, videos, pictures, class numbers, visibility and depth; gives the paths worth telling.

    classes: the ontology of the view's class map, empty if the model makes none.
    The first sample goes to frames/ and view.mp4, further ones to frames_s1/, view_s1.mp4, and so on.
    Raises OutputError.
    """
    written: list[Path] = []

    def place(name: str) -> Path:
        written.append(out / name)
        return written[-1]

    def write_maps(name: str, maps: Mapping[str, torch.Tensor], meanings: Sequence[ClassRecord] = ()) -> None:
        arrays: dict[str, NDArray[Any]] = {key: numbers.numpy() for key, numbers in maps.items()}
        if meanings:
            arrays["ids"] = np.array([each.id for each in meanings], np.uint8)
            arrays["names"] = np.array([each.name for each in meanings])
            arrays["colours"] = np.array([each.colour for each in meanings], np.uint8)
        write_npz(place(name), arrays)

    for number, sample in enumerate(view.samples):
        ending = f"_s{number}" if number else ""
        frames, folder = to_u8(sample.numpy()), place(f"frames{ending}")
        for index, frame in enumerate(frames):
            write_png(folder / f"{index:04d}.png", frame)
        write_video(place(f"view{ending}.mp4"), list(frames), source.clip.fps)
    pictures, maps = to_u8(view.video.numpy()), list[Image]()
    if view.classes is not None:
        write_maps("classes.npz", {"classes": view.classes}, classes)
        maps = [paint(view.classes[0].numpy(), classes)]
    if view.visibility is not None:
        write_maps("visibility.npz", {"visibility": view.visibility}, VISIBILITY)
        maps = [hatched(pictures, view.visibility.numpy()), *maps]
        write_video(place("seen.mp4"), list(maps[0]), source.clip.fps)
    if view.inverse_depth is not None:
        write_maps("depth.npz", {"inverse_depth": view.inverse_depth})
    moments = spread(len(pictures), _STRIP_FRAMES)
    shown = strip([[row[i] for i in moments] for row in (source.pictures, pictures, *maps)])
    write_png(place("strip.png"), np.concatenate([shown, legend(classes, shown.shape[1])]) if classes else shown)
    if view.std is not None:
        std = view.std.numpy()
        levels = np.rint(std / max(float(std.max()), 1e-6) * 255.0).astype(np.uint8)
        heat = [cv2.applyColorMap(levels[i], cv2.COLORMAP_INFERNO)[..., ::-1] for i in moments]
        write_png(place("uncertainty.png"), side_by_side(*(np.ascontiguousarray(each, np.uint8) for each in heat)))
    return written
