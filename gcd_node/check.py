"""Goes through a launch file as a start would, but loads no weights: what `gcd-node check` finds. Prints nothing."""

import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias

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


@dataclass(frozen=True, kw_only=True, slots=True)
class Resources:
    """What this machine has left for the model. memory: bytes free on `device`."""

    device: str
    memory: int


@dataclass(slots=True)
class _Known:
    """What has been found out so far. weight_bytes: the weights in the precision they will be used in."""

    info: SourceInfo | None = None
    traits: Traits | None = None
    weight_bytes: int = 0


def check(config: NodeConfig, resources: Resources | None = None) -> Iterator[Finding]:
    """Look at endpoints, source, weights, memory, views and time, in this order, and where recordings go, if anywhere;
    each as soon as it is known.

    resources: measured if left out. What follows from something that failed is left out.
    """
    known = _Known()
    yield _tried("endpoints", lambda: _endpoints(config))
    if config.record.folder is not None:
        yield _tried("record", lambda: _record(Path(config.record.folder or ""), config.record))
    yield _tried("source", lambda: _source(config, known))
    yield _tried("weights", lambda: _weights(config.model, known))
    info, traits = known.info, None if known.traits is None else known.traits.streaming()
    if traits is not None:
        yield _tried("memory", lambda: _memory(traits, known.weight_bytes, resources or measured(traits.device)))
    if traits is not None and info is not None:
        yield _tried("views", lambda: _views(config, traits, info))
        yield _tried("time", lambda: _time(config, traits, info))


class _DoubtfulError(Exception):
    """A start would go on, with a warning."""


def _tried(topic: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(topic=topic, verdict="ok", detail=look())
    except _DoubtfulError as doubt:
        return Finding(topic=topic, verdict="warning", detail=str(doubt))
    except (NodeError, ClientError, ModelError) as error:
        return Finding(topic=topic, verdict="failed", detail=str(error), error=error)


def _endpoints(config: NodeConfig) -> str:
    with open_session(config) as (_, publisher):
        wanted = config.control.endpoint
        control = "no control" if wanted is None else f"control {resolve_endpoint(wanted, 'control')}"
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
        told = known.info = source.info
        rate = f"{told.width} x {told.height} at {told.fps_nominal:g} FPS"
        lens = "" if told.lens is None else ", calibrated"
        return f"{told.kind} {told.id}: {rate}{lens}; its first frame is number {first.seq}"
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
    kind, _, name = section.weights.partition(":")
    if kind == "random":
        known.traits = load_synthesizer(section.weights, device="cpu").traits
        raise _DoubtfulError(f"{section.weights}: these weights are random, so every picture is noise")
    path = _packaged(name) if kind == "package" else Path(section.weights)
    if is_export(path):
        return _exported(path, section, known)
    report = inspect_weights(
        path, family=section.family, head_width=section.head_width, image_heads=section.image_heads
    )
    known.traits = _traits(report, section) if section.adapter is None else _adapted(section)
    known.weight_bytes = report.parameters * _BYTES.get(known.traits.precision, 4)
    family = "unknown" if known.traits.family is None else known.traits.family.name
    return f"{known.traits.name}, family {family}, {report.parameters / 1e6:.1f} M parameters"


def _exported(folder: Path, section: ModelSection, known: _Known) -> str:
    """Of an export: it is loaded, as nothing less says whether onnxruntime takes it here."""
    known.traits = load_model(section).traits
    known.weight_bytes = sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    return f"{known.traits.name}, {known.traits.precision}, an export of {known.weight_bytes / 1e6:.1f} MB"


def _adapted(section: ModelSection) -> Traits:
    """Of weights with an adapter: both are loaded, as nothing less says whether they belong together."""
    return load_synthesizer(
        section.weights,
        family=section.family,
        device="cpu",
        dtype=section.dtype,
        head_width=section.head_width,
        image_heads=section.image_heads,
        adapter=section.adapter,
    ).traits


def _packaged(name: str) -> Path:
    path = Path(str(files("gcd_model").joinpath("weights", f"{name}.safetensors")))
    if not path.is_file():
        raise CheckpointError(f"no weights called {name!r} ship with the package; give a path, or random:driving")
    return path


def _traits(report: WeightsReport, section: ModelSection) -> Traits:
    """What loading would say of the weights, without loading them."""
    device = _device(section.device)
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


def _device(wanted: str) -> str:
    if wanted != "auto":
        return wanted
    return "cuda" if torch.cuda.is_available() else "cpu"


def measured(device: str) -> Resources:
    """What this machine has left on a device: free memory of the GPU, or what Linux calls available."""
    if device.startswith("cuda"):
        return Resources(device=device, memory=torch.cuda.mem_get_info(device)[0])
    for line in Path("/proc/meminfo").read_text().splitlines():
        name, _, rest = line.partition(":")
        if name == "MemAvailable":
            return Resources(device="cpu", memory=1024 * int(rest.split()[0]))
    return Resources(device="cpu", memory=0)


def _memory(traits: Traits, needed: int, found: Resources) -> str:
    line = f"weights take {needed / 2**30:.2f} GiB in {traits.precision}, {found.memory / 2**30:.2f} are free on "
    line += f"{found.device}; what the model needs to compute comes on top and is not counted"
    if needed > found.memory:
        raise CheckpointError(f"{line}. Free some, or use bfloat16 or a smaller model")
    if needed > _MUCH_MEMORY * found.memory:
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
    period_s = (config.window.stride or traits.config.frames) / prepare_stream(config, traits, info).fps
    model = config.model
    if isinstance(traits.config, ModelConfig):
        runs = Schedule.of(traits.config, drawing_options(model)).evaluations
    else:
        runs = sampler_in_use(model, traits).steps * traits.config.frames
    runs *= model.samples * len(config.view)
    unit = "window" if traits.config.frames > 1 else "frame"
    return (
        f"a {unit} every {period_s:.2f} s, {runs} network evaluations each, so {1000 * period_s / runs:.1f} ms for one "
        f"if none is to be left out; {model_threads(model)} CPU threads"
    )
