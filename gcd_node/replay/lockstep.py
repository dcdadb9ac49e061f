"""A launch file replayed: its recording through its model as fast as that goes, into a run on disk."""

import hashlib
import platform
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from msgspec.structs import replace

from gcd_client.protocol import ClassRecord, EndMessage, OriginHeader, StatusTopic, ViewHeader, ViewMessage, kind_of
from gcd_model import Traits
from gcd_node.config import LifeConfig, NodeConfig
from gcd_node.config_dump import config_digest, to_toml
from gcd_node.errors import ConfigError, DamagedRunError, ModelFailedError, OutputError, SourceError
from gcd_node.frame import FrameSource, SourceInfo
from gcd_node.inference import WindowReport
from gcd_node.node import Node, NodeOptions
from gcd_node.pipeline import Summary
from gcd_node.publisher import PublisherStats
from gcd_node.replay.run import (
    KeptKind,
    Manifest,
    Pixels,
    PixelWriter,
    RunFolder,
    SizeEntry,
    TotalsEntry,
    TroubleEntry,
    ViewEntry,
    WindowEntry,
    check_pixels,
    new_folder,
    open_run,
    pixel_digest,
    pixels_path,
    to_stamp,
    write_manifest,
)
from gcd_node.session import load_model, model_threads
from gcd_node.source_config import LiveSource, SourceConfig, SyntheticSource
from gcd_node.sources import open_source, resolve_path
from gcd_node.transitions import Parts

PARTS = Parts(open_source=open_source, load_model=load_model)
"""What a launch file names, as `gcd-node run` opens it."""
_TROUBLES = ("MODEL_NAN", "GPU_OOM")


def lockstep_config(config: NodeConfig) -> NodeConfig:
    """The launch file as it is replayed: in lockstep, once, with nothing but what decides how views come out.

    Its digest, and with it every seed, is that of the original.
    Raises:
        ConfigError: its source cannot be replayed: a live camera, or a drawn drive without an end.
    """
    source = config.source
    if isinstance(source, LiveSource):
        raise ConfigError(
            f"a replay needs a recording, got [source] kind = {source.kind!r}, a live camera: record it first, then "
            'give a launch file with kind = "mcap" or "file" and its path'
        )
    if isinstance(source, SyntheticSource) and source.frames is None:
        raise ConfigError("a replay must end, and this drawn drive does not: set frames in [source]")
    return NodeConfig(
        source=replace(source, pace="lockstep", loop=False),
        model=config.model,
        view=config.view,
        window=config.window,
        life=LifeConfig(hang_s=config.life.hang_s),
        node_id=config.node_id,
        strict=config.strict,
    )


def replay(
    config: NodeConfig, out: Path, on_window: Callable[[WindowReport], None] | None = None, parts: Parts = PARTS
) -> RunFolder:
    """Replay a launch file into the folder `out`, which appears when all of it is there.

    No socket is opened. On the same machine the same launch file gives the same pixels, hash by hash.

    Args:
        out: must not exist, or be an empty folder.
        on_window: told of every window.
        parts: what opens the recording and loads the model.
    Raises:
        ConfigError: see lockstep_config(); and as Node.run. OutputError: `out` is in use or cannot be written.
        ModelFailedError: not one window came out.
    """
    config = lockstep_config(config)
    with new_folder(out) as folder, _repeatable():
        write_manifest(folder, _filled(config, folder, on_window, parts))
        try:
            check_pixels(open_run(folder))  # OpenCV does not say that a disk is full
        except DamagedRunError as error:
            raise OutputError(f"{out} could not be written whole; is there space? {error}") from error
    return open_run(out)


@contextmanager
def _repeatable() -> Generator[None]:
    """On a GPU, only convolutions that give the same result each time."""
    cudnn = torch.backends.cudnn
    before = cudnn.deterministic, cudnn.benchmark
    cudnn.deterministic, cudnn.benchmark = True, False
    try:
        yield
    finally:
        cudnn.deterministic, cudnn.benchmark = before


def _filled(
    config: NodeConfig, folder: Path, on_window: Callable[[WindowReport], None] | None, parts: Parts
) -> Manifest:
    """Run the node; its pixels are in the folder then."""
    infos: list[SourceInfo] = []
    traits: list[Traits] = []

    def open_and_note(section: SourceConfig) -> FrameSource:
        source = parts.open_source(section)
        infos.append(source.info)
        return source

    with RunWriter(folder) as writer:

        def finish(report: WindowReport) -> None:
            writer.finish_window(report)
            if on_window is not None:
                on_window(report)

        options = NodeOptions(once=True, on_configured=traits.append, on_window=finish)
        summary = Node(config, Parts(open_source=open_and_note, load_model=parts.load_model), writer, options).run()
    return _manifest(config, infos[0], traits[-1], writer, summary)


def _manifest(config: NodeConfig, info: SourceInfo, traits: Traits, writer: "RunWriter", summary: Summary) -> Manifest:
    if writer.size is None:
        raise ModelFailedError(
            f'none of the {summary.counts.nan_windows} windows came out: all had NaN; try dtype = "float32" in '
            "[model], and look at the weights with `gcd-node weights inspect`"
        )
    return Manifest(
        made_from=_made_from(config, info, traits),
        config=to_toml(config),
        cfg_digest=config_digest(config, traits),
        size=writer.size,
        fps=writer.fps,
        classes=writer.classes,
        totals=TotalsEntry(
            frames=summary.frames,
            windows=summary.counts.windows,
            rejected=dict(sorted(summary.rejected.items())),
            nan_windows=summary.counts.nan_windows,
        ),
        troubles=tuple(writer.troubles),
        windows=tuple(writer.windows),
    )


# What a run is made from.


def _made_from(config: NodeConfig, info: SourceInfo, traits: Traits) -> dict[str, str]:
    """Weights, recording, programs and machine: hashes of two runs are only bound to agree if all of it does.

    Raises SourceError if the recording cannot be read any more.
    """
    section = config.source
    files = {
        "source": None if isinstance(section, SyntheticSource | LiveSource) else resolve_path(section.path),
        "calibration": None if section.calibration is None else Path(section.calibration).expanduser(),
    }
    return {
        "weights name": traits.name,
        "weights sha256_12": traits.sha256_12,
        "weights precision": traits.precision,
        "source id": f"{info.kind} {info.id}",
        "source pictures": f"{info.width}x{info.height}, {info.fps_nominal:g} FPS, {info.codec or 'no codec'}",
        **{f"{name} sha256": digest_of(path) for name, path in files.items() if path is not None},
        "version gcd-node": version("gcd-node"),
        "version python": platform.python_version(),
        "version torch": str(torch.__version__),
        "version kornia": kornia.__version__,
        "version opencv": cv2.__version__,
        "version numpy": np.__version__,
        "machine system": f"{platform.system()} {platform.machine()}",
        "machine device": traits.device,
        "machine processor": _processor(traits.device),
        "machine instructions": torch.backends.cpu.get_cpu_capability(),
        "machine threads": str(model_threads(config.model)),
    }


def digest_of(path: Path) -> str:
    """SHA-256 of a file, 64 hex digits; of a folder, over the names and contents of all files in it, by name.

    Raises:
        SourceError: it cannot be read.
    """
    try:
        if not path.is_dir():
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        total = hashlib.sha256()
        for each in sorted(each for each in path.rglob("*") if each.is_file()):
            total.update(each.relative_to(path).as_posix().encode() + b"\0")
            total.update(bytes.fromhex(digest_of(each)))
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}; is it still there?") from error
    return total.hexdigest()


def _processor(device: str) -> str:
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    return next(_cpu_names(), platform.processor() or "unknown")


def _cpu_names() -> Iterator[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return
    yield from (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))


# What is kept of it.


@dataclass(slots=True)
class _Arrived:
    """What has come of a view of the window in work."""

    header: ViewHeader
    sha256: dict[KeptKind, str] = field(default_factory=dict[KeptKind, str])


class RunWriter:
    """A message sink that needs no reader: takes the rgb8 messages of a lockstep node and keeps windows and their maps.

    Single frames are part of their window, and deviations of its samples: neither is kept. Use it as a context
    manager; at its end the videos are finished. size, fps: of its windows, None before the first.
    """

    def __init__(self, folder: Path) -> None:
        self.windows: list[WindowEntry] = []
        self.troubles: list[TroubleEntry] = []
        self.classes: tuple[ClassRecord, ...] = ()
        self.size: SizeEntry | None = None
        self.fps = 0.0
        self._folder = folder
        self._videos: dict[Path, PixelWriter] = {}
        self._arrived: dict[str, _Arrived] = {}
        self._sent = 0

    def __enter__(self) -> "RunWriter":
        return self

    def __exit__(self, *_: object) -> None:
        for video in self._videos.values():
            video.close()

    def send(self, message: ViewMessage) -> bool:
        """Take a view; see MessageSink. Raises OutputError if its video cannot be begun."""
        self._sent += 1
        header, kind = message.header, kind_of(message.topic)
        if kind not in ("win", "cls", "vis", "depth"):
            return True
        if kind == "win":
            self._arrived[header.view_id] = _Arrived(header)
        if kind == "cls":
            self.classes = tuple(header.classes or ())
        pixels, path = _pixels(message), pixels_path(self._folder, header.view_id, kind)
        if path not in self._videos:
            _, height, width = pixels.shape[:3]
            self._videos[path] = PixelWriter(path, height=height, width=width, fps=header.src.fps_cond)
        self._videos[path].write(pixels)
        self._arrived[header.view_id].sha256[kind] = pixel_digest(pixels)
        return True

    def finish_window(self, report: WindowReport) -> None:
        """Take note that all views of a window were sent; a node's `on_window`."""
        window, arrived, self._arrived = report.window, self._arrived, {}
        frames, height, width, _ = next(iter(arrived.values())).header.shape
        self.size, self.fps = SizeEntry(frames=frames, height=height, width=width), window.fps
        self.windows.append(
            WindowEntry(
                window_id=window.window_id,
                epoch=window.epoch,
                stamps=tuple(to_stamp(stamp_ns) for stamp_ns in window.stamps_ns),
                seqs=window.seqs,
                input_sha256=pixel_digest(window.images),
                render_ms=round(report.render_s * 1000, 3),
                views={view_id: _view_entry(each) for view_id, each in arrived.items()},
            )
        )

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        """Nobody looks; see MessageSink."""

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Nothing follows from it; see MessageSink."""

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Keep what the model could not do; see MessageSink."""
        if topic == "event" and fields["code"] in _TROUBLES:
            detail = fields["rung"] if "rung" in fields else f"seeds {', '.join(map(str, fields['seeds']))}"
            self.troubles.append(TroubleEntry(code=fields["code"], window_id=fields["window_id"], detail=detail))

    def stop_waiting(self) -> None:
        """Nobody is waited for; see MessageSink."""

    @property
    def stats(self) -> PublisherStats:
        """Messages taken; see MessageSink."""
        return PublisherStats(sent=self._sent)


def _pixels(message: ViewMessage) -> Pixels:
    """Pictures [T, H, W, 3]; of maps the bytes of each row, [T, H, W] or of depth [T, H, 2 W]."""
    frames, height, width, channels = message.header.shape
    bytes_ = np.frombuffer(message.payload, np.uint8)
    return bytes_.reshape((frames, height, width, 3) if channels == 3 else (frames, height, -1))


def _view_entry(arrived: _Arrived) -> ViewEntry:
    header, quality = arrived.header, arrived.header.quality
    return ViewEntry(
        view_rev=header.view_rev,
        sha256=arrived.sha256,
        seed=quality.seed,
        steps=quality.steps,
        ood=quality.ood,
        nan_frames=quality.nan_frames,
    )
