"""The types that cross the door: a Clip goes in, a View comes out."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.config import SemanticClass
from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import CameraMount, Intrinsics, Trajectory
from gcd_model.geometry.pose import require_rigid


@dataclass(frozen=True, kw_only=True, slots=True)
class Clip:
    """A short video as the model takes it.

    video: float32 [T, 3, H, W], RGB in [-1, 1].
    fps: frames per second of the clip itself, not of the camera; the network is told this number.
    mount: how the camera sits on its vehicle, for the live model; None: not known.
    lens, depth, odometry: for the live model, which makes up for what is left out; lens and depth also for
        `visibility_of`.
    lens: of these pictures; None: of the mount's field of view.
    depth: float32 [T, H, W], metres along the axis, instead of the depth network's; 0, negative or not finite: a hole.
    odometry: float64 [T, 4, 4], world_from_camera of any world that stays; None: from the pictures.
    """

    video: Tensor
    fps: float
    mount: CameraMount | None = None
    lens: Intrinsics | None = None
    depth: Tensor | None = None
    odometry: Tensor | None = None

    def __post_init__(self) -> None:
        if self.video.ndim != 4 or self.video.shape[1] != 3:
            raise ShapeError(f"video must be [T, 3, H, W], got {list(self.video.shape)}")
        if self.video.dtype != torch.float32:
            raise ShapeError(f"video must be float32 in [-1, 1], got {self.video.dtype}")
        if not (self.fps > 0 and math.isfinite(self.fps)):
            raise OptionError(f"fps must be a positive number, got {self.fps}")
        frames, _, height, width = self.video.shape
        if self.lens is not None and (self.lens.height, self.lens.width) != (height, width):
            raise ShapeError(f"the lens is of {self.lens.width} x {self.lens.height}, the video of {width} x {height}")
        depth, odometry = self.depth, self.odometry
        if depth is not None and (depth.dtype != torch.float32 or depth.shape != (frames, height, width)):
            found = f"{depth.dtype} {list(depth.shape)}"
            raise ShapeError(f"depth must be float32 [{frames}, {height}, {width}] as the video is, got {found}")
        if odometry is not None:
            if odometry.dtype != torch.float64 or odometry.shape != (frames, 4, 4):
                found = f"{odometry.dtype} {list(odometry.shape)}"
                raise ShapeError(f"odometry must be float64 [{frames}, 4, 4], got {found}")
            require_rigid(odometry, "odometry")

    @property
    def frames(self) -> int:
        """T."""
        return self.video.shape[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class View:
    """The clip as another camera would have seen it. Every pixel is generated.

    samples: float32 [S, T, 3, H, W], RGB in [0, 1], on the CPU; S draws of the same view. Where whole levels were asked
        for, uint8 in 0..255.
    latents: float32 [S, T, C, h, w], what was decoded, in the scaled space the network works in.
    trajectory: the camera path that was asked for.
    motion_bucket: the motion number the network was told.
    classes: uint8 [S, T, H, W], class ids of `Traits.classes`, on the CPU; None for models that make none.
    uncertainty_scale: see `Traits`.
    visibility: uint8 [T, H, W], the same for every draw: 2 where the source camera sees the surface now, 1 where it saw
        it before, 0 where the pixel is painted. None where nobody knows.
    inverse_depth: float32 [T, H, W], 1/m along the view's axis; 0 for the sky and where there is none. A guess under
        painted pixels. None for models that make none.
    log_variance: float32 [T, H, W], log of the variance of the truth about the mean picture, mean over the channels, of
        pictures in [0, 1]. None for models that do not state their own spread.
    ood: how unlike the training the source looks to the model, 0 to 1, mean over the frames. None for models that
        cannot tell.
    lost: for every frame before which all that was remembered had to be forgotten, why: odometry that jumps, or motion
        that the pictures do not tell.
    """

    samples: Tensor
    latents: Tensor
    trajectory: Trajectory
    motion_bucket: float
    classes: Tensor | None = None
    uncertainty_scale: float | None = None
    visibility: Tensor | None = None
    inverse_depth: Tensor | None = None
    log_variance: Tensor | None = None
    ood: float | None = None
    lost: tuple[str, ...] = ()

    @property
    def video(self) -> Tensor:
        """The first sample, [T, 3, H, W]."""
        return self.samples[0]

    @property
    def std(self) -> Tensor | None:
        """What the model states of its own spread; else the population standard deviation over samples, channel mean.

        [T, H, W], None with one sample of a model that states nothing.
        """
        if self.log_variance is not None:
            return (self.log_variance / 2).exp()
        if self.samples.shape[0] < 2:
            return None
        samples = self.samples if self.samples.is_floating_point() else self.samples / 255
        return samples.std(dim=0, correction=0).mean(dim=1)

    @property
    def uncertainty(self) -> Tensor | None:
        """How far the truth lies from the mean of the samples, as a standard deviation: [T, H, W], in parts of 1.

        What the model states of itself; of samples, `std` times the scale that was measured on held-out clips, None
        where nobody measured it.
        """
        std = self.std
        if std is None or self.log_variance is not None:
            return std
        return None if self.uncertainty_scale is None else std * self.uncertainty_scale


@dataclass(frozen=True, kw_only=True, slots=True)
class Augmentation:
    """The noise added in pixel space to the conditioning frames the VAE sees (CLIP sees them clean).

    strength: its standard deviation on frames in [-1, 1]; the network is told this number. None means: as the
        checkpoint was made for.
    seed: where the noise is drawn from.
    noise: float32 [T, 3, H, W], unit variance, used instead of a draw.
    """

    strength: float | None = None
    seed: int = 0
    noise: Tensor | None = None

    def __post_init__(self) -> None:
        if self.strength is not None and not 0 <= self.strength < math.inf:
            raise OptionError(f"the augmentation strength must be 0 or more, got {self.strength}")


# --- what stands where, in colour: class maps, and pixels that nobody saw ---------------------------------------------


_PERIOD, _WIDTH, _AMBER = 6, 2, (245, 158, 11)


def palette(classes: tuple[SemanticClass, ...]) -> Tensor:
    """Colours by class id: uint8 [K, 3], RGB; `palette(classes)[class_map.long()]` paints a map."""
    return torch.tensor([entry.colour for entry in classes], dtype=torch.uint8)


def nearest_classes(pixels: Tensor, classes: tuple[SemanticClass, ...]) -> Tensor:
    """The class whose colour is nearest to each pixel; of equally near ones the first.

    Args:
        pixels: [T, 3, H, W], RGB in [0, 1].
    Returns:
        uint8 [T, H, W].
    """
    colours = palette(classes).to(pixels) / 255  # [K, 3]
    half_square = (colours**2).sum(dim=1) / 2
    # |p - c|^2 = |p|^2 - 2 (p . c - |c|^2 / 2): one product a pixel; frame by frame, to stay small
    frames = [torch.addmm(-half_square[:, None], colours, frame.flatten(1)) for frame in pixels]  # [K, H*W] each
    return torch.stack([frame.max(dim=0).indices for frame in frames]).to(torch.uint8).view(-1, *pixels.shape[-2:])


def hatched(pictures: NDArray[np.uint8], visibility: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Pictures [..., H, W, 3] with thin amber diagonals over painted pixels; what was seen stays as it is.

    visibility: [..., H, W], 0 for painted.
    """
    rows, columns = np.indices(visibility.shape[-2:])
    lines = ((rows + columns) % _PERIOD < _WIDTH) & (visibility == 0)
    return np.where(lines[..., None], pictures // 2 + np.array(_AMBER, np.uint8) // 2, pictures)
