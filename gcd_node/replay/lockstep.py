"""A launch file replayed: its recording through its model as fast as that goes, into a run on disk or a ROS 2 bag."""

import dataclasses
import hashlib
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import kornia
import msgspec
import numpy as np
import torch
from msgspec.structs import replace

from gcd_client.protocol import DataMessage, EndMessage, GridMessage, OriginHeader, StatusTopic, ViewMessage, kind_of
from gcd_model import Traits
from gcd_node.config import LifeConfig, NodeConfig
from gcd_node.errors import ConfigError, ModelFailedError, OutputError, SourceError
from gcd_node.frame import FrameSource
from gcd_node.image_io import write_whole
from gcd_node.lifecycle import Parts
from gcd_node.messages import PublisherStats
from gcd_node.node import Node
from gcd_node.pipeline import Summary
from gcd_node.replay.run import (
    MANIFEST,
    Digest,
    KeptKind,
    Manifest,
    RunFolder,
    WindowEntry,
    encode_manifest,
    keep_pixels,
    new_folder,
    open_run,
    pixel_digest,
)
from gcd_node.ros_messages import McapFile, RosMessage, data_messages, write_bag_metadata
from gcd_node.session import load_model, model_threads
from gcd_node.sources import LiveSource, SourceConfig, SyntheticSource, open_source, resolve_path
from gcd_node.stream_context import config_digest
from gcd_node.work import WindowReport

PARTS = Parts(open_source=open_source, load_model=load_model)
"""What a launch file names, as `gcd-node run` opens it."""


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
    traits: list[Traits] = []
    repeatable = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True)  # on a GPU
    with new_folder(out) as folder, repeatable:
        writer = RunWriter(folder, on_window)
        summary = Node(config, parts, writer, on_configured=traits.append, on_window=writer.finish_window).run()
        _require_windows(summary)
        manifest = Manifest(
            made_from=_made_from(config, traits[-1]),
            config=msgspec.to_builtins(config),
            cfg_digest=config_digest(config, traits[-1]),
            frames=summary.frames,
            rejected=dict(sorted(summary.rejected.items())),
            nan_windows=summary.counts.nan_windows,
            troubles=writer.troubles,
            windows=tuple(writer.windows),
        )
        write_whole(folder / MANIFEST, lambda file: file.write(encode_manifest(manifest)))
    return open_run(out)


def replay_to_bag(
    config: NodeConfig, out: Path, on_window: Callable[[WindowReport], None] | None = None, parts: Parts = PARTS
) -> Summary:
    """Replay a launch file into the ROS 2 bag `out`: its views, on the time line of the log they were made from.

    Stamps are those of the log's pictures, log times when the log recorded them, and transforms hang on the frame_id of
    its pictures: so the bag can be played or merged with the log. Args and errors: as of `replay`.
    """
    config = lockstep_config(config)
    with new_folder(out) as folder, closing(McapFile(folder / f"{out.name}_0.mcap")) as file:
        writer = BagWriter(file, config)

        def opened(section: SourceConfig) -> FrameSource:
            source = parts.open_source(section)
            writer.recorded_after_ns = source.info.recorded_after_ns
            return source

        own = Parts(open_source=opened, load_model=parts.load_model)
        summary = Node(config, own, writer, on_window=on_window).run()
        _require_windows(summary)
        if not file.close():
            raise OutputError(f"cannot finish {out}: the disk is full or broken; make room on it")
        write_bag_metadata(folder, [file])
    return summary


def _require_windows(summary: Summary) -> None:
    if not summary.counts.windows:
        raise ModelFailedError(
            f'none of the {summary.counts.nan_windows} windows came out: all had NaN; try dtype = "float32" in '
            "[model], and look at the weights with `gcd-node weights inspect`"
        )


class NullSink:
    """A message sink that needs no reader, and that nobody waits for. What is not overridden is not kept."""

    def __init__(self) -> None:
        self.stats = PublisherStats()  # nobody reads

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None: ...

    def preview(self, made: Callable[[], ViewMessage]) -> None: ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None: ...

    def stop_waiting(self) -> None: ...


class BagWriter(NullSink):
    """Writes views and grids into a file. recorded_after_ns: see SourceInfo."""

    def __init__(self, file: McapFile, config: NodeConfig) -> None:
        super().__init__()
        self._file, self.recorded_after_ns, self._config = file, 0, config

    def send(self, message: DataMessage) -> bool:
        """Take a view or a grid; see MessageSink. Raises OutputError."""
        if kind_of(message.topic) != "frm":  # a frame is part of its window
            try:
                self._file.write(self._at_capture(message))
            except OSError as error:
                raise OutputError(f"cannot write {self._file.path}: {error.strerror}; make room on its disk") from error
        return True

    def _at_capture(self, message: DataMessage) -> Iterator[RosMessage]:
        """Its ROS messages at the time of their stamps, by image_transport's names. Ages of a replay mean nothing."""
        newest_ns = message.header.t_capture_ns[-1]
        for each in data_messages(message, self._config):
            head = getattr(each.fields, "header", None)
            stamp_ns = newest_ns if head is None else head.stamp.sec * 10**9 + head.stamp.nanosec
            at_ns = stamp_ns + self.recorded_after_ns
            kind = each.fields.__msgtype__.rpartition("/")[2]
            if kind != "Float64":
                topic = f"{each.topic}/compressed" if kind == "CompressedImage" else each.topic
                yield dataclasses.replace(each, topic=topic, log_ns=at_ns, sent_ns=at_ns)


class RunWriter(NullSink):
    """Keeps the windows of a lockstep node and their maps.

    Single frames are part of their window, and deviations of its samples: neither is kept; grids are not, either.
    """

    def __init__(self, folder: Path, on_window: Callable[[WindowReport], None] | None) -> None:
        super().__init__()
        self.windows: list[WindowEntry] = []
        self.troubles: dict[str, str] = {}
        self._folder, self._on_window = folder, on_window
        self._views: dict[str, dict[KeptKind, Digest]] = {}  # of the window in work, as the next two
        self._seed, self._ood = 0, ()

    _ood: tuple[str, ...]

    def send(self, message: DataMessage) -> bool:
        """Take a view; see MessageSink. Raises OutputError."""
        kind = kind_of(message.topic)
        if isinstance(message, GridMessage) or kind not in ("win", "cls", "vis", "depth"):
            return True
        header = message.header
        frames, height, width, channels = header.shape
        shape = (frames, height, width, 3) if channels == 3 else (frames, height, -1)
        pixels = np.frombuffer(message.payload, np.uint8).reshape(shape)
        digest = keep_pixels(self._folder, header.view_id, header.window_id, kind, pixels)
        self._views.setdefault(header.view_id, {})[kind] = digest
        if kind == "win":
            self._seed, self._ood = header.quality.seed, header.quality.ood
        return True

    def finish_window(self, report: WindowReport) -> None:
        """Take note that all views of a window were sent; a node's `on_window`."""
        window = report.window
        self.windows.append(
            WindowEntry(
                window_id=window.window_id,
                epoch=window.epoch,
                stamps_ns=tuple(window.stamps_ns),
                seqs=window.seqs,
                input_sha256=pixel_digest(window.images),
                seed=self._seed,
                ood=self._ood,
                views=self._views,
            )
        )
        self._views = {}
        if self._on_window is not None:
            self._on_window(report)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Keep what the model could not do; see MessageSink."""
        if topic == "event" and fields["code"] in ("MODEL_NAN", "GPU_OOM"):
            detail = fields["rung"] if "rung" in fields else f"seeds {', '.join(map(str, fields['seeds']))}"
            self.troubles[f"{fields['code']} in window {fields['window_id']}"] = detail


def _made_from(config: NodeConfig, traits: Traits) -> dict[str, str]:
    """Weights, recording, programs and machine: hashes of two runs are only bound to agree if all of it does."""
    section, files = config.source, dict[str, Path]()
    if not isinstance(section, SyntheticSource | LiveSource):
        files["source sha256"] = resolve_path(section.path)
    if section.calibration is not None:
        files["calibration sha256"] = Path(section.calibration).expanduser()
    return {
        "weights name": traits.name,
        "weights sha256_12": traits.sha256_12,
        "weights precision": traits.precision,
        **{name: digest_of(path) for name, path in files.items()},
        "version python": platform.python_version(),
        "version gcd-node": version("gcd-node"),
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
    told = Path("/proc/cpuinfo")
    names = re.findall(r"^model name\s*: (.*)$", told.read_text(), re.MULTILINE) if told.exists() else []
    return names[0] if names else platform.processor() or "unknown"
