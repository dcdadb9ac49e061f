"""`gcd-node bench`: measures a node as its clients see it, latency, throughput, missed frames, jitter, and its cost.

Figures carry the names that the published results of Isaac ROS Benchmark use, so that both fit one table; names that
begin with `GcdNodeMetrics` are our own. The node runs in a process of its own, its readers in this one.
"""

import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec
import numpy as np
import psutil
from msgspec.structs import replace
from rich.console import Console
from typer import Argument, Option

from gcd_client.subscriber import ReceivedView, ViewSubscriber
from gcd_node.cli.main import table
from gcd_node.cli.run import Changes
from gcd_node.config import ControlConfig, NodeConfig, ViewerConfig, load_config, parse_config, to_toml
from gcd_node.errors import NodeError, OutputError, UsageError
from gcd_node.sources import LIVE_KINDS, FileSource, FolderSource, McapSource, SyntheticSource

_RATES_HZ = (5.0, 10.0, 15.0)
_FIRST_VIEW_S, _IDLE_S, _END_S, _POLL_S = 180.0, 2.0, 20.0, 0.05
_CPU_INTERVAL_S = 1.0  # psutil's figure of a shorter interval is noise
_FEWEST_VIEWS = 3  # jitter is a difference of differences
_MEBIBYTE = 2**20

Stream: TypeAlias = Annotated[bool, Option("--stream", help="One run alone, at the source's own rate.")]

Pace: TypeAlias = Literal["realtime", "lockstep"]

_ROWS: dict[str, tuple[str, int]] = {
    "input frames": ("BasicPerformanceMetrics.NUM_FRAMES_SENT", 0),
    "missed": ("BasicPerformanceMetrics.NUM_MISSED_FRAMES", 0),
    "views": ("GcdNodeMetrics.NUM_VIEWS", 0),
    "throughput, frames/s": ("BasicPerformanceMetrics.MEAN_FRAME_RATE", 1),
    "age of a view on arrival, mean, ms": ("BasicPerformanceMetrics.MEAN_LATENCY", 0),
    "p50": ("GcdNodeMetrics.P50_LATENCY", 0),
    "p95": ("GcdNodeMetrics.P95_LATENCY", 0),
    "p99": ("GcdNodeMetrics.P99_LATENCY", 0),
    "max": ("BasicPerformanceMetrics.MAX_LATENCY", 0),
    "jitter, mean, ms": ("BasicPerformanceMetrics.MEAN_JITTER", 0),
    "jitter, max, ms": ("BasicPerformanceMetrics.MAX_JITTER", 0),
    "process start to first view, s": ("GcdNodeMetrics.FIRST_VIEW", 1),
    "CPU of the machine, idle, %": ("ResourceMetrics.BASELINE_OVERALL_CPU_UTILIZATION", 0),
    "the same over idle while the node runs, %": ("GcdNodeMetrics.CPU_OVER_IDLE", 0),
    "cores the node used": ("GcdNodeMetrics.CPU_CORES", 2),
    "peak memory, MiB": ("GcdNodeMetrics.PEAK_MEMORY", 0),
}
"""What the table shows: the figure's name, and its decimals."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrival:
    """A view that reached its reader. at_ns: monotonic clock. age_ms: of its newest frame. seqs: of its frames."""

    at_ns: int
    age_ms: float
    seqs: tuple[int, ...]


def bench(
    config: Annotated[
        Path | None, Argument(metavar="[CONFIG]", help="A launch file; the packaged drive where left out.")
    ] = None,
    rates: Annotated[
        list[float] | None, Option("--rate", min=0.1, help="Input rate for latency, Hz; 5, 10 and 15. Again for more.")
    ] = None,
    seconds: Annotated[float, Option(min=1.0, help="How long each run is watched after its first view.")] = 20.0,
    stream: Stream = False,
    changes: Changes = None,
    json_file: Annotated[
        Path | None, Option("--json", help="Also a file, in the names of Isaac ROS Benchmark.")
    ] = None,
) -> None:
    """Measure a node in a process of its own: latency, throughput, missed frames, cost.

    First as fast as the node can take the input, then at 5, 10 and 15 Hz; or with --stream as the source plays.
    """
    if json_file is not None and not json_file.parent.is_dir():
        raise OutputError(f"cannot write {json_file}: there is no folder {json_file.parent}; make it, or give another")
    if config is None:
        from gcd_node.demo import demo_config  # it brings torch

        settings = parse_config(to_toml(demo_config(Path())).encode(), "the packaged drive", changes or ())
    else:
        settings = load_config(config, changes or ())
    if not stream and settings.source.kind in (*LIVE_KINDS, "mcap"):
        raise UsageError(f"the rate of a source of kind {settings.source.kind!r} cannot be chosen; use --stream")
    with Console(stderr=True).status("idle") as status:
        psutil.cpu_percent()
        time.sleep(_IDLE_S)
        idle, own_fps = psutil.cpu_percent(), getattr(settings.source, "fps", None)
        first = "stream" if stream else "as fast as it can"
        status.update(first)
        figures = _run(settings, "realtime" if stream else "lockstep", own_fps, seconds, idle)
        by_rate: dict[float, dict[str, float]] = {}
        for rate in () if stream else rates or _RATES_HZ:
            status.update(f"{rate:g} Hz")
            by_rate[rate] = _run(settings, "realtime", rate, seconds, idle)
    runs = (figures, *by_rate.values())
    rows = ((label, *(f"{run[name]:.{decimals}f}" for run in runs)) for label, (name, decimals) in _ROWS.items())
    Console().print(table(rows, ("", f">{first}", *(f">{rate:g} Hz" for rate in by_rate))))
    if json_file is not None:
        named = {f"{rate:.1f}fps": run for rate, run in by_rate.items()}
        text = msgspec.json.encode({**figures, **named, "metadata": _metadata(settings, idle)})
        try:
            json_file.write_bytes(msgspec.json.format(text, indent=2) + b"\n")
        except OSError as error:
            raise OutputError(f"cannot write {json_file}: {error.strerror}; give another path with --json") from error


def view_figures(views: Mapping[str, Sequence[Arrival]]) -> dict[str, float]:
    """Figures of what arrived, by view. A frame is missed unless every view answers it.

    Raises:
        NodeError: a view came fewer than three times.
    """
    each = list(views.values())
    if (fewest := min(map(len, each))) < _FEWEST_VIEWS:
        raise NodeError(f"{fewest} views came, at least {_FEWEST_VIEWS} are needed; give more --seconds")
    first, last = max(one[0].seqs[0] for one in each), min(one[-1].seqs[-1] for one in each)
    sent = set(range(first, last + 1))
    missed = sent - set.intersection(*({seq for arrival in one for seq in arrival.seqs} for one in each))
    ages_ms = [arrival.age_ms for one in each for arrival in one]
    at_ms = [np.array([arrival.at_ns for arrival in one]) / 1e6 for one in each]
    jitter_ms = np.concatenate([np.abs(np.diff(times, 2)) for times in at_ms])
    basic = {
        "RECEIVED_DURATION": max(times[-1] - times[0] for times in at_ms),
        "MEAN_PLAYBACK_FRAME_RATE": max(_per_second(one, one[-1].seqs[-1] - one[0].seqs[-1]) for one in each),
        "MEAN_FRAME_RATE": min(_per_second(one, _answered(one)) for one in each),
        "NUM_FRAMES_SENT": len(sent),
        "NUM_MISSED_FRAMES": len(missed),
        "FIRST_SENT_RECEIVED_LATENCY": max(one[0].age_ms for one in each),
        "LAST_SENT_RECEIVED_LATENCY": max(one[-1].age_ms for one in each),
        "MEAN_LATENCY": np.mean(ages_ms),
        "MIN_LATENCY": min(ages_ms),
        "MAX_LATENCY": max(ages_ms),
        "MEAN_JITTER": jitter_ms.mean(),
        "MIN_JITTER": jitter_ms.min(),
        "MAX_JITTER": jitter_ms.max(),
        "STD_DEV_JITTER": jitter_ms.std(),
    }
    figures = {f"BasicPerformanceMetrics.{name}": float(value) for name, value in basic.items()}
    for share in (50, 95, 99):
        figures[f"GcdNodeMetrics.P{share}_LATENCY"] = float(np.percentile(ages_ms, share, method="higher"))
    return figures | {"GcdNodeMetrics.NUM_VIEWS": len(ages_ms)}


def _answered(arrivals: Sequence[Arrival]) -> int:
    """Input frames that views after the first one answered."""
    return len({seq for arrival in arrivals[1:] for seq in arrival.seqs}.difference(arrivals[0].seqs))


def _per_second(arrivals: Sequence[Arrival], count: int) -> float:
    return count / (arrivals[-1].at_ns - arrivals[0].at_ns) * 1e9


def _run(config: NodeConfig, pace: Pace, fps: float | None, seconds: float, idle: float) -> dict[str, float]:
    """One process of a node, from its start until it has been watched for `seconds` after its first view."""
    with tempfile.TemporaryDirectory(prefix="gcd-bench-") as folder:
        node = _Node(_bench_config(config, folder, pace, fps), Path(folder))
        try:
            until_s = time.monotonic() + _FIRST_VIEW_S
            while not all(node.arrivals.values()):
                node.require_alive()
                if time.monotonic() > until_s:
                    raise NodeError(f"no view of each kind within {_FIRST_VIEW_S:g} s; see what `gcd-node check` says")
                time.sleep(_POLL_S)
            first_ns = max(arrivals[0].at_ns for arrivals in node.arrivals.values())
            cost = _watch(node, seconds, idle)
        except psutil.Error as error:
            node.require_alive()
            raise NodeError(f"the node's process cannot be measured: {error}") from error
        finally:
            node.close()
    later = {view: [one for one in arrivals if one.at_ns > first_ns] for view, arrivals in node.arrivals.items()}
    return view_figures(later) | {"GcdNodeMetrics.FIRST_VIEW": (first_ns - node.started_ns) / 1e9} | cost


def _bench_config(config: NodeConfig, folder: str, pace: Pace, fps: float | None) -> NodeConfig:
    """The launch file of one run: endless, with sockets in a folder of its own and no other way in."""
    source = config.source
    if isinstance(source, SyntheticSource):
        source = replace(source, pace=pace, fps=source.fps if fps is None else fps, frames=None)
    elif isinstance(source, FileSource | FolderSource):
        source = replace(source, pace=pace, fps=source.fps if fps is None else fps, loop=True)
    elif isinstance(source, McapSource):
        source = replace(source, pace=pace, loop=True)
    return replace(
        config,
        source=source,
        publish=replace(config.publish, data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        control=ControlConfig(endpoint=None),
        health=replace(config.health, http=None),
        viewer=ViewerConfig(),
    )


def _watch(node: "_Node", seconds: float, idle: float) -> dict[str, float]:
    """What the node's process and the whole machine use for so long."""
    begun_s = sampled_s = time.monotonic()
    process = psutil.Process(node.process.pid)
    before = process.cpu_times()
    busy: list[float] = []
    peak_bytes = 0
    psutil.cpu_percent()
    while (now_s := time.monotonic()) < begun_s + seconds:
        node.require_alive()
        peak_bytes = max(peak_bytes, process.memory_info().rss)
        if now_s - sampled_s >= _CPU_INTERVAL_S:
            busy.append(psutil.cpu_percent())
            sampled_s = now_s
        time.sleep(_POLL_S)
    busy = busy or [psutil.cpu_percent()]
    after = process.cpu_times()
    return {
        "ResourceMetrics.BASELINE_OVERALL_CPU_UTILIZATION": idle,
        "ResourceMetrics.MEAN_OVERALL_CPU_UTILIZATION": float(np.mean(busy)),
        "ResourceMetrics.MIN_OVERALL_CPU_UTILIZATION": min(busy),
        "ResourceMetrics.MAX_OVERALL_CPU_UTILIZATION": max(busy),
        "ResourceMetrics.STDDEV_OVERALL_CPU_UTILIZATION": float(np.std(busy)),
        "GcdNodeMetrics.CPU_OVER_IDLE": float(np.mean(busy)) - idle,
        "GcdNodeMetrics.CPU_CORES": (after.user + after.system - before.user - before.system) / (now_s - begun_s),
        "GcdNodeMetrics.PEAK_MEMORY": peak_bytes / _MEBIBYTE,
    }


class _Node:
    """`gcd-node run` in a process, and a thread for each view that notes when it arrives."""

    def __init__(self, config: NodeConfig, folder: Path) -> None:
        launch, self._stderr = folder / "launch.toml", folder / "stderr"
        launch.write_text(to_toml(config, secrets=True))
        self.arrivals: dict[str, list[Arrival]] = {view: [] for view in config.view}
        self._closed, self._error = threading.Event(), None
        self._readers = [threading.Thread(target=self._read, args=(config.publish.data, view)) for view in config.view]
        for reader in self._readers:
            reader.start()
        self.started_ns = time.monotonic_ns()
        with self._stderr.open("wb") as stderr:
            command = [sys.executable, "-m", "gcd_node", "run", str(launch)]
            self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr)  # noqa: S603

    def require_alive(self) -> None:
        """Raises NodeError if the node has ended, and what ended a reader."""
        if (code := self.process.poll()) is not None:
            lines = self._stderr.read_text(errors="replace").strip().splitlines()
            raise NodeError(f"the node ended with {code}: {lines[-1] if lines else 'without a word'}")
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """End the process and the readers."""
        self._closed.set()
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
        for reader in self._readers:
            reader.join()

    def _read(self, endpoint: str, view: str) -> None:
        def note(found: ReceivedView) -> None:
            now_ns, seqs = time.monotonic_ns(), found.header.src.seq
            self.arrivals[view].append(Arrival(at_ns=now_ns, age_ms=found.age_ms, seqs=seqs))

        try:
            with ViewSubscriber(endpoint, view, conflate=False) as views:
                views.run(note, self._closed)
        except Exception as error:  # the end of a thread: require_alive() raises it
            self._error = error


def _metadata(config: NodeConfig, idle: float) -> dict[str, object]:
    system = platform.uname()
    facts = {
        "NAME": f"gcd-node {config.model.weights}",
        "TEST_DATETIME": datetime.now(UTC).isoformat(timespec="seconds"),
        "DEVICE_ARCH": system.machine,
        "DEVICE_OS": f"{system.system} {system.release}",
        "IDLE_CPU_UTIL": idle,
        "INPUT_DATA_PATH": getattr(config.source, "path", config.source.kind),
        "CONFIG": to_toml(config),
    }
    return {f"BenchmarkMetadata.{name}": value for name, value in facts.items()}
