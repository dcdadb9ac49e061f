"""From the picture of a calibrated lens to the one an ideal camera of the model's field of view would have taken."""

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import Intrinsics
from gcd_node.errors import ConfigError
from gcd_node.frame import Image
from gcd_node.optics.calibration import LensModel

_WIDEST_DEG = 120.0
_NARROWEST_DEG = 1.0
_SLACK_PX = 1.0
_ENLARGED = 1.01
_SUPERSAMPLED = 2
_MOST_SHRINK = 4.0
_HALF_PIXEL = 0.5
_SIDE_POINTS, _RING_POINTS = 17, 65


class Rectifier:
    """Undistorts, cuts to a field of view and resizes, in one step per picture.

    The picture is sampled at twice the wanted size and then averaged: within 37 dB of undistorting at full resolution
    and averaging, at a third of the time. Sampling straight at the wanted size would alias (24 dB).
    Pictures more than four times as fine as wanted are halved first, for the same reason.
    """

    def __init__(
        self, lens: LensModel, *, width: int, height: int, hfov_deg: float | None, allow_upscale: bool = False
    ) -> None:
        """Work out which camera the fitted pictures are of.

        Args:
            lens: of the source's pictures.
            width, height: of the fitted picture.
            hfov_deg: wanted horizontal field of view, None for as much as the lens sees (at most 120 degrees).
            allow_upscale: enlarge pictures that are too coarse instead of refusing them.
        Raises:
            ConfigError: the lens sees next to nothing around its axis, or its picture would have to be enlarged.
        """
        self._lens = lens
        self._camera = widest_camera(lens, width, height, _WIDEST_DEG if hfov_deg is None else hfov_deg)
        self._allow_upscale = allow_upscale
        self._sampling = self._sampling_of(lens.width, lens.height)

    @property
    def resize(self) -> Literal["remap2x_area"]:
        """Published as `src.resize`."""
        return "remap2x_area"

    @property
    def camera(self) -> Intrinsics:
        """Of the fitted picture: looks along the lens's axis, square pixels, no distortion. Its field of view is the
        wanted one, or the largest of that shape which the lens sees all of."""
        return self._camera

    def image(self, image: Image) -> Image:
        """One picture, u8 [H, W, 3] to [height, width, 3].

        Raises:
            ConfigError: of another shape than the lens was calibrated for, or too coarse.
        """
        high, wide = image.shape[:2]
        if (wide, high) != (self._sampling.lens.width, self._sampling.lens.height):
            self._sampling = self._sampling_of(wide, high)
        return self._sampling.image(image)

    def _sampling_of(self, width: int, height: int) -> "_Sampling":
        lens = self._lens.resized(width, height)
        enlarged = max(self._camera.fx / lens.fx, self._camera.fy / lens.fy)
        if enlarged > _ENLARGED and not self._allow_upscale:
            raise ConfigError(
                f"a {width} x {height} picture would have to be enlarged {enlarged:.2f} times to fill the "
                f"{self._camera.width} x {self._camera.height} the model takes at {self._camera.hfov_deg:.0f} degrees; "
                "use a larger one or set allow_upscale"
            )
        return _Sampling(lens, self._camera)


def widest_camera(lens: LensModel, width: int, height: int, hfov_deg: float) -> Intrinsics:
    """The camera of `width` x `height` along the lens's axis with a field of view of up to `hfov_deg` across, of which
    the lens sees every pixel.

    Raises:
        ConfigError: not even one degree of it.
    """
    wanted = Intrinsics.from_hfov(hfov_deg, width, height)
    if _sees(lens, wanted):
        return wanted
    least, most = _NARROWEST_DEG, hfov_deg
    if not _sees(lens, Intrinsics.from_hfov(least, width, height)):
        raise ConfigError(
            f"the calibration ({lens}) leaves less than {_NARROWEST_DEG:g} degree of view around the axis; "
            "calibrate the camera again"
        )
    while most - least > 1e-3:
        middle = (least + most) / 2
        least, most = (middle, most) if _sees(lens, Intrinsics.from_hfov(middle, width, height)) else (least, middle)
    return Intrinsics.from_hfov(least, width, height)


def _sees(lens: LensModel, camera: Intrinsics) -> bool:
    """Whether every pixel of the camera is in the lens's picture. A polynomial fitted to the picture may turn back
    beyond its edge: from the axis outwards, pixels must go outwards too."""
    rings = np.linspace(1 / _RING_POINTS, 1, _RING_POINTS)[:, None, None] * _border_rays(camera)
    pixels = project(lens, rings.reshape(-1, 2)).reshape(rings.shape)
    outwards = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    rising = np.diff(np.hypot(outwards[..., 0], outwards[..., 1]), axis=0) > 0
    low, high = -_HALF_PIXEL - _SLACK_PX, np.array([lens.width, lens.height]) - _HALF_PIXEL + _SLACK_PX
    edge = pixels[-1]
    return bool(rising.all() and np.isfinite(edge).all() and (edge >= low).all() and (edge <= high).all())


def _border_rays(camera: Intrinsics) -> NDArray[np.float64]:
    """x / z and y / z along the four edges of the picture, [N, 2]."""
    u, v = np.linspace(0, camera.width, _SIDE_POINTS), np.linspace(0, camera.height, _SIDE_POINTS)
    edges = [(u, 0 * u), (u, 0 * u + camera.height), (0 * v, v), (0 * v + camera.width, v)]
    pixels = np.concatenate([np.stack(edge, axis=1) for edge in edges])
    return (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)


def project(lens: LensModel, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where rays meet the lens's picture: [N, 2] of x / z and y / z to [N, 2] pixels, from the first pixel's centre."""
    coefficients = np.array(lens.coefficients)
    if lens.distortion == "equidistant":
        pixels = cv2.fisheye.distortPoints(rays[:, None], lens.matrix, coefficients)
    else:
        ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        pixels, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), lens.matrix, coefficients)
    return np.asarray(pixels, np.float64).reshape(-1, 2)


class _Sampling:
    """Where each pixel of the camera's picture, at twice its size, lies in pictures of one size."""

    def __init__(self, lens: LensModel, camera: Intrinsics) -> None:
        self.lens = lens
        self._size = (camera.width, camera.height)
        self._shrunk = _shrunk_size(lens, camera)
        small, fine = lens.resized(*self._shrunk), camera.resized(*(_SUPERSAMPLED * side for side in self._size))
        target = np.array(
            [[fine.fx, 0.0, fine.cx - _HALF_PIXEL], [0.0, fine.fy, fine.cy - _HALF_PIXEL], [0.0, 0.0, 1.0]]
        )
        arguments = (small.matrix, np.array(small.coefficients), np.eye(3), target, (fine.width, fine.height))
        if lens.distortion == "equidistant":
            self._maps = cv2.fisheye.initUndistortRectifyMap(*arguments, cv2.CV_16SC2)
        else:
            self._maps = cv2.initUndistortRectifyMap(*arguments, cv2.CV_16SC2)

    def image(self, image: Image) -> Image:
        if self._shrunk != (self.lens.width, self.lens.height):
            image = np.asarray(cv2.resize(image, self._shrunk, interpolation=cv2.INTER_AREA), np.uint8)
        fine = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.resize(fine, self._size, interpolation=cv2.INTER_AREA), np.uint8)


def _shrunk_size(lens: LensModel, camera: Intrinsics) -> tuple[int, int]:
    """The picture's size, halved until it is at most four times as fine as the camera's."""
    finer = min(lens.fx / camera.fx, lens.fy / camera.fy)
    halvings = max(0, math.ceil(math.log2(finer / _MOST_SHRINK)))
    return max(1, lens.width >> halvings), max(1, lens.height >> halvings)
