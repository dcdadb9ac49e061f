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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

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
from gcd_node.sources import LIVE_KINDS

_RATES_HZ = (5.0, 10.0, 15.0)
_FIRST_VIEW_S, _IDLE_S, _END_S, _POLL_S = 180.0, 2.0, 20.0, 0.05
_FEWEST_VIEWS = 3  # jitter is a difference of differences


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
    stream: Annotated[bool, Option("--stream", help="One run alone, at the source's own rate.")] = False,
    changes: Changes = None,
    json_file: Annotated[
        Path | None, Option("--json", help="Also a file, in the names of Isaac ROS Benchmark.")
    ] = None,
) -> None:
    """Measure a node in a process of its own: latency, throughput, missed frames, cost.

    First as fast as the node can take the input, then at 5, 10 and 15 Hz; or with --stream as the source plays.
    Latency, jitter and durations are milliseconds, FIRST_VIEW seconds from the start of the process, memory MiB.
    """
    if json_file is not None and not json_file.parent.is_dir():
        raise OutputError(f"cannot write {json_file}: there is no folder {json_file.parent}; make it, or give another")
    if config is None:
        from gcd_node.demo import demo_config  # it brings torch

        settings = parse_config(to_toml(demo_config(Path())).encode(), "the packaged drive", changes or ())
    else:
        settings = load_config(config, changes or ())
    kind = settings.source.kind
    if not stream and kind in (*LIVE_KINDS, "mcap"):
        raise UsageError(f"the rate of a source of kind {kind!r} cannot be chosen; use --stream")
    at_rates = {f"{rate:.1f}fps": ("realtime", f"source.fps={rate}") for rate in rates or _RATES_HZ}
    planned = {"stream": ("realtime",)} if stream else {"as fast as it can": ("lockstep",), **at_rates}
    runs: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory(prefix="gcd-bench-") as folder, Console(stderr=True).status("idle") as status:
        launch = Path(folder) / "launch.toml"
        launch.write_text(to_toml(_alone(settings, folder), secrets=True))
        psutil.cpu_percent()
        time.sleep(_IDLE_S)
        idle = psutil.cpu_percent()
        for name, (pace, *rate) in planned.items():
            status.update(name)
            endless = [] if kind in LIVE_KINDS else ["source.loop=true", f"source.pace={pace}", *rate]
            runs[name] = _run(launch, endless, seconds, idle)
    figures = next(iter(runs.values()))
    rows = ((name.partition(".")[2], *(f"{run[name]:.4g}" for run in runs.values())) for name in figures)
    Console().print(table(rows, ("", *(f">{name}" for name in runs))))
    if json_file is not None:
        named = {name: run for name, run in runs.items() if run is not figures}
        text = msgspec.json.encode({**figures, **named, "metadata": _metadata(settings, idle)})
        try:
            json_file.write_bytes(msgspec.json.format(text, indent=2) + b"\n")
        except OSError as error:
            raise OutputError(f"cannot write {json_file}: {error.strerror}; give another path with --json") from error


def _alone(config: NodeConfig, folder: str) -> NodeConfig:
    """With sockets in a folder of its own and no other way in."""
    return replace(
        config,
        publish=replace(config.publish, data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        control=ControlConfig(endpoint=None),
        health=replace(config.health, http=None),
        viewer=ViewerConfig(),
    )


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
    answered = [len({seq for view in one[1:] for seq in view.seqs}.difference(one[0].seqs)) for one in each]
    basic = {
        "RECEIVED_DURATION": max(times[-1] - times[0] for times in at_ms),
        "MEAN_PLAYBACK_FRAME_RATE": max(_per_second(one, one[-1].seqs[-1] - one[0].seqs[-1]) for one in each),
        "MEAN_FRAME_RATE": min(map(_per_second, each, answered)),
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


def _per_second(arrivals: Sequence[Arrival], count: int) -> float:
    return count / (arrivals[-1].at_ns - arrivals[0].at_ns) * 1e9


def _run(launch: Path, changes: list[str], seconds: float, idle: float) -> dict[str, float]:
    """One process of a node, from its start until it has been watched for `seconds` after its first view."""
    config, closed, said = load_config(launch), threading.Event(), launch.with_name("stderr")
    views: dict[str, list[Arrival]] = {view: [] for view in config.view}
    command = [sys.executable, "-m", "gcd_node", "run", str(launch)]
    command += [word for change in changes for word in ("--set", change)]
    with ThreadPoolExecutor(len(views)) as pool, said.open("wb") as stderr:
        readers = [pool.submit(_read, config.publish.data, view, found, closed) for view, found in views.items()]
        started_s = time.monotonic()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr)  # noqa: S603

        def check() -> None:
            """Raises NodeError if the node has ended, and what ended a reader."""
            if (code := process.poll()) is not None:
                lines = said.read_text(errors="replace").strip().splitlines()
                raise NodeError(f"the node ended with {code}: {lines[-1] if lines else 'without a word'}")
            for reader in readers:
                if reader.done():
                    reader.result()
            time.sleep(_POLL_S)

        try:
            while not all(views.values()):
                check()
                if time.monotonic() > started_s + _FIRST_VIEW_S:
                    raise NodeError(f"no view of each kind within {_FIRST_VIEW_S:g} s; see what `gcd-node check` says")
            first_ns = max(found[0].at_ns for found in views.values())
            cost = _cost(psutil.Process(process.pid), check, seconds, idle)
        except psutil.Error as error:
            raise NodeError(f"the node's process cannot be measured: {error}") from error
        finally:
            closed.set()
            process.terminate()
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
    later = {view: [each for each in found if each.at_ns > first_ns] for view, found in views.items()}
    return view_figures(later) | {"GcdNodeMetrics.FIRST_VIEW": first_ns / 1e9 - started_s} | cost


def _read(endpoint: str, view: str, found: list[Arrival], closed: threading.Event) -> None:
    def note(received: ReceivedView) -> None:
        seqs = received.header.src.seq
        found.append(Arrival(at_ns=time.monotonic_ns(), age_ms=received.age_ms, seqs=seqs))

    with ViewSubscriber(endpoint, view, conflate=False) as views:
        views.run(note, closed)


def _cost(process: psutil.Process, check: Callable[[], None], seconds: float, idle: float) -> dict[str, float]:
    """What the node's process and the whole machine use for so long; the machine's share by the second."""
    begun_s, before, peak_bytes = time.monotonic(), process.cpu_times(), 0
    busy: list[float] = []
    psutil.cpu_percent()
    while time.monotonic() < begun_s + seconds:
        check()
        peak_bytes = max(peak_bytes, process.memory_info().rss)
        if time.monotonic() >= begun_s + len(busy) + 1:
            busy.append(psutil.cpu_percent())
    after, took_s = process.cpu_times(), time.monotonic() - begun_s
    overall = {"BASELINE": idle, "MEAN": np.mean(busy), "MIN": min(busy), "MAX": max(busy), "STDDEV": np.std(busy)}
    figures = {f"ResourceMetrics.{name}_OVERALL_CPU_UTILIZATION": float(share) for name, share in overall.items()}
    return figures | {
        "GcdNodeMetrics.CPU_OVER_IDLE": float(np.mean(busy)) - idle,
        "GcdNodeMetrics.CPU_CORES": (after.user + after.system - before.user - before.system) / took_s,
        "GcdNodeMetrics.PEAK_MEMORY": peak_bytes / 2**20,
    }


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
