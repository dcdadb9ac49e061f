"""`meta/cameras.json`: where the cameras of a LeRobot data set stand; LeRobot itself has no field for it.

    {"cameras": {"observation.images.front": {
        "width": 640, "height": 480, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0,
        "base_from_camera": [[1, 0, 0, 0.4], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]}}}

Pixels count from the top left corner of the picture (an OpenCV calibration: add 0.5 to cx and cy); no distortion. The
base is the robot's, metres; camera axes are x right, y down, z ahead. A camera that moves has, instead of
`base_from_camera`, a `pose_feature`: the name of a feature with its base_from_camera of each frame, 16 numbers row by
row.
"""

from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.errors import FileError, ModelError
from gcd_model.geometry import Intrinsics, require_rigid
from gcd_model.small_files import read_json
from gcd_train.data.files import FileFault
from gcd_train.errors import DataError

CAMERA_FILE = "meta/cameras.json"
Rows = tuple[tuple[float, ...], ...]


class CameraCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera: its pinhole in pixels, and where it stands, once for all or by the name of a feature."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    base_from_camera: Rows | None = None
    pose_feature: str | None = None

    @property
    def lens(self) -> Intrinsics:
        """The pinhole. Raises OptionError or ShapeError if it is none."""
        return Intrinsics(fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, width=self.width, height=self.height)

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """base_from_camera [4, 4] of a camera that stands still."""
        return None if self.base_from_camera is None else np.asarray(self.base_from_camera, np.float64)


class CameraFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All calibrated cameras, by the name of their feature, for one `observation.images.front`."""

    cameras: dict[str, CameraCalibration]


_EXAMPLE = msgspec.json.encode(
    CameraFile(
        cameras={
            "observation.images.front": CameraCalibration(
                width=640,
                height=480,
                fx=600.0,
                fy=600.0,
                cx=320.0,
                cy=240.0,
                base_from_camera=((1, 0, 0, 0.4), (0, -1, 0, 0), (0, 0, -1, 1.2), (0, 0, 0, 1)),
            )
        }
    )
).decode()


def read_cameras(folder: Path, calibration: Path | None = None) -> dict[str, CameraCalibration]:
    """The calibration of a data set, from its own file or from another one.

    Raises:
        DataError: there is none; the message shows what to write. FileFault: it is wrong.
    """
    path = calibration or folder / CAMERA_FILE
    if not path.exists():
        raise DataError(
            f"{path} is missing: LeRobot keeps no camera poses, and pairs of cameras need them; write one there, or "
            f"give another with --calibration FILE; for example {_EXAMPLE}"
        )
    try:
        cameras = read_json(path, CameraFile).cameras
    except FileError as error:
        raise FileFault(path, f"is no camera calibration: it {error}; for example {_EXAMPLE}") from error
    for name, camera in cameras.items():
        _check(path, name, camera)
    if len(cameras) < 2:
        raise FileFault(path, f"tells of {len(cameras)} camera(s), pairs need two or more")
    return cameras


def _check(path: Path, name: str, camera: CameraCalibration) -> None:
    if (camera.base_from_camera is None) == (camera.pose_feature is None):
        raise FileFault(path, f"must give {name} either base_from_camera or pose_feature")
    try:
        camera.lens  # noqa: B018  refuses what is no pinhole
        if camera.pose is not None:
            require_rigid(torch.from_numpy(camera.pose), f"base_from_camera of {name}")
    except (ModelError, ValueError) as error:
        raise FileFault(path, f"is wrong about {name}: {error}") from error


def write_cameras(folder: Path, cameras: dict[str, CameraCalibration]) -> None:
    """Write `meta/cameras.json` of a data set."""
    text = msgspec.json.format(msgspec.json.encode(CameraFile(cameras=cameras)), indent=1)
    (folder / CAMERA_FILE).write_bytes(text)
