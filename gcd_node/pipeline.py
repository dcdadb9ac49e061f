"""One activation: from an open source to published views, in threads of its own, until it ends or is stopped."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from gcd_model import ModelError
from gcd_node.drift import DriftDetector
from gcd_node.errors import (
    ConfigError,
    EndpointError,
    ModelFailedError,
    PublisherError,
    ReaderError,
    SourceError,
    TooShortError,
)
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.health import Level, SourceState
from gcd_node.inference import Renderer
from gcd_node.model import ModelSlot
from gcd_node.recorder import Recorder
from gcd_node.sources.live import Opener, SourceWatch
from gcd_node.status import Announcer, metadata
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.views import InputPreview, LiveConfig
from gcd_node.window import Reason, WindowBuilder, WindowSlot, read
from gcd_node.work import WindowReport, WorkCounts
from gcd_node.worker import ModelWorker

_STOP_DELAY_MS = 100
_KEPT_EPOCHS = 8  # windows of a former epoch may still be in work
MODEL_FAILED = "MODEL_FAILED"
_ENDINGS: tuple[tuple[type[Exception], str, SourceState], ...] = (
    (TooShortError, "TOO_SHORT", "ended"),
    (ReaderError, "SRC_FAILED", "closed"),
    (SourceError, "SRC_LOST", "lost"),
    (ConfigError, "SRC_REFUSED", "closed"),
    (EndpointError, "NOT_DELIVERED", "closed"),
    (PublisherError, "PUBLISH_FAILED", "closed"),
    (ModelFailedError, MODEL_FAILED, "closed"),
    (ModelError, MODEL_FAILED, "closed"),
    (Exception, "INTERNAL", "closed"),
)
"""Event code, and the state of the source, by what an activation failed with; the first that fits holds."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """What an activation came to. fps: of a window. dropped: windows never rendered. frames: read. rejected: what
    spoilt windows, and how many."""

    counts: WorkCounts = field(default_factory=WorkCounts)
    fps: float = 0.0
    dropped: int = 0
    frames: int = 0
    rejected: dict[str, int] = field(default_factory=dict[str, int])


class Stream:
    """Source, reader thread and model thread, started and stopped together. Implements WatchListener.

    over: the last window was dealt with. failure: what it ended with, if not well.
    """

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        model: ModelSlot,
        source: FrameSource,
        *,
        reopen: Opener,
        first: tuple[int, int],
        on_window: Callable[[WindowReport], None] | None,
        recorder: Recorder,
    ) -> None:
        """Check everything that can be checked without a frame.

        Args:
            source: open. reopen: opens it again when it is lost.
            first: window id and epoch to go on from: neither may come twice in one life of a node.
            recorder: is shown every frame.
        Raises:
            ConfigError: see prepare_stream(). OptionError, PoseError: see VirtualView.
        """
        self._live, self._health, self._announcer = live, announcer.health, announcer
        self._model, self._recorder = model, recorder
        config, traits = live.config, model.traits
        context = prepare_stream(config, traits, source.info, boot_id=announcer.boot_id)
        self._contexts = [(first[1], context)]  # of the source as it is now last; replaced in the reader thread
        self._builder = WindowBuilder(
            frames=traits.config.frames,
            fps=context.fps,
            stride=config.window.stride,
            max_skew=config.window.max_skew,
            source_fps=source.info.fps_nominal,
            fit=lambda image: self.context.fit.image(image),
            fit_depth=(lambda depth: self.context.fit.depth(depth)) if traits.live else None,
            first_id=first[0],
            first_epoch=first[1],
        )
        self._newest = WindowSlot(lossless=config.source.pace == "lockstep")
        self._watch = SourceWatch(source, reopen, self, config.source)
        self._preview = InputPreview(announcer.sink, lambda: self.context)
        self.drift: DriftDetector | None = None
        if context.references and config.source.pace == "realtime":
            self.drift = DriftDetector(live, announcer, context.references, self.notice_change)
        self.renderer = Renderer(live, announcer, model, self.context_at, on_window, self.drift)
        self.worker = ModelWorker(live, announcer, model, self.renderer)
        self._threads = [
            threading.Thread(target=self._work, name="model", daemon=True),
            threading.Thread(target=read, args=(self._watch, self._builder, self._newest), name="reader", daemon=True),
        ]
        if self.drift is not None:
            self._threads.append(threading.Thread(target=self.drift.run, name="drift", daemon=True))
        self._reported: dict[str, int] = {}
        self._state: SourceState = "closed"
        self._stopped = self.over = False
        self.failure: Exception | None = None
        self._order = threading.Lock()  # what is announced is announced in the order in which it came to be

    @property
    def context(self) -> StreamContext:
        """What is known of the source now."""
        return self._contexts[-1][1]

    def context_at(self, epoch: int) -> StreamContext:
        """The same in an epoch; now, if it is none."""
        contexts = self._contexts
        return next((context for since, context in reversed(contexts) if since <= epoch), contexts[-1][1])

    @property
    def next(self) -> tuple[int, int]:
        """Window id and epoch that the next activation goes on from."""
        return self._builder.next_id, self._builder.epoch + 1

    def start(self) -> None:
        """Begin. Frames are read while the model warms up: its first window is a new one, and no camera's own buffers
        grow old."""
        for code in self.context.ood:
            self._health.raise_reason(code, Level.WARN)
        self.notice_change()
        for thread in self._threads:
            thread.start()

    def notice_change(self) -> None:
        """The live configuration has changed: other views are due, and the metadata says so."""
        with self._order:
            settings = self._live.settings()
            config = settings.config
            window_s = (config.window.stride or self._builder.frames) / self.context.fps
            self._health.expect(settings.revisions, window_s if config.source.pace == "realtime" else None)
            context = replace(self.context, config=config, traits=self._model.traits)
            self._announcer.meta(metadata(context, settings))

    def interrupt(self) -> None:
        """End soon: no new window begins, the one in work is abandoned at its next layer. May wait a second for a
        camera that does not answer."""
        self._stopped = True
        self.renderer.cancel.set()
        self._stop_drift()
        self._newest.close()
        self._watch.close()

    def join(self, patience_s: float) -> bool:
        """Wait for the threads; whether all have ended."""
        until_s = time.monotonic() + patience_s
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(max(0.0, until_s - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def tick(self) -> None:
        """Pass on what the builder and the source count, with an event for every new kind of trouble."""
        with self._order:
            rejected = self._rejected
            self._health.faults = rejected
            self._health.corrupt(self._watch.corrupt)
            dropped = self._builder.dropped + self._watch.skipped
            self._health.counts.update(built=self._builder.built, source=dropped, slot=self._newest.dropped)
            for reason, count in rejected.items():
                if count > self._reported.get(reason, 0) and reason != "SRC_LOST":
                    is_meant = reason == "CLOCK_STEP" and getattr(self._live.config.source, "loop", False)
                    self._announcer.event(reason, Level.OK if is_meant else Level.WARN, {"count": count})
            self._reported = rejected

    def announce_end(self) -> str:
        """Say how it ended, and the end of every view; gives the code. After `join`."""
        self.tick()
        code, source = ending(self.failure, stopped=self._stopped)
        self._health.source(source)
        self._health.model = "failed" if code == MODEL_FAILED else "ready"
        if self.failure is None:
            self._announcer.event(code, Level.OK)
        else:
            if code not in ("SRC_LOST", MODEL_FAILED):  # these two last by themselves, longer than to the next start
                self._health.raise_reason(code, Level.ERROR)
            self._announcer.event(code, Level.ERROR, {"message": str(self.failure)})
        delay_ms = _STOP_DELAY_MS if self._stopped else None
        self.renderer.announce_end(delay_ms=delay_ms)
        self._preview.announce_end(delay_ms=delay_ms)
        return code

    def summary(self) -> Summary:
        """What it came to so far."""
        return Summary(
            counts=self.renderer.counts,
            fps=self.context.fps,
            dropped=self._newest.dropped,
            frames=self._builder.pushed,
            rejected=self._rejected,
        )

    @property
    def _rejected(self) -> dict[str, int]:
        return {str(reason): count for reason, count in self._builder.reasons.items()}

    # WatchListener: called in the reader thread.

    def source_state(self, state: SourceState, detail: str) -> None:
        """Tell; see WatchListener."""
        before, self._state = self._state, state
        self._health.source(state)
        fields: dict[str, object] = {"message": detail, "source": self._watch.info.id}
        if state == "stalled":
            self._announcer.event("SRC_STALLED", Level.WARN, fields)
        elif state == "lost":
            self._announcer.event("SRC_LOST", Level.ERROR, fields)
        elif state == "streaming" and before in ("stalled", "lost"):
            self._announcer.event("SRC_BACK", Level.OK, fields | {"epoch": self._builder.epoch})

    def source_frame(self, frame: Frame) -> None:
        """Count, and show; see WatchListener."""
        now_ns = time.monotonic_ns()
        self._health.frame(frame.stamp_ns, now_ns)
        self._recorder.frame(frame)
        self._preview.offer(frame, now_ns, self._builder.epoch)

    def source_broken(self, reason: Reason) -> None:
        """Begin a new epoch; see WatchListener."""
        self._builder.restart(reason)
        self._newest.show(self._builder.filling)

    def source_opened(self, info: SourceInfo) -> bool:
        """Work out anew what is known of the source; see WatchListener. False if the model cannot be given what it
        gives now: no windows then, until that changes."""
        try:
            if info != self.context.source:
                self._adapt(info)
        except ConfigError as error:
            self._health.raise_reason("SRC_REFUSED", Level.ERROR)
            self._announcer.event("SRC_REFUSED", Level.ERROR, {"message": str(error), "source": info.id})
            return False
        else:
            self._health.clear_reason("SRC_REFUSED")
            return True
        finally:
            lens = self.context.lens
            is_fitting = lens is not None and lens.fits(info.width, info.height)
            self._recorder.source(info, lens if is_fitting else None)

    def _adapt(self, info: SourceInfo) -> None:
        """To another size, rate or camera. Raises ConfigError, and changes nothing then."""
        before = self.context
        now = prepare_stream(self._live.config, before.traits, info, boot_id=before.boot_id, before=before)
        self._contexts = [*self._contexts[1 - _KEPT_EPOCHS :], (self._builder.epoch, now)]
        self._builder.run_at(now.fps, info.fps_nominal)
        for code in before.ood:
            self._health.clear_reason(code)
        for code in now.ood:
            self._health.raise_reason(code, Level.WARN)
        self.notice_change()

    def _work(self) -> None:
        try:
            self.worker.work(self._newest)
        except Exception as error:  # the end of a thread: the node looks at it
            self.failure = error
        finally:
            self._newest.close()
            self._watch.close()
            self._stop_drift()
            self.over = True

    def _stop_drift(self) -> None:
        if self.drift is not None:
            self.drift.stop()


def ending(failure: Exception | None, *, stopped: bool) -> tuple[str, SourceState]:
    """Event code, and the state of the source, after an activation that ended with this failure, or by itself.

    stopped: it was interrupted.
    """
    if failure is None:
        return ("STOPPED", "closed") if stopped else ("SRC_ENDED", "ended")
    return next((code, source) for kind, code, source in _ENDINGS if isinstance(failure, kind))
