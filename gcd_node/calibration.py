"""What is known of a lens, and where it comes from: ROS camera_info files, CameraInfo messages, a camera's memory."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

Distortion: TypeAlias = Literal["none", "plumb_bob", "rational_polynomial", "equidistant"]


@dataclass(frozen=True, kw_only=True, slots=True)
class LensModel:
    """A calibrated camera as OpenCV and ROS describe it: pixel coordinates count from the centre of the first pixel.

    width, height: of the pictures it was calibrated for. fx, fy, cx, cy: pixels of those.
    coefficients: of `distortion`, in OpenCV's order.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()
