"""The pinhole camera, and the crop that brings a picture to the trained shape."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gcd_model.errors import OptionError, ShapeError


@dataclass(frozen=True, kw_only=True, slots=True)
class Intrinsics:
    """A distortion-free camera: u = fx x / z + cx, v = fy y / z + cy, all in pixels.

    u and v count from the top left corner of the picture, so a centred camera has cx = width / 2 and resizing just
    scales. An OpenCV calibration counts from the centre of the first pixel: add 0.5 to its cx and cy.
    Raises OptionError for a focal length that is not positive, ShapeError for an empty picture.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ShapeError(f"a picture must be at least 1 x 1, got {self.width} x {self.height}")
        if not all(math.isfinite(number) for number in (self.fx, self.fy, self.cx, self.cy)):
            raise OptionError(f"intrinsics must be finite, got {self}")
        if self.fx <= 0.0 or self.fy <= 0.0:
            raise OptionError(f"focal lengths must be positive pixels, got fx {self.fx:g}, fy {self.fy:g}")

    @classmethod
    def from_hfov(cls, hfov_deg: float, width: int, height: int) -> "Intrinsics":
        """A centred camera with square pixels that sees `hfov_deg` across its width.

        Raises:
            OptionError: the angle is not within 0..180 degrees.
        """
        if not 0.0 < hfov_deg < 180.0:
            raise OptionError(f"a horizontal field of view must lie between 0 and 180 degrees, got {hfov_deg:g}")
        focal = width / 2 / math.tan(math.radians(hfov_deg) / 2)
        return cls(fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height)

    @property
    def matrix(self) -> Tensor:
        """float64 [3, 3], from camera axes to homogeneous pixels."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=torch.float64)

    def rays(self, device: torch.device | None = None) -> Tensor:
        """x / z and y / z through each pixel's centre: float32 [2, H, W]."""
        x = (torch.arange(self.width, dtype=torch.float32, device=device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=torch.float32, device=device) + 0.5 - self.cy) / self.fy
        return torch.stack(torch.meshgrid(x, y, indexing="xy"))

    @property
    def hfov_deg(self) -> float:
        """Angle from the left to the right edge, degrees."""
        return _angle_deg(self.fx, self.cx, self.width)

    @property
    def vfov_deg(self) -> float:
        """Angle from the upper to the lower edge, degrees."""
        return _angle_deg(self.fy, self.cy, self.height)

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The camera of the same picture at another size; the angles stay."""
        across, along = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * across, self.fy * along, self.cx * across, self.cy * along
        return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> "Intrinsics":
        """The camera of a part of the picture, in pixels; the focal lengths stay.

        Raises:
            ShapeError: the part is empty or reaches over the edge.
        """
        if left < 0 or top < 0 or left + width > self.width or top + height > self.height:
            raise ShapeError(
                f"a crop must stay inside the {self.width} x {self.height} picture, "
                f"got {width} x {height} at ({left}, {top})"
            )
        return replace(self, cx=self.cx - left, cy=self.cy - top, width=width, height=height)


def center_crop_box(width: int, height: int, aspect: float, tolerance: float = 2e-3) -> tuple[int, int, int, int]:
    """The largest centred part of a picture that has a given shape.

    Args:
        width, height: of the picture, pixels.
        aspect: wanted width / height.
        tolerance: a picture whose own width / height is this near is taken whole.
    Returns:
        left, top, width, height of the part, whole pixels, rounded down.
    Raises:
        ShapeError: an empty picture, or a shape that leaves no pixel. OptionError: an aspect that is not positive.
    Source: the preparation of custom videos for Generative Camera Dolly.
    """
    if width < 1 or height < 1:
        raise ShapeError(f"a picture must be at least 1 x 1, got {width} x {height}")
    if not (math.isfinite(aspect) and aspect > 0.0):
        raise OptionError(f"an aspect must be a positive number, width / height, got {aspect}")
    surplus = width / height - aspect
    if abs(surplus) <= tolerance:
        return 0, 0, width, height
    kept_width, kept_height = (int(height * aspect), height) if surplus > 0 else (width, int(width / aspect))
    if kept_width < 1 or kept_height < 1:
        raise ShapeError(f"a picture of {width} x {height} has no part of aspect {aspect:g}; give a larger one")
    return (width - kept_width) // 2, (height - kept_height) // 2, kept_width, kept_height


def _angle_deg(focal: float, centre: float, size: int) -> float:
    return math.degrees(math.atan(centre / focal) + math.atan((size - centre) / focal))
