"""Goes through a launch file as a start would, but loads no weights: what `gcd-node check` finds. Prints nothing."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psutil
import torch

from gcd_client.protocol import ClientError
from gcd_model import (
    CheckpointError,
    ModelError,
    OptionError,
    Traits,
    inspect_weights,
    is_export,
    placement,
    weights_path,
)
from gcd_node.auth import load_server_security
from gcd_node.config import ModelSection, NodeConfig
from gcd_node.errors import ConfigError, NodeError, SourceError
from gcd_node.frame import SourceInfo
from gcd_node.preprocess import assumed_hfov_deg, in_words
from gcd_node.recorder import RoomError, check_room
from gcd_node.session import load_model, open_session
from gcd_node.sources import open_source
from gcd_node.stream_context import family_name, prepare_stream
from gcd_node.views import LiveConfig, VirtualViews


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """One thing that was looked at. error: what a start would fail with, None otherwise."""

    topic: str
    verdict: Literal["ok", "warning", "failed"]
    detail: str
    error: Exception | None = None


class _DoubtfulError(Exception):
    """A start would go on, with a warning."""


def check_launch(config: NodeConfig, free_memory: int | None = None) -> Iterator[Finding]:
    """Look at endpoints, where recordings go, source, weights and views; gives each as soon as it is known.

    free_memory: bytes, on the model's device; measured if left out.
    """
    look = _Look(config, free_memory)
    yield _finding("endpoints", look.endpoints)
    if config.record.folder is not None:
        yield _finding("record", look.record)
    yield _finding("source", look.source)
    yield _finding("weights", look.weights)
    yield _finding("views", look.views)


def _finding(topic: str, look: Callable[[], str]) -> Finding:
    try:
        return Finding(topic=topic, verdict="ok", detail=look())
    except _DoubtfulError as doubt:
        return Finding(topic=topic, verdict="warning", detail=str(doubt))
    except (NodeError, ClientError, ModelError) as error:
        return Finding(topic=topic, verdict="failed", detail=str(error), error=error)


class _Look:
    """Each method looks at one thing and says in words what it is; some leave what others go on from."""

    def __init__(self, config: NodeConfig, free_memory: int | None) -> None:
        self._config, self._free_memory = config, free_memory
        self.info: SourceInfo | None = None
        self.traits: Traits | None = None

    def endpoints(self) -> str:
        with open_session(self._config) as (_, publisher, control):
            sockets = f"data {publisher.endpoint}, status {publisher.status_endpoint}"
            return f"free: {sockets}, {'no control' if control is None else f'control {control.endpoint}'}"

    def record(self) -> str:
        section = self._config.record
        root = Path(section.folder or "").expanduser()
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

    def source(self) -> str:
        source = open_source(self._config.source, load_server_security(self._config.security))
        try:
            first = next(iter(source.frames()), None)  # of a camera it waits already, or opening had failed
            if first is None:
                raise SourceError(f"{source.info.id} has no frames; is it the right one?")
            info = self.info = source.info
            rate = f"{info.width} x {info.height} at {info.fps_nominal:g} FPS"
            rate += "" if info.lens is None else ", calibrated"
            return f"{info.kind} {info.id}: {rate}; its first frame is number {first.seq}"
        finally:
            source.close()

    def weights(self) -> str:
        section = self._config.model
        is_random = section.weights.startswith("random:")
        is_elsewhere = is_random or section.engine == "remote"
        if is_elsewhere or section.adapter is not None or is_export(weights_path(section.weights)):
            # Only loading says whether weights and adapter belong together, or onnxruntime takes an export here.
            traits = load_model(section).traits
        else:
            traits = self._inspected(section)
        self.traits = traits.streaming()
        if is_random:
            raise _DoubtfulError(f"{section.weights}: these weights are random, so every picture is noise")
        return f"{traits.name}, family {family_name(traits)}, {traits.precision} on {traits.device}"

    def _inspected(self, section: ModelSection) -> Traits:
        """What loading would say. Raises CheckpointError, also if the weights alone are more than the free memory."""
        path = weights_path(section.weights)
        report = inspect_weights(
            path, family=section.family, head_width=section.head_width, image_heads=section.image_heads
        )
        try:
            engine = None if section.engine == "remote" else section.engine  # which is not looked at here
            device, precision = placement(section.device, engine, section.dtype, live=report.live)
        except OptionError as error:
            raise ConfigError(f"[model]: {error}") from error
        needed, free = report.parameters * (4 if precision == "float32" else 2), self._free_memory
        if free is None:
            free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available
        if needed > free:
            sizes = f"the weights take {needed / 2**30:.2f} GiB in {precision}, {free / 2**30:.2f} are free on {device}"
            raise CheckpointError(f"{sizes}; free some, or use bfloat16 or a smaller model")
        return Traits.of(report, sha256_12=report.sha256_12, precision=precision, device=str(device))

    def views(self) -> str:
        config, traits, info = self._config, self.traits, self.info
        if traits is None or info is None:
            raise _DoubtfulError("not looked at: that takes the source and the weights")
        context = prepare_stream(config, traits, info)
        VirtualViews(traits).sync(LiveConfig(config).settings(), context.mount, context.references)
        frames, names = traits.config.frames, ", ".join([*config.view, *(f"grid {name}" for name in config.grid)])
        line = f"{names}: {f'windows of {frames} frames' if frames > 1 else 'every frame'} at {context.fps:g} FPS"
        line = "; ".join(filter(None, (line, in_words(context.mount, config.source.pose, traits))))
        if traits.live and context.lens is None and info.hfov_in_use(config.source.hfov_deg) is None:
            hfov_deg = assumed_hfov_deg(config.source.pose)
            raise _DoubtfulError(f"{line}; the pictures are taken to be {hfov_deg:.4g} degrees wide: state hfov_deg")
        if context.ood:
            raise _DoubtfulError(f"{line}; outside what {traits.name} was trained with: {', '.join(context.ood)}")
        return line
