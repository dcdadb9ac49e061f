"""Where frames come from: the section [source] of a launch file, one struct for each kind with the keys that kind has,
and its source, open. One contract, `gcd_node.frame`. What a kind needs is imported when such a source is opened.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias, get_args

import msgspec
from msgspec import Meta

from gcd_node.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from gcd_node.auth import EventSink, ServerSecurity
    from gcd_node.frame import FrameSource

_PACKAGE = "package:"

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
Rate: TypeAlias = Annotated[float, Meta(gt=0, le=1000)]
Count: TypeAlias = Annotated[int, Meta(ge=1)]
SourceKind: TypeAlias = Literal["file", "folder", "synthetic", "mcap", "v4l2", "rtsp", "oak", "push"]


class SourcePose(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera stands: on a sphere around the scene, or on its vehicle; not both.

    elevation_deg, radius: for models steered by angles: above the ground plane (left out, 5), and distance to the
        scene's centre, metres or scene units (left out, 15). Views are differences, so rigid transforms alone need it.
    height_m, forward_m, left_m, tilt_deg: for the live model: above the ground, ahead and to the left of the vehicle's
        origin, and how far the camera looks down. What is left out is as CameraMount has it.
    """

    elevation_deg: Annotated[float, Meta(gt=-90, lt=90)] | None = None
    radius: Positive | None = None
    height_m: Annotated[float, Meta(gt=0, le=100)] | None = None
    forward_m: Annotated[float, Meta(ge=-100, le=100)] | None = None
    left_m: Annotated[float, Meta(ge=-100, le=100)] | None = None
    tilt_deg: Annotated[float, Meta(gt=-90, lt=90)] | None = None

    def __post_init__(self) -> None:
        if self.on_sphere and self.on_vehicle:
            raise ValueError(
                "a camera stands on a sphere (elevation, radius) or on its vehicle (height, forward, left, tilt): "
                "state one of the two"
            )

    @property
    def on_sphere(self) -> bool:
        """Whether elevation or radius is stated."""
        return (self.elevation_deg, self.radius) != (None, None)

    @property
    def on_vehicle(self) -> bool:
        """Whether anything of the mount is stated."""
        return (self.height_m, self.forward_m, self.left_m, self.tilt_deg) != (None,) * 4


class _Source(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """What every kind has.

    hfov_deg: horizontal field of view of the source picture, if known; then no lens the source itself knows is used.
        What is wider than the model was trained with is cut off, if enough pixels are left. Published as intrinsics,
        part of the mount for models that warp by known planes, and what the live model needs to know most.
    resize: "released" is the bilinear resize the checkpoints were trained with, "area" averages (less aliasing). Where
        there is a calibration neither: pictures are undistorted at twice the size and averaged.
    allow_upscale: enlarge pictures that are smaller than the model takes, instead of refusing them.
    pose: where the camera stands, see there.
    calibration: a ROS camera_info YAML file; left out, what the source itself knows (OAK memory, CameraInfo in a log).
        With one, pictures are undistorted and cut to the field of view the model was trained with.
    """

    hfov_deg: Annotated[float, Meta(gt=0, lt=180)] | None = None
    resize: Literal["released", "area"] = "released"
    allow_upscale: bool = False
    pose: SourcePose | None = None
    calibration: str | None = None

    @property
    def kind(self) -> SourceKind:
        """As the launch file names it."""
        tag: Any = self.__struct_config__.tag
        return tag


class RecordedSource(_Source, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """pace: "realtime" plays at the recorded speed; "lockstep" waits for the model and skips nothing.
    loop: begin again at its end."""

    pace: Literal["realtime", "lockstep"] = "realtime"
    loop: bool = False


class FileSource(RecordedSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="file"):
    """path: of a video; `package:drive.mp4` and `package:workbench.mp4` ship. fps: instead of its stamps."""

    path: str
    fps: Rate | None = None


class FolderSource(RecordedSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="folder"):
    """path: of a folder of pictures. fps: at which they were taken; they cannot say."""

    path: str
    fps: Rate


class McapSource(RecordedSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="mcap"):
    """path: of an MCAP file, a ROS 2 bag or its folder, a ROS 1 bag.
    topic: where the pictures are; left out if the log has just one such topic.
    depth_topic, odometry_topic: depth pictures aligned with them, and nav_msgs/Odometry. Each frame carries those whose
        stamps are nearest to its own, within half a frame period."""

    path: str
    topic: str | None = None
    depth_topic: str | None = None
    odometry_topic: str | None = None


class SyntheticSource(RecordedSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="synthetic"):
    """A moving pattern. frames: end after so many."""

    fps: Rate = 10.0
    frames: Count | None = None


class LiveSource(_Source, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera: it does not wait and cannot be played again.

    open_timeout_s: how long it may take to open, to its first picture.
    stall_ms: silence after which it counts as stalled; left out, 3 frame periods and at least 200.
    max_reconnects: give up after so many failed attempts in a row; left out, never.
    fps: asked of `v4l2` and `oak` (left out, 30); of `rtsp` it counts instead of what the stream states, of `push`
        instead of what is measured.
    """

    pace: ClassVar[Literal["realtime"]] = "realtime"
    open_timeout_s: Positive = 5.0
    stall_ms: Positive | None = None
    max_reconnects: Annotated[int, Meta(ge=0)] | None = None
    fps: Rate | None = None


class V4l2Source(LiveSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="v4l2"):
    """device: a number or a path such as /dev/video0 (left out, 0); one in /dev/v4l/by-id stays the same when cables
        move.
    width, height: what it is asked for; it may give something else, which is then used and said."""

    device: str | None = None
    width: Count | None = None
    height: Count | None = None


class RtspSource(LiveSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="rtsp"):
    """url: rtsp://, or http:// and udp:// streams of the same decoder. May hold a password: never logged."""

    url: str


class OakSource(LiveSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="oak"):
    """device: an id, USB port or address; left out, the only one there is, and that one again when it was lost.
    socket: of the sensor, such as "CAM_A"; left out, the one that DepthAI takes for colour.
    width, height: of the pictures. fps: left out, 30.
    focus: lens position, 0 (far) to 255 (near); left out, the camera focuses by itself, and a lens that moves changes
        its field of view by a few per cent.
    exposure_us, iso: both, or neither: the camera exposes by itself.
    anti_banding: keeps lamps on the mains from flickering; left out, as the camera has it.
    open_timeout_s: a search, a boot and a connection take up to 30 s.
    """

    open_timeout_s: Positive = 30.0
    device: str | None = None
    socket: Annotated[str, Meta(pattern=r"^CAM_[A-J]$(?!\n)")] | None = None
    focus: Annotated[int, Meta(ge=0, le=255)] | None = None
    exposure_us: Annotated[int, Meta(ge=1, le=33_000)] | None = None
    iso: Annotated[int, Meta(ge=100, le=1600)] | None = None
    anti_banding: Literal["off", "50hz", "60hz", "auto"] | None = None
    width: Count = 1280
    height: Count = 720

    def __post_init__(self) -> None:
        if (self.exposure_us is None) != (self.iso is None):
            raise ValueError("a fixed exposure is exposure_us and iso: state both, or neither")


class PushSource(LiveSource, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="push"):
    """endpoint: where frames are pushed to, as in [publish]."""

    endpoint: str = "ipc"


SourceConfig: TypeAlias = (
    FileSource | FolderSource | McapSource | SyntheticSource | V4l2Source | RtspSource | OakSource | PushSource
)
_KINDS: dict[str, type[_Source]] = {str(each.__struct_config__.tag): each for each in get_args(SourceConfig)}
LIVE_KINDS: frozenset[SourceKind] = frozenset({"v4l2", "rtsp", "oak", "push"})
"""Sources that cannot be played again, and that may fall silent and come back."""


def prepare_source(table: dict[str, Any], name: str) -> None:
    """Make a [source] without a kind a file, before it is read.

    Raises:
        ConfigError: no such kind; a key that its kind has not.
    """
    from gcd_model import explain_settings_error  # only now: it brings torch

    section = table.get("source")
    if not isinstance(section, dict):
        return
    kind = section.setdefault("kind", "file")
    if kind not in _KINDS:
        raise ConfigError(f"{name}: [source] kind must be one of {', '.join(_KINDS)}, got {kind!r}")
    for key in section.keys() - {"kind", *_KINDS[kind].__struct_fields__}:
        unknown = explain_settings_error(f"Object contains unknown field `{key}`", _KINDS[kind])
        raise ConfigError(f"{name}: [source] of kind {kind!r}: {unknown}")


def open_source(
    config: SourceConfig, security: "ServerSecurity | None" = None, on_event: "EventSink | None" = None
) -> "FrameSource":
    """The source a launch file asks for; see FrameSource. security, on_event: for one that listens, see open_push().

    Raises:
        SourceError: it cannot be opened, or the package it needs is not installed; the message says which.
        ConfigError: a setting is wrong.
    """
    match config:
        case FileSource() | FolderSource():
            from gcd_node.sources import files

            path, pace, loop = resolve_path(config.path), config.pace, config.loop
            if isinstance(config, FileSource):
                return files.VideoFile(path, fps=config.fps, pace=pace, loop=loop)
            return files.ImageFolder(path, fps=config.fps, pace=pace, loop=loop)
        case McapSource():
            from gcd_node.sources.logs import LogSource

            return LogSource(
                resolve_path(config.path),
                topic=config.topic,
                depth_topic=config.depth_topic,
                odometry_topic=config.odometry_topic,
                pace=config.pace,
                loop=config.loop,
            )
        case SyntheticSource():
            from gcd_node.sources.files import MovingPattern

            return MovingPattern(fps=config.fps, frames=config.frames, pace=config.pace, loop=config.loop)
        case V4l2Source() | RtspSource():
            from gcd_node.sources import opencv

            return opencv.open_v4l2(config) if isinstance(config, V4l2Source) else opencv.open_stream(config)
        case OakSource():
            from gcd_node.sources.oak import open_oak

            return open_oak(config)
        case PushSource():
            from gcd_node.sources.push import open_push

            return open_push(config, security, on_event)


def resolve_path(name: str) -> Path:
    """The path a launch file means: `package:drive.mp4` is a file of this package, anything else is itself.

    Raises:
        SourceError: the package has no such file.
    """
    if not name.startswith(_PACKAGE):
        return Path(name).expanduser()
    assets = Path(__file__).parent.parent / "assets"
    path = assets / name.removeprefix(_PACKAGE)
    if path.parent != assets or not path.is_file():
        known = ", ".join(sorted(_PACKAGE + entry.name for entry in assets.glob("*.mp4")))
        raise SourceError(f"the package has no file {name}; it has {known or 'none, install it again'}")
    return path
