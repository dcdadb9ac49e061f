"""A node for hours: a camera that misbehaves, readers that stall, a client that attacks, an operator who commands; and
whether it holds more of anything at the end than at the beginning."""

import random
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

from gcd_node.load.busy_operator import BusyOperator
from gcd_node.load.clients import Arrival, Attacks, Client, hostile, reader
from gcd_node.load.meter import holding, open_files
from gcd_node.load.rig import VIEW, Rig, running_node
from gcd_node.load.scripted_camera import ACTS, Act, CameraScript
from gcd_node.load.soak_report import SoakReport, growth, spread
from gcd_node.load.stand_in import StandInModel
from gcd_node.publisher import begin_zero_copy
from gcd_node.rendering.model_worker import WindowReport

_STEP_S = 0.1
_SAMPLES = 2000
_LEAST_SAMPLE_S = 0.2
_NAN_EVERY = 50
_END_S = 10.0
_SOCKETS = ("socket:", "anon_inode:")
_MEDIAN, _FLOOR = 50.0, 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class SoakOptions:
    """How to soak. width, height: of the views. seed: of camera, operator and attacker."""

    hours: float
    width: int = 384
    height: int = 256
    seed: int = 0

    @property
    def seconds(self) -> float:
        """The same in seconds."""
        return 3600.0 * self.hours


@dataclass(frozen=True, kw_only=True, slots=True)
class Sample:
    """How it stands. left_s: to go."""

    left_s: float
    memory_mb: float
    threads: int
    files: int
    arrived: int


def run_soak(options: SoakOptions, on_sample: Callable[[Sample], None] | None = None) -> SoakReport:
    """Soak; `on_sample` is told now and then. Ctrl-C ends it early, with a report.

    Raises:
        NodeError: the node did not come up.
    """
    was = _Before()
    model = StandInModel(width=options.width, height=options.height, nan_every=_NAN_EVERY)
    script = CameraScript(_acts(options.seed), size=(5 * options.width // 4, 5 * options.height // 4))
    log = _Log(script=script, model=model)
    failures: list[str] = []
    with running_node(script, model, on_window=log.window) as rig:
        _Soak(options, rig, log, failures).run(on_sample or _nobody)
    failures += [] if rig.failure is None else [f"the node ended with {type(rig.failure).__name__}: {rig.failure}"]
    failures += ["a thread of the node hung and was left behind"] if rig.node.left_behind else []
    return log.report(was.left(), failures)


class _Soak:
    """One run: connects everybody, and measures until the time is over."""

    def __init__(self, options: SoakOptions, rig: Rig, log: "_Log", failures: list[str]) -> None:
        self._options, self._rig, self._log, self._failures = options, rig, log, failures
        self._every_s = max(_LEAST_SAMPLE_S, options.seconds / _SAMPLES)

    def run(self, on_sample: Callable[[Sample], None]) -> None:
        options, rig = self._options, self._rig
        data, status = rig.publisher.endpoint, rig.publisher.status_endpoint or ""
        with ExitStack() as stack:
            healthy = stack.enter_context(reader(data, VIEW))
            others = [
                stack.enter_context(reader(data, VIEW, "--newest", "--pause", "1.0")),
                stack.enter_context(reader(data, VIEW, "--stall", "20.0")),
            ]
            rig.wait_for(lambda: rig.publisher.stats.subscribers >= 3, "three subscriptions")
            attacker = stack.enter_context(hostile(data, status, rig.control, options.seed))
            restart_s = min(60.0, options.seconds / 4)
            operator = stack.enter_context(BusyOperator(rig, restart_s=restart_s, seed=options.seed))
            rig.wait_for(lambda: healthy.last is not None, "a first view")
            try:
                self._go_on(healthy, [*others, attacker], operator, on_sample)
            except KeyboardInterrupt:
                self._log.seconds = time.monotonic() - self._log.started_s
            self._log.note_attacks(attacker.last)
            self._log.note_operator(operator)

    def _go_on(
        self,
        healthy: Client[Arrival],
        others: list[Client[Arrival] | Client[Attacks]],
        operator: BusyOperator,
        on_sample: Callable[[Sample], None],
    ) -> None:
        log = self._log
        log.started_s = sampled_s = time.monotonic()
        while (now_s := time.monotonic()) < log.started_s + self._options.seconds:
            operator.step()
            log.arrivals(healthy.take())
            for client in others[:-1]:
                client.take()
            if now_s - sampled_s >= self._every_s:
                sampled_s = now_s
                on_sample(log.sample(self._rig.publisher.stats.subscribers, self._options.seconds))
            if self._died(healthy, *others):
                break
            time.sleep(_STEP_S)
        log.seconds = time.monotonic() - log.started_s
        log.end_silence()

    def _died(self, *clients: Client[Arrival] | Client[Attacks]) -> bool:
        """Whether going on makes no sense; says why."""
        if any(not client.alive for client in clients):
            self._failures.append("a client process died; its last words are above")
            return True
        return not self._rig.running


@dataclass(kw_only=True, slots=True)
class _Log:
    """What was measured, in little memory."""

    script: CameraScript
    model: StandInModel
    started_s: float = 0.0
    seconds: float = 0.0
    sampled_s: "array[float]" = field(default_factory=lambda: array("d"))
    memory_mb: "array[float]" = field(default_factory=lambda: array("d"))
    threads: "array[float]" = field(default_factory=lambda: array("d"))
    files: "array[float]" = field(default_factory=lambda: array("d"))
    subscriptions: "array[float]" = field(default_factory=lambda: array("d"))
    arrived_s: "array[float]" = field(default_factory=lambda: array("d"))
    age_ms: "array[float]" = field(default_factory=lambda: array("d"))
    reply_ms: list[float] = field(default_factory=list[float])
    codes: dict[str, int] = field(default_factory=dict[str, int])
    attacks: Attacks = field(default_factory=lambda: Attacks(done={}, refused=0))
    windows: int = 0
    skipped: int = 0
    backlog: int = 0
    silent_s: float = 0.0
    unanswered: int = 0
    restarts: int = 0

    def window(self, report: WindowReport) -> None:
        """A window was published; in the model thread. How long it had waited, in windows."""
        self.windows += 1
        waited_s = (self.model.taken_ns - report.window.arrival_ns) / 1e9
        window_s = len(report.window.seqs) / report.window.fps
        self.backlog = max(self.backlog, int(waited_s / window_s))

    def arrivals(self, arrived: list[Arrival]) -> None:
        for each in arrived:
            at_s = each.arrived_ns / 1e9 - self.started_s
            taken_ns = self.script.taken_ns(each.last_seq)
            if taken_ns is None or at_s < 0:
                continue
            self._silence(at_s)
            self.arrived_s.append(at_s)
            self.age_ms.append((each.arrived_ns - taken_ns) / 1e6)
            self.skipped += each.skipped

    def sample(self, subscriptions: int, whole_s: float) -> Sample:
        now, at_s = holding(), time.monotonic() - self.started_s
        self.sampled_s.append(at_s)
        self.memory_mb.append(now.memory_mb)
        self.threads.append(now.threads)
        self.files.append(now.files)
        self.subscriptions.append(subscriptions)
        return Sample(
            left_s=max(0.0, whole_s - at_s),
            memory_mb=now.memory_mb,
            threads=now.threads,
            files=now.files,
            arrived=len(self.arrived_s),
        )

    def end_silence(self) -> None:
        self._silence(self.seconds)

    def note_attacks(self, attacks: Attacks | None) -> None:
        self.attacks = attacks or self.attacks

    def note_operator(self, operator: BusyOperator) -> None:
        self.reply_ms = [1000 * each for each in operator.reply_s]
        self.codes, self.unanswered = dict(operator.codes), operator.unanswered
        self.restarts = operator.restarts

    def report(self, left: tuple[str, ...], failures: list[str]) -> SoakReport:
        return SoakReport(
            seconds=self.seconds,
            memory_mb=growth(self.sampled_s, self.memory_mb, share=_MEDIAN),
            threads=growth(self.sampled_s, self.threads, share=_FLOOR),
            files=growth(self.sampled_s, self.files, share=_FLOOR),
            subscriptions=growth(self.sampled_s, self.subscriptions, share=_FLOOR),
            median_age_ms=growth(self.arrived_s, self.age_ms, share=_MEDIAN),
            age_ms=spread(self.age_ms),
            reply_ms=spread(self.reply_ms),
            backlog_windows=self.backlog,
            windows=self.windows,
            arrived=len(self.arrived_s),
            skipped=self.skipped,
            silent_s=self.silent_s,
            openings=self.script.openings,
            restarts=self.restarts,
            unanswered=self.unanswered,
            refused=self.attacks.refused,
            acts={str(act): count for act, count in self.script.done.items()},
            codes=self.codes,
            attacks=self.attacks.done,
            left=left,
            failures=tuple(failures),
        )

    def _silence(self, until_s: float) -> None:
        self.silent_s = max(self.silent_s, until_s - (self.arrived_s[-1] if self.arrived_s else 0.0))


class _Before:
    """What this process held before there was a node."""

    def __init__(self) -> None:
        begin_zero_copy()
        self._threads = set(threading.enumerate())
        self._files = open_files()

    def left(self) -> tuple[str, ...]:
        """Threads and sockets that are there now and were not; those that end soon are waited for."""
        until_s = time.monotonic() + _END_S
        while (found := self._found()) and time.monotonic() < until_s:
            time.sleep(_STEP_S)
        return found

    def _found(self) -> tuple[str, ...]:
        threads = [f"thread {each.name!r}" for each in threading.enumerate() if each not in self._threads]
        files = [
            kind
            for number, kind in open_files().items()
            if kind.startswith(_SOCKETS) and self._files.get(number) != kind
        ]
        return (*threads, *files)


def _acts(seed: int) -> Iterator[Act]:
    """All acts, in another order each time round."""
    chance = random.Random(seed)  # noqa: S311  the order is no secret
    while True:
        acts = list(ACTS)
        chance.shuffle(acts)
        yield from acts


def _nobody(_: Sample) -> None:
    """Nobody wants to know."""
