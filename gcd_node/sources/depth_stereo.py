"""Depth from two cameras side by side: a DepthAI calibration or a rectified pair, matched by OpenCV's SGBM."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import Intrinsics
from gcd_node.calibration import HALF_PIXEL, LensModel, read_depthai
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image
from gcd_node.preprocess import seen_pixels, widest_camera
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


class StereoDepth:
    """Rectifies a left and a right picture and measures the depth of the left one.

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
                sees every pixel, at most 120 degrees. Of a wider one, what no lens sees is black, without depth.
            match_scale: matches at this many times the size. 2 doubles the farthest depth and takes eight times as
                long: for sizes well under the camera's.
        Raises:
            ConfigError: these are not two cameras side by side, or this size cannot be matched.
        """
        if hfov_deg is not None and not 0 < hfov_deg <= _WIDEST_DEG:
            raise ConfigError(f"hfov_deg must be over 0 and at most {_WIDEST_DEG:g} degrees, got {hfov_deg:g}")
        self.baseline_m = _checked_baseline(right_from_left)
        left_turn, right_turn = _rectifying_turns(right_from_left)
        if hfov_deg is None:
            self.lens = widest_camera(lenses[0], *size, None, left_turn)
        else:
            self.lens = Intrinsics.from_hfov(hfov_deg, *size)
        fine = self.lens.resized(*(match_scale * side for side in size))
        self._left, self._right = _View(lenses[0], left_turn, fine), _View(lenses[1], right_turn, fine)
        self._scale, self._camera = match_scale, fine
        self._most = fine.fx * self.baseline_m / _NEAREST_M
        if self._most >= fine.width:
            raise ConfigError(
                f"at {_NEAREST_M:g} m the two pictures of {fine.width} pixels have nothing in common (they are "
                f"{self._most:.0f} pixels apart): the cameras stand too far apart, or see too little"
            )
        self._margin = _STEPS * max(1, math.ceil((self._most + 1) / _STEPS))
        self._matcher = _matcher(self._margin, fine)
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
            board = read_depthai(calibration)
            left, right = board.lens(_LEFT_SOCKET), board.lens(_RIGHT_SOCKET)
            right_from_left = board.transform(_LEFT_SOCKET, _RIGHT_SOCKET)
            if rectified:
                left = right = replace(right, distortion="none", coefficients=())
                baseline_m, right_from_left = _checked_baseline(right_from_left), np.eye(4)
                right_from_left[0, 3] = -baseline_m
            return cls((left, right), right_from_left, size=size, hfov_deg=hfov_deg, match_scale=match_scale)
        except ConfigError as error:
            raise ConfigError(f"{calibration}: {error}") from error

    def __call__(self, left: Image, right: Image) -> tuple[Image, DepthPicture]:
        """The rectified left picture and its depth, of two pictures u8 [H, W, 3], each of any size that its calibration
        scales to.

        Raises:
            DepthError: of another shape than they were calibrated for, or the calibration is of another device: until a
                pair with enough detail fits it, each is checked for that.
        """
        left, right = self._left.image(left, "left"), self._right.image(right, "right")
        grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (left, right)]
        if not self._checked:
            self._checked = _rows_match(*grey)
        # SGBM leaves its widest disparity out at the left: hence the margin
        wide = [cv2.copyMakeBorder(each, 0, 0, self._margin, 0, cv2.BORDER_REPLICATE) for each in grey]
        disparity = self._matcher.compute(*wide)[:, self._margin :].astype(np.float32) / np.float32(_STEPS)
        start, step = self._scale // 2, self._scale  # every pixel of the picture's size: no mean over an edge
        depth = np.ascontiguousarray(self._depth(disparity)[start::step, start::step])
        if self._scale > 1:
            size = (self.lens.width, self.lens.height)
            left = np.asarray(cv2.resize(left, size, interpolation=cv2.INTER_AREA), np.uint8)
        return left, depth

    def _depth(self, disparity: NDArray[np.float32]) -> DepthPicture:
        """disparity: pixels, [H, W]; under 0 is unknown."""
        rows, columns = np.indices(disparity.shape, dtype=np.int32)
        there = np.rint(columns - disparity).astype(np.int32)
        known = (disparity >= _LEAST_DISPARITY) & (disparity <= self._most) & (there >= 0) & self._left.seen
        known &= self._right.seen[rows, there.clip(0, disparity.shape[1] - 1)]
        reach = np.float32(self._camera.fx * self.baseline_m)
        return np.divide(reach, disparity, out=np.zeros_like(disparity), where=known)


class _View:
    """Where each pixel of the ideal camera lies in the pictures of one lens."""

    def __init__(self, lens: LensModel, turn: NDArray[np.float64], camera: Intrinsics) -> None:
        self._lens, self._camera = lens, camera
        u, v = np.arange(camera.width) + HALF_PIXEL, np.arange(camera.height) + HALF_PIXEL
        self._pixels, self.seen = seen_pixels(lens, camera, u, v, turn)
        self._sampled: tuple[int, int] = (0, 0)  # size of the pictures the maps are for
        self._shrunk = (0, 0)
        self._maps: tuple[Any, Any]

    def image(self, picture: Image, name: str) -> Image:
        """u8 [H, W, 3], black where the lens does not see. Raises DepthError for a picture it is not calibrated for."""
        high, wide = picture.shape[:2]
        if (wide, high) != self._sampled:
            self._prepare(wide, high, name)
        if self._shrunk != (wide, high):
            picture = np.asarray(cv2.resize(picture, self._shrunk, interpolation=cv2.INTER_AREA), np.uint8)
        image = cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        image[~self.seen] = 0
        return np.asarray(image, np.uint8)

    def _prepare(self, width: int, height: int, name: str) -> None:
        """Pictures finer than the ideal camera's are averaged down to it first: sampling them would alias."""
        lens, camera = self._lens, self._camera
        if not lens.fits(width, height):
            raise DepthError(
                f"the {name} picture is {width} x {height}, the calibration is for {lens.width} x {lens.height}, which "
                "is another shape: calibrate at the size you run, or give this device's own calibration"
            )
        shrink = min(1.0, camera.fx / lens.fx * lens.width / width)
        self._shrunk = max(1, round(width * shrink)), max(1, round(height * shrink))
        scale = np.array([self._shrunk[0] / lens.width, self._shrunk[1] / lens.height])
        pixels = ((self._pixels + HALF_PIXEL) * scale - HALF_PIXEL).astype(np.float32)
        self._maps = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
        self._sampled = (width, height)


def _rectifying_turns(right_from_left: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [3, 3] from the left and the right camera's axes to those of the ideal pair."""
    any_lens, no_distortion = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(5)
    left, right, *_ = cv2.stereoRectify(
        any_lens, no_distortion, any_lens, no_distortion, (640, 480), right_from_left[:3, :3], right_from_left[:3, 3:]
    )
    return np.asarray(left, np.float64), np.asarray(right, np.float64)


def _rows_match(left: NDArray[Any], right: NDArray[Any]) -> bool:
    """Whether things stand in the same rows of two rectified grey pictures; False if there is too little to see.

    Another device's calibration is off by a few rows at once. That it is turned about the vertical, does not show.
    Raises:
        DepthError: they do not, or they do with left and right swapped.
    """
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


def _matcher(disparities: int, camera: Intrinsics) -> cv2.StereoSGBM:
    """Penalties as OpenCV advises for one channel; matches are checked from both sides and against the next best."""
    return cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=max(1, round(_SPECKLE_SHARE * camera.width * camera.height)),
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )


def _checked_baseline(right_from_left: NDArray[np.float64]) -> float:
    """Metres between two cameras side by side. Raises ConfigError if that is not what they are."""
    rotation, left_centre = right_from_left[:3, :3], right_from_left[:3, 3]
    if not np.isfinite(right_from_left).all():
        raise ConfigError("the transform between the two cameras must be finite numbers; calibrate the pair again")
    baseline_m = float(np.linalg.norm(left_centre))
    if not _SHORTEST_M <= baseline_m <= _LONGEST_M:
        raise ConfigError(
            f"two cameras must stand {_SHORTEST_M:g} to {_LONGEST_M:g} m apart, the calibration says {baseline_m:g} m; "
            "DepthAI's files are in centimetres"
        )
    turned_deg = math.degrees(math.acos(float(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
    if turned_deg > _MOST_TURNED_DEG:
        raise ConfigError(
            f"two cameras of a stereo pair must look the same way, these differ by {turned_deg:.0f} degrees"
        )
    x, y, z = -rotation.T @ left_centre  # the right camera's centre, seen from the left one
    if abs(x) < max(abs(y), abs(z)):
        raise ConfigError(
            f"the right camera must stand beside the left one, it is at x {x:.3f}, y {y:.3f}, z {z:.3f} m: "
            "choose two sockets side by side"
        )
    if x < 0:
        raise ConfigError(f"the left camera stands {-x:.3f} m to the right of the right one: swap the two sockets")
    return baseline_m
