"""The node's settings, as a launch file states them (TOML).

Longer than most files: one page with every section of a launch file.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_node.config_changes import with_changes
from gcd_node.errors import ConfigError

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Count: TypeAlias = Annotated[int, Meta(ge=1)]
_LEAST_ROTATE_MB, _LEAST_ROTATE_S = 0.1, 1.0
Matrix: TypeAlias = Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
ViewId: TypeAlias = Annotated[str, Meta(pattern=r"^(?!src$)[a-z0-9_]{1,16}$(?!\n)")]  # src is the input


class SourcePose(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the source camera stands: on a sphere around the scene, or on its vehicle; not both.

    elevation_deg, radius: for models steered by angles: above the ground plane (left out, 5), and distance to the
        scene's centre, metres or scene units (left out, 15). Views are differences, so rigid transforms alone need it.
    height_m, forward_m, left_m, tilt_deg: for models that warp by known planes, and for the live model: above the
        ground, ahead and to the left of the vehicle's origin, and how far the camera looks down. What is left out is as
        the model was trained.
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


SourceKind: TypeAlias = Literal["file", "folder", "synthetic", "mcap", "v4l2", "rtsp", "oak"]
LIVE_KINDS: frozenset[SourceKind] = frozenset({"v4l2", "rtsp", "oak"})
"""Sources that cannot be played again, and that may fall silent and come back."""


class SourceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where frames come from.

    path: a video file, a folder of images or an MCAP log; `package:drive.mp4` and `package:workbench.mp4` ship.
    device: of `v4l2` a number or a path such as /dev/video0 (left out, 0); one in /dev/v4l/by-id stays the same when
        cables move. Of `oak` an id, USB port or address; left out, the only one there is, and that one again when it
        was lost.
    url: of `rtsp`: rtsp://, or http:// and udp:// streams of the same decoder. May hold a password: never logged.
    topic: of `mcap`: where the pictures are; left out if the log has just one such topic.
    width, height: what a camera of this machine is asked for; it may give something else, which is then used and said.
        `oak`: left out, 1280 x 720.
    pace: "realtime" plays at the recorded speed; "lockstep" waits for the model and skips nothing.
    loop: begin a recording again at its end.
    fps: of an image folder, which cannot say. `v4l2` and `oak` are asked for it (`oak`: left out, 30); of `rtsp` it
        counts instead of what the stream states, of a video file instead of its stamps; a synthetic drive has it (left
        out, 10). Not for a log, whose pictures have stamps.
    hfov_deg: horizontal field of view of the source picture, if known; then no lens the source itself knows is used.
        What is wider than the model was trained with is cut off, if enough pixels are left. Published as intrinsics,
        part of the mount for models that warp by known planes, and what the live model needs to know most.
    resize: "released" is the bilinear resize the checkpoints were trained with, "area" averages (less aliasing). Where
        there is a calibration neither: pictures are undistorted at twice the size and averaged.
    allow_upscale: enlarge pictures that are smaller than the model takes, instead of refusing them.
    frames, seed: of a synthetic drive: stop after so many; which street.
    pose: where the camera stands, see there.
    calibration: a ROS camera_info YAML file; left out, what the source itself knows (OAK memory, CameraInfo in a log).
        With one, pictures are undistorted and cut to the field of view the model was trained with.
    open_timeout_s: how long a live camera may take to open.
    stall_ms: silence after which a live source counts as stalled; left out, 3 frame periods and at least 200.
    max_reconnects: give up after so many failed attempts in a row; left out, never.
    """

    kind: SourceKind = "file"
    path: str | None = None
    device: str | None = None
    url: str | None = None
    topic: str | None = None
    width: Count | None = None
    height: Count | None = None
    calibration: str | None = None
    open_timeout_s: Positive = 5.0
    stall_ms: Positive | None = None
    max_reconnects: Annotated[int, Meta(ge=0)] | None = None
    pace: Literal["realtime", "lockstep"] = "realtime"
    loop: bool = False
    fps: Positive | None = None
    hfov_deg: Annotated[float, Meta(gt=0, lt=180)] | None = None
    resize: Literal["released", "area"] = "released"
    allow_upscale: bool = False
    frames: Count | None = None
    seed: int = 0
    pose: SourcePose | None = None

    def __post_init__(self) -> None:
        if (self.path is None) != (self.kind not in ("file", "folder", "mcap")):
            raise ValueError(f"source kind {self.kind!r} {'takes no' if self.path else 'needs a'} path")
        if (self.url is None) != (self.kind != "rtsp"):
            raise ValueError(f"source kind {self.kind!r} {'takes no' if self.url else 'needs a'} url")
        if self.device is not None and self.kind not in ("v4l2", "oak"):
            raise ValueError(f"source kind {self.kind!r} takes no device")
        if self.kind in LIVE_KINDS and (self.pace == "lockstep" or self.loop):
            raise ValueError(f"a {self.kind} camera does not wait and cannot be played again: leave pace and loop out")
        if self.kind == "folder" and self.fps is None:
            raise ValueError("an image folder does not know its frame rate: give fps")


class WindowConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How frames become windows.

    fps: frame rate of a window; left out, the highest trained rate the source can give, or its own if there is none.
    stride: grid frames from one window to the next; left out, as many as a window holds (no overlap).
    max_skew: how far, in frame periods, a frame may lie from its place in time.
    """

    fps: Positive | None = None
    stride: Count | None = None
    max_skew: Annotated[float, Meta(gt=0, le=0.5)] = 0.5


class ModelSection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The model and how it is sampled. What is left out is as the checkpoint was made for.

    weights: a checkpoint, a diffusers folder, an export, `package:NAME`, or `random:FAMILY` (noise, for the plumbing).
    engine: what computes: "torch", "cuda" (compiled, on a GPU) or "onnxruntime" (exports); left out, what fits weights.
    providers: of onnxruntime, by its own names, best first; left out, its CPU one, or on device "cuda" its CUDA one.
    adapter: file of a low-rank adapter trained on these weights; family and move_time are then the adapter's.
    threads: CPU threads for the model, and for OpenCV beside it; leave the rest of the robot its cores.
    quality: "exact" draws as the checkpoint was made for; "fast" and "fastest" take fewer steps where it has many.
    steps, solver, guidance, guidance_interval: what is stated wins over quality. guidance: scale of the first and of
        the last frame; guidance_interval: lowest and highest noise level at which it applies (left out, at all).
    cond_aug: strength of the noise on the conditioning frames.
    depth_model: for the live model: an ONNX depth network whose depth takes the place of its own. depth_kind: "metric"
        gives metres; "inverse" is relative, and [source.pose] says where the ground is that gives the scale.
    on_bad_depth: where that network fails on a frame: "learned" goes on with the model's own depth for it, "stop" drops
        the windows that hold the frame.
    """

    weights: str
    adapter: str | None = None
    family: str | None = None
    device: str = "auto"
    engine: Literal["torch", "cuda", "onnxruntime"] | None = None
    providers: tuple[str, ...] = ()
    dtype: str | None = None
    threads: Count | None = None
    quality: Literal["exact", "fast", "fastest"] = "exact"
    steps: Count | None = None
    solver: Literal["euler", "dpmpp_2m"] | None = None
    guidance: tuple[float, float] | None = None
    guidance_interval: tuple[NotNegative, NotNegative] | None = None
    samples: Count = 1
    seed: int = 0
    motion_bucket: float | None = None
    move_time: Annotated[int, Meta(ge=0)] | None = None
    cond_aug: Annotated[float, Meta(ge=0)] | None = None
    head_width: Count | None = None
    image_heads: Count | None = None
    depth_model: str | None = None
    depth_kind: Literal["metric", "inverse"] = "metric"
    on_bad_depth: Literal["learned", "stop"] = "learned"

    def __post_init__(self) -> None:
        low, high = self.guidance_interval or (0.0, 0.0)
        if low > high:
            raise ValueError(f"guidance_interval goes from a noise level up to another, got {low:g} to {high:g}")


class ViewConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A virtual camera.

    fixed: its goal pose, as differences from the source camera; none for a checkpoint with one fixed view, or for the
        live model's view from above and behind.
    orbit: starts there and swings in azimuth by rate_deg_s, between -amplitude_deg and +amplitude_deg.
    position_m, look_at_m: of a fixed view, instead of differences, for models that take any pose: where it stands and
        what it looks at, (x, y, z) in the frame of what the source camera is mounted on (x ahead, y left, z up, the
        ground at z = 0).
    source_from_view: the same as 16 numbers, a rigid 4x4 matrix row by row: the view's camera in source camera axes.
    """

    kind: Literal["fixed", "orbit"] = "fixed"
    azimuth_deg: float = 0.0
    elevation_deg: float = 0.0
    radius: float = 0.0
    position_m: tuple[float, float, float] | None = None
    look_at_m: tuple[float, float, float] | None = None
    source_from_view: Matrix | None = None
    rate_deg_s: float | None = None
    amplitude_deg: Positive | None = None

    def __post_init__(self) -> None:
        if (self.position_m is None) != (self.look_at_m is None):
            raise ValueError("position_m says where a view stands, look_at_m what it looks at: state both")
        ways = [self.position_m is not None, self.source_from_view is not None, not self.at_source]
        if sum(ways) > 1:
            raise ValueError(
                "a goal is azimuth_deg, elevation_deg and radius, or position_m and look_at_m, or source_from_view: "
                "state one of them"
            )
        if self.kind == "orbit" and any(ways[:2]):
            raise ValueError('an orbit swings about the scene: leave position_m and source_from_view to kind = "fixed"')
        moving = (self.rate_deg_s is not None, self.amplitude_deg is not None)
        if self.kind == "orbit" and not all(moving):
            raise ValueError("an orbit needs rate_deg_s and amplitude_deg")
        if self.kind == "fixed" and any(moving):
            raise ValueError('a fixed view has no rate_deg_s and no amplitude_deg; for these say kind = "orbit"')

    @property
    def at_source(self) -> bool:
        """Whether there is no difference of angles and radius."""
        return (self.azimuth_deg, self.elevation_deg, self.radius) == (0.0, 0.0, 0.0)

    @property
    def plain(self) -> dict[str, object]:
        """Plain values; of position_m, look_at_m and source_from_view, which came later, those that are stated."""
        later = ("position_m", "look_at_m", "source_from_view")
        told: dict[str, object] = msgspec.to_builtins(self)
        return {name: value for name, value in told.items() if name not in later or value is not None}


class PublishConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where views go, and how.

    data, status: endpoints, or "ipc" for the runtime folder.
    min_subscribers: in lockstep, how many must be there before the first window is sent.
    end_delay_ms: how long the end-of-stream message follows the last window.
    """

    data: str = "ipc"
    status: str = "ipc"
    encoding: Literal["rgb8", "jpeg"] = "rgb8"
    jpeg_quality: Annotated[int, Meta(ge=50, le=100)] = 90
    min_subscribers: Annotated[int, Meta(ge=0)] = 0
    end_delay_ms: Annotated[int, Meta(ge=0)] = 500


class ControlConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The control socket. endpoint: as in [publish]; left out, the node takes no commands."""

    endpoint: str | None = "ipc"


class SecurityConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Who may connect over tcp: without both of these only this machine may.

    keys: folder with the node's CURVE key pair, as `gcd-node keys` makes it.
    allow: file of allowed client keys and their roles, viewer or operator.
    """

    keys: str | None = None
    allow: str | None = None

    def __post_init__(self) -> None:
        if (self.keys is None) != (self.allow is None):
            raise ValueError("encryption without a list of clients lets everybody in: state keys and allow, or neither")


class HealthConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the node tells of itself beside the status socket.

    http: "127.0.0.1:PORT" of /healthz, /readyz and /metrics; left out, none. Loopback only.
    log: "text" or "json" lines on stderr.
    """

    http: str | None = None
    log: Literal["text", "json"] = "text"


class LifeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the node behaves beside others.

    autostart: configure and activate at once; else it waits for commands.
    idle_s: without a subscriber for so long, nothing is rendered; 0 renders always.
    hang_s: a model step may take so long before the node counts as hung.
    nice: added to the process's niceness, 0 to 19.
    """

    autostart: bool = True
    idle_s: Annotated[float, Meta(ge=0)] = 0.0
    hang_s: Positive = 60.0
    nice: Annotated[int, Meta(ge=0, le=19)] = 0


class RecordConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept on disk, and where. Needs the extra `record`.

    folder: every recording gets a folder of its own in it; left out, nothing can be recorded.
    what: "inputs" is what the camera saw, "views" what was made of it. Everything else is small and always kept.
    input_encoding: of inputs; "raw" loses nothing and takes about ten times as much.
    jpeg_quality: of inputs, and of views that are published as rgb8.
    notes: headers, events, status, metadata and commands are JSON: as "ros2" inside std_msgs/String, which ROS 2 can
        play; as "json" on channels with a JSON schema, which viewers can plot and `ros2 bag play` refuses.
    rotate_mb, rotate_s: begin a new file after so much, or so long; 0 never.
    max_total_mb: what all recordings in `folder` may take; 0 without a limit. keep_free_mb: what its disk must keep
        free. Recording stops before either is passed; nothing is ever deleted.
    autostart: record from the first moment; else wait for record_start.
    """

    folder: str | None = None
    what: tuple[Literal["inputs", "views"], ...] = ("inputs", "views")
    input_encoding: Literal["jpeg", "raw"] = "jpeg"
    jpeg_quality: Annotated[int, Meta(ge=50, le=100)] = 90
    notes: Literal["ros2", "json"] = "ros2"
    rotate_mb: Annotated[float, Meta(ge=0)] = 500.0
    rotate_s: Annotated[float, Meta(ge=0)] = 0.0
    max_total_mb: Annotated[float, Meta(ge=0)] = 0.0
    keep_free_mb: Annotated[float, Meta(ge=0)] = 500.0
    autostart: bool = False

    def __post_init__(self) -> None:
        if self.autostart and self.folder is None:
            raise ValueError("to record from the start, state the folder that recordings go to")
        if 0 < self.rotate_mb < _LEAST_ROTATE_MB or 0 < self.rotate_s < _LEAST_ROTATE_S:
            raise ValueError(
                f"a file of a recording takes at least {_LEAST_ROTATE_MB:g} MB and {_LEAST_ROTATE_S:g} s (0: no limit)"
            )


class ViewerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A page to look at the node in a browser.

    http: "127.0.0.1:8470" or another port of this machine; left out, none. Loopback only.
    keys: the page's own client keys, as `gcd-node keys new` makes them; for a node with [security] on tcp endpoints.
    """

    http: str | None = None
    keys: str | None = None


class NodeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole launch file. strict: refuse what would only be flagged as out of the trained domain."""

    source: SourceConfig
    model: ModelSection
    view: Annotated[dict[ViewId, ViewConfig], Meta(min_length=1)]
    window: WindowConfig = WindowConfig()
    publish: PublishConfig = PublishConfig()
    control: ControlConfig = ControlConfig()
    security: SecurityConfig = SecurityConfig()
    health: HealthConfig = HealthConfig()
    life: LifeConfig = LifeConfig()
    record: RecordConfig = RecordConfig()
    viewer: ViewerConfig = ViewerConfig()
    node_id: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$(?!\n)")] = "gcd"
    strict: bool = False


def load_config(path: Path, changes: Sequence[str] = ()) -> NodeConfig:
    """Read a launch file. changes: such as `model.steps=4`, made before anything is checked.

    Raises:
        ConfigError: missing, not TOML, an unknown key (the nearest known one is named), a value out of range.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"cannot read the launch file {path}: {error.strerror}; give the path of a TOML file"
        ) from error
    return parse_config(text, str(path), changes)


def parse_config(text: bytes, name: str, changes: Sequence[str] = ()) -> NodeConfig:
    """Read a launch file's content; `name` is for the message. Raises ConfigError as `load_config`."""
    try:
        table = msgspec.toml.decode(text, type=dict[str, Any])
        return msgspec.convert(with_changes(table, changes), NodeConfig, strict=True)
    except msgspec.ValidationError as error:
        from gcd_model import explain_settings_error  # only now: it brings torch, and clients of a node need none

        raise ConfigError(f"{name}: {explain_settings_error(str(error), NodeConfig)}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{name} is not valid TOML: {error}") from error
