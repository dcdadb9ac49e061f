"""Depth from elsewhere, in place of the live model's own: a topic's or a file's (clean_depth), or a network's of the
user (OnnxDepth)."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import CameraMount, Intrinsics
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image

DepthPicture: TypeAlias = NDArray[np.float32]
"""[H, W], metres along the camera's axis; 0 is unknown, a hole."""

DepthSource: TypeAlias = Callable[[Image], DepthPicture]
"""Of a picture, u8 [H, W, 3]. Raises DepthError: this picture cannot be used, the next may be."""

_SHAPE_TOLERANCE = 0.01
_MM = np.float32(1e-3)
_BEYOND_RANGE = 65535  # what cameras send in millimetres for too far
_MEAN, _SPREAD = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)  # of ImageNet's pictures
_PATCH, _TRIAL = 14, 224  # free sizes are rounded to this: what Depth Anything needs; side of a first picture
_FARTHEST_M = 1000.0
_NEAR_GROUND = 1 / 3  # of the nearest ground's inverse depth: farther ground says little about the scale
_GROUND_TOLERANCE = 0.05  # relative
_LEAST_GROUND = 0.25  # of the pixels where it should be
_LEAST_SLANT = 1.3  # nearest over farthest ground: a floor straight below does not tell a scale from a shift
_TRIALS, _REFITS, _MOST_POINTS = 200, 2, 4000


def clean_depth(depth: NDArray[Any], shape: tuple[int, int]) -> DepthPicture:
    """A depth picture as somebody sent it, ready for the model.

    NaN, infinite and negative depth become holes, and so do 65535 mm, "too far" of many cameras. A picture of another
    size but the same shape takes the nearest pixel: a mean over an edge would be a surface that is not there. A picture
    without any depth is allowed.

    Args:
        depth: [H, W] or [H, W, 1], metres as any floating-point type, or millimetres as uint16.
        shape: height and width of the picture it belongs to.
    Raises:
        DepthError: of another type, or of another shape than the picture.
    """
    if depth.ndim == 3 and depth.shape[2] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or depth.size == 0:
        raise DepthError(f"depth must be a picture of one channel, [H, W], got {list(depth.shape)}")
    high, wide = shape
    if abs(depth.shape[1] / wide * high / depth.shape[0] - 1) > _SHAPE_TOLERANCE:
        raise DepthError(
            f"depth must be of the picture's shape, {wide} x {high}, got {depth.shape[1]} x {depth.shape[0]}: "
            "send the depth that is aligned with the picture"
        )
    if depth.dtype == np.uint16:
        metres = np.where(depth == _BEYOND_RANGE, np.float32(0), depth * _MM)
    elif np.issubdtype(depth.dtype, np.floating):
        with np.errstate(over="ignore"):
            metres = depth.astype(np.float32)
        metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
    else:
        raise DepthError(f"depth must be metres as floats, or millimetres as uint16, got {depth.dtype}: convert it")
    if metres.shape != shape:
        metres = np.asarray(cv2.resize(metres, (wide, high), interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
    return metres


class OnnxDepth:
    """A depth network of the user's, one picture at a time, by onnxruntime on one thread of the CPU."""

    def __init__(self, path: Path, *, kind: Literal["metric", "inverse"], scale: CameraMount | None = None) -> None:
        """Open it.

        Args:
            path: an ONNX file: one input, float32 [1, 3, H, W] (RGB, less ImageNet's mean, by its deviation), one
                output, float32 [1, H, W] or [1, 1, H, W].
            kind: what it gives. metric: metres. inverse: relative inverse depth, as MiDaS and Depth Anything do.
            scale: of inverse depth, the camera's mount: the ground is found in every picture and gives scale and shift.
        Raises:
            ConfigError: onnxruntime is not there, or cannot open it; another signature; inverse depth without a scale.
        """
        if kind == "inverse" and scale is None:
            raise ConfigError(f"{path} gives relative depth: state the camera's mount")
        self._path, self._scale = path, scale if kind == "inverse" else None
        self._session = _open_network(path)
        try:
            first = self._session.get_inputs()[0]
            high, wide = first.shape[-2:]
            self._input, fixed = first.name, isinstance(high, int) and isinstance(wide, int)
            self._size: tuple[int, int] | None = (wide, high) if fixed else None
            self._run(np.zeros((_TRIAL, _TRIAL, 3), np.uint8))
        except (DepthError, ValueError, IndexError) as error:  # as of a second input or output, or none
            raise ConfigError(
                "a depth network takes one float32 [1, 3, H, W] and gives one float32 [1, H, W] or [1, 1, H, W]; "
                f"{path} does not: {_first_line(error)}"
            ) from error

    def __call__(self, picture: Image) -> DepthPicture:
        """See DepthSource: the depth of a picture of any size, in the same size.

        Raises:
            DepthError: the network failed, or the ground that gives the scale is not in the picture.
        """
        inverse = self._run(picture)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self._scale is None:
                inverse = np.where(inverse > 0, 1 / inverse, np.float32(np.nan))
            # between the network's pixels, inverse depth is what is linear: on a plane exactly; NaN spreads
            inverse = np.asarray(cv2.resize(inverse, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)
            if self._scale is not None:
                scale, shift = fit_ground(inverse, self._scale)
                inverse = scale * inverse + shift
            return np.where(inverse > 1 / _FARTHEST_M, 1 / inverse, 0).astype(np.float32)

    def _run(self, picture: Image) -> NDArray[np.float32]:
        """The network's output, [h, w]."""
        high, wide = picture.shape[:2]
        size = self._size or tuple(max(_PATCH, round(side / _PATCH) * _PATCH) for side in (wide, high))
        shrinks = size[0] < wide or size[1] < high
        fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        values = (np.asarray(fitted, np.float32) / np.float32(255) - _MEAN) / _SPREAD
        try:
            (output,) = self._session.run(None, {self._input: np.ascontiguousarray(values.transpose(2, 0, 1)[None])})
        except Exception as error:  # of onnxruntime, of many kinds
            raise DepthError(
                f"{self._path} failed on a picture of {size[0]} x {size[1]}: {_first_line(error)}; "
                "export it for pictures of this size"
            ) from error
        found = np.asarray(output)
        if found.ndim not in (3, 4) or any(side != 1 for side in found.shape[:-2]) or found.size == 0:
            raise DepthError(f"{self._path} must give [1, H, W] or [1, 1, H, W], gave {list(found.shape)}")
        return found.reshape(found.shape[-2:]).astype(np.float32)


def fit_ground(inverse: NDArray[np.float32], mount: CameraMount) -> tuple[float, float]:
    """Scale a and shift b for which a y + b is the inverse depth of the ground, 1 / m, where the ground is.

    A quarter of the near ground must be seen: the fit with the most pixels wins (RANSAC, always the same draws).

    Args:
        inverse: [H, W], y; NaN is unknown.
    Raises:
        DepthError: no plane of that height and tilt is in the lower part of the picture.
    """
    high, wide = inverse.shape
    camera = Intrinsics.from_hfov(mount.hfov_deg, wide, high)
    tilt = math.radians(mount.tilt_deg)
    rows = ((np.arange(high) + 0.5 - camera.cy) / camera.fy * math.cos(tilt) + math.sin(tilt)) / mount.height_m
    ground = np.broadcast_to(rows[:, None], inverse.shape)
    where = np.flatnonzero((ground > _NEAR_GROUND * rows.max()) & np.isfinite(inverse))
    where = where[:: 1 + where.size // _MOST_POINTS]
    y, wanted = inverse.ravel()[where].astype(np.float64), ground.ravel()[where]
    if y.size < 2 or wanted.max() < _LEAST_SLANT * wanted.min():
        raise DepthError(
            "the mount's ground is not in the picture, or all about as far away, which fits any scale: check the "
            "mount, or use a network that gives metres"
        )
    i, j = np.random.default_rng(0).integers(y.size, size=(2, _TRIALS))
    with np.errstate(all="ignore"):  # two points of one depth give no line
        a = (wanted[i] - wanted[j]) / (y[i] - y[j])
        off = np.abs(a[:, None] * y + (wanted[i] - a * y[i])[:, None] - wanted)
    fitting = (off < _GROUND_TOLERANCE * wanted) & (a > 0)[:, None]
    best = max(fitting, key=np.count_nonzero)
    if (share := np.count_nonzero(best) / y.size) < _LEAST_GROUND:
        raise DepthError(
            f"the ground of a camera {mount.height_m:g} m up, tilted {mount.tilt_deg:g} degrees, must fit "
            f"{_LEAST_GROUND:.0%} of the lower picture, it fits {share:.0%}: check the mount"
        )
    scale = shift = 0.0
    for _ in range(_REFITS):
        scale, shift = map(float, np.polyfit(y[best], wanted[best], 1))
        best = np.abs(scale * y + shift - wanted) < _GROUND_TOLERANCE * wanted
    return scale, shift


def _open_network(path: Path) -> Any:
    """A session of onnxruntime. Raises ConfigError."""
    if not path.is_file():
        raise ConfigError(f"there is no depth network {path}; check the path")
    try:
        import onnxruntime
    except ImportError as error:
        raise ConfigError(f"a depth network needs onnxruntime ({error}): pip install 'gcd-node[onnx]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # as above
        raise ConfigError(f"onnxruntime cannot open {path}: {_first_line(error)}; export it again") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
