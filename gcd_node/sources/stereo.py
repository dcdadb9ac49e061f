"""Depth of two cameras side by side, by the calibration in an OAK's memory, through OpenCV's SGBM."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model import FileError, Intrinsics, read_json
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import HALF_PIXEL, Image, LensModel, depthai_lens
from gcd_node.preprocess import Rectifier, seen_pixels, widest_camera
from gcd_node.sources.depth import DepthPicture

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
_CAMERA_TYPES = {0: "Perspective", 1: "Fisheye"}
_ROTATION_TOLERANCE = 1e-3


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


class _Extrinsics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """From this camera's axes to those of another on the board, centimetres; -1 is no other."""

    rotation_matrix: tuple[tuple[float, float, float], ...]
    translation: dict[str, float]
    to_camera_socket: int

    @property
    def transform(self) -> NDArray[np.float64] | None:
        """[4, 4], metres; None if the rotation is none: DepthAI fills what was never calibrated with zeros."""
        rotation, transform = np.array(self.rotation_matrix), np.eye(4)
        if rotation.shape != (3, 3) or np.linalg.det(rotation) < 0:
            return None
        transform[:3, :3] = rotation
        transform[:3, 3] = [self.translation.get(axis, math.nan) / 100 for axis in "xyz"]
        return transform if np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE else None


class _Camera(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    camera_type: int = 0  # 0 perspective, 1 fish-eye
    width: int
    height: int
    intrinsic_matrix: tuple[tuple[float, float, float], ...]
    distortion_coeff: tuple[float, ...]
    extrinsics: _Extrinsics


class _Board(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    camera_data: tuple[tuple[int, _Camera], ...]


def load_stereo(path: Path, left: int, right: int) -> tuple[LensModel, LensModel, NDArray[np.float64]]:
    """The lenses of two sockets, and right_from_left, [4, 4], metres, out of what DepthAI's `eepromToJsonFile` wrote:
    the memory of an OAK.

    Raises:
        ConfigError: missing, or not such a file; no such camera, or the pair was never calibrated.
    """
    try:
        cameras = dict(read_json(path, _Board).camera_data)
    except FileError as error:
        raise ConfigError(f"it {error}; give the JSON file of DepthAI's eepromToJsonFile") from error
    if not {left, right} <= cameras.keys():
        raise ConfigError(f"there must be cameras at sockets {left} and {right}, there are at {sorted(cameras)}")
    found = (cameras[left], cameras[right])
    models = [_CAMERA_TYPES.get(each.camera_type, str(each.camera_type)) for each in found]
    lenses = [
        depthai_lens(each.intrinsic_matrix, each.distortion_coeff, model, (each.width, each.height))
        for each, model in zip(found, models, strict=True)
    ]
    left_chain, right_chain = _chain(cameras, left), _chain(cameras, right)
    common = next((socket for socket in left_chain if socket in right_chain), None)
    if common is None:
        raise ConfigError(f"how the cameras at sockets {left} and {right} stand to each other is not in it: calibrate")
    return lenses[0], lenses[1], np.linalg.inv(right_chain[common]) @ left_chain[common]


def _chain(cameras: Mapping[int, _Camera], socket: int) -> dict[int, NDArray[np.float64]]:
    """other_from_socket, for each camera that the file leads to from this one."""
    chain, here = {socket: np.eye(4)}, socket
    while here in cameras:
        extrinsics = cameras[here].extrinsics
        onward, step = extrinsics.to_camera_socket, extrinsics.transform
        if onward < 0 or onward in chain or step is None:
            break
        chain[onward] = step @ chain[here]
        here = onward
    return chain
