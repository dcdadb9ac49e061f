"""Depth from elsewhere, in place of the live model's own: what every source of it promises, and the door it enters by.

picture, depth = source(left, right)        StereoDepth (depth_stereo.py)
picture, depth = source(picture)            OnnxDepth (this file)
depth = clean_depth(message, (height, width))    a topic, a file, a caller
"""

import math
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import CameraMount, Intrinsics
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image

DepthPicture: TypeAlias = NDArray[np.float32]
"""[H, W], metres along the camera's axis; 0 is unknown, a hole."""

_SHAPE_TOLERANCE = 0.01
_MM = np.float32(1e-3)
_BEYOND_RANGE = 65535  # what cameras send in millimetres for too far
_RGB = 3
_MEAN, _SPREAD = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)  # of ImageNet's pictures
_PATCH = 14  # free sizes are rounded to this: what Depth Anything needs
_FARTHEST_M = 1000.0
_NEAR_GROUND = 1 / 3  # of the nearest ground's inverse depth: farther ground says little about the scale
_GROUND_TOLERANCE = 0.05  # relative
_LEAST_GROUND = 0.25  # of the pixels where it should be
_LEAST_SLANT = 1.3  # nearest over farthest ground: a floor straight below does not tell a scale from a shift
_TRIALS, _REFITS, _MOST_POINTS = 200, 2, 4000


class DepthSource(Protocol):
    """Measures or estimates the depth of one moment, from the picture or pictures taken then."""

    def __call__(self, *pictures: Image) -> tuple[Image, DepthPicture]:
        """The picture, u8 [H, W, 3], and the depth of each of its pixels; the picture may be a rectified one.

        Raises:
            DepthError: these pictures cannot be used; the next ones may be.
        """
        ...


def clean_depth(depth: NDArray[Any], shape: tuple[int, int]) -> DepthPicture:
    """A depth picture as somebody sent it, ready for the model.

    NaN, infinite and negative depth become holes, and so do 65535 mm, "too far" of many cameras. A picture of another
    size but the same shape takes the nearest pixel: a mean over an edge would be a surface that is not there. A picture
    without any depth is allowed: `known_share` tells.

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
    metres = _to_metres(depth)
    if metres.shape != shape:
        metres = np.asarray(cv2.resize(metres, (wide, high), interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
    return metres


def _to_metres(depth: NDArray[Any]) -> DepthPicture:
    if depth.dtype == np.uint16:
        return np.where(depth == _BEYOND_RANGE, np.float32(0), depth * _MM)
    if not np.issubdtype(depth.dtype, np.floating):
        raise DepthError(
            f"depth must be metres as float32 or float16, or millimetres as uint16, got {depth.dtype}: convert it"
        )
    with np.errstate(over="ignore"):
        metres = depth.astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))


def known_share(depth: DepthPicture) -> float:
    """Share of the pixels that have a depth, 0 to 1."""
    return float(np.count_nonzero(depth) / depth.size)


def require_known(depth: DepthPicture) -> DepthPicture:
    """The same depth. Raises DepthError if it is all holes: nothing can be seen by that."""
    if not depth.any():
        raise DepthError(f"a depth of {depth.shape[1]} x {depth.shape[0]} is all holes: look at what measures it")
    return depth


def require_picture(picture: Image, name: str) -> Image:
    """The picture as u8 [H, W, 3]; a grey one, [H, W] or [H, W, 1], is repeated. Raises DepthError for others."""
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[..., 0]
    if picture.dtype != np.uint8 or picture.size == 0 or picture.shape[2:] not in ((), (_RGB,)):
        raise DepthError(
            f"the {name} picture must be u8 [H, W, 3] or [H, W], got {picture.dtype} {list(picture.shape)}"
        )
    return picture if picture.ndim == _RGB else np.repeat(picture[..., None], _RGB, axis=2)


class OnnxDepth:
    """A depth network of the user's, one picture at a time, computed by onnxruntime on one thread of the CPU."""

    def __init__(
        self,
        path: Path,
        *,
        kind: Literal["metric", "inverse"],
        scale: "CameraMount | tuple[float, float] | None" = None,
        size: tuple[int, int] | None = None,
        normalise: Literal["imagenet", "unit"] = "imagenet",
    ) -> None:
        """Open it.

        Args:
            path: an ONNX file: one input, float32 [1, 3, H, W] (RGB), one output, float32 [1, H, W] or [1, 1, H, W].
            kind: what it gives. metric: metres. inverse: relative inverse depth, as MiDaS and Depth Anything do.
            scale: what makes inverse depth of its output y: (a, b) for a y + b in 1 / m (of metric depth, y is one over
                the metres); or the camera's mount, whose ground is found in every picture and gives a and b (of metric
                depth a alone). None leaves metric depth as it is.
            size: width and height of its input, if the file leaves them open; None for about the picture's own.
            normalise: imagenet: less ImageNet's mean, by its deviation; unit: 0 to 1.
        Raises:
            ConfigError: onnxruntime is not there, it cannot open the file, the network has another signature, or
                inverse depth is without a scale.
        """
        if kind == "inverse" and scale is None:
            raise ConfigError(f"{path} gives relative depth: state the camera's mount, or a scale and a shift")
        if isinstance(scale, tuple) and not (all(map(math.isfinite, scale)) and scale[0] > 0):
            raise ConfigError(f"a scale must be a positive number and a finite shift, got {scale}")
        self._path, self._kind, self._scale, self._normalise = path, kind, scale, normalise
        self._session = _open_network(path)
        self._input, fixed = _checked_signature(self._session, path)
        if fixed is not None and size not in (None, fixed):
            raise ConfigError(f"{path} takes pictures of {fixed[0]} x {fixed[1]}, not {size}: leave size out")
        self._size = fixed or size

    def __call__(self, *pictures: Image) -> tuple[Image, DepthPicture]:
        """See DepthSource: one picture, of any size; its depth is of the same size.

        Raises:
            DepthError: not one picture, or the network failed, or the ground that gives the scale is not in it.
        """
        if len(pictures) != 1:
            raise DepthError(f"a depth network takes one picture, got {len(pictures)}")
        picture = require_picture(pictures[0], "source")
        inverse = self._inverse(self._run(picture), (picture.shape[1], picture.shape[0]))
        if isinstance(self._scale, CameraMount):
            scale, shift = fit_ground(inverse, self._scale, shift=self._kind == "inverse")
        else:
            scale, shift = self._scale or (1.0, 0.0)
        scaled = scale * inverse + shift
        known = np.isfinite(scaled) & (scaled > 1 / _FARTHEST_M)
        depth = np.divide(1, scaled, out=np.zeros(scaled.shape, np.float32), where=known, casting="same_kind")
        return picture, depth

    def _run(self, picture: Image) -> NDArray[np.float32]:
        """The network's output, [h, w]."""
        high, wide = picture.shape[:2]
        size = self._size or (_rounded(wide), _rounded(high))
        shrinks = size[0] < wide or size[1] < high
        fitted = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        values = np.asarray(fitted, np.float32) / np.float32(255)
        if self._normalise == "imagenet":
            values = (values - _MEAN) / _SPREAD
        try:
            (output,) = self._session.run(None, {self._input: np.ascontiguousarray(values.transpose(2, 0, 1)[None])})
        except Exception as error:
            if not type(error).__module__.startswith("onnxruntime"):
                raise
            raise DepthError(
                f"{self._path} failed on a picture of {size[0]} x {size[1]}: {_first_line(error)}; "
                "state the size it takes"
            ) from error
        found = np.asarray(output)
        if found.ndim not in (3, 4) or any(side != 1 for side in found.shape[:-2]) or found.size == 0:
            raise DepthError(f"{self._path} must give [1, H, W] or [1, 1, H, W], gave {list(found.shape)}")
        return found.reshape(found.shape[-2:]).astype(np.float32)

    def _inverse(self, output: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
        """Inverse depth up to a scale, [H, W]; NaN where the network says nothing. Between its pixels, inverse depth is
        what is linear: on a plane exactly."""
        known = np.isfinite(output)
        if self._kind == "metric":
            known &= output > 1 / _FARTHEST_M
            output = np.divide(1, output, out=np.zeros_like(output), where=known, casting="same_kind")
        filled = np.where(known, output, np.float32(0))
        inverse = np.asarray(cv2.resize(filled, size, interpolation=cv2.INTER_LINEAR), np.float32)
        if known.all():
            return inverse
        whole = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.where(whole > 1 - 1e-3, inverse, np.float32(np.nan))


def fit_ground(inverse: NDArray[np.float32], mount: CameraMount, *, shift: bool) -> tuple[float, float]:
    """Scale a and shift b for which a y + b is the inverse depth of the ground, 1 / m, where the ground is.

    Most of the near ground may be hidden, a quarter of it must be seen: the fit with the most pixels wins.

    Args:
        inverse: [H, W], y; NaN is unknown.
        shift: whether to fit b; without, it is 0.
    Raises:
        DepthError: no plane of that height and tilt is in the lower part of the picture.
    """
    high, wide = inverse.shape
    camera = Intrinsics.from_hfov(mount.hfov_deg, wide, high)
    tilt = math.radians(mount.tilt_deg)
    rows = ((np.arange(high) + 0.5 - camera.cy) / camera.fy * math.cos(tilt) + math.sin(tilt)) / mount.height_m
    if rows.max() <= 0:
        raise DepthError(f"a camera tilted by {mount.tilt_deg:g} degrees sees no ground: state its mount, or a scale")
    ground = np.broadcast_to(rows[:, None], inverse.shape)
    where = np.flatnonzero((ground > _NEAR_GROUND * rows.max()) & np.isfinite(inverse))
    if where.size > _MOST_POINTS:
        where = np.random.default_rng(0).choice(where, _MOST_POINTS, replace=False)
    y, wanted = inverse.ravel()[where].astype(np.float64), ground.ravel()[where]
    if shift and y.size > 1 and wanted.max() < _LEAST_SLANT * wanted.min():
        raise DepthError("the ground is all about as far away, which fits any scale: state a scale and a shift")
    share, scale = _best_scale(y, wanted, shift=shift)
    if share < _LEAST_GROUND:
        raise DepthError(
            f"the ground of a camera {mount.height_m:g} m up, tilted {mount.tilt_deg:g} degrees, must fit "
            f"{_LEAST_GROUND:.0%} of the lower picture, it fits {share:.0%}: check the mount, or state a scale"
        )
    return scale


def _best_scale(
    y: NDArray[np.float64], wanted: NDArray[np.float64], *, shift: bool
) -> tuple[float, tuple[float, float]]:
    """RANSAC, always the same draws. Returns the share of the pixels on the best line, and its scale and shift."""
    chance, best, line = np.random.default_rng(0), 0, (0.0, 0.0)
    for _ in range(_TRIALS if y.size else 0):
        chosen = chance.integers(y.size, size=2 if shift else 1)
        candidate = _fitted_line(y[chosen], wanted[chosen], shift=shift)
        count = np.count_nonzero(_on_line(y, wanted, candidate)) if candidate[0] > 0 else 0
        if count > best:
            best, line = count, candidate
    for _ in range(_REFITS if best else 0):
        near = _on_line(y, wanted, line)
        line = _fitted_line(y[near], wanted[near], shift=shift)
    return best / max(1, y.size), line


def _on_line(y: NDArray[np.float64], wanted: NDArray[np.float64], line: tuple[float, float]) -> NDArray[np.bool_]:
    return np.abs(line[0] * y + line[1] - wanted) < _GROUND_TOLERANCE * wanted


def _fitted_line(y: NDArray[np.float64], wanted: NDArray[np.float64], *, shift: bool) -> tuple[float, float]:
    """Least squares; a scale of 0 where there is none."""
    if not shift:
        return float(y @ wanted / max(y @ y, 1e-30)), 0.0
    if y.size < 2 or (spread := y - y.mean()) @ spread <= 0:
        return 0.0, 0.0
    a = float(spread @ wanted / (spread @ spread))
    return a, float(wanted.mean() - a * y.mean())


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
    except Exception as error:
        if not type(error).__module__.startswith("onnxruntime"):
            raise
        raise ConfigError(f"onnxruntime cannot open {path}: {_first_line(error)}; export it again") from error


def _checked_signature(session: Any, path: Path) -> tuple[str, tuple[int, int] | None]:
    """Name of the input, and its width and height if the file fixes them. Raises ConfigError for another signature."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    found = ", ".join(f"{each.name} {each.type} {each.shape}" for each in inputs)
    gives = ", ".join(f"{each.name} {each.type} {each.shape}" for each in outputs)
    takes_pictures = len(inputs) == 1 and inputs[0].type == "tensor(float)" and _fits(inputs[0].shape, (1, 3))
    gives_depth = len(outputs) == 1 and outputs[0].type == "tensor(float)"
    if not (takes_pictures and gives_depth and any(_fits(outputs[0].shape, lead) for lead in ((1,), (1, 1)))):
        raise ConfigError(
            f"a depth network takes one float32 [1, 3, H, W] and gives one float32 [1, H, W] or [1, 1, H, W]; {path} "
            f"takes {found or 'nothing'} and gives {gives or 'nothing'}: export it so"
        )
    high, wide = inputs[0].shape[2:]
    return inputs[0].name, (wide, high) if isinstance(high, int) and isinstance(wide, int) else None


def _fits(shape: list[Any], lead: tuple[int, ...]) -> bool:
    """Whether a shape is `lead` and two sides of a picture; names stand for any number."""
    if len(shape) != len(lead) + 2 or any(isinstance(side, int) and side < _PATCH for side in shape[-2:]):
        return False
    return all(not isinstance(side, int) or side == wanted for side, wanted in zip(shape, lead, strict=False))


def _rounded(side: int) -> int:
    return max(_PATCH, round(side / _PATCH) * _PATCH)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
