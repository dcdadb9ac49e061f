"""How fast everything around the model is: the way of a frame into another process, a slow model, a stalled reader, a
camera that comes back, a process that starts. The model is a stand-in but for the last, the readers are real processes,
the sockets are ipc."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

from gcd_node.errors import NodeError
from gcd_node.load.clients import Arrival, Client, reader
from gcd_node.load.first_view import FirstView, first_view
from gcd_node.load.meter import memory_mb, percentile
from gcd_node.load.rig import VIEW, Rig, running_node
from gcd_node.load.scripted_camera import Act, CameraScript, Return
from gcd_node.load.stand_in import StandInModel
from gcd_node.rendering.model_worker import WindowReport

_LOOK_S = 0.02
_SLOWNESS = 2.0
_UNMEASURED = 2  # the first windows pay for what happens only once
_GRACE_S = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchOptions:
    """How much to measure.

    windows: for the latency, and again beside a healthy reader before another one stalls. slow_windows: of the slow
    model. stall_s: how long a reader does not read. returns: how often the camera comes back; outage_s: gone each time.
    starts: processes with the packaged model.
    width, height: of the views. fps: of the camera; one the stand-in was "trained" with.
    """

    windows: int = 100
    slow_windows: int = 12
    stall_s: float = 60.0
    returns: int = 3
    outage_s: float = 1.0
    starts: int = 3
    width: int = 384
    height: int = 256
    fps: float = 24.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Latency:
    """From the moment a window's last frame was taken until its view was there, ms. count: windows."""

    count: int
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, kw_only=True, slots=True)
class SlowModel:
    """A model that takes twice the time there is.

    work_ms, window_ms: what a rendering takes, and how often a window is complete. first_ms, last_ms: median age of the
    views of the first and of the last third; most_ms: the oldest. backlog_windows: most windows' time any window waited
    for the model. dropped: windows replaced by newer ones.
    """

    work_ms: float
    window_ms: float
    windows: int
    first_ms: float
    last_ms: float
    most_ms: float
    backlog_windows: int
    dropped: int


@dataclass(frozen=True, kw_only=True, slots=True)
class StalledReader:
    """A healthy reader before and while another one does not read. memory_growth_mb: of the node's process, at most;
    the other one's own memory does not count. skipped: views the healthy one missed."""

    stall_s: float
    before: Latency
    during: Latency
    memory_growth_mb: float
    skipped: int


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceBack:
    """A camera that was gone. after_first_ms: from its first frame to the first view, the median and the longest;
    after_plugged_ms: from when it could have been opened, so with the wait before the next attempt. window_ms: what
    the frames of a window alone take."""

    count: int
    outage_s: float
    after_first_ms: float
    after_first_most_ms: float
    after_plugged_ms: float
    after_plugged_most_ms: float
    window_ms: float


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchReport:
    """Everything measured. stages_ms: p50 of the node's own stages for the latency, ms: see health.report.Stage.
    machine_load: the load average of the last minute before: what else there was to do."""

    machine_load: float
    frames: int
    width: int
    height: int
    latency: Latency
    stages_ms: dict[str, float]
    slow_model: SlowModel
    stalled_reader: StalledReader
    source_back: SourceBack
    first_view: FirstView


def bench_node(options: BenchOptions, on_part: Callable[[str], None]) -> BenchReport:
    """Measure everything, one after another; `on_part` is told what comes next.

    Raises:
        NodeError: a node or a reader did not come up, or nothing arrives.
    """
    machine_load = os.getloadavg()[0]
    on_part("frame to view")
    latency, stages_ms = _latency(options)
    on_part("a model twice too slow")
    slow_model = _slow_model(options)
    on_part("a reader that stalls beside a healthy one")
    stalled_reader = _stalled_reader(options)
    on_part("a camera that comes back")
    source_back = _source_back(options)
    on_part("a process that starts")
    first = first_view(options.starts)
    return BenchReport(
        machine_load=machine_load,
        frames=_model(options).traits.config.frames,
        width=options.width,
        height=options.height,
        latency=latency,
        stages_ms=stages_ms,
        slow_model=slow_model,
        stalled_reader=stalled_reader,
        source_back=source_back,
        first_view=first,
    )


def _latency(options: BenchOptions) -> tuple[Latency, dict[str, float]]:
    """With windows that overlap by half, so that there are more of them."""
    script, model = _camera(options), _model(options)
    with running_node(script, model, stride=model.traits.config.frames // 2) as rig, _healthy(rig) as healthy:
        arrived = _await(rig, healthy, options.windows + _UNMEASURED)
        stages = rig.node.health.snapshot().stages
        return _ages(script, arrived[_UNMEASURED:]), {name: 1000 * each.p50_s for name, each in stages.items()}


def _slow_model(options: BenchOptions) -> SlowModel:
    script = _camera(options)
    window_s = _model(options).traits.config.frames / options.fps
    model = _model(options, work_s=_SLOWNESS * window_s)
    waited_s: list[float] = []

    def note(report: WindowReport) -> None:
        waited_s.append((model.taken_ns - report.window.arrival_ns) / 1e9)

    with running_node(script, model, on_window=note) as rig, _healthy(rig) as healthy:
        arrived = _await(rig, healthy, options.slow_windows + _UNMEASURED)[_UNMEASURED:]
        dropped = rig.node.health.snapshot().drops["slot"]
    ages_ms = _ages_ms(script, arrived)
    third = max(1, len(ages_ms) // 3)
    return SlowModel(
        work_ms=1000 * _SLOWNESS * window_s,
        window_ms=1000 * window_s,
        windows=len(ages_ms),
        first_ms=percentile(ages_ms[:third], 50),
        last_ms=percentile(ages_ms[-third:], 50),
        most_ms=max(ages_ms),
        backlog_windows=int(max(waited_s) / window_s),
        dropped=dropped,
    )


def _stalled_reader(options: BenchOptions) -> StalledReader:
    script, model = _camera(options), _model(options)
    with ExitStack() as stack:
        rig = stack.enter_context(running_node(script, model, stride=model.traits.config.frames // 2))
        healthy = stack.enter_context(_healthy(rig))
        before = _await(rig, healthy, options.windows + _UNMEASURED)[_UNMEASURED:]
        stalled = stack.enter_context(reader(rig.publisher.endpoint, VIEW, "--pause", "100000"))
        rig.wait_for(lambda: stalled.last is not None, "the one view it reads")
        healthy.take()
        during, grown_mb = _watch(rig, healthy, options.stall_s)
    return StalledReader(
        stall_s=options.stall_s,
        before=_ages(script, before),
        during=_ages(script, during),
        memory_growth_mb=grown_mb,
        skipped=sum(each.skipped for each in during),
    )


def _watch(rig: Rig, healthy: Client[Arrival], seconds: float) -> tuple[list[Arrival], float]:
    """What arrives, and by how much the node's memory has grown at most."""
    arrived: list[Arrival] = []
    until_s, began_mb, most_mb = time.monotonic() + seconds, memory_mb(), 0.0
    while time.monotonic() < until_s:
        most_mb = max(most_mb, memory_mb())
        arrived += healthy.take()
        _check(rig, healthy)
        time.sleep(_LOOK_S)
    return arrived, max(0.0, most_mb - began_mb)


def _source_back(options: BenchOptions) -> SourceBack:
    gone = threading.Event()
    script, model = _camera(options, _dies_when(gone)), _model(options)
    found: list[tuple[Return, Arrival]] = []
    with running_node(script, model) as rig, _healthy(rig) as healthy:
        _await(rig, healthy, 1)
        for count in range(1, options.returns + 1):
            gone.set()
            rig.wait_for(lambda count=count: len(script.returns) >= count, "a return of the camera")
            back = script.returns[-1]
            found.append((back, _first_since(rig, healthy, back.first_seq)))
    after_first_ms = [(view.arrived_ns - back.first_ns) / 1e6 for back, view in found]
    after_plugged_ms = [(view.arrived_ns - back.plugged_ns) / 1e6 for back, view in found]
    return SourceBack(
        count=len(found),
        outage_s=options.outage_s,
        after_first_ms=percentile(after_first_ms, 50),
        after_first_most_ms=max(after_first_ms),
        after_plugged_ms=percentile(after_plugged_ms, 50),
        after_plugged_most_ms=max(after_plugged_ms),
        window_ms=1000 * model.traits.config.frames / options.fps,
    )


def _camera(options: BenchOptions, acts: Iterator[Act] | None = None) -> CameraScript:
    """Larger than what the model takes, so that frames are resized as in a robot."""
    size = (5 * options.width // 4, 5 * options.height // 4)
    return CameraScript(acts or iter(()), fps=options.fps, size=size, outage_s=options.outage_s)


def _model(options: BenchOptions, work_s: float = 0.0) -> StandInModel:
    return StandInModel(width=options.width, height=options.height, work_s=work_s)


def _dies_when(gone: threading.Event) -> Iterator[Act]:
    while True:
        if gone.is_set():
            gone.clear()
            yield "die"
        yield "steady"


def _healthy(rig: Rig) -> Client[Arrival]:
    """A reader that takes everything at once."""
    return reader(rig.publisher.endpoint, VIEW)


def _await(rig: Rig, client: Client[Arrival], count: int) -> list[Arrival]:
    """The next `count` arrivals. Raises NodeError if one keeps us waiting for a minute."""
    arrived: list[Arrival] = []
    while len(arrived) < count:
        arrived += _next(rig, client)
    return arrived[:count]


def _first_since(rig: Rig, client: Client[Arrival], seq: int) -> Arrival:
    """The first view made of frames from `seq` on."""
    while True:
        for each in _next(rig, client):
            if each.first_seq >= seq:
                return each


def _next(rig: Rig, client: Client[Arrival]) -> list[Arrival]:
    until_s = time.monotonic() + _GRACE_S
    while not (arrived := client.take()):
        _check(rig, client)
        if time.monotonic() > until_s:
            raise NodeError(f"no view reached the reader for {_GRACE_S:g} s; run with -v to see why")
        time.sleep(_LOOK_S)
    return arrived


def _check(rig: Rig, client: Client[Arrival]) -> None:
    if not rig.running:
        raise NodeError(f"the node ended: {rig.failure}; run with -v to see why")
    if not client.alive:
        raise NodeError("the reading process died; its last words are above")


def _ages(script: CameraScript, arrived: list[Arrival]) -> Latency:
    ages_ms = _ages_ms(script, arrived)
    return Latency(count=len(ages_ms), p50_ms=percentile(ages_ms, 50), p99_ms=percentile(ages_ms, 99))


def _ages_ms(script: CameraScript, arrived: list[Arrival]) -> list[float]:
    """From each view's last frame to its arrival; by the camera itself, not by stamps."""
    taken_ns = [(each.arrived_ns, script.taken_ns(each.last_seq)) for each in arrived]
    return [(arrived_ns - taken) / 1e6 for arrived_ns, taken in taken_ns if taken is not None]
