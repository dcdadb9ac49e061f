"""From a camera's picture to the network's: crop, resize, and what that does to the camera's intrinsics."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import Intrinsics, ShapeError, center_crop_box
from gcd_node.errors import ConfigError
from gcd_node.frame import Image

Resize: TypeAlias = Literal["released", "area"]
"""released: bilinear, as in training; it aliases when it shrinks a lot. area: averages, and does not."""

ResizePath: TypeAlias = Literal[Resize, "remap2x_area"]
"""What is published as `src.resize`; remap2x_area: undistorted at twice the size, then averaged."""

_LEVELS = np.arange(256, dtype=np.float32) / np.float32(127.5) - np.float32(1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Fit:
    """How pictures of any size become `width` x `height`: the largest centred crop of that shape, resized.

    resize: the name published as `src.resize`.
    share: how much of the picture's width may be used; less than 1 narrows the field of view.
    allow_upscale: enlarge pictures that are too small instead of refusing them.
    Source: Generative Camera Dolly, loading of custom videos, as released; wire protocol, section 7, F7.
    """

    width: int
    height: int
    resize: Resize = "released"
    share: float = 1.0
    allow_upscale: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:
            raise ConfigError(f"the share of a picture that is used must lie above 0 and up to 1, got {self.share:g}")
        if self.width < 1 or self.height < 1:
            raise ConfigError(f"frames must be fitted to at least 1 x 1 pixels, got {self.width} x {self.height}")

    def crop_box(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The part of a `width` x `height` picture that is used: left, top, width, height, pixels.

        Raises:
            ConfigError: it would have to be enlarged, and `allow_upscale` is not set.
        """
        beside = round(width * (1 - self.share) / 2)
        try:
            left, top, wide, high = center_crop_box(max(1, width - 2 * beside), height, self.width / self.height)
        except ShapeError as error:
            raise ConfigError(str(error)) from error
        if not self.allow_upscale and (wide < self.width or high < self.height):
            raise ConfigError(
                f"a {width} x {height} picture (cropped to {wide} x {high}) is smaller than the {self.width} x "
                f"{self.height} the model takes; use a larger one or set allow_upscale"
            )
        return left + beside, top, wide, high

    def image(self, image: Image) -> Image:
        """Crop and resize one picture: u8 [H, W, 3] to [height, width, 3]. Raises ConfigError as `crop_box`."""
        left, top, wide, high = self.crop_box(image.shape[1], image.shape[0])
        part = image[top : top + high, left : left + wide]
        if (wide, high) == (self.width, self.height):
            return np.ascontiguousarray(part)
        shrinks = self.width < wide or self.height < high
        how = cv2.INTER_AREA if self.resize == "area" and shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, (self.width, self.height), interpolation=how), np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same of a depth picture, [H, W]; no depth between two surfaces is made up. Raises as `crop_box`."""
        left, top, wide, high = self.crop_box(depth.shape[1], depth.shape[0])
        part = np.ascontiguousarray(depth[top : top + high, left : left + wide])
        size = (self.width, self.height)
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)

    def intrinsics(self, source: Intrinsics) -> Intrinsics:
        """The camera of the fitted picture, from the camera of the whole. Raises ConfigError as `crop_box`."""
        return source.cropped(*self.crop_box(source.width, source.height)).resized(self.width, self.height)


def to_clip_tensor(images: Image) -> NDArray[np.float32]:
    """u8 [T, H, W, 3] in 0..255 -> float32 [T, 3, H, W] in [-1, 1], contiguous.

    Raises:
        ConfigError: another type or shape.
    """
    if images.dtype != np.uint8 or images.ndim != 4 or images.shape[3] != 3:
        raise ConfigError(f"images must be u8 [T, H, W, 3], got {images.dtype} {list(images.shape)}")
    count, height, width, _ = images.shape
    clip = np.empty((count, 3, height, width), np.float32)
    for image, planes in zip(images, clip, strict=True):
        write_planes(image, planes)
    return clip


def to_image(planes: NDArray[np.float32]) -> Image:
    """Inverse of write_planes(): float32 [3, H, W] in [-1, 1] -> u8 [H, W, 3], at the nearest level."""
    return np.rint((planes.transpose(1, 2, 0) + 1.0) * 127.5).clip(0, 255).astype(np.uint8)


def write_planes(image: Image, planes: NDArray[np.float32]) -> None:
    """One picture, u8 [H, W, 3] in 0..255, into float32 [3, H, W] in [-1, 1], contiguous."""
    for levels, plane in zip(cv2.split(image), planes, strict=True):
        cv2.LUT(levels, _LEVELS, plane)
