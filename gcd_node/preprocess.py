"""From a camera's picture to the network's: crop, resize, and what that does to the camera's intrinsics."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import (
    CameraMount,
    Intrinsics,
    ModelError,
    OptionError,
    Spherical,
    Traits,
    center_crop_box,
)
from gcd_node.errors import ConfigError
from gcd_node.frame import HALF_PIXEL, Image, LensModel
from gcd_node.sources import SourcePose

Resize: TypeAlias = Literal["released", "area"]
"""released: bilinear, as in training; it aliases when it shrinks a lot. area: averages, and does not."""

_LEVELS = np.arange(256, dtype=np.float32) / np.float32(127.5) - np.float32(1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Fit:
    """How pictures of any size become `width` x `height`: the largest centred crop of that shape, resized.

    resize: the name published as `src.resize`.
    share: how much of the picture's width may be used; less than 1 narrows the field of view.
    allow_upscale: enlarge pictures that are too small instead of refusing them.
    Source: Generative Camera Dolly, loading of custom videos, as released; docs/node.md, F7.
    """

    width: int
    height: int
    resize: Resize = "released"
    share: float = 1.0
    allow_upscale: bool = False

    def crop_box(self, width: int, height: int) -> tuple[int, int, int, int]:
        """The part of a `width` x `height` picture that is used: left, top, width, height, pixels.

        Raises:
            ConfigError: it would have to be enlarged, and `allow_upscale` is not set.
        """
        beside = round(width * (1 - self.share) / 2)
        try:
            left, top, wide, high = center_crop_box(max(1, width - 2 * beside), height, self.width / self.height)
        except ModelError as error:
            raise ConfigError(str(error)) from error
        if not self.allow_upscale and (wide < self.width or high < self.height):
            raise ConfigError(
                f"a {width} x {height} picture (cropped to {wide} x {high}) is smaller than the {self.width} x "
                f"{self.height} the model takes; use a larger one or set allow_upscale"
            )
        return left + beside, top, wide, high

    def image(self, image: Image) -> Image:
        """Crop and resize one picture: u8 [H, W, 3] to [height, width, 3]. Raises ConfigError as `crop_box`."""
        left, top, wide, high = self.crop_box(image.shape[1], image.shape[0])
        part = image[top : top + high, left : left + wide]
        if (wide, high) == (self.width, self.height):
            return np.ascontiguousarray(part)
        shrinks = self.width < wide or self.height < high
        how = cv2.INTER_AREA if self.resize == "area" and shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, (self.width, self.height), interpolation=how), np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same of a depth picture, [H, W]; no depth between two surfaces is made up. Raises as `crop_box`."""
        left, top, wide, high = self.crop_box(depth.shape[1], depth.shape[0])
        part = np.ascontiguousarray(depth[top : top + high, left : left + wide])
        size = (self.width, self.height)
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)

    def intrinsics(self, source: Intrinsics) -> Intrinsics:
        """The camera of the fitted picture, from the camera of the whole. Raises ConfigError as `crop_box`."""
        return source.cropped(*self.crop_box(source.width, source.height)).resized(self.width, self.height)


def to_clip_tensor(images: Image) -> NDArray[np.float32]:
    """u8 [T, H, W, 3] in 0..255 -> float32 [T, 3, H, W] in [-1, 1], contiguous."""
    count, height, width, _ = images.shape
    clip = np.empty((count, 3, height, width), np.float32)
    for image, planes in zip(images, clip, strict=True):
        for levels, plane in zip(cv2.split(image), planes, strict=True):
            cv2.LUT(levels, _LEVELS, plane)
    return clip


_WIDEST_DEG, _NARROWEST_DEG = 120.0, 1.0
_SLACK_PX = 1.0
_ENLARGED = 1.01
_SUPERSAMPLED = 2
_MOST_SHRINK = 4.0
_SIDE_POINTS, _DIRECTIONS, _RINGS = 17, 32, 400
_STEEPEST = 4.0  # of rays x / z: 76 degrees off the axis


class Rectifier:
    """Undistorts, cuts to a field of view and resizes, in one step per picture.

    The picture is sampled at twice the wanted size and then averaged: within 37 dB of undistorting at full resolution
    and averaging, at a third of the time. Sampling straight at the wanted size would alias (24 dB).
    Pictures more than four times as fine as wanted are halved first, for the same reason.
    """

    resize: Literal["remap2x_area"] = "remap2x_area"
    """Published as `src.resize`."""

    def __init__(self, lens: LensModel, camera: Intrinsics, *, allow_upscale: bool = False) -> None:
        """Make the maps for pictures of the size the lens is calibrated for.

        Args:
            camera: of the fitted picture: square pixels, no distortion; see widest_camera().
            allow_upscale: enlarge pictures that are too coarse instead of refusing them.
        Raises:
            ConfigError: the picture would have to be enlarged.
        """
        self.camera = camera
        self._lens, self._allow_upscale = lens, allow_upscale
        self._prepare(lens.width, lens.height)

    def image(self, image: Image) -> Image:
        """One picture, u8 [H, W, 3] to [height, width, 3].

        Raises:
            ConfigError: of another shape than the lens was calibrated for, or too coarse.
        """
        self._prepare(image.shape[1], image.shape[0])
        if self._shrunk != self._size:
            image = np.asarray(cv2.resize(image, self._shrunk, interpolation=cv2.INTER_AREA), np.uint8)
        fine = cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        size = (self.camera.width, self.camera.height)
        return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same of a depth picture, [H, W]; no depth between two surfaces is made up. Raises as `image`."""
        self._prepare(depth.shape[1], depth.shape[0])
        if self._depth_maps is None:  # of floats: the nearest of fixed-point maps would be those to the upper left
            self._depth_maps = self._maps_to(self.camera, cv2.CV_32FC1)
        small = cv2.resize(depth, self._shrunk, interpolation=cv2.INTER_NEAREST_EXACT)
        return np.asarray(cv2.remap(small, *self._depth_maps, cv2.INTER_NEAREST), np.float32)  # 0, a hole, beyond it

    _size = (0, 0)  # of the pictures that the maps are for

    def _prepare(self, width: int, height: int) -> None:
        if (width, height) == self._size:
            return
        lens, camera = self._lens.resized(width, height), self.camera
        enlarged = max(camera.fx / lens.fx, camera.fy / lens.fy)
        if enlarged > _ENLARGED and not self._allow_upscale:
            raise ConfigError(
                f"a {width} x {height} picture would have to be enlarged {enlarged:.2f} times to fill the "
                f"{camera.width} x {camera.height} the model takes at {camera.hfov_deg:.0f} degrees; "
                "use a larger one or set allow_upscale"
            )
        halvings = max(0, math.ceil(-math.log2(enlarged * _MOST_SHRINK)))
        self._size, self._shrunk = (width, height), (max(1, width >> halvings), max(1, height >> halvings))
        self._maps = self._maps_to(
            camera.resized(_SUPERSAMPLED * camera.width, _SUPERSAMPLED * camera.height), cv2.CV_16SC2
        )
        self._depth_maps: tuple[NDArray[Any], NDArray[Any]] | None = None

    def _maps_to(self, camera: Intrinsics, kind: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """For `cv2.remap`, from the shrunk picture."""
        small = self._lens.resized(*self._shrunk)
        centre = (camera.cx - HALF_PIXEL, camera.cy - HALF_PIXEL)
        target = np.array([[camera.fx, 0.0, centre[0]], [0.0, camera.fy, centre[1]], [0.0, 0.0, 1.0]])
        equidistant = self._lens.distortion == "equidistant"
        undistort = cv2.fisheye.initUndistortRectifyMap if equidistant else cv2.initUndistortRectifyMap
        size = (camera.width, camera.height)
        return undistort(small.matrix, np.array(small.coefficients), np.eye(3), target, size, kind)


def widest_camera(lens: LensModel, width: int, height: int, hfov_deg: float | None) -> Intrinsics:
    """The camera of `width` x `height` with a field of view of up to `hfov_deg` across, at most 120 degrees, of which
    the lens sees every pixel.

    Raises:
        ConfigError: not even one degree of it.
    """
    u, v = np.linspace(0, width, _SIDE_POINTS), np.linspace(0, height, _SIDE_POINTS)

    def sees_all(hfov_deg: float) -> bool:
        camera = Intrinsics.from_hfov(hfov_deg, width, height)
        x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
        rays = np.stack([x, y], axis=-1).reshape(-1, 2)
        pixels = project(lens, rays)
        low, high = -HALF_PIXEL - _SLACK_PX, np.array([lens.width, lens.height]) - HALF_PIXEL + _SLACK_PX
        inside = (pixels >= low) & (pixels <= high)
        return bool(inside.all() and (np.hypot(*rays.T) < _reach(lens)).all())

    least, most = _NARROWEST_DEG, _WIDEST_DEG if hfov_deg is None else hfov_deg
    if sees_all(most):
        return Intrinsics.from_hfov(most, width, height)
    if not sees_all(least):
        raise ConfigError(
            f"the calibration ({lens}) leaves less than {least:g} degree of view around the axis; calibrate again"
        )
    while most - least > 1e-3:
        middle = (least + most) / 2
        least, most = (middle, most) if sees_all(middle) else (least, middle)
    return Intrinsics.from_hfov(least, width, height)


@lru_cache(maxsize=8)
def _reach(lens: LensModel) -> float:
    """How far from the axis, as a tangent, the calibration holds: its polynomial may turn back beyond the picture it
    was fitted to, and show there, mirrored, what lies inside."""
    angles = np.linspace(0, 2 * math.pi, _DIRECTIONS, endpoint=False)
    rings = np.linspace(0, _STEEPEST, _RINGS + 1)[:, None, None]
    rays = rings * np.stack([np.cos(angles), np.sin(angles)], axis=-1)  # [R, A, 2]
    away = (project(lens, rays.reshape(-1, 2)).reshape(rays.shape) - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    with np.errstate(invalid="ignore"):  # a senseless polynomial ends in infinities: not rising
        rising = (np.diff(np.hypot(away[..., 0], away[..., 1]), axis=0) > 0).all(axis=1)
    return _STEEPEST if rising.all() else float(rings[int(np.argmin(rising)), 0, 0])


def project(lens: LensModel, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where rays meet the lens's picture: [N, 2] of x / z and y / z to [N, 2] pixels, from the first pixel's centre."""
    coefficients = np.array(lens.coefficients)
    if lens.distortion == "equidistant":
        pixels = cv2.fisheye.distortPoints(rays[:, None], lens.matrix, coefficients)
    else:
        ahead = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        pixels, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), lens.matrix, coefficients)
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def require_usable(pose: SourcePose | None, traits: Traits) -> None:
    """Refuse a pose in words the model does not know.

    Raises:
        OptionError: angles for a model that is not steered by them, a mount for another model than the live one.
    """
    steered = traits.config.camera != "none"
    if pose is None or traits.live:  # that one has a use for either
        return
    if pose.on_vehicle:
        reason = "is steered by angles" if steered else "sees nothing but the pictures"
        remedy = "; state elevation and radius instead" if steered else "; leave it out"
        raise OptionError(f"{traits.name} {reason} and has no use for a mount (height, forward, left, tilt){remedy}")
    if pose.on_sphere and not steered:
        raise OptionError(
            f"{traits.name} is not steered by angles and has no use for elevation and radius; leave them out"
        )


def stated_sphere(pose: SourcePose | None) -> Spherical | None:
    """The camera on the sphere, None if nobody stated it. Raises PoseError."""
    if pose is None or pose.on_vehicle:
        return None
    return Spherical(
        azimuth_deg=0.0,
        elevation_deg=Traits.ASSUMED_SOURCE.elevation_deg if pose.elevation_deg is None else pose.elevation_deg,
        radius_m=Traits.ASSUMED_SOURCE.radius_m if pose.radius is None else pose.radius,
    )


def stated_mount(pose: SourcePose | None, hfov_deg: float | None, traits: Traits) -> CameraMount | None:
    """The camera on its vehicle, for the live model where a mount was stated: it knows where the ground is then.

    hfov_deg: horizontal field of view of the picture the model is given, None if nobody knows.
    Raises:
        OptionError: numbers that no camera has.
    """
    if not traits.live or pose is None or not pose.on_vehicle:
        return None
    usual = CameraMount(hfov_deg=assumed_hfov_deg(pose))
    return CameraMount(
        height_m=usual.height_m if pose.height_m is None else pose.height_m,
        forward_m=usual.forward_m if pose.forward_m is None else pose.forward_m,
        left_m=usual.left_m if pose.left_m is None else pose.left_m,
        tilt_deg=usual.tilt_deg if pose.tilt_deg is None else pose.tilt_deg,
        hfov_deg=usual.hfov_deg if hfov_deg is None else hfov_deg,
    )


def assumed_hfov_deg(pose: SourcePose | None) -> float:
    """See `Traits.assumed_hfov_deg`."""
    return Traits.assumed_hfov_deg(on_sphere=pose is not None and pose.on_sphere)


def in_words(mount: CameraMount | None, pose: SourcePose | None, traits: Traits) -> str:
    """Where the live model is told that the source camera stands; empty where nothing is stated, and for other models.

    mount: as `stated_mount` gives it.
    """
    if not traits.live or pose is None:
        return ""
    if mount is not None:
        where = f"{mount.height_m:g} m above the ground, {mount.forward_m:g} m ahead, tilted {mount.tilt_deg:g} degrees"
    else:
        source = stated_sphere(pose) or Traits.ASSUMED_SOURCE
        where = f"at an elevation of {source.elevation_deg:g} degrees and a radius of {source.radius_m:g} m"
    return f"the source camera stands {where}"
