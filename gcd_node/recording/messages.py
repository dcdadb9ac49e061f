"""ROS messages of a recording as bytes. Definitions: schemas.py."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_node.health.report import Level
from gcd_node.optics.calibration import LensModel
from gcd_node.recording.cdr import CdrWriter

_UPRIGHT = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_NO_BINNING_AND_WHOLE = (0, 0, 0, 0, 0, 0)  # binning across and down, then the region of interest
_UNKNOWN = (0.0,) * 9


@dataclass(frozen=True, kw_only=True, slots=True)
class Stamped:
    """Head of a ROS message. stamp_ns: when it was captured. frame_id: of the camera."""

    stamp_ns: int
    frame_id: str


@dataclass(frozen=True, kw_only=True, slots=True)
class DiagnosticStatus:
    """How one part of the node does."""

    name: str
    level: Level
    message: str
    hardware_id: str
    values: Mapping[str, str]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FrameTransform:
    """Where a camera stands in another one's axes. parent_from_child: [4, 4], rigid, metres."""

    stamp_ns: int
    parent: str
    child: str
    parent_from_child: NDArray[np.float64]


def string(text: str) -> bytes:
    """std_msgs/String."""
    return CdrWriter().text(text).done()


def float64(value: float) -> bytes:
    """std_msgs/Float64."""
    return CdrWriter().number("d", value).done()


def compressed_image(head: Stamped, coded: bytes | memoryview) -> bytes:
    """sensor_msgs/CompressedImage of a JPEG."""
    return CdrWriter().header(head.stamp_ns, head.frame_id).text("jpeg").blob(coded).done()


def image(head: Stamped, pixels: NDArray[np.uint8] | NDArray[np.float32]) -> bytes:
    """sensor_msgs/Image: u8 [H, W, 3] as rgb8 and [H, W, 1] as mono8; depth in metres [H, W, 1] as 32FC1 (REP 118)."""
    height, width, channels = pixels.shape
    writer = CdrWriter().header(head.stamp_ns, head.frame_id).number("I", height).number("I", width)
    encoding = "32FC1" if pixels.dtype == np.float32 else "rgb8" if channels == 3 else "mono8"
    writer.text(encoding).number("B", 0).number("I", width * channels * pixels.itemsize)
    return writer.blob(np.ascontiguousarray(pixels).data.cast("B")).done()


def source_camera(head: Stamped, size: tuple[int, int], lens: LensModel | None) -> bytes:
    """sensor_msgs/CameraInfo of pictures of `size` (width, height); where nobody knows the lens, or only that of
    pictures of another shape, k is all zero as ROS wants."""
    if lens is None or not lens.fits(*size):
        return _camera_info(head, size, "", (), _UNKNOWN)
    lens = lens.resized(*size)
    kind = "plumb_bob" if lens.distortion == "none" else lens.distortion
    coefficients = lens.coefficients or (0.0,) * 5
    return _camera_info(head, size, kind, coefficients, (lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0))


def view_camera(head: Stamped, size: tuple[int, int], k: Sequence[float]) -> bytes:
    """sensor_msgs/CameraInfo of generated pictures, which have no distortion. k: row by row."""
    return _camera_info(head, size, "plumb_bob", (0.0,) * 5, k)


def _camera_info(
    head: Stamped, size: tuple[int, int], distortion: str, d: Sequence[float], k: Sequence[float]
) -> bytes:
    width, height = size
    p = (*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0)
    writer = CdrWriter().header(head.stamp_ns, head.frame_id).number("I", height).number("I", width).text(distortion)
    writer.listed("d", d).numbers("d", k).numbers("d", _UPRIGHT).numbers("d", p)
    return writer.numbers("I", _NO_BINNING_AND_WHOLE).number("B", 0).done()


def diagnostics(stamp_ns: int, parts: Sequence[DiagnosticStatus]) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    writer = CdrWriter().header(stamp_ns, "").number("I", len(parts))
    for part in parts:
        writer.number("B", int(part.level)).text(part.name).text(part.message).text(part.hardware_id)
        writer.number("I", len(part.values))
        for key, value in part.values.items():
            writer.text(key).text(value)
    return writer.done()


def transforms(each: Sequence[FrameTransform]) -> bytes:
    """tf2_msgs/TFMessage."""
    writer = CdrWriter().number("I", len(each))
    for one in each:
        writer.header(one.stamp_ns, one.parent).text(one.child)
        writer.numbers("d", one.parent_from_child[:3, 3].tolist())
        writer.numbers("d", quaternion(one.parent_from_child[:3, :3]))
    return writer.done()


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation matrix [3, 3], from its largest component, so that nothing is divided by little.

    Source: Shepperd, Quaternion from rotation matrix, 1978.
    """
    diagonal = rotation.diagonal()
    squares = np.array([*(1 + 2 * diagonal - diagonal.sum()), 1 + diagonal.sum()]) / 4  # x, y, z, w, squared
    largest = int(squares.argmax())
    quarter = 4 * float(np.sqrt(squares[largest]))
    skew, mirror = rotation - rotation.T, rotation + rotation.T
    sums = np.zeros((4, 4))  # 4 times the products of two components
    sums[:3, :3] = mirror
    sums[3, :3] = sums[:3, 3] = skew[2, 1], skew[0, 2], skew[1, 0]
    found = sums[largest] / quarter
    found[largest] = quarter / 4
    return float(found[0]), float(found[1]), float(found[2]), float(found[3])
