"""The model thread: takes windows, renders every view of each, hands the messages over. Owns the device."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch

from gcd_client.protocol import ViewKind
from gcd_model import Cancelled, DeviceMemoryError, NonFiniteError, PoseError, RenderOptions, View
from gcd_node.capture import WindowSlot
from gcd_node.encoded_frames import EncodedFrames, EncodeTerms, window_seed
from gcd_node.errors import DepthError
from gcd_node.fallback import FULL, Condition, FailureCounter, OomLevel, oom_levels
from gcd_node.health import IDLE, Health, Level
from gcd_node.messages import (
    Rendered,
    Run,
    carried_kinds,
    messages,
    newest_ns,
    utc_offset_ns,
    world_flags,
)
from gcd_node.model import (
    IdleTimer,
    ModelSlot,
    drawing_options,
    interruptible,
    model_errors,
    render_grey,
    sampler_in_use,
)
from gcd_node.publisher import MessageSink
from gcd_node.status import Announcer
from gcd_node.views import EndOfStream, LiveConfig, Settings, VirtualView, VirtualViews
from gcd_node.window import FrameWindow, PartialWindow

_LOG = logging.getLogger(__name__)
_KEPT = 1000  # a node runs for weeks
_BAD_DEPTH = "DEPTH_BAD"
_BAD_ODOMETRY = "ODOMETRY_BAD"
_LOST_MOTION = "MOTION_LOST"
_HOLD_S = 1.0
WORK_REASONS = ("world", _BAD_DEPTH, _BAD_ODOMETRY, _LOST_MOTION)
"""What a model thread raises of the node's health by what its windows show."""


@dataclass(slots=True)
class WorkCounts:
    """What the model thread has done. render_s: inference times of the latest windows. age_ms: theirs, at publish."""

    windows: int = 0
    nan_windows: int = 0
    last_window_id: int = -1
    render_s: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))
    age_ms: deque[float] = field(default_factory=lambda: deque[float](maxlen=_KEPT))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WindowReport:
    """A window that was just published, for whoever watches. render_s, age_ms: see WorkCounts."""

    window: FrameWindow
    render_s: float
    age_ms: float


@dataclass(frozen=True, kw_only=True, slots=True)
class WorkerParts:
    """What a model thread works with."""

    model: ModelSlot
    live: LiveConfig
    sink: MessageSink
    health: Health
    announcer: Announcer
    on_window: Callable[[WindowReport], None] | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Job:
    """One window and everything that was decided for it when it was taken."""

    window: FrameWindow
    settings: Settings
    run: Run
    views: list[VirtualView]


class ModelWorker:
    """Renders windows until there are no more, it is cancelled, or the model has failed."""

    def __init__(self, parts: WorkerParts, run_of: Callable[[int], Run]) -> None:
        """run_of: what is known of the source in an epoch; -1 for now."""
        self.counts = WorkCounts()
        self.warm = threading.Event()  # the first window may come
        self._parts, self._run_of = parts, run_of
        config = parts.live.config
        self._realtime = config.source.pace == "realtime"
        self._out = EndOfStream(parts.live, parts.sink, lambda: run_of(-1))
        self._views = VirtualViews(parts.model.traits)
        self._idle = IdleTimer(config.life.idle_s if self._realtime else 0.0)
        self._failures = FailureCounter(parts.health, parts.announcer)
        self._cancel = threading.Event()
        self._beat_s: float | None = None
        self._encoded = EncodedFrames(self._beat, self._count_bad_depth, self._tell_odometry)
        hold_s = _HOLD_S if parts.model.streams else 0.0
        self._bad_depth, self._bad_odometry, self._lost_motion = (
            Condition(code, parts.health, parts.announcer, hold_s=hold_s) for code in WORK_REASONS[1:]
        )
        self._may_encode_ahead = True
        self._epoch = -1

    @property
    def silent_s(self) -> float:
        """How long the model has been at one step; 0 while it waits for windows."""
        beat_s = self._beat_s
        return 0.0 if beat_s is None else time.monotonic() - beat_s

    def cancel(self) -> None:
        """Abandon the window in work at the next layer of a network; from any thread."""
        self._cancel.set()

    def work(self, newest: WindowSlot) -> None:
        """Take windows and publish their views; while there is none, encode what has arrived of the next.

        Raises:
            ModelFailedError: three windows in a row could not be used, or there is no memory however little is asked.
            whatever the source failed with, once its last window is done.
        """
        try:
            with interruptible(self._cancel):
                self._work(newest)
        except Cancelled:
            _LOG.info("the window in work was abandoned")
        finally:
            self._beat_s = None
            self.warm.set()

    def _work(self, newest: WindowSlot) -> None:
        if self._realtime:
            self._warm_up()
        self._ready()
        self.warm.set()
        while (window := newest.take(lambda: self._encode_ahead(newest.filling))) is not None:
            self._may_encode_ahead = True
            self._out.announce_due(self.counts.last_window_id)
            if not self._is_idle():
                self._beat()
                self._parts.health.stage("window", (time.monotonic_ns() - window.arrival_ns) / 1e9)
                try:
                    self._render_or_count(self._job(window))
                except DepthError:  # it is known already: see _count_bad_depth
                    self._parts.health.count("model")
            self._ready()
        self._out.announce_due(self.counts.last_window_id)

    def announce_end(self, *, delay_ms: int | None) -> None:
        """Send the end of every view. After `work`. delay_ms: see MessageSink."""
        self._out.announce_all(self.counts.last_window_id, delay_ms=delay_ms)

    def _beat(self) -> None:
        self._beat_s = time.monotonic()
        self._parts.health.model("degraded" if self._oom_level is not FULL else "busy")

    def _ready(self) -> None:
        self._beat_s = None
        self._parts.health.model("degraded" if self._oom_level is not FULL else "ready")

    @property
    def _oom_level(self) -> OomLevel:
        return self._failures.level

    @property
    def _watchers(self) -> int:
        return self._parts.sink.stats.readers.watchers

    def _is_idle(self) -> bool:
        """Whether nobody would see this window."""
        rests = self._idle.is_idle(self._watchers)
        if rests:
            self._parts.health.raise_reason(IDLE, Level.OK)
        else:
            self._parts.health.clear_reason(IDLE)
        return rests

    def _encode_ahead(self, filling: PartialWindow | None) -> bool:
        """Encode one frame of the window that fills; False if there is nothing to do."""
        if filling is None or not self._may_encode_ahead or self._idle.is_idle(self._watchers):
            return False
        run = self._run(self._parts.live.settings(), filling.epoch)
        try:
            with model_errors():
                return self._encoded.ahead(self._parts.model.synthesizer, filling, _terms(run))
        except DeviceMemoryError as error:
            _LOG.warning("nothing is encoded before the next window is there: %s", error)
            self._encoded.forget()
            self._may_encode_ahead = False
            return False
        finally:
            self._ready()

    def _run(self, settings: Settings, epoch: int) -> Run:
        return replace(self._run_of(epoch), config=settings.config, traits=self._parts.model.traits)

    def _job(self, window: FrameWindow) -> _Job:
        """A command that comes from here on is for the next window."""
        settings = self._parts.live.settings()
        run = self._run(settings, window.epoch)
        views = self._views.following(settings, run.mount)
        return _Job(window=window, settings=settings, run=run, views=views[:1] if self._oom_level.single else views)

    def _warm_up(self) -> None:
        """Render a grey clip in one step, so that the first window does not pay for what happens only once."""
        self._parts.health.model("warming")
        self._beat_s = time.monotonic()
        settings, mount = self._parts.live.settings(), self._run_of(-1).mount
        paths = [view.planned() for view in self._views.following(settings, mount)]
        try:
            with model_errors():
                render_grey(self._parts.model.synthesizer, paths, mount, self._options(settings, 0, steps=1))
        except (NonFiniteError, DeviceMemoryError) as error:
            _LOG.warning("the warm-up came to nothing: %s", error)  # windows are dealt with one by one

    def _options(self, settings: Settings, seed: int, *, steps: int | None) -> RenderOptions:
        model = settings.config.model
        samples = 1 if self._oom_level.single else model.samples
        return replace(
            drawing_options(model),
            steps=steps,
            samples=samples,
            seed=seed,
            whole_levels=samples == 1 and self._parts.model.traits.device.startswith("cuda"),
            progress=self._step_done,
            cancel=self._cancel,
        )

    def _step_done(self, _done: int, _steps: int) -> None:
        self._beat()

    def _render_or_count(self, job: _Job) -> None:
        """One retry, with another seed or with less asked; a window that fails again is counted and not published."""
        failure: NonFiniteError | DeviceMemoryError | None = None
        seeds = [window_seed(job.run.digest, job.window.window_id, attempt) for attempt in (0, 1)]
        for seed in seeds:
            failure = self._attempt(job, seed)
            if failure is None:
                self._failures.success()
                return
            self._encoded.forget()
            self._parts.model.forget_frames()
            if isinstance(failure, NonFiniteError):
                _LOG.warning("window %d: %s", job.window.window_id, failure)
            else:
                self._give_up_more(job, failure)
                job = self._job(job.window)
        self._parts.health.count("model")
        if isinstance(failure, NonFiniteError):
            self._count_nan(job, seeds)

    def _attempt(self, job: _Job, seed: int) -> NonFiniteError | DeviceMemoryError | None:
        """What it failed with; without its traceback, which would keep the model and all its work in memory."""
        try:
            self._publish(job, seed)
        except (NonFiniteError, DeviceMemoryError) as error:
            return error.with_traceback(None)
        return None

    def _give_up_more(self, job: _Job, error: DeviceMemoryError) -> None:
        """Step down the ladder, which is laid by what is asked when it is first needed."""
        model, samples = self._parts.model, job.run.config.model.samples
        way = oom_levels(
            views=len(job.views),
            samples=samples,
            steps=self._asked_steps(job),
            can_halve=model.can_halve,
            can_part=not model.streams,
        )
        self._failures.out_of_memory(job.window.window_id, error, way)
        if self._oom_level.half and model.can_halve:
            self._beat_s = None  # loading takes as long as it takes
            self._parts.health.model("loading")
            model.halve()

    def _count_nan(self, job: _Job, seeds: list[int]) -> None:
        self.counts.nan_windows += 1
        window = job.window
        self._failures.not_a_number(
            {
                "window_id": window.window_id,
                "seeds": seeds,
                "seq": [window.seqs[0], window.seqs[-1]],
                "view_revs": dict(job.settings.revisions),
                "cfg_digest": job.run.digest,
            }
        )

    def _count_bad_depth(self, error: DepthError) -> None:
        """Of one frame."""
        self._parts.health.count("bad_depths")
        self._bad_depth.wrong({"message": str(error)})

    def _tell_odometry(self, error: PoseError | None) -> None:
        """Of one frame: None if it can be used."""
        self._bad_odometry.right() if error is None else self._bad_odometry.wrong({"message": str(error)})

    def _check_depth(self, run: Run) -> None:
        """Of the window that was just encoded. Raises DepthError if one of its frames is not to be shown so."""
        guessed = self._encoded.guessed
        if guessed and run.config.model.on_bad_depth == "stop":
            raise DepthError(f"the depth of {guessed} frames of this window cannot be used; it is not rendered")
        if not guessed:
            self._bad_depth.right()

    def _tell_source(self, run: Run, view: View) -> None:
        """Whether the model knows such a source, and how it moved; the same for all views of a window."""
        if view.lost:
            self._lost_motion.wrong({"message": view.lost[0], "frames": len(view.lost)})
        else:
            self._lost_motion.right()
        self._parts.health.measure("ood_score", view.ood)
        if world_flags(run.traits, view):
            self._parts.health.raise_reason("world", Level.WARN)
        else:
            self._parts.health.clear_reason("world")

    def _asked_steps(self, job: _Job) -> int:
        return sampler_in_use(job.run.config.model, job.run.traits).steps

    def _publish(self, job: _Job, seed: int) -> None:
        started_ns = time.monotonic_ns()
        steps = max(1, self._asked_steps(job) // self._oom_level.steps_divisor)
        with model_errors():
            drawn = self._draw(job, seed, steps if self._oom_level.steps_divisor > 1 else job.run.config.model.steps)
        if self._cancel.is_set():  # a model that hears no cancel: nothing may follow the end
            raise Cancelled("the node was told to stop")
        ended_ns, offset_ns = time.monotonic_ns(), utc_offset_ns()
        for view in drawn[:1]:
            self._tell_source(job.run, view)
        self._out.carried = frozenset[ViewKind]().union(*map(carried_kinds, drawn))
        for virtual, view in zip(job.views, drawn, strict=True):
            rendered = Rendered(
                window=job.window,
                view=view,
                view_id=virtual.view_id,
                view_rev=virtual.rev,
                started_ns=started_ns,
                ended_ns=ended_ns,
                steps=steps,
                seed=seed,
                utc_offset_ns=offset_ns,
            )
            self._out.send(messages(job.run, rendered))
            age_s = (time.monotonic_ns() - newest_ns(job.run, job.window)) / 1e9
            self._parts.health.published(virtual.view_id, age_s)
        self._parts.health.stage("publish", (time.monotonic_ns() - ended_ns) / 1e9)
        self._count(job, (ended_ns - started_ns) / 1e9)

    def _draw(self, job: _Job, seed: int, steps: int | None) -> list[View]:
        synthesizer, health = self._parts.model.synthesizer, self._parts.health
        if job.window.epoch != self._epoch:
            self._parts.model.forget_frames()
            self._epoch = job.window.epoch
        started_s = time.monotonic()
        features = self._encoded.features(synthesizer, job.window, _terms(job.run))
        self._check_depth(job.run)
        encoded_s = time.monotonic()
        health.stage("encode", encoded_s - started_s)
        self._beat()
        paths = [view.trajectory(job.window.stamps_ns[-1], job.window.epoch) for view in job.views]
        options = self._options(job.settings, seed, steps=steps)
        if self._oom_level.one_by_one:
            drawn = [synthesizer.render(features, [path], options)[0] for path in paths]
        else:
            drawn = synthesizer.render(features, paths, options)
        health.stage("render", time.monotonic() - encoded_s)
        self._beat()
        return drawn

    def _count(self, job: _Job, seconds: float) -> None:
        self.counts.windows += 1
        self.counts.last_window_id = job.window.window_id
        self.counts.render_s.append(seconds)
        age_ms = (time.monotonic_ns() - newest_ns(job.run, job.window)) / 1e6
        self.counts.age_ms.append(age_ms)
        if self._parts.model.traits.device.startswith("cuda"):
            self._parts.health.measure("gpu_mem_mb", torch.cuda.memory_allocated() / 1e6)
        if self._parts.on_window is not None:
            self._parts.on_window(WindowReport(window=job.window, render_s=seconds, age_ms=age_ms))


def _terms(run: Run) -> EncodeTerms:
    lens = run.intrinsics if run.traits.live else None
    return EncodeTerms(
        digest=run.digest, strength=run.config.model.cond_aug, mount=run.mount, lens=lens, depth=run.depth
    )
