"""A launch file replayed: its recording through its model as fast as that goes, into a run on disk."""

import hashlib
import platform
from collections.abc import Callable, Generator, Mapping
from contextlib import closing, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from msgspec.structs import replace

from gcd_client.protocol import ClassRecord, EndMessage, OriginHeader, StatusTopic, ViewMessage, kind_of
from gcd_model import Traits
from gcd_node.config import LifeConfig, NodeConfig, to_toml
from gcd_node.errors import ConfigError, DamagedRunError, ModelFailedError, OutputError, SourceError
from gcd_node.frame import FrameSource, SourceInfo
from gcd_node.image_io import VideoWriter
from gcd_node.inference import WindowReport
from gcd_node.lifecycle import Parts
from gcd_node.messages import PublisherStats
from gcd_node.node import Node
from gcd_node.pipeline import Summary
from gcd_node.replay.run import (
    MANIFEST,
    Manifest,
    Pixels,
    RunFolder,
    SizeEntry,
    TotalsEntry,
    TroubleEntry,
    ViewEntry,
    WindowEntry,
    encode_manifest,
    new_folder,
    open_run,
    pixel_digest,
    pixels_path,
    read_windows,
)
from gcd_node.session import load_model, model_threads
from gcd_node.sources import LiveSource, SourceConfig, SyntheticSource, open_source, resolve_path
from gcd_node.stream_context import config_digest

PARTS = Parts(open_source=open_source, load_model=load_model)
"""What a launch file names, as `gcd-node run` opens it."""
_TROUBLES = ("MODEL_NAN", "GPU_OOM")
_SECOND_NS = 1_000_000_000


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
    infos: list[SourceInfo] = []
    traits: list[Traits] = []

    def open_and_note(section: SourceConfig) -> FrameSource:
        source = parts.open_source(section)
        infos.append(source.info)
        return source

    with new_folder(out) as folder, _repeatable():
        with closing(RunWriter(folder, on_window)) as writer:
            noting = Parts(open_source=open_and_note, load_model=parts.load_model)
            node = Node(config, noting, writer, on_configured=traits.append, on_window=writer.finish_window)
            summary = node.run()
        manifest = _manifest(config, infos[0], traits[-1], writer, summary)
        try:
            (folder / MANIFEST).write_bytes(encode_manifest(manifest))
            for _ in read_windows(open_run(folder)):  # OpenCV does not say that a disk is full
                pass
        except (OSError, DamagedRunError) as error:
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


class RunWriter:
    """A message sink that needs no reader: takes the rgb8 messages of a lockstep node and keeps windows and their maps.

    Single frames are part of their window, and deviations of its samples: neither is kept. size, fps: of its windows,
    None before the first.
    """

    def __init__(self, folder: Path, on_window: Callable[[WindowReport], None] | None) -> None:
        self.windows: list[WindowEntry] = []
        self.troubles: list[TroubleEntry] = []
        self.classes: tuple[ClassRecord, ...] = ()
        self.size: SizeEntry | None = None
        self.fps = 0.0
        self.stats = PublisherStats()  # nobody reads
        self._folder, self._on_window = folder, on_window
        self._videos: dict[Path, VideoWriter] = {}
        self._views: dict[str, ViewEntry] = {}  # of the window in work

    def close(self) -> None:
        """Finish the videos."""
        for video in self._videos.values():
            video.close()

    def send(self, message: ViewMessage) -> bool:
        """Take a view; see MessageSink. Raises OutputError if its video cannot be begun."""
        header, kind = message.header, kind_of(message.topic)
        if kind not in ("win", "cls", "vis", "depth"):
            return True
        frames, height, width, channels = header.shape
        pixels: Pixels = np.frombuffer(message.payload, np.uint8)
        pixels = pixels.reshape((frames, height, width, 3) if channels == 3 else (frames, height, -1))
        sha256, quality = pixel_digest(pixels), header.quality
        if kind == "win":
            self.size = SizeEntry(frames=frames, height=height, width=width)
            self._views[header.view_id] = ViewEntry(
                view_rev=header.view_rev,
                sha256={"win": sha256},
                seed=quality.seed,
                steps=quality.steps,
                ood=quality.ood,
                nan_frames=quality.nan_frames,
            )
        elif kind == "cls":
            self.classes = tuple(header.classes or ())
        self._views[header.view_id].sha256[kind] = sha256
        path = pixels_path(self._folder, header.view_id, kind)
        if path not in self._videos:
            self._videos[path] = VideoWriter(path, header.src.fps_cond)
        self._videos[path].add(pixels)
        return True

    def finish_window(self, report: WindowReport) -> None:
        """Take note that all views of a window were sent; a node's `on_window`."""
        window, self.fps = report.window, report.window.fps
        self.windows.append(
            WindowEntry(
                window_id=window.window_id,
                epoch=window.epoch,
                stamps=tuple(divmod(stamp_ns, _SECOND_NS) for stamp_ns in window.stamps_ns),
                seqs=window.seqs,
                input_sha256=pixel_digest(window.images),
                render_ms=round(report.render_s * 1000, 3),
                views=self._views,
            )
        )
        self._views = {}
        if self._on_window is not None:
            self._on_window(report)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Keep what the model could not do; see MessageSink."""
        if topic == "event" and fields["code"] in _TROUBLES:
            detail = fields["rung"] if "rung" in fields else f"seeds {', '.join(map(str, fields['seeds']))}"
            self.troubles.append(TroubleEntry(code=fields["code"], window_id=fields["window_id"], detail=detail))

    # Nobody looks, and nobody is waited for:

    def preview(self, made: Callable[[], ViewMessage]) -> None: ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None: ...

    def stop_waiting(self) -> None: ...


def _manifest(config: NodeConfig, info: SourceInfo, traits: Traits, writer: RunWriter, summary: Summary) -> Manifest:
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


def _made_from(config: NodeConfig, info: SourceInfo, traits: Traits) -> dict[str, str]:
    """Weights, recording, programs and machine: hashes of two runs are only bound to agree if all of it does."""
    section, digests = config.source, dict[str, str]()
    if not isinstance(section, SyntheticSource | LiveSource):
        digests["source sha256"] = digest_of(resolve_path(section.path))
    if section.calibration is not None:
        digests["calibration sha256"] = digest_of(Path(section.calibration).expanduser())
    return {
        "weights name": traits.name,
        "weights sha256_12": traits.sha256_12,
        "weights precision": traits.precision,
        "source id": f"{info.kind} {info.id}",
        "source pictures": f"{info.width}x{info.height}, {info.fps_nominal:g} FPS, {info.codec or 'no codec'}",
        **digests,
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
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or "unknown")
