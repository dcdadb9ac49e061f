"""What is known of a lens, and where it comes from: ROS camera_info files, CameraInfo messages, a camera's memory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model import FileError, read_json, read_small
from gcd_node.errors import ConfigError

Distortion: TypeAlias = Literal["none", "plumb_bob", "rational_polynomial", "equidistant"]

_COUNTS: dict[Distortion, tuple[int, ...]] = {
    "none": (0,),
    "plumb_bob": (4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
_NAMES: dict[str, Distortion] = {
    "": "none",
    "none": "none",
    "plumb_bob": "plumb_bob",
    "pinhole": "plumb_bob",  # older camera_info files name the projection instead
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}
_SHAPE_TOLERANCE = 0.01
_LARGEST_FILE = 16384
_DEPTHAI_MODELS = {"Perspective": 14, "Fisheye": 4}  # and how many coefficients they have
_CAMERA_TYPES = {0: "Perspective", 1: "Fisheye"}
_RATIONAL = 8  # coefficients without prism and tilt
_ROTATION_TOLERANCE = 1e-3
HALF_PIXEL = 0.5
"""OpenCV and ROS count pixels from the centre of the first, this project from its corner."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LensModel:
    """A calibrated camera as OpenCV and ROS describe it: pixel coordinates count from the centre of the first pixel.

    width, height: of the pictures it was calibrated for. fx, fy, cx, cy: pixels of those.
    coefficients: of `distortion`, in OpenCV's order: none has 0, plumb_bob 4 or 5, rational_polynomial 8, 12 or 14,
        equidistant (fish-eye) 4.
    Raises ConfigError for numbers that no camera has.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ConfigError(f"a calibration must be for pictures of some size, got {self.width} x {self.height}")
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.coefficients))):
            raise ConfigError(f"a calibration must hold finite numbers, got {self}; calibrate the camera again")
        if self.fx <= 0 or self.fy <= 0:
            raise ConfigError(f"focal lengths must be positive pixels, got fx {self.fx:g}, fy {self.fy:g}")
        if not (0 <= self.cx < self.width and 0 <= self.cy < self.height):
            raise ConfigError(
                f"the optical axis must lie in the {self.width} x {self.height} picture, got cx {self.cx:g}, "
                f"cy {self.cy:g}"
            )
        if len(self.coefficients) not in _COUNTS[self.distortion]:
            wanted = " or ".join(map(str, _COUNTS[self.distortion]))
            raise ConfigError(f"{self.distortion} distortion has {wanted} coefficients, got {len(self.coefficients)}")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[3, 3], from camera axes (x right, y down, z ahead) to homogeneous pixels of the undistorted picture."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def fits(self, width: int, height: int) -> bool:
        """Whether it is known where the lens is in pictures of that size: they must be of the same shape."""
        return min(width, height) > 0 and abs(width / self.width * self.height / height - 1) <= _SHAPE_TOLERANCE

    def resized(self, width: int, height: int) -> "LensModel":
        """The same lens for the same picture at another size.

        Raises:
            ConfigError: of another shape, so that nobody knows which part of it was kept.
        """
        if not self.fits(width, height):
            raise ConfigError(
                f"the calibration is for {self.width} x {self.height} pictures, the source gives {width} x {height}, "
                "which is another shape; calibrate at the size you run"
            )
        across, along = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * across,
            fy=self.fy * along,
            cx=(self.cx + HALF_PIXEL) * across - HALF_PIXEL,
            cy=(self.cy + HALF_PIXEL) * along - HALF_PIXEL,
        )


def lens_of(
    *,
    width: int,
    height: int,
    model: str,
    d: Sequence[float],
    k: Sequence[float],
    p: Sequence[float] = (),
    binning: tuple[int, int] = (1, 1),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    rectified: bool = False,
) -> LensModel | None:
    """The lens that a ROS CameraInfo or a Foxglove CameraCalibration states; None if the camera was never calibrated.

    Args:
        width, height: of the full picture. model: the name of the distortion, whose coefficients are d.
        k: [9] of the raw picture, all zero if nobody calibrated it; p: [12] of the rectified one, or ().
        binning: pixels joined across and down, 0 and 1 are none. roi: left, top, width, height of the part of the full
            picture that is sent; all 0 is the whole.
        rectified: the pictures are undistorted already: p holds, and there is no distortion left.
    Raises:
        ConfigError: an unknown kind of distortion, or numbers that no camera has.
    Source: the ROS message sensor_msgs/CameraInfo.
    """
    matrix, columns = (p, 4) if rectified else (k, 3)
    if not any(matrix):
        return None
    if len(matrix) != 3 * columns:
        raise ConfigError(f"a camera matrix must have {3 * columns} numbers, got {len(matrix)}")
    kind, coefficients = ("none", ()) if rectified else _distortion(model, tuple(d))
    left, top, part_wide, part_high = roi
    across, along = (max(each, 1) for each in binning)
    whole = LensModel(
        width=part_wide or width,
        height=part_high or height,
        fx=matrix[0],
        cx=matrix[2] - left,
        fy=matrix[columns + 1],
        cy=matrix[columns + 2] - top,
        distortion=kind,
        coefficients=coefficients,
    )
    return whole if (across, along) == (1, 1) else whole.resized(whole.width // across, whole.height // along)


def _distortion(model: str, d: tuple[float, ...]) -> tuple[Distortion, tuple[float, ...]]:
    kind = _NAMES.get(model.strip().lower())
    if kind is None:
        raise ConfigError(f"unknown distortion_model {model[:40]!r}; known are {', '.join(_COUNTS)}")
    if not any(d):  # drivers of ideal cameras send no coefficients, or zeros, under any name but the fish-eye's
        return (kind, (0.0,) * 4) if kind == "equidistant" else ("none", ())
    if kind == "plumb_bob" and len(d) in _COUNTS["rational_polynomial"]:
        kind = "rational_polynomial"  # the same formula, longer
    return kind, d


class _Matrix(msgspec.Struct, frozen=True, kw_only=True):
    data: tuple[float, ...]


class _File(msgspec.Struct, frozen=True, kw_only=True):
    """A camera_info file as ROS calibrators write it; other keys of it are of no interest here."""

    image_width: int
    image_height: int
    camera_matrix: _Matrix
    distortion_coefficients: _Matrix = _Matrix(data=())
    distortion_model: str | None = None
    camera_model: str | None = None


def load_lens(path: Path) -> LensModel:
    """Read a ROS camera_info YAML file, as `cameracalibrator` and camera drivers write it.

    Raises:
        ConfigError: missing, not YAML, something in it is missing or no camera has it.
    """
    try:
        return parse_lens(read_small(path, _LARGEST_FILE), str(path))
    except FileError as error:
        raise ConfigError(
            f"cannot read the calibration {path}: it {error}; give a ROS camera_info YAML file"
        ) from error


def parse_lens(text: str | bytes, name: str) -> LensModel:
    """The same of a file's content; `name` is for messages. Raises ConfigError as `load_lens`."""
    try:
        stated = msgspec.convert(_parse_yaml(text, name), _File, strict=False)  # YAML takes 1e-05 for a word
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name} is not a ROS camera_info file: {error}") from error
    try:
        lens = lens_of(
            width=stated.image_width,
            height=stated.image_height,
            model=stated.distortion_model or stated.camera_model or "plumb_bob",
            d=stated.distortion_coefficients.data,
            k=stated.camera_matrix.data,
        )
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from error
    if lens is None:
        raise ConfigError(f"{name} holds no calibration: its camera matrix is zero; calibrate the camera")
    return lens


def _parse_yaml(text: str | bytes, name: str) -> object:
    try:
        import yaml
    except ImportError as error:
        raise ConfigError("to read a calibration file, PyYAML is needed: pip install pyyaml") from error
    try:
        return yaml.safe_load(text)  # the loader in C would end the process on deep nesting
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"{name} is not valid YAML: {reason}; give a ROS camera_info YAML file") from error


def depthai_lens(
    matrix: Sequence[Sequence[float]], coefficients: Sequence[float], model: str, size: tuple[int, int]
) -> LensModel:
    """A lens as DepthAI describes it.

    Args:
        matrix: 3 x 3 intrinsics, pixels of pictures of `size`, width and height.
        coefficients: of OpenCV's rational model with prism and tilt, or of its fish-eye model; zeros may be left out.
        model: DepthAI's name of it.
    Raises:
        ConfigError: another model, or numbers that no camera has.
    """
    if model not in _DEPTHAI_MODELS or len(matrix) != 3:
        raise ConfigError(f"a lens of model {model} with {len(matrix)} rows of intrinsics is not known here")
    count = _DEPTHAI_MODELS[model]
    full = (*coefficients, *[0.0] * count)[:count]
    distortion: Distortion = "equidistant"
    if model == "Perspective":
        distortion = "rational_polynomial" if any(full) else "none"
        full = full if any(full[_RATIONAL:]) else full[:_RATIONAL] if any(full) else ()
    (fx, _, cx), (_, fy, cy), _ = matrix
    return LensModel(
        width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion, coefficients=full
    )


def read_depthai(path: Path) -> "DepthaiBoard":
    """What DepthAI's `eepromToJsonFile` wrote: the memory of an OAK.

    Raises:
        ConfigError: missing, or not such a file.
    """
    try:
        return read_json(path, DepthaiBoard)
    except FileError as error:
        raise ConfigError(f"it {error}; give the JSON file of DepthAI's eepromToJsonFile") from error


class _Offset(msgspec.Struct, frozen=True, kw_only=True):
    x: float
    y: float
    z: float


class _Extrinsics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """From this camera's axes to those of another on the board; -1 is no other."""

    rotation_matrix: tuple[tuple[float, float, float], ...]
    translation: _Offset  # centimetres
    to_camera_socket: int

    @property
    def transform(self) -> NDArray[np.float64] | None:
        """[4, 4], metres; None if the rotation is none."""
        rotation, transform = np.array(self.rotation_matrix), np.eye(4)
        if rotation.shape != (3, 3):
            return None
        transform[:3, :3] = rotation
        transform[:3, 3] = np.array([self.translation.x, self.translation.y, self.translation.z]) / 100
        proper = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
        return transform if proper else None


class _Camera(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    camera_type: int = 0  # 0 perspective, 1 fish-eye
    width: int
    height: int
    intrinsic_matrix: tuple[tuple[float, float, float], ...]
    distortion_coeff: tuple[float, ...]
    extrinsics: _Extrinsics


class DepthaiBoard(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A DepthAI calibration file; other keys of it are of no interest here."""

    camera_data: tuple[tuple[int, _Camera], ...]

    def _camera(self, socket: int) -> _Camera:
        cameras = dict(self.camera_data)
        if socket not in cameras:
            there = ", ".join(map(str, sorted(cameras))) or "none"
            raise ConfigError(f"there is no camera at socket {socket}, only at {there}")
        return cameras[socket]

    def lens(self, socket: int) -> LensModel:
        """Raises ConfigError: no such camera, or it was never calibrated."""
        camera = self._camera(socket)
        model, size = _CAMERA_TYPES.get(camera.camera_type, str(camera.camera_type)), (camera.width, camera.height)
        try:
            return depthai_lens(camera.intrinsic_matrix, camera.distortion_coeff, model, size)
        except ConfigError as error:
            raise ConfigError(f"the camera at socket {socket}: {error}; calibrate the device") from error

    def transform(self, left: int, right: int) -> NDArray[np.float64]:
        """right_from_left, [4, 4], metres. Raises ConfigError if the file does not connect the two."""
        left_chain, right_chain = self._chain(left), self._chain(right)
        common = next((socket for socket in left_chain if socket in right_chain), None)
        if common is None:
            raise ConfigError(
                f"the file does not say how the cameras at sockets {left} and {right} stand to each other: "
                "calibrate the pair"
            )
        return np.linalg.inv(right_chain[common]) @ left_chain[common]

    def _chain(self, socket: int) -> dict[int, NDArray[np.float64]]:
        """other_from_socket, for each camera that the file leads to from this one; a step without a rotation ends it:
        DepthAI fills what was never calibrated with zeros."""
        chain, here = {socket: np.eye(4)}, socket
        while True:
            extrinsics = self._camera(here).extrinsics
            onward, step = extrinsics.to_camera_socket, extrinsics.transform
            if onward < 0 or onward in chain or step is None:
                return chain
            chain[onward] = step @ chain[here]
            here = onward
