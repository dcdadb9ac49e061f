"""A DepthAI calibration file: the lenses of an OAK's cameras and how they stand to each other."""

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_node.errors import ConfigError
from gcd_node.optics.calibration import Distortion, LensModel

_LARGEST_FILE = 1 << 20
_COEFFICIENTS: dict[int, tuple[Distortion, int]] = {0: ("rational_polynomial", 14), 1: ("equidistant", 4)}
_MOST_JOINTS = 16  # between two cameras of a board
_ROTATION_TOLERANCE = 1e-3


def read_depthai(path: Path) -> "DepthaiBoard":
    """What DepthAI's `eepromToJsonFile` wrote: the memory of an OAK.

    Raises:
        ConfigError: missing, or not such a file.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_LARGEST_FILE + 1)
    except OSError as error:
        raise ConfigError(f"cannot read the calibration: {error.strerror}; check the path") from error
    if len(text) > _LARGEST_FILE:
        raise ConfigError(f"larger than {_LARGEST_FILE} bytes; give the JSON file of DepthAI's eepromToJsonFile")
    try:
        return msgspec.json.decode(text, type=DepthaiBoard)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not a calibration of DepthAI ({error}); give the JSON file of eepromToJsonFile") from error


class _Offset(msgspec.Struct, frozen=True, kw_only=True):
    x: float
    y: float
    z: float


class _Extrinsics(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """From this camera's axes to those of another on the board; -1 is no other."""

    rotation_matrix: tuple[tuple[float, float, float], ...]
    translation: _Offset  # centimetres
    to_camera_socket: int

    @property
    def transform(self) -> NDArray[np.float64] | None:
        """[4, 4], metres; None if the rotation is none."""
        if len(self.rotation_matrix) != 3:
            return None
        transform = np.eye(4)
        transform[:3, :3] = rotation = np.array(self.rotation_matrix)
        transform[:3, 3] = np.array([self.translation.x, self.translation.y, self.translation.z]) / 100
        proper = np.abs(rotation @ rotation.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
        return transform if proper else None


class _Camera(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    camera_type: int = 0  # 0 perspective, 1 fish-eye
    width: int
    height: int
    intrinsic_matrix: tuple[tuple[float, float, float], ...]
    distortion_coeff: tuple[float, ...]
    extrinsics: _Extrinsics


class DepthaiBoard(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """A DepthAI calibration file; other keys of it are of no interest here."""

    camera_data: tuple[tuple[int, _Camera], ...]

    def _camera(self, socket: int) -> _Camera:
        cameras = dict(self.camera_data)
        if socket not in cameras:
            there = ", ".join(map(str, sorted(cameras))) or "none"
            raise ConfigError(f"there is no camera at socket {socket}, only at {there}: name two of these")
        return cameras[socket]

    def lens(self, socket: int) -> LensModel:
        """Raises ConfigError: no such camera, or it was never calibrated."""
        camera = self._camera(socket)
        if camera.camera_type not in _COEFFICIENTS:
            raise ConfigError(f"the camera at socket {socket} has a lens of type {camera.camera_type}; known are 0, 1")
        if len(camera.intrinsic_matrix) != 3:
            raise ConfigError(f"the camera at socket {socket} must have a 3 x 3 matrix; calibrate the device")
        distortion, count = _COEFFICIENTS[camera.camera_type]
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsic_matrix
        try:
            return LensModel(
                width=camera.width,
                height=camera.height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                distortion=distortion,
                coefficients=(*camera.distortion_coeff, *[0.0] * count)[:count],
            )
        except ConfigError as error:
            raise ConfigError(f"the camera at socket {socket}: {error}") from error

    def transform(self, left: int, right: int) -> NDArray[np.float64]:
        """right_from_left, [4, 4], metres. Raises ConfigError if the file does not connect the two."""
        left_chain, right_chain = self._chain(left), self._chain(right)
        common = next((socket for socket in left_chain if socket in right_chain), None)
        if common is None or left == right:
            raise ConfigError(
                f"the file does not say how the cameras at sockets {left} and {right} stand to each other: "
                "calibrate the pair, or name two that it knows"
            )
        return np.linalg.inv(right_chain[common]) @ left_chain[common]

    def _chain(self, socket: int) -> dict[int, NDArray[np.float64]]:
        """other_from_socket, for each camera that the file leads to from this one; a step without a rotation ends it:
        DepthAI fills what was never calibrated with zeros."""
        chain, here = {socket: np.eye(4)}, socket
        for _ in range(_MOST_JOINTS):
            extrinsics = self._camera(here).extrinsics
            onward, step = extrinsics.to_camera_socket, extrinsics.transform
            if onward < 0 or onward in chain or step is None:
                break
            chain[onward] = step @ chain[here]
            here = onward
        return chain
