"""Goes through a launch file as a start would, but loads no weights: what `gcd-node check` finds. Prints nothing."""

import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias

import psutil
import torch

from gcd_client.endpoints import resolve_endpoint
from gcd_client.protocol import ClientError
from gcd_model import (
    FAMILIES,
    CheckpointError,
    ModelConfig,
    ModelError,
    Schedule,
    Traits,
    WeightsReport,
    default_precision,
    inspect_weights,
    is_export,
    load_synthesizer,
)
from gcd_node.auth import load_server_security
from gcd_node.config import ModelSection, NodeConfig, RecordConfig
from gcd_node.errors import ConfigError, NodeError, SourceLostError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.mcap_file import RoomError, check_room
from gcd_node.model import drawing_options, sampler_in_use
from gcd_node.preprocess import in_words
from gcd_node.session import load_model, model_threads, open_session
from gcd_node.sources import open_source
from gcd_node.stream_context import prepare_stream
from gcd_node.views import LiveConfig, VirtualViews

Verdict: TypeAlias = Literal["ok", "warning", "failed"]

_FIRST_FRAME_S = 5.0
_MUCH_MEMORY = 0.7
_BYTES = {"float32": 4, "bfloat16": 2, "float16": 2}


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that was looked at. error: what a start would fail with, None otherwise."""

    topic: str
    verdict: Verdict
    detail: str
    error: Exception | None = None


@dataclass(slots=True)
class _Known:
    """What has been found out so far. weight_bytes: the weights in the precision they will be used in."""

    info: SourceInfo | None = None
    traits: Traits | None = None
    weight_bytes: int = 0


class _DoubtfulError(Exception):
    """A start would go on, with a warning."""


def check_launch(config: NodeConfig, free_memory: int | None = None) -> Iterator[Finding]:
    """Look at endpoints, source, weights, memory, views and time, in this order, and where recordings go, if anywhere;
    each as soon as it is known.

    free_memory: bytes, on the model's device; measured if left out. What follows from something that failed is left
        out.
    """
    known = _Known()
    yield _finding("endpoints", lambda: _endpoints(config))
    if config.record.folder is not None:
        yield _finding("record", lambda: _record(Path(config.record.folder or ""), config.record))
    yield _finding("source", lambda: _source(config, known))
    yield _finding("weights", lambda: _weights(config.model, known))
    info, traits = known.info, None if known.traits is None else known.traits.streaming()
    if traits is not None:
        yield _finding("memory", lambda: _memory(traits, known.weight_bytes, free_memory))
    if traits is not None and info is not None:
        yield _finding("views", lambda: _views(config, traits, info))
        yield _finding("time", lambda: _time(config, traits, info))


def _finding(topic: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(topic=topic, verdict="ok", detail=look())
    except _DoubtfulError as doubt:
        return Finding(topic=topic, verdict="warning", detail=str(doubt))
    except (NodeError, ClientError, ModelError) as error:
        return Finding(topic=topic, verdict="failed", detail=str(error), error=error)


def _endpoints(config: NodeConfig) -> str:
    with open_session(config) as (_, publisher):
        endpoint = config.control.endpoint
        control = "no control" if endpoint is None else f"control {resolve_endpoint(endpoint, 'control')}"
        return f"free: data {publisher.endpoint}, status {publisher.status_endpoint}, {control}"


def _record(folder: Path, section: RecordConfig) -> str:
    """What fails here ends no start, but nothing would be recorded."""
    root = folder.expanduser()
    try:
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=root):
            free_mb = check_room(section, root)
    except OSError as error:
        raise ConfigError(f"nothing can be recorded in {root}: {error}; check folder in [record]") from error
    except RoomError as limit:
        raise _DoubtfulError(f"nothing would be recorded: {limit}") from limit
    when = "from the start" if section.autostart else "when asked to"
    return f"{', '.join(section.what)} into {root}, {when}; {free_mb / 1000:.1f} GB are free"


def _source(config: NodeConfig, known: _Known) -> str:
    source = open_source(config.source, load_server_security(config.security))
    try:
        first = _first_frame(source)
        info = known.info = source.info
        rate = f"{info.width} x {info.height} at {info.fps_nominal:g} FPS"
        lens = "" if info.lens is None else ", calibrated"
        return f"{info.kind} {info.id}: {rate}{lens}; its first frame is number {first.seq}"
    finally:
        source.close()


def _first_frame(source: FrameSource) -> Frame:
    """Raises SourceLostError if none comes."""
    found: list[Frame | Exception] = []

    def look() -> None:
        try:
            found.extend(frame for frame, _ in zip(source.frames(), range(1), strict=False))
        except Exception as error:  # the end of a thread
            found.append(error)

    looker = threading.Thread(target=look, name="first frame", daemon=True)
    looker.start()
    looker.join(_FIRST_FRAME_S)
    if not found:
        raise SourceLostError(f"{source.info.id} opened, and gave no frame in {_FIRST_FRAME_S:g} s; is it covered?")
    if isinstance(found[0], Exception):
        raise found[0]
    return found[0]


def _weights(section: ModelSection, known: _Known) -> str:
    if section.weights.startswith("random:"):
        known.traits = load_synthesizer(section.weights, device="cpu").traits
        raise _DoubtfulError(f"{section.weights}: these weights are random, so every picture is noise")
    path = weights_path(section.weights)
    if is_export(path):  # only loading says whether onnxruntime takes it here
        known.traits = load_model(section).traits
        known.weight_bytes = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
        return f"{known.traits.name}, {known.traits.precision}, an export of {known.weight_bytes / 1e6:.1f} MB"
    report = inspect_weights(
        path, family=section.family, head_width=section.head_width, image_heads=section.image_heads
    )
    # Only loading says whether weights and adapter belong together.
    traits = known.traits = _traits(report, section) if section.adapter is None else load_model(section).traits
    known.weight_bytes = report.parameters * _BYTES.get(traits.precision, 4)
    family = "unknown" if traits.family is None else traits.family.name
    return f"{traits.name}, family {family}, {report.parameters / 1e6:.1f} M parameters"


def weights_path(weights: str) -> Path:
    """The file that weights are in; `package:NAME` ships with the model package. Raises CheckpointError."""
    kind, _, name = weights.partition(":")
    if kind != "package":
        return Path(weights)
    path = Path(str(files("gcd_model").joinpath("weights", f"{name}.safetensors")))
    if "/" in name or not path.is_file():
        raise CheckpointError(f"no weights called {name!r} ship with the package; give a path, or random:driving")
    return path


def _traits(report: WeightsReport, section: ModelSection) -> Traits:
    """What loading would say of the weights, without loading them."""
    device = section.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    return Traits(
        name=report.name,
        config=report.config,
        family=None if report.family is None else FAMILIES[report.family],
        move_time=report.move_time,
        sha256_12=report.sha256_12,
        precision=section.dtype or default_precision(torch.device(device), live=report.family == "live"),
        device=device,
        trained=report.trained,
        uncertainty_scale=report.uncertainty_scale,
    )


def _memory(traits: Traits, needed: int, free: int | None) -> str:
    on_gpu = traits.device.startswith("cuda")
    if free is None:
        free = torch.cuda.mem_get_info(traits.device)[0] if on_gpu else psutil.virtual_memory().available
    line = f"weights take {needed / 2**30:.2f} GiB in {traits.precision}, {free / 2**30:.2f} are free on "
    line += f"{traits.device if on_gpu else 'cpu'}; what the model needs to compute comes on top and is not counted"
    if needed > free:
        raise CheckpointError(f"{line}. Free some, or use bfloat16 or a smaller model")
    if needed > _MUCH_MEMORY * free:
        raise _DoubtfulError(line)
    return line


def _views(config: NodeConfig, traits: Traits, info: SourceInfo) -> str:
    run = prepare_stream(config, traits, info)
    VirtualViews(traits).sync(LiveConfig(config).settings(), run.mount)
    frames = traits.config.frames
    line = (
        f"{', '.join(config.view)}: {f'windows of {frames} frames' if frames > 1 else 'every frame'} at {run.fps:g} FPS"
    )
    camera = in_words(run.mount, config.source.pose, traits)
    line += f"; {camera}" if camera else ""
    if run.ood:
        raise _DoubtfulError(f"{line}; outside what {traits.name} was trained with: {', '.join(run.ood)}")
    return line


def _time(config: NodeConfig, traits: Traits, info: SourceInfo) -> str:
    frames, model = traits.config.frames, config.model
    period_s = (config.window.stride or frames) / prepare_stream(config, traits, info).fps
    if isinstance(traits.config, ModelConfig):
        runs = Schedule.of(traits.config, drawing_options(model)).evaluations
    else:
        runs = sampler_in_use(model, traits).steps * frames
    runs *= model.samples * len(config.view)
    unit = "window" if frames > 1 else "frame"
    return (
        f"a {unit} every {period_s:.2f} s, {runs} network evaluations each, so {1000 * period_s / runs:.1f} ms for one "
        f"if none is to be left out; {model_threads(model)} CPU threads"
    )
