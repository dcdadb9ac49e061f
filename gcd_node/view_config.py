"""A virtual camera as a launch file states it, and the file in which `gcd-node calibrate-view` leaves a pose."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import tomli_w
from msgspec import Meta

from gcd_node.errors import ConfigError
from gcd_node.sources import Count, Positive

Matrix: TypeAlias = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
Pose: TypeAlias = tuple[float, ...]
_FARTHEST_M = 10_000.0
ViewId: TypeAlias = Annotated[str, Meta(pattern=r"^(?!src$)[a-z0-9_]{1,16}$(?!\n)")]  # src is the input


class ViewConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A virtual camera.

    kind: of a fixed view the goal is stated as differences from the source camera; none for a checkpoint with one fixed
        view, or for the live model's view from above and behind.
    orbit: starts there and swings in azimuth by rate_deg_s, between -amplitude_deg and +amplitude_deg.
    position_m, look_at_m: of a fixed view, instead of differences, for models that take any pose: where it stands and
        what it looks at, (x, y, z) in the frame of what the source camera is mounted on (x ahead, y left, z up, the
        ground at z = 0).
    pose: of kind "pose", the view's camera in the source camera's axes (x right, y down, z ahead; metres for models
        that know them): x, y, z and a quaternion x, y, z, w, or the 16 numbers of a rigid 4x4 matrix row by row.
    canonical: what another camera, such as a policy's in training, saw from where it stood. reference: its picture, or
        a folder of them. hfov_deg or calibration: its lens, as of a source. size: width and height of the view; left
        out, the reference's; of another shape: stretched, as a policy's resizing does. pose: of that camera, as above;
        left out, the node finds it. realign: the pose follows a source camera that was moved.
    """

    kind: Literal["fixed", "orbit", "pose", "canonical"] = "fixed"
    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    radius: float = 0.0
    position_m: tuple[float, float, float] | None = None
    look_at_m: tuple[float, float, float] | None = None
    pose: Pose | None = None
    rate_deg_s: float | None = None
    amplitude_deg: Positive | None = None
    reference: str | None = None
    hfov_deg: Annotated[float, Meta(gt=0, lt=180)] | None = None
    calibration: str | None = None
    size: tuple[Count, Count] | None = None
    realign: bool = False

    def __post_init__(self) -> None:
        if (self.position_m is None) != (self.look_at_m is None):
            raise ValueError("position_m says where a view stands, look_at_m what it looks at: state both")
        if sum([self.position_m is not None, self.pose is not None, not self.at_source]) > 1:
            raise ValueError("a goal is angles and radius, or position_m and look_at_m, or pose: state one of them")
        if (self.pose is not None) != (self.kind == "pose") and self.kind != "canonical":
            raise ValueError('kind = "pose" goes with pose, x, y, z and a quaternion x, y, z, w: state both')
        of_camera = (self.reference, self.hfov_deg, self.calibration, self.size)
        if self.kind != "canonical":
            if self.realign or any(each is not None for each in of_camera):
                raise ValueError('reference, hfov_deg, calibration, size and realign are for kind = "canonical"')
        elif self.reference is None or (self.hfov_deg is None) == (self.calibration is None):
            raise ValueError('kind = "canonical" needs reference, a picture or a folder, and hfov_deg or calibration')
        elif self.position_m is not None or not self.at_source:
            raise ValueError('kind = "canonical" stands where its pose says: leave angles, radius and position_m out')
        if self.pose is not None:
            pose_matrix(self.pose)
        if self.kind == "orbit" and self.position_m is not None:
            raise ValueError('an orbit swings about the scene: leave position_m to kind = "fixed"')
        if {self.rate_deg_s is not None, self.amplitude_deg is not None} != {self.kind == "orbit"}:
            raise ValueError('an orbit needs rate_deg_s and amplitude_deg, which are for kind = "orbit" alone')

    @property
    def at_source(self) -> bool:
        """Whether there is no difference of angles and radius."""
        return (self.azimuth_deg, self.elevation_deg, self.radius) == (0.0, 0.0, 0.0)

    @property
    def plain(self) -> dict[str, object]:
        """Plain values; of those that came later, such as position_m, the stated ones."""
        later = ("position_m", "look_at_m", "pose", "reference", "hfov_deg", "calibration", "size", "realign")
        plain: dict[str, object] = msgspec.to_builtins(self)
        return {name: value for name, value in plain.items() if name not in later or value not in (None, False)}


def pose_matrix(pose: Pose) -> Matrix:
    """A view's pose as the 16 numbers of a 4x4 matrix, row by row; whether a matrix is rigid, the model looks at.

    Raises ValueError: neither 7 nor 16 numbers, not finite, farther than 10 km away, or a quaternion not of length 1.
    """
    if len(pose) not in (7, 16) or not all(map(math.isfinite, pose)):
        raise ValueError("a pose is 7 numbers, x, y, z and a quaternion x, y, z, w, or 16 of a 4x4 matrix, all finite")
    if max(map(abs, pose)) > _FARTHEST_M:
        raise ValueError(f"a pose lies within {_FARTHEST_M:.0f} m of the source camera, got {max(map(abs, pose)):g}")
    if len(pose) == 16:
        return pose
    (a, b, c), (x, y, z, w) = pose[:3], pose[3:]
    if not math.isclose(math.hypot(x, y, z, w), 1.0, abs_tol=1e-3):
        raise ValueError(f"a quaternion x, y, z, w has length 1, got {math.hypot(x, y, z, w):g}")
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), a),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), b),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), c),
        *(0.0, 0.0, 0.0, 1.0),
    )


class CalibratedView(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What `gcd-node calibrate-view` found: the pose of the reference's camera in the source camera's axes, how far
    that is from the source, by how much each of it may be wrong, and of how many common corners how many agree."""

    pose: Matrix
    pixels: float
    degrees: float
    centimetres: float
    doubt_pixels: float
    doubt_degrees: float
    doubt_centimetres: float
    inliers: Count
    matches: Count

    def to_toml(self) -> str:
        """As `prepare_views` reads it."""
        return tomli_w.dumps(msgspec.to_builtins(self))


def prepare_views(table: dict[str, Any], name: str) -> None:
    """Put the numbers in the place of each view's pose that names a file, before the table is read. Raises ConfigError:
    the file is missing, or no such file."""
    from gcd_model import FileError, decode_toml, read_small  # only now: it brings torch

    views = table.get("view")
    for view_id, view in views.items() if isinstance(views, dict) else ():
        path = view.get("pose") if isinstance(view, dict) else None
        if isinstance(path, str):
            try:
                found = msgspec.convert(decode_toml(read_small(Path(path).expanduser())), CalibratedView)
            except (FileError, msgspec.ValidationError) as error:
                raise ConfigError(
                    f"{name}: [view.{view_id}] pose: {path} {error}; make it with `gcd-node calibrate-view`"
                ) from error
            view["pose"] = list(found.pose)
