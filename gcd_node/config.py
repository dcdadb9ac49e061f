"""The node's settings, as a launch file states them (TOML): one page with every section of a launch file."""

import re
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Annotated, Literal, TypeAlias

import msgspec
import tomli_w
from msgspec import Meta

from gcd_node.errors import ConfigError
from gcd_node.sources import Count, Positive, Rate, SourceConfig, prepare_source
from gcd_node.view_config import ViewConfig, ViewId, prepare_views

NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
_LEAST_ROTATE_MB, _LEAST_ROTATE_S = 0.1, 1.0
_FARTHEST_CELL_M, _MOST_CELLS = 200.0, 512
_HIDDEN = "***"
Table: TypeAlias = dict[str, object]
"""A TOML table: keys to plain values, lists and tables."""


class WindowConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How frames become windows.

    fps: frame rate of a window; left out, the highest trained rate the source can give, or its own if there is none.
    stride: grid frames from one window to the next; left out, as many as a window holds (no overlap).
    max_skew: how far, in frame periods, a frame may lie from its place in time.
    """

    fps: Rate | None = None
    stride: Count | None = None
    max_skew: Annotated[float, Meta(gt=0, le=0.5)] = 0.5


EngineName = Literal["torch", "cuda", "onnxruntime"]
Quality = Literal["exact", "fast", "fastest"]
SolverName = Literal["euler", "dpmpp_2m", "heun"]
"""The model's own words once more: readers of launch files need no model, which takes seconds to import."""


class ModelSection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The model and how it is sampled. What is left out is as the checkpoint was made for.

    weights: a checkpoint, a diffusers folder, an export, `package:NAME`, or `random:FAMILY` (noise, for the plumbing);
        of engine "remote" the address of a service (`gcd-node serve`), http:// or https://.
    engine: what computes: "torch", "cuda" (compiled, on a GPU), "onnxruntime" (exports) or "remote"; left out, what
        fits weights.
    deadline_s, fallback, token: of engine "remote": from a window that is taken to its views; what renders the windows
        that are not back by then, a live model's weights or "drop"; file of the service's password.
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
    engine: EngineName | Literal["remote"] | None = None
    providers: tuple[str, ...] = ()
    dtype: str | None = None
    threads: Count | None = None
    quality: Quality = "exact"
    steps: Annotated[int, Meta(ge=1, le=1000)] | None = None
    solver: SolverName | None = None
    guidance: tuple[float, float] | None = None
    guidance_interval: tuple[NotNegative, NotNegative] | None = None
    samples: Count = 1
    seed: int = 0
    motion_bucket: float | None = None
    move_time: Annotated[int, Meta(ge=0)] | None = None
    cond_aug: NotNegative | None = None
    head_width: Count | None = None
    image_heads: Count | None = None
    depth_model: str | None = None
    depth_kind: Literal["metric", "inverse"] = "metric"
    on_bad_depth: Literal["learned", "stop"] = "learned"
    deadline_s: Annotated[float, Meta(ge=0.05, le=30)] = 2.0
    fallback: str = "drop"
    token: str | None = None

    def __post_init__(self) -> None:
        if (self.engine == "remote") != self.weights.startswith(("http://", "https://")):
            raise ValueError('engine = "remote" goes with the address of a service as weights, http://HOST:PORT')
        low, high = self.guidance_interval or (0.0, 0.0)
        if low > high:
            raise ValueError(f"guidance_interval goes from a noise level up to another, got {low:g} to {high:g}")


class GridConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A bird's-eye grid about the vehicle. extent_m: x from, x to, y from, y to; x ahead, y left of the vehicle's
    origin. seconds: for how long what is out of sight is remembered."""

    extent_m: tuple[float, float, float, float] = (-10.0, 30.0, -20.0, 20.0)
    cell_m: Annotated[float, Meta(ge=0.05, le=5)] = 0.5
    seconds: Annotated[float, Meta(ge=0, le=60)] = 2.0

    def __post_init__(self) -> None:
        sides = [(high - low) / self.cell_m for low, high in (self.extent_m[:2], self.extent_m[2:])]
        if not all(1 <= side <= _MOST_CELLS and abs(side - round(side)) < 1e-6 for side in sides):
            wanted = f"x from, x to, y from, y to, 1 to {_MOST_CELLS} whole cells of cell_m each"
            raise ValueError(f"extent_m is {wanted}, got {self.extent_m} and {self.cell_m:g}")
        farthest_m = min(_FARTHEST_CELL_M, _MOST_CELLS * self.cell_m)  # the memory lies all about the vehicle
        if max(map(abs, self.extent_m)) > farthest_m:
            raise ValueError(f"such a grid reaches at most {farthest_m:g} m from the vehicle, got {self.extent_m}")


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
    idle_s: NotNegative = 0.0
    hang_s: Positive = 60.0
    nice: Annotated[int, Meta(ge=0, le=19)] = 0


class RecordConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is kept on disk, and where.

    folder: every recording gets a folder of its own in it; left out, nothing can be recorded.
    what: "inputs" is what the camera saw, "views" what was made of it. Everything else is small and always kept.
    input_encoding: of inputs; "raw" loses nothing and takes about ten times as much.
    jpeg_quality: of inputs, and of views that are published as rgb8.
    rotate_mb, rotate_s: begin a new file after so much, or so long; 0 never.
    max_total_mb: what all recordings in `folder` may take; 0 without a limit. keep_free_mb: what its disk must keep
        free. Recording stops before either is passed; nothing is ever deleted.
    autostart: record from the first moment; else wait for record_start.
    """

    folder: str | None = None
    what: tuple[Literal["inputs", "views"], ...] = ("inputs", "views")
    input_encoding: Literal["jpeg", "raw"] = "jpeg"
    jpeg_quality: Annotated[int, Meta(ge=50, le=100)] = 90
    rotate_mb: NotNegative = 500.0
    rotate_s: NotNegative = 0.0
    max_total_mb: NotNegative = 0.0
    keep_free_mb: NotNegative = 500.0
    autostart: bool = False

    def __post_init__(self) -> None:
        if self.autostart and self.folder is None:
            raise ValueError("to record from the start, state the folder that recordings go to")
        if 0 < self.rotate_mb < _LEAST_ROTATE_MB or 0 < self.rotate_s < _LEAST_ROTATE_S:
            raise ValueError(
                f"a file of a recording takes at least {_LEAST_ROTATE_MB:g} MB and {_LEAST_ROTATE_S:g} s (0: no limit)"
            )


class ViewerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A page to look at the node in a browser: `gcd-node run` starts a `gcd-node viewer` beside the node.

    http: "127.0.0.1:8470" or another port of this machine; left out, none. Loopback only.
    keys: the page's own client keys, as `gcd-node keys new` makes them; for a node with [security] on tcp endpoints.
    """

    http: str | None = None
    keys: str | None = None


class NodeConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole launch file. strict: refuse what would only be flagged as out of the trained domain."""

    source: SourceConfig
    model: ModelSection
    view: Annotated[dict[ViewId, ViewConfig], Meta(min_length=1, max_length=64)]
    grid: Annotated[dict[ViewId, GridConfig], Meta(max_length=8)] = {}
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

    def __post_init__(self) -> None:
        if self.model.engine == "remote" and self.model.deadline_s >= self.life.hang_s:
            wait, hang = f"[model] deadline_s {self.model.deadline_s:g}", f"[life] hang_s {self.life.hang_s:g}"
            raise ValueError(f"{wait} has to be less than {hang}, or a node that waits for its service counts as hung")


def load_config(path: Path, changes: Sequence[str] = ()) -> NodeConfig:
    """Read a launch file. changes: such as `model.steps=4`, made before anything is checked.

    Raises:
        ConfigError: missing, not TOML, an unknown key (the nearest known one is named), a value out of range.
    """
    from gcd_model import FileError, read_small  # only now: it brings torch, and clients of a node need none

    try:
        return parse_config(read_small(path), str(path), changes)
    except FileError as error:
        raise ConfigError(f"the launch file {path} {error}; give the path of a TOML file") from error


def parse_config(text: str | bytes, name: str, changes: Sequence[str] = ()) -> NodeConfig:
    """Read a launch file's content; `name` is for the message. Raises ConfigError as `load_config`."""
    from gcd_model import FileError, decode_toml, explain_settings_error

    try:
        table = decode_toml(text)
        for change in changes:
            _make_change(table, change)
        prepare_source(table, name)
        prepare_views(table, name)
        return msgspec.convert(table, NodeConfig, strict=True)
    except msgspec.ValidationError as error:
        words = re.sub(
            r"^Expected `str` matching regex .* - at ",
            "a name is of a-z, 0-9 and _ (of node_id also A-Z and -), and src is the input's; got another at ",
            str(error),
        )
        raise ConfigError(f"{name}: {explain_settings_error(words, NodeConfig)}") from error
    except FileError as error:
        raise ConfigError(f"{name} {error}") from error


def _make_change(table: Table, change: str) -> None:
    """Change a launch file's content, such as by `model.steps=4`.

    A value is read as TOML, so numbers, true and "quoted text" are what they look like; what is no TOML is text.
    Raises:
        ConfigError: not of the form KEY=VALUE, or a key goes through something that is no section.
    """
    from gcd_model import FileError, decode_toml

    key, equals, text = change.partition("=")
    *sections, name = [part.strip() for part in key.split(".")]
    if not equals or not all((*sections, name)):
        raise ConfigError(f"a change is SECTION.KEY=VALUE, such as model.steps=4, got {change!r}")
    try:
        value = decode_toml(f"value = {text.strip()}")["value"]
    except (FileError, KeyError):
        value = text.strip()
    inner: object = table
    for section in sections:
        inner = inner.setdefault(section, {}) if isinstance(inner, dict) else None
    if not isinstance(inner, dict):
        raise ConfigError(f"{change!r}: {'.'.join(sections)} is no section")
    inner[name] = value


# Written down.


def to_toml(config: NodeConfig, *, secrets: bool = False) -> str:
    """The whole configuration, defaults included, as a launch file. secrets: with passwords, which are hidden else."""
    return tomli_w.dumps(_stated(msgspec.to_builtins(config) if secrets else without_secrets(config)))


def to_change(key: str, value: object) -> str:
    """A change to a launch file as parse_config() takes it, such as `model.steps=4`. value: what TOML can say."""
    plain = str(value) if isinstance(value, PurePath) else value
    return f"{key}={tomli_w.dumps({'value': plain}).removeprefix('value = ').strip()}"


def without_secrets(config: NodeConfig) -> Table:
    """The configuration as plain values, with the password of a url hidden."""
    table: Table = msgspec.to_builtins(config)
    source = table["source"]
    if isinstance(source, dict) and isinstance(source.get("url"), str):
        source["url"] = _without_password(source["url"])
    return table


def _stated(table: Table) -> Table:
    """Without what is None: TOML has no word for it."""
    stated = {key: value for key, value in table.items() if value is not None}
    return {key: _stated(value) if isinstance(value, dict) else value for key, value in stated.items()}


def _without_password(url: str) -> str:
    """Rather too much is hidden than too little, where a password holds what a url may not."""
    shown = re.sub(r"^([^:/]*://[^:/?#]*):.*@", rf"\1:{_HIDDEN}@", url, flags=re.DOTALL)
    return re.sub(r"[?#].*", f"?{_HIDDEN}", shown, flags=re.DOTALL)
