"""The model thread: takes windows, renders every view of each, hands the messages over. Owns the device."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch

from gcd_model import Cancelled, DeviceMemoryError, NonFiniteError, PoseError, RenderOptions, View
from gcd_node.encoded_frames import EncodedFrames, EncodeTerms, window_seed
from gcd_node.errors import DepthError
from gcd_node.health import IDLE, Level
from gcd_node.messages import Rendered, messages, newest_ns, utc_offset_ns, world_flags
from gcd_node.model import (
    FULL,
    FailureCounter,
    IdleTimer,
    ModelSlot,
    OomLevel,
    interruptible,
    model_errors,
    oom_levels,
    render_grey,
)
from gcd_node.status import Announcer, Condition
from gcd_node.stream_context import StreamContext, drawing_options, sampler_in_use
from gcd_node.views import EndOfStream, LiveConfig, Settings, VirtualView, VirtualViews
from gcd_node.window import FrameWindow, PartialWindow, WindowSlot

_LOG = logging.getLogger(__name__)
_KEPT = 1000  # a node runs for weeks
_HOLD_S = 1.0
_INPUT_CODES = ("DEPTH_BAD", "ODOMETRY_BAD", "MOTION_LOST")
WORK_REASONS = ("world", *_INPUT_CODES)
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
    """A window that was just published, for observers. render_s, age_ms: see WorkCounts."""

    window: FrameWindow
    render_s: float
    age_ms: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Job:
    """One window and everything that was decided for it when it was taken."""

    window: FrameWindow
    settings: Settings
    context: StreamContext
    views: list[VirtualView]


class ModelWorker:
    """Renders windows until there are no more, it is cancelled, or the model has failed."""

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        model: ModelSlot,
        context_at: Callable[[int], StreamContext],
        on_window: Callable[[WindowReport], None] | None = None,
    ) -> None:
        """context_at: what is known of the source in an epoch; -1 for now.

        Raises:
            OptionError, PoseError: see VirtualView.
        """
        self.counts = WorkCounts()
        self.warm = threading.Event()  # the first window may come
        self._model, self._context_at, self._on_window = model, context_at, on_window
        self._live, self._sink, self._health = live, announcer.sink, announcer.health
        config = live.config
        self._realtime = config.source.pace == "realtime"
        self._out = EndOfStream(live, announcer.sink, lambda: context_at(-1))
        self._views = VirtualViews(model.traits)
        self._views.sync(live.settings(), context_at(-1).mount)
        self._idle = IdleTimer(config.life.idle_s if self._realtime else 0.0)
        self._failures = FailureCounter(announcer)
        self._cancel = threading.Event()
        self._beat_s: float | None = None
        self._encoded = EncodedFrames(self._beat, self._count_bad_depth, self._tell_odometry)
        hold_s = _HOLD_S if model.streams else 0.0
        self._bad_depth, self._bad_odometry, self._lost_motion = (
            Condition(code, announcer, hold_s=hold_s) for code in _INPUT_CODES
        )
        self._may_encode_ahead = True
        self._epoch = -1
        self._latest: tuple[StreamContext, StreamContext] | None = None

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

    def announce_end(self, *, delay_ms: int | None) -> None:
        """Send the end of every view. After `work`. delay_ms: see MessageSink."""
        self._out.announce_all(self.counts.last_window_id, delay_ms=delay_ms)

    def _work(self, newest: WindowSlot) -> None:
        if self._realtime:
            self._warm_up()
        self._ready()
        self.warm.set()
        while (window := newest.take(lambda: self._encode_ahead(newest.filling))) is not None:
            self._may_encode_ahead = True
            self._out.announce_removed(self.counts.last_window_id)
            if not self._is_idle():
                self._beat()
                self._health.stage("window", (time.monotonic_ns() - window.arrival_ns) / 1e9)
                try:
                    self._render_or_count(self._job(window))
                except DepthError:  # it is known already: see _count_bad_depth
                    self._health.count("model")
            self._ready()
        self._out.announce_removed(self.counts.last_window_id)

    def _beat(self) -> None:
        self._beat_s = time.monotonic()
        self._health.model("degraded" if self._level is not FULL else "busy")

    def _ready(self) -> None:
        self._beat_s = None
        self._health.model("degraded" if self._level is not FULL else "ready")

    @property
    def _level(self) -> OomLevel:
        return self._failures.level

    def _is_idle(self) -> bool:
        """Whether no subscriber would see this window."""
        is_idle = self._idle.is_idle(self._sink.stats.watchers)
        if is_idle:
            self._health.raise_reason(IDLE, Level.OK)
        else:
            self._health.clear_reason(IDLE)
        return is_idle

    def _warm_up(self) -> None:
        """Render a grey clip in one step, so that the first window does not pay for what happens only once."""
        self._health.model("warming")
        self._beat_s = time.monotonic()
        settings, mount = self._live.settings(), self._context_at(-1).mount
        paths = [view.planned() for view in self._views.sync(settings, mount)]
        try:
            with model_errors():
                render_grey(self._model.synthesizer, paths, mount, self._options(settings, 0, steps=1))
        except (NonFiniteError, DeviceMemoryError) as error:
            _LOG.warning("the warm-up came to nothing: %s", error)  # windows are dealt with one by one

    def _encode_ahead(self, filling: PartialWindow | None) -> bool:
        """Encode one frame of the window that fills; False if there is nothing to do."""
        if filling is None or not self._may_encode_ahead or self._idle.is_idle(self._sink.stats.watchers):
            return False
        try:
            with model_errors():
                terms = _terms(self._context(self._live.settings(), filling.epoch))
                return self._encoded.ahead(self._model.synthesizer, filling, terms)
        except DeviceMemoryError as error:
            _LOG.warning("nothing is encoded before the next window is there: %s", error)
            self._encoded.forget()
            self._may_encode_ahead = False
            return False
        finally:
            self._ready()

    # One window.

    def _context(self, settings: Settings, epoch: int) -> StreamContext:
        """With what is in force now; the same object while nothing changes, as its digest is costly."""
        base, config, traits = self._context_at(epoch), settings.config, self._model.traits
        if self._latest is not None and self._latest[0] is base:
            context = self._latest[1]
            if context.config is config and context.traits is traits:
                return context
        self._latest = base, replace(base, config=config, traits=traits)
        return self._latest[1]

    def _job(self, window: FrameWindow) -> _Job:
        """A command that comes from here on is for the next window."""
        settings = self._live.settings()
        context = self._context(settings, window.epoch)
        views = self._views.sync(settings, context.mount)
        return _Job(window=window, settings=settings, context=context, views=views[:1] if self._level.single else views)

    def _render_or_count(self, job: _Job) -> None:
        """One retry, with another seed or with less asked; a window that fails again is counted and not published."""
        failure: NonFiniteError | DeviceMemoryError | None = None
        window_id = job.window.window_id
        seeds = [window_seed(job.context.digest, window_id, attempt) for attempt in (0, 1)]
        for seed in seeds:
            failure = self._attempt(job, seed)
            if failure is None:
                self._failures.success()
                return
            self._encoded.forget()
            self._model.forget_frames()
            if isinstance(failure, NonFiniteError):
                _LOG.warning("window %d: %s", window_id, failure)
            else:
                self._give_up_more(job, failure)
                job = self._job(job.window)
        self._health.count("model")
        if isinstance(failure, NonFiniteError):
            self.counts.nan_windows += 1
            self._failures.not_a_number(
                {
                    "window_id": window_id,
                    "seeds": seeds,
                    "seq": [job.window.seqs[0], job.window.seqs[-1]],
                    "view_revs": dict(job.settings.revisions),
                    "cfg_digest": job.context.digest,
                }
            )

    def _attempt(self, job: _Job, seed: int) -> NonFiniteError | DeviceMemoryError | None:
        """What it failed with; without its traceback, which would keep the model and all its work in memory."""
        try:
            self._publish(job, seed)
        except (NonFiniteError, DeviceMemoryError) as error:
            return error.with_traceback(None)
        return None

    def _give_up_more(self, job: _Job, error: DeviceMemoryError) -> None:
        levels = oom_levels(
            views=len(job.views),
            samples=job.context.config.model.samples,
            steps=self._steps_in_full(job),
            can_halve=self._model.can_halve,
            can_part=not self._model.streams,
        )
        self._failures.out_of_memory(job.window.window_id, error, levels)
        if self._level.half and self._model.can_halve:
            self._beat_s = None  # loading takes as long as it takes
            self._health.model("loading")
            self._model.halve()

    def _publish(self, job: _Job, seed: int) -> None:
        started_ns, level = time.monotonic_ns(), self._level
        steps = max(1, self._steps_in_full(job) // level.steps_divisor)
        with model_errors():
            views = self._draw(job, seed, steps if level.steps_divisor > 1 else job.context.config.model.steps)
        if self._cancel.is_set():  # a model that ignores cancel: nothing may follow the end
            raise Cancelled("the node is stopping")
        ended_ns, offset_ns = time.monotonic_ns(), utc_offset_ns()
        self._tell_source(job.context, views[0])
        for virtual, view in zip(job.views, views, strict=True):
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
            self._out.send(messages(job.context, rendered))
            age_s = (time.monotonic_ns() - newest_ns(job.context, job.window)) / 1e9
            self._health.published(virtual.view_id, age_s)
        self._health.stage("publish", (time.monotonic_ns() - ended_ns) / 1e9)
        self._count(job, (ended_ns - started_ns) / 1e9)

    def _draw(self, job: _Job, seed: int, steps: int | None) -> list[View]:
        synthesizer, window, context = self._model.synthesizer, job.window, job.context
        if window.epoch != self._epoch:
            self._model.forget_frames()
            self._epoch = window.epoch
        started_s = time.monotonic()
        features = self._encoded.features(synthesizer, window, _terms(context))
        guessed = self._encoded.guessed
        if guessed and context.config.model.on_bad_depth == "stop":
            raise DepthError(f"the depth of {guessed} frames of this window cannot be used; it is not rendered")
        if not guessed:
            self._bad_depth.update(None)
        encoded_s = time.monotonic()
        self._health.stage("encode", encoded_s - started_s)
        self._beat()
        paths = [view.trajectory(window.stamps_ns[-1], window.epoch) for view in job.views]
        options = self._options(job.settings, seed, steps=steps)
        if self._level.one_by_one:
            views = [synthesizer.render(features, [path], options)[0] for path in paths]
        else:
            views = synthesizer.render(features, paths, options)
        self._health.stage("render", time.monotonic() - encoded_s)
        self._beat()
        return views

    def _options(self, settings: Settings, seed: int, *, steps: int | None) -> RenderOptions:
        model = settings.config.model
        samples = 1 if self._level.single else model.samples
        return replace(
            drawing_options(model),
            steps=steps,
            samples=samples,
            seed=seed,
            whole_levels=samples == 1 and self._model.traits.device.startswith("cuda"),
            progress=self._step_done,
            cancel=self._cancel,
        )

    def _step_done(self, _done: int, _steps: int) -> None:
        self._beat()

    def _steps_in_full(self, job: _Job) -> int:
        return sampler_in_use(job.context.config.model, job.context.traits).steps

    # What windows show, and cost.

    def _count_bad_depth(self, error: DepthError) -> None:
        """Of one frame."""
        self._health.count("bad_depths")
        self._bad_depth.update({"message": str(error)})

    def _tell_odometry(self, error: PoseError | None) -> None:
        """Of one frame: None if it can be used."""
        self._bad_odometry.update(None if error is None else {"message": str(error)})

    def _tell_source(self, context: StreamContext, view: View) -> None:
        """Whether the model knows such a source, and how it moved; the same for all views of a window."""
        self._lost_motion.update({"message": view.lost[0], "frames": len(view.lost)} if view.lost else None)
        self._health.measure("ood_score", view.ood)
        if world_flags(context.traits, view):
            self._health.raise_reason("world", Level.WARN)
        else:
            self._health.clear_reason("world")

    def _count(self, job: _Job, seconds: float) -> None:
        age_ms = (time.monotonic_ns() - newest_ns(job.context, job.window)) / 1e6
        self.counts.windows += 1
        self.counts.last_window_id = job.window.window_id
        self.counts.render_s.append(seconds)
        self.counts.age_ms.append(age_ms)
        if self._model.traits.device.startswith("cuda"):
            self._health.measure("gpu_mem_mb", torch.cuda.memory_allocated() / 1e6)
        if self._on_window is not None:
            self._on_window(WindowReport(window=job.window, render_s=seconds, age_ms=age_ms))


def _terms(context: StreamContext) -> EncodeTerms:
    return EncodeTerms(
        digest=context.digest,
        strength=context.config.model.cond_aug,
        mount=context.mount,
        lens=context.intrinsics if context.traits.live else None,
        depth=context.depth,
    )
