"""Calibration of ParallelDomain scenes: lens and pose of each camera, in the spellings that occur."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.datasets.picture_files import MOST_TEXT, read
from gcd_train.datasets.rotations import pose_from_quaternion
from gcd_train.datasets.skips import FileFault
from gcd_train.errors import DataError

_ROTATIONS, _TRANSLATIONS = ("rotation", "orientation"), ("translation", "position")


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraCalibration:
    """One camera on the vehicle. fx, fy, cx, cy: pixels. vehicle_from_camera: f64 [4, 4], metres."""

    path: Path
    fx: float
    fy: float
    cx: float
    cy: float
    vehicle_from_camera: NDArray[np.float64]

    def lens(self, width: int, height: int) -> Intrinsics:
        """For pictures of this size. Raises FileFault for a lens that no picture of this size has."""
        if not (0 <= self.cx <= width and 0 <= self.cy <= height):
            raise FileFault(
                self.path,
                f"says that the optical axis meets the picture at ({self.cx:g}, {self.cy:g}), outside of the "
                f"{width} x {height} pixels that pictures have: they were resized or the file is another scene's",
            )
        try:
            return Intrinsics(fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=width, height=height)
        except ModelError as error:
            raise FileFault(self.path, f"holds an impossible lens: {error}") from error


class _File(msgspec.Struct, frozen=True):
    """Others' file; lists are parallel. What is no camera (velodyne) may have null or empty entries."""

    names: list[str]
    intrinsics: list[dict[str, Any] | None]
    extrinsics: list[dict[str, Any] | None]


def read_calibration(folder: Path, cameras: Sequence[str]) -> dict[str, CameraCalibration]:
    """These cameras of a scene's `calibration` folder, from however many JSON files they are in.

    Raises: FileFault if there is no file, one is damaged, or a camera is in none.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise FileFault(folder, "holds no JSON: where the cameras are is unknown; download the scene again")
    found: dict[str, CameraCalibration] = {}
    for path in paths:
        wanted = [camera for camera in cameras if camera not in found]
        if wanted:
            found |= _cameras_of(path, wanted)
    lacking = [camera for camera in cameras if camera not in found]
    if lacking:
        raise FileFault(paths[0], f"lacks {len(lacking)} of {len(cameras)} cameras, first: {lacking[0]}")
    return found


def _cameras_of(path: Path, wanted: Sequence[str]) -> dict[str, CameraCalibration]:
    try:
        file = decode_json(read(path, MOST_TEXT), _File)
        if not len(file.names) == len(file.intrinsics) == len(file.extrinsics):
            raise FileFault(path, "is damaged: its lists of names, intrinsics and extrinsics differ in length")
        places = {name: place for place, name in enumerate(file.names) if name in wanted}
        return {name: _camera(path, file.intrinsics[at], file.extrinsics[at]) for name, at in places.items()}
    except FileError as error:
        raise FileFault(path, f"is no calibration: it {error}") from error


def _camera(path: Path, lens: Mapping[str, Any] | None, pose: Mapping[str, Any] | None) -> CameraCalibration:
    rotation = _first(path, pose or {}, _ROTATIONS)
    translation = _first(path, pose or {}, _TRANSLATIONS)
    quaternion = [_number(path, rotation, (f"q{axis}", axis)) for axis in "wxyz"]
    position = [_number(path, translation, (axis,)) for axis in "xyz"]
    try:
        matrix = pose_from_quaternion(np.array(quaternion), np.array(position))
    except DataError as error:
        raise FileFault(path, f"holds no usable camera pose: {error}") from error
    fx, fy, cx, cy = (_number(path, lens or {}, (name,)) for name in ("fx", "fy", "cx", "cy"))
    return CameraCalibration(path=path, fx=fx, fy=fy, cx=cx, cy=cy, vehicle_from_camera=matrix)


def _first(path: Path, pose: Mapping[str, Any], spellings: Sequence[str]) -> Mapping[str, Any]:
    for spelling in spellings:
        if isinstance(pose.get(spelling), dict):
            return pose[spelling]
    raise FileFault(path, f"holds a camera without {' or '.join(spellings)}")


def _number(path: Path, numbers: Mapping[str, Any], spellings: Sequence[str]) -> float:
    for spelling in spellings:
        value = numbers.get(spelling)
        if isinstance(value, int | float) and math.isfinite(value):
            return float(value)
    raise FileFault(path, f"holds a camera without a number for {' or '.join(spellings)}")
