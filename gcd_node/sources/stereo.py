"""Depth of two cameras side by side, by the calibration in an OAK's memory, through OpenCV's rectification and SGBM."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model import FileError, Intrinsics, read_json
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import HALF_PIXEL, Image, LensModel, depthai_lens
from gcd_node.sources.depth import DepthPicture

_LEFT_SOCKET, _RIGHT_SOCKET = 1, 2  # CAM_B and CAM_C
_SHORTEST_M, _LONGEST_M = 0.005, 2.0  # of baselines
_NEAREST_M = 0.5  # nearer than this, depth is unknown; the time of matching grows as it falls
_FINER = 2  # pictures are matched at this many times the size: depth reaches twice as far
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

    The picture it gives is that of an ideal camera, `lens`, whose rows lie along the baseline and of which both cameras
    see every pixel: turned a little away from the left camera's own axis. Depth is along the ideal camera's axis.
    """

    def __init__(
        self, lenses: tuple[LensModel, LensModel], right_from_left: NDArray[np.float64], *, size: tuple[int, int]
    ) -> None:
        """Work out the ideal camera and how to get there.

        Args:
            lenses: of the left and the right camera; `right_from_left`: [4, 4] rigid transform, metres.
            size: width and height of the rectified picture and its depth.
        Raises:
            ConfigError: these are not two cameras side by side, or this size cannot be matched.
        """
        self._size, fine = size, (_FINER * size[0], _FINER * size[1])
        self._source = lenses[0].resized(fine[0], round(lenses[0].height * fine[0] / lenses[0].width))
        taken = (self._source.width, self._source.height)
        left, right = self._source, lenses[1].resized(*taken)
        pair: Any = (left.matrix, np.array(left.coefficients), right.matrix, np.array(right.coefficients), taken)
        step: Any = (right_from_left[:3, :3].copy(), right_from_left[:3, 3:].copy())
        try:
            if left.distortion == "equidistant":
                undistort = cv2.fisheye.initUndistortRectifyMap
                turns = cv2.fisheye.stereoRectify(*pair, *step, flags=cv2.CALIB_ZERO_DISPARITY, newImageSize=fine)[:4]
            else:
                undistort = cv2.initUndistortRectifyMap
                turns = cv2.stereoRectify(*pair, *step, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0, newImageSize=fine)[:4]
        except cv2.error as error:
            raise ConfigError(f"the two cameras cannot be rectified ({error.err}); calibrate them again") from error
        ideal = np.asarray(turns[2])
        self.baseline_m = float(-turns[3][0, 3] / ideal[0, 0])
        if not _SHORTEST_M <= self.baseline_m <= _LONGEST_M:
            raise ConfigError(
                f"the right camera must stand {_SHORTEST_M:g} to {_LONGEST_M:g} m to the right of the left one and "
                f"look the same way, the calibration says {self.baseline_m:g} m: choose two sockets side by side, or "
                "swap them; DepthAI's files are in centimetres"
            )
        (fx, _, cx), (_, fy, cy), _ = ideal[:, :3].tolist()
        self.lens = Intrinsics(
            fx=fx, fy=fy, cx=cx + HALF_PIXEL, cy=cy + HALF_PIXEL, width=fine[0], height=fine[1]
        ).resized(*size)
        self._maps = [
            undistort(lens.matrix, np.array(lens.coefficients), np.asarray(turn), ideal[:, :3], fine, cv2.CV_16SC2)
            for lens, turn in zip((left, right), turns[:2], strict=True)
        ]
        self._reach = np.float32(fx * self.baseline_m)  # depth times disparity
        self._margin = _STEPS * math.ceil((float(self._reach) / _NEAREST_M + 1) / _STEPS)
        if self._margin >= fine[0]:
            raise ConfigError(
                f"at {_NEAREST_M:g} m two pictures of {fine[0]} pixels have nothing in common: the cameras stand too "
                "far apart, or see too little"
            )
        self._matcher = _matcher(fine, self._margin)
        self._checked = False

    @classmethod
    def from_depthai(cls, calibration: Path, *, size: tuple[int, int], rectified: bool = False) -> "StereoDepth":
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
                baseline_m, right_from_left = float(np.linalg.norm(right_from_left[:3, 3])), np.eye(4)
                right_from_left[0, 3] = -baseline_m
            return cls((left, right), right_from_left, size=size)
        except ConfigError as error:
            raise ConfigError(f"{calibration}: {error}") from error

    def __call__(self, left: Image, right: Image) -> tuple[Image, DepthPicture]:
        """The rectified left picture and its depth, of two pictures u8 [H, W, 3] of any size.

        Raises:
            DepthError: of another shape than they were calibrated for, or the calibration is of another device: each
                pair is checked until one with enough detail fits.
        """
        pictures: list[Any] = []
        for picture, maps in zip((left, right), self._maps, strict=True):
            if not self._source.fits(picture.shape[1], picture.shape[0]):
                raise DepthError(
                    f"the calibration is of another shape than the picture's {picture.shape[1]} x {picture.shape[0]}; "
                    "give this device's own calibration"
                )
            taken = cv2.resize(picture, (self._source.width, self._source.height), interpolation=cv2.INTER_AREA)
            pictures.append(cv2.remap(taken, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
        grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in pictures]
        self._checked = self._checked or _rows_match(*grey)
        # SGBM leaves its widest disparity out at the left: hence the margin
        wide = [cv2.copyMakeBorder(each, 0, 0, self._margin, 0, cv2.BORDER_REPLICATE) for each in grey]
        disparity = self._matcher.compute(*wide)[:, self._margin :].astype(np.float32) / np.float32(_STEPS)
        disparity = disparity[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER]  # no mean over an edge
        known = (disparity >= _LEAST_DISPARITY) & (disparity <= _FINER * np.arange(disparity.shape[1]))
        depth = np.divide(self._reach, disparity, out=np.zeros(disparity.shape, np.float32), where=known)
        return np.asarray(cv2.resize(pictures[0], self._size, interpolation=cv2.INTER_AREA), np.uint8), depth


def _matcher(size: tuple[int, int], disparities: int) -> cv2.StereoSGBM:
    """For rectified grey pictures of this width and height."""
    return cv2.StereoSGBM.create(  # penalties as OpenCV advises for one channel
        minDisparity=0,
        numDisparities=disparities,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=max(1, round(_SPECKLE_SHARE * size[0] * size[1])),
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )


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


class _Extrinsics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """From this camera's axes to those of another on the board, centimetres; -1 is no other."""

    rotation_matrix: tuple[tuple[float, float, float], ...]
    translation: dict[str, float]
    to_camera_socket: int


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
    lenses = [
        depthai_lens(
            each.intrinsic_matrix,
            each.distortion_coeff,
            _CAMERA_TYPES.get(each.camera_type, str(each.camera_type)),
            (each.width, each.height),
        )
        for each in (cameras[left], cameras[right])
    ]
    return lenses[0], lenses[1], _link(cameras, left, right)


def _link(cameras: dict[int, _Camera], left: int, right: int) -> NDArray[np.float64]:
    """right_from_left, [4, 4], metres: the file leads from camera to camera, in either direction."""
    for start, end in ((left, right), (right, left)):
        here = start
        end_from_start: NDArray[np.float64] = np.eye(4)
        for _ in cameras:
            extrinsics, step = cameras[here].extrinsics, np.eye(4)
            rotation = np.array(extrinsics.rotation_matrix)
            is_turn = rotation.shape == (3, 3) and np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE
            if extrinsics.to_camera_socket not in cameras or not is_turn:  # zeros were never calibrated
                break
            step[:3, :3] = rotation
            step[:3, 3] = [extrinsics.translation.get(axis, math.nan) / 100 for axis in "xyz"]
            here, end_from_start = extrinsics.to_camera_socket, step @ end_from_start
            if here == end:
                return end_from_start if start == left else np.asarray(np.linalg.inv(end_from_start), np.float64)
    raise ConfigError(f"how the cameras at sockets {left} and {right} stand to each other is not in it: calibrate")
