"""The input of `gcd-node synthesize`: a video, a folder, a still or an array becomes one clip of T frames."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import Clip, Intrinsics, Traits
from gcd_node.errors import SourceError, TooShortError, UsageError
from gcd_node.frame import Image
from gcd_node.optics.preprocess import Fit, to_clip_tensor
from gcd_node.pictures.array_file import read_npy
from gcd_node.sources.image_folder import SUFFIXES, ImageFolder, read_picture
from gcd_node.sources.video_file import VideoFile

_LOG = logging.getLogger(__name__)
_RATE_TOLERANCE = 0.05


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipRequest:
    """Which frames of the input, at what size, under which frame rate.

    start, stride: in frames of the input. fps: what the network is told; else worked out.
    height, width: else the trained size. An array keeps its own size.
    hfov_deg: horizontal field of view of the input's pictures, if known.
    """

    start: int = 0
    stride: int = 1
    fps: float | None = None
    height: int | None = None
    width: int | None = None
    hfov_deg: float | None = None

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1:
            raise UsageError(f"--start must be 0 or more and --stride 1 or more, got {self.start} and {self.stride}")
        if (self.height is None) != (self.width is None):
            raise UsageError("--height and --width go together; give both or none")


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
    """
    if path.suffix.lower() == ".npy" and not path.is_dir():
        return _from_array(path, request, traits)
    height = traits.config.height if request.height is None else request.height
    width = traits.config.width if request.width is None else request.width
    traits.check_size(height, width)
    images, source_fps = _pictures(path, request, traits.config.frames)
    fit = Fit(width=width, height=height, allow_upscale=True)
    fitted = np.stack([fit.image(image) for image in images])
    clip = Clip(video=torch.from_numpy(to_clip_tensor(fitted)), fps=_label(request, source_fps, traits))
    hfov_deg = request.hfov_deg
    if hfov_deg is not None:
        hfov_deg = fit.intrinsics(Intrinsics.from_hfov(hfov_deg, images[0].shape[1], images[0].shape[0])).hfov_deg
    return OfflineClip(clip=clip, pictures=fitted, hfov_deg=hfov_deg)


def _pictures(path: Path, request: ClipRequest, frames: int) -> tuple[list[Image], float | None]:
    """T pictures and the input's frame rate, None if it has none."""
    if path.is_dir():
        return _strided((frame.image for frame in ImageFolder(path, fps=1.0).frames()), request, frames, path), None
    if path.suffix.lower() in SUFFIXES:
        return [read_picture(path)] * frames, None
    video = VideoFile(path)
    images = _strided((frame.image for frame in video.frames()), request, frames, path)
    return images, video.info.fps_nominal


def _strided(images: Iterator[Image], request: ClipRequest, frames: int, path: Path) -> list[Image]:
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
    clip = Clip(video=video, fps=_label(request, None, traits))
    return OfflineClip(clip=clip, pictures=pictures, hfov_deg=request.hfov_deg)


def _load_array(path: Path) -> NDArray[np.float32]:
    array = read_npy(path, "float32 [T, H, W, 3] in [0, 1] as .npy")
    if array.dtype != np.float32 or array.ndim != 4 or array.shape[3] != 3:
        found = f"{array.dtype} {list(array.shape)}"
        raise SourceError(f"{path} must hold float32 [T, H, W, 3] in [0, 1], got {found}")
    if array.size and not (np.isfinite(array).all() and array.min() >= 0.0 and array.max() <= 1.0):
        raise SourceError(f"{path} must hold finite numbers in [0, 1]; scale them first")
    return array
