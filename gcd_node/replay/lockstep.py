"""A launch file replayed: its recording through its model as fast as that goes, into a run on disk."""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import torch
from msgspec.structs import replace

from gcd_model import Traits
from gcd_node.config import LIVE_KINDS, LifeConfig, NodeConfig, SourceConfig
from gcd_node.config_digest import config_digest
from gcd_node.config_text import to_toml
from gcd_node.errors import ConfigError, DamagedRunError, ModelFailedError, OutputError
from gcd_node.frame import FrameSource, SourceInfo
from gcd_node.life.machinery import Parts
from gcd_node.life.stream import Summary
from gcd_node.node import Node, NodeOptions
from gcd_node.rendering.model_worker import WindowReport
from gcd_node.replay import provenance
from gcd_node.replay.manifest import Manifest, TotalsEntry
from gcd_node.replay.run_folder import RunFolder, check_pixels, new_folder, open_run, write_manifest
from gcd_node.replay.run_writer import RunWriter
from gcd_node.session import load_model, model_threads
from gcd_node.sources import open_source

PARTS = Parts(open_source=open_source, load_model=load_model)
"""What a launch file names, as `gcd-node run` opens it."""


def lockstep_config(config: NodeConfig) -> NodeConfig:
    """The launch file as it is replayed: in lockstep, once, with nothing but what decides how views come out.

    Its digest, and with it every seed, is that of the original.
    Raises:
        ConfigError: its source cannot be replayed: a live camera, or a drawn drive without an end.
    """
    source = config.source
    if source.kind in LIVE_KINDS:
        raise ConfigError(
            f"a replay needs a recording, got [source] kind = {source.kind!r}, a live camera: record it first, then "
            'give a launch file with kind = "mcap" or "file" and its path'
        )
    if source.kind == "synthetic" and source.frames is None:
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
        _require_readable(folder, out)
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


class _Watched:
    """Parts that remember what they gave."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self.infos: list[SourceInfo] = []
        self.traits: list[Traits] = []

    def watched(self) -> Parts:
        return Parts(open_source=self._open, load_model=self._parts.load_model)

    def _open(self, section: SourceConfig) -> FrameSource:
        source = self._parts.open_source(section)
        self.infos.append(source.info)
        return source


def _filled(
    config: NodeConfig, folder: Path, on_window: Callable[[WindowReport], None] | None, parts: Parts
) -> Manifest:
    """Run the node; its pixels are in the folder then."""
    watched = _Watched(parts)
    with RunWriter(folder) as writer:

        def finish(report: WindowReport) -> None:
            writer.finish_window(report)
            if on_window is not None:
                on_window(report)

        options = NodeOptions(once=True, on_configured=watched.traits.append, on_window=finish)
        summary = Node(config, watched.watched(), writer, options).run()
    return _manifest(config, watched, writer, summary)


def _manifest(config: NodeConfig, watched: _Watched, writer: RunWriter, summary: Summary) -> Manifest:
    kept, traits = writer.kept, watched.traits[-1]
    if kept.size is None:
        raise ModelFailedError(
            f'none of the {summary.counts.nan_windows} windows came out: all had NaN; try dtype = "float32" in '
            "[model], and look at the weights with `gcd-node weights inspect`"
        )
    return Manifest(
        versions=provenance.versions(),
        machine=provenance.machine(traits.device, model_threads(config.model)),
        config=to_toml(config),
        cfg_digest=config_digest(config, traits),
        weights=provenance.weights(traits),
        source=provenance.source(config.source, watched.infos[0]),
        size=kept.size,
        fps=kept.fps,
        classes=kept.classes,
        totals=TotalsEntry(
            frames=summary.frames,
            windows=summary.counts.windows,
            rejected=dict(sorted(summary.rejected.items())),
            nan_windows=summary.counts.nan_windows,
        ),
        troubles=tuple(kept.troubles),
        windows=tuple(kept.windows),
    )


def _require_readable(folder: Path, out: Path) -> None:
    """OpenCV does not say that a disk is full: what cannot be read back was not written."""
    try:
        check_pixels(open_run(folder))
    except DamagedRunError as error:
        raise OutputError(f"{out} could not be written whole; is there space? {error}") from error
