"""The input of `gcd-node synthesize`: a video, folder, still, array or stereo pair becomes one clip of T frames.

Its depth, where there is any, goes the way of its pictures: the same frames, crop and size.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import Clip, Intrinsics, Traits
from gcd_node.errors import DepthError, SourceError, TooShortError, UsageError
from gcd_node.frame import Image
from gcd_node.pictures.array_file import read_npy
from gcd_node.preprocess import Fit, to_clip_tensor
from gcd_node.sources.depth import DepthPicture, DepthSource, clean_depth
from gcd_node.sources.depth_stereo import StereoDepth
from gcd_node.sources.files import PICTURES, ImageFolder, VideoFile, list_pictures, read_depth, read_picture

_LOG = logging.getLogger(__name__)
_RATE_TOLERANCE = 0.05
_Frame = TypeVar("_Frame")


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipRequest:
    """Which frames of the input, at what size, under which frame rate.

    start, stride: in frames of the input. fps: what the network is told; else worked out.
    height, width: else the trained size. An array keeps its own size.
    hfov_deg: horizontal field of view of the input's pictures, if known; of a stereo pair, of the rectified ones.
    depth: of the input's frames: a folder of 16-bit pictures in millimetres, one such picture of a still, or .npy of
        [T, H, W] metres.
    right, calibration: the other video of a stereo pair, frame by frame, and its DepthAI calibration. rectified: the
        device has rectified both.
    """

    start: int = 0
    stride: int = 1
    fps: float | None = None
    height: int | None = None
    width: int | None = None
    hfov_deg: float | None = None
    depth: Path | None = None
    right: Path | None = None
    calibration: Path | None = None
    rectified: bool = False

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1:
            raise UsageError(f"--start must be 0 or more and --stride 1 or more, got {self.start} and {self.stride}")
        if (self.height is None) != (self.width is None):
            raise UsageError("--height and --width go together; give both or none")
        if (self.right is None) != (self.calibration is None):
            raise UsageError("a pair's right video and its calibration go together; give both or none")
        if self.rectified and self.right is None:
            raise UsageError("--rectified is about a stereo pair; give --depth and --calibration, or leave it out")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class OfflineClip:
    """The clip as the model takes it, and its pictures, u8 [T, H, W, 3], for showing.

    hfov_deg: horizontal field of view of these, None if nobody knows.
    """

    clip: Clip
    pictures: Image
    hfov_deg: float | None = None


def read_clip(path: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    """Read T frames of an input.

    Raises:
        SourceError: missing, empty, damaged, undecodable. TooShortError: fewer frames than a clip needs.
        OptionError: a size the network cannot take. UsageError: a size was asked for of an array.
        DepthError: the depth does not belong to the pictures, or there is none. ConfigError: a calibration of no pair.
    """
    if request.right is not None and request.calibration is not None:
        return _from_pair(path, request.right, request.calibration, request, traits)
    if path.suffix.lower() == ".npy" and not path.is_dir():
        return _from_array(path, request, traits)
    width, height = _size(request, traits)
    images, source_fps = _pictures(path, request, traits.config.frames)
    fit = Fit(width=width, height=height, allow_upscale=True)
    fitted = np.stack([fit.image(image) for image in images])
    lens, hfov_deg = None, request.hfov_deg
    if hfov_deg is not None:
        lens = fit.intrinsics(Intrinsics.from_hfov(hfov_deg, images[0].shape[1], images[0].shape[0]))
    still = not path.is_dir() and path.suffix.lower() in PICTURES
    depth = [fit.depth(each) for each in _stated_depth(request, images[0].shape[:2], len(images), still=still)]
    clip = Clip(
        video=torch.from_numpy(to_clip_tensor(fitted)),
        fps=_label(request, source_fps, traits),
        lens=lens,
        depth=_stacked(depth) if depth else None,
    )
    return OfflineClip(clip=clip, pictures=fitted, hfov_deg=None if lens is None else lens.hfov_deg)


def with_depth(source: OfflineClip, network: DepthSource) -> OfflineClip:
    """The same clip with the depth of its pictures. Raises DepthError."""
    depth = _stacked([network(picture)[1] for picture in source.pictures])
    return replace(source, clip=replace(source.clip, depth=depth))


def _from_pair(path: Path, right: Path, calibration: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    """Pictures are the left camera's, rectified."""
    size, frames = _size(request, traits), traits.config.frames
    (left, fps), (other, other_fps) = (_pictures(each, request, frames) for each in (path, right))
    if fps != other_fps:
        raise SourceError(f"{path} runs at {fps}, {right} at {other_fps} frames per second; give one recording's two")
    stereo = StereoDepth.from_depthai(
        calibration,
        size=size,
        rectified=request.rectified,
        hfov_deg=request.hfov_deg,
        match_scale=2 if left[0].shape[1] >= 2 * size[0] else 1,
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


def _stated_depth(
    request: ClipRequest, shape: tuple[int, ...], frames: int, *, still: bool = False
) -> list[DepthPicture]:
    """Of the chosen frames, as large as the input's pictures, [H, W]; empty without. still: they are one picture."""
    path, (high, wide) = request.depth, shape
    if path is None:
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


def _pictures(path: Path, request: ClipRequest, frames: int) -> tuple[list[Image], float | None]:
    """T pictures and the input's frame rate, None if it has none."""
    if path.is_dir():
        return _strided((frame.image for frame in ImageFolder(path, fps=1.0).frames()), request, frames, path), None
    if path.suffix.lower() in PICTURES:
        return [read_picture(path)] * frames, None
    video = VideoFile(path)
    images = _strided((frame.image for frame in video.frames()), request, frames, path)
    return images, video.info.fps_nominal


def _strided(images: Iterator[_Frame], request: ClipRequest, frames: int, path: Path) -> list[_Frame]:
    last = request.start + (frames - 1) * request.stride
    chosen = list(islice(images, request.start, last + 1, request.stride))
    if len(chosen) < frames:
        raise _too_short(path, request, frames, len(chosen))
    return chosen


def _too_short(path: Path, request: ClipRequest, wanted: int, found: int) -> TooShortError:
    return TooShortError(
        f"TOO_SHORT n={found}: {path} gives {found} of {wanted} frames from --start {request.start} with --stride "
        f"{request.stride}; start earlier, take a smaller stride, or give a longer clip"
    )


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


def _from_array(path: Path, request: ClipRequest, traits: Traits) -> OfflineClip:
    if request.height is not None:
        raise UsageError("a .npy input keeps its own size; leave out --height and --width")
    array = _load_array(path)
    traits.check_size(*array.shape[1:3])
    frames = traits.config.frames
    chosen = array[request.start :: request.stride][:frames]
    if len(chosen) < frames:
        raise _too_short(path, request, frames, len(chosen))
    video = torch.from_numpy(np.ascontiguousarray(chosen.transpose(0, 3, 1, 2))) * 2.0 - 1.0
    pictures = np.rint(chosen * 255.0).astype(np.uint8)
    hfov_deg, (height, width) = request.hfov_deg, video.shape[-2:]
    lens = None if hfov_deg is None else Intrinsics.from_hfov(hfov_deg, width, height)
    depth = _stated_depth(request, (height, width), frames)
    label = _label(request, None, traits)
    clip = Clip(video=video, fps=label, lens=lens, depth=_stacked(depth) if depth else None)
    return OfflineClip(clip=clip, pictures=pictures, hfov_deg=request.hfov_deg)


def _load_array(path: Path) -> NDArray[np.float32]:
    array = read_npy(path, "float32 [T, H, W, 3] in [0, 1] as .npy")
    if array.dtype != np.float32 or array.ndim != 4 or array.shape[3] != 3:
        found = f"{array.dtype} {list(array.shape)}"
        raise SourceError(f"{path} must hold float32 [T, H, W, 3] in [0, 1], got {found}")
    if array.size and not (np.isfinite(array).all() and array.min() >= 0.0 and array.max() <= 1.0):
        raise SourceError(f"{path} must hold finite numbers in [0, 1]; scale them first")
    return array
