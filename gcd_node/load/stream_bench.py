"""A whole node on a stream: how old its views are in another process, whether it keeps up, what it takes."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from gcd_node.config import (
    ControlConfig,
    ModelSection,
    NodeConfig,
    PublishConfig,
    SourceConfig,
    ViewConfig,
    WindowConfig,
)
from gcd_node.config_text import to_toml
from gcd_node.demo import VIEW_ID, demo_weights
from gcd_node.errors import NodeError
from gcd_node.load.first_view import end_process
from gcd_node.load.meter import percentile
from gcd_node.load.process_meter import PrivatePeak, cpu_s, memory
from gcd_node.load.stream_report import Ages, StreamBench
from gcd_node.subscriber import ReceivedView, ViewSubscriber
from gcd_node.wire.header import ViewHeader

SYNTHETIC = "synthetic"
"""Instead of a path: a street that is drawn as it comes, which takes a part of a core itself."""

PACKAGED = "package:drive.mp4"
"""The drive that ships, ten frames a second."""

_PACKAGED_HFOV_DEG = 85.0
_PATIENCE_S, _LOOK_S = 180.0, 0.2
_LEAST_VIEWS = 2
_MEBIBYTE = 2**20


@dataclass(frozen=True, kw_only=True, slots=True)
class StreamBenchOptions:
    """What streams through what. weights: None for those of the demo. source: a video file, or SYNTHETIC; played in a
    loop at `fps`. seconds: watched after the first view. stride, threads, steps, device, dtype: see NodeConfig."""

    weights: str | None = None
    source: str = PACKAGED
    fps: float = 10.0
    seconds: float = 60.0
    stride: int | None = None
    threads: int | None = None
    steps: int | None = None
    device: str = "auto"
    dtype: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrival:
    """One view here. at_s: after the first one. age_ms: of its newest input frame."""

    at_s: float
    age_ms: float
    header: ViewHeader

    @property
    def work_s(self) -> float:
        """From when the model took its window until the view was there."""
        return (self.header.t_infer_end_ns - self.header.t_infer_start_ns) / 1e9


@dataclass(frozen=True, kw_only=True, slots=True)
class Watched:
    """What was seen of the node's process. used_cpu_s: while views were collected, over `lasted_s`."""

    first_view_s: float
    arrivals: tuple[Arrival, ...]
    lasted_s: float
    used_cpu_s: float
    resident_bytes: int
    private_bytes: int


def bench_stream(options: StreamBenchOptions, on_part: Callable[[str], None]) -> StreamBench:
    """Run `gcd-node run` in a process of its own and read its views here; `on_part` is told what comes next.

    Raises:
        NodeError: no view came, or the node ended early.
    """
    with tempfile.TemporaryDirectory(prefix="gcd-stream-") as name:
        config = stream_config(options, Path(name))
        launch = Path(name) / "launch.toml"
        launch.write_text(to_toml(config))
        on_part("a process that starts")
        watched = _watch(config.publish.data, launch, options.seconds, on_part)
    return stream_report(options, watched)


def stream_config(options: StreamBenchOptions, folder: Path) -> NodeConfig:
    """The launch file, with sockets in a folder of its own."""
    if options.source == SYNTHETIC:
        source = SourceConfig(kind="synthetic", fps=options.fps)
    else:
        hfov_deg = _PACKAGED_HFOV_DEG if options.source == PACKAGED else None
        source = SourceConfig(kind="file", path=options.source, fps=options.fps, loop=True, hfov_deg=hfov_deg)
    model = ModelSection(
        weights=options.weights or demo_weights(),
        device=options.device,
        dtype=options.dtype,
        threads=options.threads,
        steps=options.steps,
    )
    return NodeConfig(
        source=source,
        model=model,
        window=WindowConfig(stride=options.stride),
        view={VIEW_ID: ViewConfig(kind="fixed")},
        publish=PublishConfig(data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        control=ControlConfig(endpoint=None),
        node_id="bench",
    )


def stream_report(options: StreamBenchOptions, watched: Watched) -> StreamBench:
    """The figures. Raises NodeError if too few views came to say anything."""
    arrivals = watched.arrivals
    if len(arrivals) < _LEAST_VIEWS:
        raise NodeError(
            f"{len(arrivals)} views came in {watched.lasted_s:.0f} s after the first, at least {_LEAST_VIEWS} are "
            "wanted; give more --seconds"
        )
    last = arrivals[-1].header
    numbers = [each.header.window_id for each in arrivals]
    ages_ms, work_s = [each.age_ms for each in arrivals], [each.work_s for each in arrivals]
    new_s, work_p95_s = _new_s(arrivals), percentile(work_s, 95)
    return StreamBench(
        model=last.model.name,
        precision=last.model.precision,
        device=last.model.device,
        steps=last.quality.steps,
        source=Path(options.source).name,
        fps=options.fps,
        seconds=options.seconds,
        frames=last.shape[0],
        new_s=new_s,
        windows=len(arrivals),
        missed=numbers[-1] - numbers[0] + 1 - len(numbers),
        ages=Ages(
            p50_ms=percentile(ages_ms, 50),
            p95_ms=percentile(ages_ms, 95),
            p99_ms=percentile(ages_ms, 99),
            most_ms=max(ages_ms),
        ),
        work_p50_s=percentile(work_s, 50),
        work_p95_s=work_p95_s,
        real_time_factor=new_s / work_p95_s,
        first_view_s=watched.first_view_s,
        cores=watched.used_cpu_s / watched.lasted_s,
        resident_mb=watched.resident_bytes / _MEBIBYTE,
        private_mb=watched.private_bytes / _MEBIBYTE,
        arrivals=tuple((round(each.at_s, 3), round(each.age_ms, 1)) for each in arrivals),
    )


def _new_s(arrivals: Sequence[Arrival]) -> float:
    """How far apart the windows' first frames were taken, per window; the end of a loop does not count."""
    headers = [each.header for each in arrivals]
    return percentile(
        [
            (after.t_capture_ns[0] - before.t_capture_ns[0]) / 1e9 / (after.window_id - before.window_id)
            for before, after in pairwise(headers)
        ],
        50,
    )


def _watch(endpoint: str, launch: Path, seconds: float, on_part: Callable[[str], None]) -> Watched:
    started_s = time.monotonic()
    with ViewSubscriber(endpoint, VIEW_ID, conflate=False) as views:
        process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-m", "gcd_node", "run", str(launch)], stdout=subprocess.DEVNULL
        )
        try:
            _next(views, process, started_s + _PATIENCE_S)
            first_s = time.monotonic()
            on_part(f"{seconds:g} s of stream")
            with PrivatePeak(process.pid) as private:
                began_cpu_s = cpu_s(process.pid)
                arrivals = _collect(views, process, first_s, first_s + seconds)
                used_cpu_s, lasted_s = cpu_s(process.pid) - began_cpu_s, time.monotonic() - first_s
            resident = memory(process.pid).peak_resident
        except ProcessLookupError as error:
            raise NodeError(f"the node ended: {error}; its last words are above") from error
        finally:
            end_process(process)
    return Watched(
        first_view_s=first_s - started_s,
        arrivals=tuple(arrivals),
        lasted_s=lasted_s,
        used_cpu_s=used_cpu_s,
        resident_bytes=resident,
        private_bytes=private.bytes,
    )


def _collect(
    views: ViewSubscriber, process: "subprocess.Popen[bytes]", first_s: float, until_s: float
) -> list[Arrival]:
    arrivals: list[Arrival] = []
    while time.monotonic() < until_s:
        _require_alive(process)
        view = views.receive(1000 * _LOOK_S)
        if view is not None:
            arrivals.append(Arrival(at_s=time.monotonic() - first_s, age_ms=view.age_ms, header=view.header))
    return arrivals


def _next(views: ViewSubscriber, process: "subprocess.Popen[bytes]", until_s: float) -> ReceivedView:
    while (view := views.receive(1000 * _LOOK_S)) is None:
        _require_alive(process)
        if time.monotonic() > until_s:
            raise NodeError(f"no first view within {_PATIENCE_S:g} s; see what `gcd-node demo` says")
    return view


def _require_alive(process: "subprocess.Popen[bytes]") -> None:
    if process.poll() is not None:
        raise NodeError(f"the node ended with {process.returncode}; its last words are above")
