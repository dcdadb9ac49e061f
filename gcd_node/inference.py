"""One window: what is seen of it, its views drawn and sent, what goes wrong on the way, and what it cost."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch

from gcd_model import (
    Cancelled,
    DeviceMemoryError,
    FrameSynthesizer,
    NonFiniteError,
    RenderOptions,
    SeenFrame,
    SourceFeatures,
    View,
)
from gcd_node.drift import DriftDetector
from gcd_node.encoded_frames import EncodedFrames, window_seed
from gcd_node.errors import DepthError, RemoteError
from gcd_node.grids import Grids
from gcd_node.messages import Rendered, messages, newest_ns, utc_offset_ns
from gcd_node.model import Failure, FailureCounter, ModelSlot, Pulse, model_errors, oom_levels, render_grey, tried
from gcd_node.status import Announcer
from gcd_node.stream_context import StreamContext, drawing_options, sampler_in_use
from gcd_node.views import EndOfStream, LiveConfig, Settings, VirtualViews
from gcd_node.window import FrameWindow, PartialWindow
from gcd_node.work import Job, Known, Placed, Seen, WindowReport, WorkConditions, WorkCounts

_LOG = logging.getLogger(__name__)


class Renderer:
    """Renders windows with a model in three steps: `take`, `place`, `render`. Each may have a thread of its own."""

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        model: ModelSlot,
        context_at: Callable[[int], StreamContext],
        on_window: Callable[[WindowReport], None] | None = None,
        drift: DriftDetector | None = None,
    ) -> None:
        """context_at: what is known of the source in an epoch; -1 for now. drift: is shown every frame that was seen.

        Raises:
            OptionError, PoseError: see VirtualView.
        """
        self.counts, self.cancel = WorkCounts(), threading.Event()
        """cancel: set to abandon what is in work."""
        self._model, self._context_at, self._on_window = model, context_at, on_window
        self._live, self._health, self._drift = live, announcer.health, drift
        self._out = EndOfStream(live, announcer.sink, lambda: context_at(-1))
        self._grids = Grids(live.config.grid, announcer.sink, lambda: context_at(-1))
        self._views = VirtualViews(model.traits)
        self._views.sync(live.settings(), context_at(-1).mount, context_at(-1).references)
        self._failures = FailureCounter(announcer)
        self._given_up = self._failures.given_up
        self.pulse = Pulse(announcer.health, self._given_up)
        self._shown = WorkConditions(announcer, frame_by_frame=model.streams)
        self._encoded = EncodedFrames(self.pulse.beat, self._shown.bad_depth, self._shown.odometry)
        self._seeing, self._placing = threading.Lock(), threading.Lock()
        """Held by whoever encodes or makes the model forget, and by whoever places; both, in this order, by whoever
        exchanges the model."""
        self._memory = 0
        self._epoch = -1
        self._latest: tuple[StreamContext, StreamContext] | None = None

    def warm_up(self) -> None:
        """Render a grey clip in one step; of a model that computes elsewhere, with its fallback alone. Raises
        NonFiniteError, DeviceMemoryError."""
        settings, context = self._live.settings(), self._context_at(-1)
        paths = [view.planned() for view in self._views.sync(settings, context.mount, context.references)]
        if paths and (local := self._model.local) is not None:
            render_grey(local, paths, context.mount, self._options(settings, 0, steps=1))

    def encode_ahead(self, filling: PartialWindow) -> bool:
        """Encode one frame of the window that fills; False if there is nothing to do. Raises DeviceMemoryError."""
        with self._seeing, model_errors():
            try:
                context = self._context(self._live.settings(), filling.epoch)
                return self._encoded.ahead(self._model.synthesizer, filling, context)
            except DeviceMemoryError:
                self._encoded.forget()
                raise

    def take(self, window: FrameWindow) -> tuple[Job, Seen] | None:
        """What of a window is needed for every view. None if its depth is not to be trusted or there is no view."""
        with self._seeing:
            self.pulse.beat()
            job = self._job(window)
            try:
                seen = self._seen(job)
                if self._drift is not None and not isinstance(seen, SourceFeatures | Failure):
                    self._drift.offer(seen[-1])
                return (job, seen) if job.views else None
            except DepthError:  # it is known already: see _count_bad_depth
                self._health.count("model")
                return None

    def place(self, job: Job, seen: Seen) -> Placed | None:
        """What is known of each view before anything is painted: the model's memory goes on by a window, and grids are
        sent. None if that began anew since the window was seen."""
        if isinstance(seen, SourceFeatures | Failure):
            return seen
        with self._placing, model_errors():
            self.pulse.beat()
            placed = tried(lambda: self._frames.place(seen, job.paths)) if job.memory == self._memory else None
            if placed is not None and not isinstance(placed, Failure):
                self._grids.publish(job.context, job.window, placed)
            return placed

    def render(self, job: Job, placed: Placed | None) -> None:
        """Its views, drawn and sent; one retry, with another seed or with less asked; else counted, and not published,
        as what belongs to a memory that is no more. Raises ModelFailedError: the third in a row, or there is no device
        memory; Cancelled."""
        try:
            if placed is None or job.memory != self._memory:
                self._health.count("model")
            else:
                self._render_or_count(job, placed)
        except (DepthError, RemoteError):
            self._health.count("model")

    @property
    def _frames(self) -> FrameSynthesizer:
        synthesizer = self._model.synthesizer
        assert isinstance(synthesizer, FrameSynthesizer), "only such a model sees frames"
        return synthesizer

    def announce_removed(self) -> None:
        """Send the end of views that were taken out."""
        self._out.announce_removed(self.counts.last_window_id)

    def announce_end(self, *, delay_ms: int | None) -> None:
        """Send the end of every view. delay_ms: see MessageSink."""
        self._out.announce_all(self.counts.last_window_id, delay_ms=delay_ms)
        self._grids.announce_end(self.counts.last_window_id, delay_ms=delay_ms)

    def _context(self, settings: Settings, epoch: int) -> StreamContext:
        """With what is in force now; the same object while nothing changes, as its digest is costly."""
        base, config, traits = self._context_at(epoch), settings.config, self._model.traits
        if self._latest is not None and self._latest[0] is base:
            context = self._latest[1]
            if context.config is config and context.traits is traits:
                return context
        self._latest = base, replace(base, config=config, traits=traits)
        return self._latest[1]

    def _job(self, window: FrameWindow) -> Job:
        """A command that comes from here on is for the next window."""
        settings = self._live.settings()
        context = self._context(settings, window.epoch)
        views = self._views.sync(settings, context.mount, context.references)
        views = views[:1] if "a single view" in self._given_up else views
        paths = [view.trajectory(window.stamps_ns[-1], window.epoch) for view in views]
        return Job(
            window=window,
            settings=settings,
            context=context,
            views=views,
            paths=paths,
            started_ns=time.monotonic_ns(),
            memory=self._memory,
        )

    def _forget(self) -> None:
        """The model's memory begins anew: what is in work of the one before is not gone on with. With `_seeing`."""
        self._encoded.forget()
        self._model.forget_frames()
        self._memory += 1

    def _seen(self, job: Job) -> Seen:
        """Or what it failed with. Raises DepthError."""
        with model_errors():
            return tried(lambda: self._see(job))

    def _see(self, job: Job) -> SourceFeatures | Sequence[SeenFrame]:
        synthesizer, window, context = self._model.synthesizer, job.window, job.context
        if window.epoch != self._epoch:
            self._model.forget_frames()
            self._epoch = window.epoch
        started_s = time.monotonic()
        features = self._encoded.features(synthesizer, window, context)
        guessed = self._encoded.guessed
        if guessed and context.config.model.on_bad_depth == "stop":
            raise DepthError(f"the depth of {guessed} frames of this window cannot be used; it is not rendered")
        if not guessed:
            self._shown.bad_depth(None)
        seen = synthesizer.see(features) if isinstance(synthesizer, FrameSynthesizer) else features
        self._health.stage("encode", time.monotonic() - started_s)
        return seen

    def _render_or_count(self, job: Job, placed: Placed | None) -> None:
        failure: Failure | None = None
        window_id = job.window.window_id
        seeds = [window_seed(job.context.digest, window_id, attempt) for attempt in (0, 1)]
        for seed in seeds:
            if failure is not None:
                job, placed = self._anew(job, failure)
            failure = tried(partial(self._publish, job, seed, placed))
            if failure is None:
                self._failures.success()
                return
            if isinstance(failure, NonFiniteError):
                _LOG.warning("window %d: %s", window_id, failure)
            else:
                self._give_up_more(job, failure)
        with self._seeing:
            self._forget()
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

    def _anew(self, job: Job, failure: Failure) -> tuple[Job, Placed | None]:
        """The job with what may still be asked of the device, and its first steps again, in a memory that begins."""
        with self._seeing:
            self._forget()
            job = replace(job, memory=self._memory)
            if isinstance(failure, DeviceMemoryError):
                most = 1 if "a single view" in self._given_up else len(job.views)
                context = self._context(job.settings, job.window.epoch)
                job = replace(job, context=context, views=job.views[:most], paths=job.paths[:most])
            seen = self._seen(job)
        return job, self.place(job, seen)

    def _give_up_more(self, job: Job, error: DeviceMemoryError) -> None:
        levels = oom_levels(
            views=len(job.views),
            samples=job.context.config.model.samples,
            steps=sampler_in_use(job.context.config.model, job.context.traits).steps,
            can_halve=self._model.can_halve,
            can_part=not self._model.streams,
        )
        self._failures.out_of_memory(job.window.window_id, error, levels)
        if "bfloat16" in self._given_up and self._model.can_halve:
            with self._seeing, self._placing:
                self.pulse.load()
                self._forget()
                self._model.halve()

    def _publish(self, job: Job, seed: int, placed: Placed | None) -> None:
        if isinstance(placed, Failure):
            raise placed
        assert placed is not None, "only this thread makes the memory begin anew"
        with model_errors():
            context, steps, views = self._drawn(job, seed, placed)
        if self.cancel.is_set():  # a model that ignores cancel: nothing may follow the end
            raise Cancelled("the node is stopping")
        ended_ns, offset_ns = time.monotonic_ns(), utc_offset_ns()
        self._shown.source(context, views[0])
        drift = self._drift
        for virtual, view in zip(job.views, views, strict=True):
            rendered = Rendered(
                window=job.window,
                view=view,
                view_id=virtual.view_id,
                view_rev=virtual.rev,
                started_ns=job.started_ns,
                ended_ns=ended_ns,
                steps=steps,
                seed=seed,
                utc_offset_ns=offset_ns,
                flags=("moved",) if drift is not None and drift.was_wrong(virtual.view_id, virtual.rev) else (),
            )
            self._out.send(messages(context, rendered))
            age_s = (time.monotonic_ns() - newest_ns(context, job.window)) / 1e9
            self._health.published(virtual.view_id, age_s)
        self._health.stage("publish", (time.monotonic_ns() - ended_ns) / 1e9)
        self._count(job, (ended_ns - job.started_ns) / 1e9)

    def _drawn(self, job: Job, seed: int, placed: Known) -> tuple[StreamContext, int, list[View]]:
        """The views, in how many steps, and in whose context: the model's, or where that computes elsewhere and is late
        its fallback's. Raises RemoteError: it has none."""
        section, halved = job.context.config.model, "half the steps" in self._given_up
        steps = max(1, sampler_in_use(section, job.context.traits).steps // (2 if halved else 1))
        try:
            views = self._draw(job, seed, placed, steps if halved else section.steps)
        except RemoteError as error:
            self._shown.remote_late(error)
            if (fallback := self._model.local) is None:
                raise
        else:
            self._shown.remote_late(None)
            return job.context, steps, views
        context, steps = replace(job.context, traits=fallback.traits), fallback.traits.config.sampling.steps
        features = EncodedFrames(self.pulse.beat).features(fallback, job.window, context)
        return context, steps, fallback.render(features, job.paths, self._options(job.settings, seed, steps=steps))

    def _draw(self, job: Job, seed: int, placed: Known, steps: int | None) -> list[View]:
        started_s = time.monotonic()
        options = self._options(job.settings, seed, steps=steps)
        self.pulse.beat()
        if not isinstance(placed, SourceFeatures):
            views = self._frames.paint(placed, job.paths, options)
        elif self._given_up:  # the views are one by one then, if there is more than one
            views = [self._model.synthesizer.render(placed, [path], options)[0] for path in job.paths]
        else:
            views = self._model.synthesizer.render(placed, job.paths, options)
        self._health.stage("render", time.monotonic() - started_s)
        self.pulse.beat()
        return views

    def _options(self, settings: Settings, seed: int, *, steps: int | None) -> RenderOptions:
        model = settings.config.model
        samples = 1 if "a single view" in self._given_up else model.samples
        return replace(
            drawing_options(model),
            steps=steps,
            samples=samples,
            seed=seed,
            whole_levels=samples == 1 and self._model.traits.device.startswith("cuda"),
            progress=self._step_done,
            cancel=self.cancel,
        )

    def _step_done(self, _done: int, _steps: int) -> None:
        self.pulse.beat()

    def _count(self, job: Job, seconds: float) -> None:
        age_ms = (time.monotonic_ns() - newest_ns(job.context, job.window)) / 1e6
        self.counts.windows += 1
        self.counts.last_window_id = job.window.window_id
        self.counts.render_s.append(seconds)
        self.counts.age_ms.append(age_ms)
        if self._model.traits.device.startswith("cuda"):
            self._health.gpu_mem_mb = torch.cuda.memory_reserved() / 1e6
        if self._on_window is not None:
            self._on_window(WindowReport(window=job.window, render_s=seconds, age_ms=age_ms))
