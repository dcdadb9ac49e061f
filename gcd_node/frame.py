"""What a camera gives: pictures with their capture stamps, what every source of them promises, and the lens they were
taken through, from ROS camera_info files, CameraInfo messages or a camera's memory."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray

from gcd_model import FileError, read_small
from gcd_node.errors import ConfigError, SourceError
from gcd_node.sources import SourceKind

Image: TypeAlias = NDArray[np.uint8]
"""u8 [H, W, 3], RGB."""

Clock: TypeAlias = Literal["realtime", "replay"]
"""Domain of a stamp. "realtime": a live source; its stamps are on this host's monotonic clock, and are converted to
UTC when they are published. "replay": of a recording, from its start or from its own clock."""

MAX_FPS = 1000.0
"""Frame rates above this are taken for a mistake."""

MAX_PIXELS = 64_000_000
"""Larger pictures are refused before they are decoded: so many pixels are 192 MB."""

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
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "pinhole": "plumb_bob",  # older camera_info files name the projection instead
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}
_LONGEST_SIDE = 65_536
_SHAPE_TOLERANCE = 0.01
_LARGEST_FILE = 16384
_DEPTHAI_MODELS = {"Perspective": "rational_polynomial", "Fisheye": "equidistant"}
HALF_PIXEL = 0.5
"""OpenCV and ROS count pixels from the centre of the first, this project from its corner."""


# Lenses.


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
        is_finite = all(map(math.isfinite, (self.fx, self.fy, *self.coefficients)))
        is_size = 0 < self.width <= _LONGEST_SIDE and 0 < self.height <= _LONGEST_SIDE
        if not is_finite or not is_size or min(self.fx, self.fy) <= 0:
            raise ConfigError(
                f"sizes must be 1 to {_LONGEST_SIDE} pixels, focal lengths positive, and all numbers finite, got {self}"
            )
        if not (0 <= self.cx < self.width and 0 <= self.cy < self.height):
            raise ConfigError(f"the optical axis must lie in the picture, got {self}; calibrate the camera again")
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


def lens_of_message(message: Any, *, rectified: bool = False) -> LensModel | None:
    """The lens that a CameraInfo of ROS 1 or 2, or a Foxglove CameraCalibration states; None if the camera was never
    calibrated.

    Args:
        message: what is binned or cut off may be missing in it.
        rectified: the pictures are undistorted already: p holds, and there is no distortion left.
    Raises:
        ConfigError: an unknown kind of distortion, or numbers that no camera has.
    Source: the ROS message sensor_msgs/CameraInfo.
    """

    def numbers(name: str) -> tuple[float, ...]:
        return tuple(map(float, getattr(message, name if hasattr(message, name) else name.upper())))

    matrix, columns = (numbers("p"), 4) if rectified else (numbers("k"), 3)
    if not any(matrix):
        return None
    if len(matrix) != 3 * columns:
        raise ConfigError(f"a camera matrix must have {3 * columns} numbers, got {len(matrix)}")
    kind, coefficients = ("none", ()) if rectified else _distortion(message.distortion_model, numbers("d"))
    across, along = (max(getattr(message, name, 1), 1) for name in ("binning_x", "binning_y"))
    part = getattr(message, "roi", None)
    left, top, width, height = (0, 0, 0, 0) if part is None else (part.x_offset, part.y_offset, part.width, part.height)
    whole = LensModel(
        width=width or message.width,
        height=height or message.height,
        fx=matrix[0],
        cx=matrix[2] - left,
        fy=matrix[columns + 1],
        cy=matrix[columns + 2] - top,
        distortion=kind,
        coefficients=coefficients,
    )
    return whole if (across, along) == (1, 1) else whole.resized(whole.width // across, whole.height // along)


def _distortion(model: str, d: tuple[float, ...]) -> tuple[Distortion, tuple[float, ...]]:
    """No coefficients, or zeros, are no distortion under any name: so ROS's image_geometry reads them, and so DepthAI
    marks pictures that it has undistorted, fish-eyes' too."""
    kind = _NAMES.get(model.strip().lower())
    if kind is None:
        raise ConfigError(f"unknown distortion_model {model[:40]!r}; known are {', '.join(_COUNTS)}")
    if not any(d):
        return "none", ()
    if kind == "plumb_bob" and len(d) in _COUNTS["rational_polynomial"]:
        kind = "rational_polynomial"  # the same formula, longer
    return kind, d


def load_lens(path: Path) -> LensModel:
    """Read a ROS camera_info YAML file, as `cameracalibrator` and camera drivers write it.

    Raises:
        ConfigError: missing, not YAML, something in it is missing or no camera has it.
    """
    try:
        # the loader in C would end the process on deep nesting
        content: dict[str, Any] = dict(yaml.safe_load(read_small(path, _LARGEST_FILE)))
        model = content.get("distortion_model") or content.get("camera_model") or "plumb_bob"
        bent = content.get("distortion_coefficients") or {"data": ()}
        info = {"distortion_model": str(model), "d": bent["data"], "k": content["camera_matrix"]["data"]}
        size = {"width": int(content["image_width"]), "height": int(content["image_height"])}
        lens = lens_of_message(SimpleNamespace(**info, **size))
    except (FileError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}; give a ROS camera_info YAML file") from error
    except (yaml.YAMLError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ConfigError(f"{path} is not a ROS camera_info YAML file: {reason}") from error
    if lens is None:
        raise ConfigError(f"{path} holds no calibration: its camera matrix is zero; calibrate the camera")
    return lens


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
    count = 4 if model == "Fisheye" else 14 if any(coefficients[8:14]) else 8  # without prism and tilt
    kind, d = _distortion(_DEPTHAI_MODELS[model], (*coefficients, *[0.0] * count)[:count])
    (fx, _, cx), (_, fy, cy), _ = matrix
    return LensModel(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, distortion=kind, coefficients=d)


# Frames.


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frame:
    """A picture as the camera took it.

    image: u8 [H, W, 3], RGB. The frame takes the array over: it is read-only from here on.
    stamp_ns: when it was captured, on the source's clock.
    seq: the source's own sequence number, gaps included.
    depth: float32 [H, W], metres along the camera's axis at the picture's pixels, 0 where unknown; None without.
    odometry: float64 [4, 4], world_from_camera, rigid, metres, camera axes x right, y down, z ahead, of any world that
        stays the same from frame to frame; None without.
    Raises SourceError for an array of another type or shape.
    """

    image: Image
    stamp_ns: int
    seq: int
    depth: NDArray[np.float32] | None = None
    odometry: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        size = self.image.shape[:2]
        wanted: list[tuple[NDArray[Any] | None, type, tuple[int, ...]]] = [
            (self.image, np.uint8, (*size, 3)), (self.depth, np.float32, size), (self.odometry, np.float64, (4, 4))
        ]  # fmt: skip
        for array, kind, shape in wanted:
            if array is not None and (array.dtype != kind or array.shape != shape or array.size == 0):
                raise SourceError(
                    f"frame {self.seq} must have {kind.__name__} {list(shape)}, got {array.dtype} {list(array.shape)}: "
                    "convert it in the source"
                )
        self.image.setflags(write=False)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceInfo:
    """What is known of a source once it is open.

    kind: as a launch file names it. id: a short name, no folder in it.
    width, height: of the first frame, pixels.
    fps_nominal: the rate the source states; stamps are what counts.
    clock: domain of the stamps.
    codec: of a recording, four characters or a picture format; None if there is none.
    hfov_deg: horizontal field of view, if the source itself knows it.
    lens: calibration the source itself knows, for pictures of the size above.
    stamp_uncertainty_us: how far a stamp may be from mid-exposure.
    optical_frame: TF frame of the camera, x right, y down, z ahead; of a log the pictures' own, else by the kind.
    recorded_after_ns: of a log, when its first picture was recorded, minus that one's stamp: the log's clock may be
        another one.
    """

    kind: SourceKind
    id: str
    width: int
    height: int
    fps_nominal: float
    clock: Clock
    codec: str | None = None
    hfov_deg: float | None = None
    lens: LensModel | None = None
    stamp_uncertainty_us: int = 500
    optical_frame: str = ""
    recorded_after_ns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "optical_frame", self.optical_frame or f"{self.kind}_optical")

    def hfov_in_use(self, stated_deg: float | None) -> float | None:
        """The field of view a launch file states, else what the source itself knows, degrees."""
        return self.hfov_deg if stated_deg is None else stated_deg


class FrameSource(Protocol):
    """Where frames come from. A recording is open once it is made, or raises SourceError; a live source opens beside
    the caller, and `info` waits for it.

    A live source that falls silent only blocks in `frames`: whoever watches it (stall timer) closes it and makes a new
    one. Its stamps may repeat or step back if the device does; the window builder sorts that out.
    """

    @property
    def corrupt(self) -> int:
        """Frames so far that arrived damaged and were not yielded."""
        ...

    @property
    def info(self) -> SourceInfo:
        """What is known of the source; does not change. Of a live one: SourceError if it does not open in time."""
        ...

    def frames(self) -> Iterator[Frame]:
        """Yield frames with rising `stamp_ns`; return at the end; raise SourceLostError if the device is lost.

        Of a recording, every call starts at its beginning. Of a live source, frames the caller was too slow for are
        skipped (their sequence numbers show it): at most the latest four wait.
        """
        ...

    def close(self) -> None:
        """End `frames` within a second, from any thread, for good, even if the device never answers again."""
        ...
