"""One activation: from an open source to published views, in threads of its own, until it ends or is stopped."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from gcd_model import ModelError
from gcd_node.calibration import LensModel
from gcd_node.capture import WindowSlot, read
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
from gcd_node.inference import WORK_REASONS, ModelWorker, WorkCounts, WorkerParts
from gcd_node.messages import Run
from gcd_node.preview import CapturedFrame, InputPreview
from gcd_node.sources.live import Opener, SourceWatch
from gcd_node.status import metadata
from gcd_node.stream_context import ActiveSource
from gcd_node.views import VirtualViews
from gcd_node.window import Reason, WindowBuilder

_STOP_DELAY_MS = 100


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """What an activation came to. fps: of a window. window_s: from one window to the next. dropped: windows never
    rendered. frames: read. rejected: what spoilt windows, and how many."""

    counts: WorkCounts = field(default_factory=WorkCounts)
    fps: float = 0.0
    dropped: int = 0
    frames: int = 0
    rejected: dict[str, int] = field(default_factory=dict[str, int])
    window_s: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class ResumePoint:
    """Where an activation goes on from the one before: numbers that must not come twice in one life of a node."""

    window_id: int = 0
    epoch: int = 0


class FrameTap(Protocol):
    """Who else is shown what arrives; called in the reader thread, returns at once."""

    def source(self, info: SourceInfo, lens: LensModel | None) -> None:
        """Frames are of this source from here on. lens: the calibration in use for its pictures."""
        ...

    def frame(self, frame: Frame) -> None:
        """A frame has arrived."""
        ...


class Stream:
    """Source, reader thread and model thread, started and stopped together. Implements WatchListener."""

    def __init__(
        self,
        worker: WorkerParts,
        source: FrameSource,
        prepared: tuple[Run, float],
        *,
        reopen: Opener,
        begin: ResumePoint,
        on_over: Callable[[], None],
        tap: FrameTap | None = None,
    ) -> None:
        """Check everything that can be checked without a frame.

        Args:
            worker: what the model thread works with.
            source: open. prepared: what prepare_run() says of it. reopen: opens it again when it is lost.
            on_over: called when the last window was dealt with, whatever the reason, from the model thread.
            tap: see FrameTap.
        Raises:
            ConfigError, OptionError, PoseError: see fit_of() and VirtualView.
        """
        self._parts, self._on_over, self._tap = worker, on_over, tap
        config = worker.live.config
        traits, boot_id = worker.model.traits, worker.announcer.boot_id
        self._known = ActiveSource(worker.live, traits, prepared, boot_id=boot_id, epoch=begin.epoch)
        VirtualViews(traits).following(worker.live.settings(), self.run.mount)
        self._builder = WindowBuilder(
            frames=traits.config.frames,
            fps=self._known.fps,
            stride=config.window.stride,
            max_skew=config.window.max_skew,
            source_fps=source.info.fps_nominal,
            fit=self._known.image,
            fit_depth=self._known.depth if traits.live else None,
            first_id=begin.window_id,
            first_epoch=begin.epoch,
        )
        self._newest = WindowSlot(lossless=config.source.pace == "lockstep")
        self._watch = SourceWatch(source, reopen, self, config.source)
        self._preview = InputPreview(worker.sink, lambda: self.run)
        self.worker = ModelWorker(worker, self._known.of)
        self._threads = [
            threading.Thread(target=self._work, name="model", daemon=True),
            threading.Thread(target=self._read, name="reader", daemon=True),
        ]
        self._told: dict[str, int] = {}
        self._corrupt = 0
        self._was: SourceState = "closed"
        self.stopped = self.over = False
        self.failure: Exception | None = None
        self._order = threading.Lock()

    @property
    def run(self) -> Run:
        """What is known of the source now."""
        return self._known.run

    @property
    def end(self) -> ResumePoint:
        """Where the next activation goes on."""
        return ResumePoint(window_id=self._builder.next_id, epoch=self._builder.epoch + 1)

    @property
    def reasons(self) -> tuple[str, ...]:
        """What it raised of the node's health, to be cleared when another source is used."""
        return (*self.run.ood, *WORK_REASONS, *LASTING)

    def start(self) -> None:
        """Begin. Frames are read while the model warms up: its first window is a new one, and no camera's own buffers
        grow old."""
        self._raise_flags((), self.run.ood)
        self.notice_change()
        for thread in self._threads:
            thread.start()

    def notice_change(self) -> None:
        """The live configuration has changed: other views are due, and the metadata says so."""
        realtime = self._parts.live.config.source.pace == "realtime"
        self._parts.health.expect(self._parts.live.settings().revisions, self._window_s if realtime else None)
        self._tell_meta()

    @property
    def _window_s(self) -> float:
        """From one window to the next."""
        return (self._parts.live.config.window.stride or self._builder.frames) / self._known.fps

    def interrupt(self) -> None:
        """End soon: no new window begins, the one in work is abandoned at its next layer. Does not wait."""
        self.stopped = True
        self.worker.cancel()
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
            self._tick()

    def _tick(self) -> None:
        builder, health = self._builder, self._parts.health
        reasons = {str(reason): count for reason, count in builder.reasons.items()}
        health.windows(builder.built, reasons)
        health.totals(source=builder.dropped + self._watch.skipped, slot=self._newest.dropped)
        corrupt = self._watch.corrupt
        if corrupt > self._corrupt:
            health.corrupt(corrupt - self._corrupt)
            self._corrupt = corrupt
        for reason, count in reasons.items():
            if count > self._told.get(reason, 0) and reason != "SRC_LOST":
                self._parts.announcer.event(reason, Level.WARN, {"count": count})
            self._told[reason] = count

    def _tell_meta(self) -> None:
        """Send the metadata if anything of it has changed."""
        settings = self._parts.live.settings()
        run = replace(self.run, config=settings.config, traits=self._parts.model.traits)
        self._parts.announcer.meta(metadata(run, settings, self._known.fps))

    @property
    def model_failed(self) -> bool:
        """Whether it ended because the model did."""
        return ending(self.failure, stopped=self.stopped)[0] == MODEL_FAILED

    def announce_end(self) -> None:
        """Say how it ended, and the end of every view. After `join`."""
        self.tick()
        code, source = ending(self.failure, stopped=self.stopped)
        health = self._parts.health
        failed = self.failure is not None
        health.source(source)
        health.model("failed" if code == MODEL_FAILED else "ready")
        if code in LASTING:
            health.raise_reason(code, Level.ERROR)
        fields = {"message": str(self.failure)} if failed else {}
        self._parts.announcer.event(code, Level.ERROR if failed else Level.OK, fields)
        delay_ms = _STOP_DELAY_MS if self.stopped else None
        self.worker.announce_end(delay_ms=delay_ms)
        self._preview.announce_end(delay_ms=delay_ms)

    def summary(self) -> Summary:
        """What it came to so far."""
        return Summary(
            counts=self.worker.counts,
            fps=self._known.fps,
            dropped=self._newest.dropped,
            frames=self._builder.pushed,
            rejected={str(reason): count for reason, count in self._builder.reasons.items()},
            window_s=self._window_s,
        )

    # WatchListener: called in the reader thread.

    def source_state(self, state: SourceState, detail: str) -> None:
        """Tell; see WatchListener."""
        was, self._was = self._was, state
        self._parts.health.source(state)
        fields: dict[str, object] = {"message": detail, "source": self._watch.info.id}
        if state == "stalled":
            self._parts.announcer.event("SRC_STALLED", Level.WARN, fields)
        elif state == "lost":
            self._parts.announcer.event("SRC_LOST", Level.ERROR, fields)
        elif state == "streaming" and was in ("stalled", "lost"):
            self._parts.announcer.event("SRC_BACK", Level.OK, fields | {"epoch": self._builder.epoch})

    def source_frame(self, frame: Frame) -> None:
        """Count, and show; see WatchListener."""
        now_ns = time.monotonic_ns()
        self._parts.health.frame(frame.stamp_ns, now_ns)
        if self._tap is not None:
            self._tap.frame(frame)
        self._preview.offer(CapturedFrame(frame=frame, arrival_ns=now_ns, epoch=self._builder.epoch))

    def source_broken(self, reason: Reason) -> None:
        """Begin a new epoch; see WatchListener."""
        self._builder.restart(reason)
        self._newest.show(self._builder.filling)

    def source_opened(self, info: SourceInfo) -> bool:
        """Work out anew what is known of the source; see WatchListener. False if the model cannot be given what it
        gives now: no windows then, until that changes."""
        health = self._parts.health
        try:
            if info != self.run.source:
                self._adapt(info)
        except ConfigError as error:
            health.raise_reason("SRC_REFUSED", Level.ERROR)
            self._parts.announcer.event("SRC_REFUSED", Level.ERROR, {"message": str(error), "source": info.id})
            return False
        else:
            health.clear_reason("SRC_REFUSED")
            return True
        finally:
            if self._tap is not None:
                self._tap.source(info, self._known.lens(info))

    def _adapt(self, info: SourceInfo) -> None:
        """To another size, rate or camera. Raises ConfigError, and changes nothing then."""
        before = self.run.ood
        self._known.adapt(info, self._builder.epoch)
        self._builder.run_at(self._known.fps, info.fps_nominal)
        self._raise_flags(before, self.run.ood)
        self.notice_change()

    def _raise_flags(self, before: tuple[str, ...], now: tuple[str, ...]) -> None:
        """What lies outside the trained domain, in the node's health."""
        for code in set(before) - set(now):
            self._parts.health.clear_reason(code)
        for code in now:
            self._parts.health.raise_reason(code, Level.WARN)

    def _read(self) -> None:
        read(self._watch, self._builder, self._newest)

    def _work(self) -> None:
        try:
            self.worker.work(self._newest)
        except Exception as error:  # the end of a thread: the node looks at it
            self.failure = error
        finally:
            self._newest.close()
            self._watch.close()
            self.over = True
            self._on_over()


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

LASTING = tuple(code for _, code, _ in _ENDINGS if code not in ("SRC_LOST", MODEL_FAILED))
"""Reasons that stay in the node's health until the next activation; those left out last longer, by themselves."""


def ending(failure: Exception | None, *, stopped: bool) -> tuple[str, SourceState]:
    """Event code, and the state of the source, after an activation that ended with this failure, or by itself.

    stopped: somebody wanted it to end.
    """
    if failure is None:
        return ("STOPPED", "closed") if stopped else ("SRC_ENDED", "ended")
    return next((code, source) for kind, code, source in _ENDINGS if isinstance(failure, kind))
