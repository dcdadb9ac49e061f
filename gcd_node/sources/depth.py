"""Depth from elsewhere, in place of the live model's own: a topic's or a file's (clean_depth), a network's of the user
(OnnxDepth), or that of two cameras side by side (StereoDepth)."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import CameraMount, Intrinsics
from gcd_node.calibration import HALF_PIXEL, LensModel, load_stereo
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image
from gcd_node.preprocess import Rectifier, seen_pixels, widest_camera

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

_LEFT_SOCKET, _RIGHT_SOCKET = 1, 2  # CAM_B and CAM_C
_SHORTEST_M, _LONGEST_M = 0.005, 2.0  # of baselines
_MOST_TURNED_DEG = 30.0
_WIDEST_DEG = 120.0
_NEAREST_M = 0.5  # nearer than this, depth is unknown; the time of matching grows as it falls
_BLOCK = 5  # pixels; less is noisier, more rounds heads off
_STEPS = 16  # of SGBM's disparities in a pixel
_LEAST_DISPARITY = 1.0  # pixels; SGBM errs by a quarter of one: farther away that is most of the depth
_LEAST_CORNERS = 50
_MOST_ROWS_OFF = 1 / 256  # of the width; an OAK's own calibration was off by 1/1000, foreign ones by 4 to 14
_SPECKLE_SHARE = 1e-3  # of the picture; smaller patches that stand alone in depth are mistakes


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
        self._path, self._kind, self._scale = path, kind, scale
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
        scaled = self._inverse(self._run(picture), (picture.shape[1], picture.shape[0]))
        if self._kind == "inverse" and self._scale is not None:
            scale, shift = fit_ground(scaled, self._scale)
            scaled = scale * scaled + shift
        known = np.isfinite(scaled) & (scaled > 1 / _FARTHEST_M)
        return np.divide(1, scaled, out=np.zeros(scaled.shape, np.float32), where=known, casting="same_kind")

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
    if rows.max() <= 0:
        raise DepthError(f"a camera tilted by {mount.tilt_deg:g} degrees sees no ground: state its mount")
    ground = np.broadcast_to(rows[:, None], inverse.shape)
    where = np.flatnonzero((ground > _NEAR_GROUND * rows.max()) & np.isfinite(inverse))
    if where.size > _MOST_POINTS:
        where = np.random.default_rng(0).choice(where, _MOST_POINTS, replace=False)
    y, wanted = inverse.ravel()[where].astype(np.float64), ground.ravel()[where]
    if y.size > 1 and wanted.max() < _LEAST_SLANT * wanted.min():
        raise DepthError("the ground is all about as far away, which fits any scale: use a network that gives metres")
    i, j = np.random.default_rng(0).integers(max(1, y.size), size=(2, _TRIALS if y.size else 0))
    with np.errstate(all="ignore"):  # two points of one depth give no line
        a = (wanted[i] - wanted[j]) / (y[i] - y[j])
        off = np.abs(a[:, None] * y + (wanted[i] - a * y[i])[:, None] - wanted)
    fitting = (off < _GROUND_TOLERANCE * wanted) & (a > 0)[:, None]
    best = max(fitting, key=np.count_nonzero, default=np.zeros(y.size, np.bool_))
    if np.count_nonzero(best) < _LEAST_GROUND * max(1, y.size):
        raise DepthError(
            f"the ground of a camera {mount.height_m:g} m up, tilted {mount.tilt_deg:g} degrees, must fit "
            f"{_LEAST_GROUND:.0%} of the lower picture, it fits {np.count_nonzero(best) / max(1, y.size):.0%}: "
            "check the mount"
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


# Two cameras side by side.


class StereoDepth:
    """Rectifies a left and a right picture and measures the depth of the left one by OpenCV's SGBM.

    The picture it gives is that of an ideal camera, `lens`, whose rows lie along the baseline: turned a little away
    from the left camera's own axis. Depth is along the ideal camera's axis.
    """

    def __init__(
        self,
        lenses: tuple[LensModel, LensModel],
        right_from_left: NDArray[np.float64],
        *,
        size: tuple[int, int],
        hfov_deg: float | None = None,
        match_scale: Literal[1, 2] = 1,
    ) -> None:
        """Work out the ideal camera and how to get there.

        Args:
            lenses: of the left and the right camera; `right_from_left`: [4, 4] rigid transform, metres.
            size: width and height of the rectified picture and its depth.
            hfov_deg: horizontal field of view of the rectified picture; None for the widest of which the left lens
                sees every pixel. Of a wider one, what no lens sees is black, without depth.
            match_scale: matches at this many times the size. 2 doubles the farthest depth, in eight times the time.
        Raises:
            ConfigError: these are not two cameras side by side, or this size cannot be matched.
        """
        if hfov_deg is not None and not 0 < hfov_deg <= _WIDEST_DEG:
            raise ConfigError(f"hfov_deg must be over 0 and at most {_WIDEST_DEG:g} degrees, got {hfov_deg:g}")
        self.baseline_m = _checked_baseline(right_from_left)
        turns = _rectifying_turns(right_from_left)
        if hfov_deg is None:
            self.lens = widest_camera(lenses[0], *size, None, turns[0])
        else:
            self.lens = Intrinsics.from_hfov(hfov_deg, *size)
        self._scale, fine = match_scale, self.lens.resized(*(match_scale * side for side in size))
        u, v = np.arange(fine.width) + HALF_PIXEL, np.arange(fine.height) + HALF_PIXEL
        pair = list(zip(lenses, turns, strict=True))
        self._seen = [seen_pixels(lens, fine, u, v, turn)[1] for lens, turn in pair]
        self._views = [Rectifier(lens, fine, turn=turn, allow_upscale=True) for lens, turn in pair]
        self._reach = np.float32(fine.fx * self.baseline_m)  # depth times disparity
        self._most = float(self._reach) / _NEAREST_M
        if self._most >= fine.width:
            raise ConfigError(
                f"at {_NEAREST_M:g} m the two pictures of {fine.width} pixels have nothing in common (they are "
                f"{self._most:.0f} pixels apart): the cameras stand too far apart, or see too little"
            )
        self._margin = _STEPS * max(1, math.ceil((self._most + 1) / _STEPS))
        self._matcher = cv2.StereoSGBM.create(  # penalties as OpenCV advises for one channel
            minDisparity=0,
            numDisparities=self._margin,
            blockSize=_BLOCK,
            P1=8 * _BLOCK**2,
            P2=32 * _BLOCK**2,
            disp12MaxDiff=1,
            preFilterCap=63,
            uniquenessRatio=10,
            speckleWindowSize=max(1, round(_SPECKLE_SHARE * fine.width * fine.height)),
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM,
        )
        self._checked = False

    @classmethod
    def from_depthai(
        cls,
        calibration: Path,
        *,
        size: tuple[int, int],
        rectified: bool = False,
        hfov_deg: float | None = None,
        match_scale: Literal[1, 2] = 1,
    ) -> "StereoDepth":
        """For an OAK's pictures, by the calibration in its memory.

        Args:
            calibration: the JSON file that DepthAI's `eepromToJsonFile` writes.
            rectified: the device has rectified the pictures, which leaves both with the right camera's matrix.
        Raises:
            ConfigError: not such a file, no such camera in it, or numbers that no pair of cameras has.
        """
        try:
            left, right, right_from_left = load_stereo(calibration, _LEFT_SOCKET, _RIGHT_SOCKET)
            if rectified:
                left = right = replace(right, distortion="none", coefficients=())
                baseline_m, right_from_left = _checked_baseline(right_from_left), np.eye(4)
                right_from_left[0, 3] = -baseline_m
            return cls((left, right), right_from_left, size=size, hfov_deg=hfov_deg, match_scale=match_scale)
        except ConfigError as error:
            raise ConfigError(f"{calibration}: {error}") from error

    def __call__(self, left: Image, right: Image) -> tuple[Image, DepthPicture]:
        """The rectified left picture and its depth, of two pictures u8 [H, W, 3] of any size.

        Raises:
            DepthError: of another shape than they were calibrated for, or the calibration is of another device: each
                pair is checked until one with enough detail fits.
        """
        try:
            left, right = (view.image(picture) for view, picture in zip(self._views, (left, right), strict=True))
        except ConfigError as error:
            raise DepthError(f"{error}, or give this device's own calibration") from error
        for picture, seen in zip((left, right), self._seen, strict=True):
            picture[~seen] = 0
        grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (left, right)]
        if not self._checked:
            self._checked = _rows_match(*grey)
        # SGBM leaves its widest disparity out at the left: hence the margin
        wide = [cv2.copyMakeBorder(each, 0, 0, self._margin, 0, cv2.BORDER_REPLICATE) for each in grey]
        disparity = self._matcher.compute(*wide)[:, self._margin :].astype(np.float32) / np.float32(_STEPS)
        start, step = self._scale // 2, self._scale  # every pixel of the picture's size: no mean over an edge
        depth = np.ascontiguousarray(self._depth(disparity)[start::step, start::step])
        size = (self.lens.width, self.lens.height)
        return np.asarray(cv2.resize(left, size, interpolation=cv2.INTER_AREA), np.uint8), depth

    def _depth(self, disparity: NDArray[np.float32]) -> DepthPicture:
        """disparity: pixels, [H, W]; under 0 is unknown."""
        rows, columns = np.indices(disparity.shape, dtype=np.int32)
        there = np.rint(columns - disparity).astype(np.int32)
        left_seen, right_seen = self._seen
        known = (disparity >= _LEAST_DISPARITY) & (disparity <= self._most) & (there >= 0) & left_seen
        known &= right_seen[rows, there.clip(0, disparity.shape[1] - 1)]
        return np.divide(self._reach, disparity, out=np.zeros_like(disparity), where=known)


def _rectifying_turns(right_from_left: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [3, 3] from the left and the right camera's axes to those of the ideal pair."""
    lens = (np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5))  # any would do
    left, right, *_ = cv2.stereoRectify(*lens, *lens, (640, 480), right_from_left[:3, :3], right_from_left[:3, 3:])
    return np.asarray(left, np.float64), np.asarray(right, np.float64)


def _rows_match(left: NDArray[Any], right: NDArray[Any]) -> bool:
    """Whether things stand in the same rows of two rectified grey pictures; False if there is too little to see. Raises
    DepthError: they do not, as by another device's calibration, or left and right are swapped."""
    corners: Any = cv2.goodFeaturesToTrack(left, maxCorners=400, qualityLevel=0.01, minDistance=8)
    if corners is None or len(corners) < _LEAST_CORNERS:
        return False
    there, found, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, np.empty(0))
    back, returned, _ = cv2.calcOpticalFlowPyrLK(right, left, there, np.empty(0))
    kept = np.logical_and(found, returned)[:, 0] & (np.abs(back - corners).max(axis=(1, 2)) < HALF_PIXEL)
    if np.count_nonzero(kept) < _LEAST_CORNERS:
        return False
    across, down = np.moveaxis((there - corners)[kept, 0], 1, 0)
    if (off := float(np.median(np.abs(down)))) > max(1.0, _MOST_ROWS_OFF * left.shape[1]):
        raise DepthError(
            f"the rectified pictures must agree in their rows, they are {off:.1f} pixels apart: the calibration is of "
            "another device, or the pictures are of different moments"
        )
    if np.median(across) > HALF_PIXEL:
        raise DepthError("things lie farther right in the right picture: swap the left and the right picture")
    return True


def _checked_baseline(right_from_left: NDArray[np.float64]) -> float:
    """Metres between two cameras side by side. Raises ConfigError if that is not what they are."""
    rotation, translation = right_from_left[:3, :3], right_from_left[:3, 3]
    baseline_m = float(np.linalg.norm(translation))
    if not (np.isfinite(rotation).all() and _SHORTEST_M <= baseline_m <= _LONGEST_M):
        raise ConfigError(
            f"two cameras must stand {_SHORTEST_M:g} to {_LONGEST_M:g} m apart, the calibration says {baseline_m:g} m; "
            "DepthAI's files are in centimetres"
        )
    turned_deg = math.degrees(math.acos(float(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
    x, y, z = -rotation.T @ translation  # the right camera's centre, seen from the left one
    if turned_deg > _MOST_TURNED_DEG or x < max(abs(y), abs(z)):
        raise ConfigError(
            f"the right camera must stand to the right of the left one and look the same way, it is at x {x:.3f}, "
            f"y {y:.3f}, z {z:.3f} m, turned by {turned_deg:.0f} degrees: choose two sockets side by side, or swap them"
        )
    return baseline_m
