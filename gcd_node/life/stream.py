"""One activation: from an open source to published views, in threads of its own, until it ends or is stopped."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from gcd_node.capture import Newest, read
from gcd_node.config import NodeConfig
from gcd_node.errors import ConfigError, EndpointError, SourceError, TooShortError
from gcd_node.frame import Frame, FrameSource, Image, SourceInfo
from gcd_node.health.announcer import metadata
from gcd_node.health.report import Level, SourceState
from gcd_node.life.source_watch import Opener, Patience, SourceWatch
from gcd_node.rendering.model_worker import ModelWorker, WorkCounts, WorkerParts
from gcd_node.rendering.preparation import fit_of, prepare_run
from gcd_node.rendering.virtual_view import VirtualViews
from gcd_node.window import FrameWindow, Reason, WindowBuilder
from gcd_node.wire.view_message import Run, end_messages

_JOIN_S = 2.0
_STOP_DELAY_MS = 100
_LASTING = ("TOO_SHORT", "SRC_REFUSED", "NOT_DELIVERED")  # reasons that stay until the next activation


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
class Begin:
    """Where an activation goes on from the one before: numbers that must not come twice in one life of a node."""

    window_id: int = 0
    epoch: int = 0


class Stream:
    """Source, reader thread and model thread, started and stopped together. Implements WatchListener."""

    def __init__(
        self,
        worker: WorkerParts,
        source: FrameSource,
        prepared: tuple[Run, float],
        *,
        reopen: Opener,
        begin: Begin,
        on_over: Callable[[], None],
    ) -> None:
        """Check everything that can be checked without a frame.

        Args:
            worker: what the model thread works with.
            source: open. prepared: what prepare_run() says of it. reopen: opens it again when it is lost.
            on_over: called when the last window was dealt with, whatever the reason, from the model thread.
        Raises:
            ConfigError, OptionError, PoseError: see fit_of() and VirtualView.
        """
        self._parts, self._on_over = worker, on_over
        config = worker.live.config
        self._runs: list[tuple[int, Run]] = []
        run, self._fps = self._ours(prepared[0]), prepared[1]
        self._fit = fit_of(config, worker.model.traits, source.info)
        VirtualViews(worker.model.traits).following(worker.live.settings(), run.mount)
        frames = worker.model.traits.config.frames
        self._builder = WindowBuilder(
            frames=frames,
            fps=self._fps,
            stride=config.window.stride,
            max_skew=config.window.max_skew,
            source_fps=source.info.fps_nominal,
            fit=self._fitted,
            first_id=begin.window_id,
            first_epoch=begin.epoch,
        )
        self._runs.append((begin.epoch, run))
        self._window_s = (config.window.stride or frames) / self._fps
        self._newest = Newest[FrameWindow](lossless=config.source.pace == "lockstep")
        self._watch = SourceWatch(source, reopen, self, _patience(config))
        self.worker = ModelWorker(worker, self._run_of)
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
        return self._runs[-1][1]

    @property
    def end(self) -> Begin:
        """Where the next activation goes on."""
        return Begin(window_id=self._builder.next_id, epoch=self._builder.epoch + 1)

    @property
    def reasons(self) -> tuple[str, ...]:
        """What it raised of the node's health, to be cleared when another source is used."""
        return (*self.run.ood, *_LASTING)

    def start(self) -> None:
        """Begin; frames are read once the model is warm."""
        for code in self.run.ood:
            self._parts.health.raise_reason(code, Level.WARN)
        self.notice_change()
        for thread in self._threads:
            thread.start()

    def notice_change(self) -> None:
        """The live configuration has changed: other views are due, and the metadata says so."""
        realtime = self._parts.live.config.source.pace == "realtime"
        self._parts.health.expect(self._parts.live.settings().revisions, self._window_s if realtime else None)
        self._tell_meta()

    def interrupt(self) -> None:
        """End soon: no new window begins, the one in work is abandoned at its next step. Does not wait."""
        self.stopped = True
        self.worker.cancel()
        self._newest.close()
        self._watch.close()

    def join(self) -> bool:
        """Wait for the threads, for a few seconds; whether all have ended."""
        until_s = time.monotonic() + _JOIN_S
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(max(0.0, until_s - time.monotonic()))
        return not any(thread.is_alive() for thread in self._threads)

    def tick(self) -> None:
        """Pass on what the builder and the source count, with an event for every new kind of trouble."""
        with self._order:
            self._tick()

    def _tick(self) -> None:
        counts, health = self._builder.counts, self._parts.health
        reasons = {str(reason): count for reason, count in counts.reasons.items()}
        health.windows(counts.built, reasons)
        health.dropped("source", counts.dropped + self._watch.skipped)
        health.dropped("slot", self._newest.dropped)
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
        self._parts.announcer.meta(metadata(run, settings, self._fps))

    def announce_end(self) -> None:
        """Say how it ended, and the end of every view. After `join`."""
        self.tick()
        code, source = self._ending()
        health, settings = self._parts.health, self._parts.live.settings()
        failed = self.failure is not None
        health.source(source)
        health.model("failed" if code == "MODEL_FAILED" else "ready")
        if code in _LASTING:
            health.raise_reason(code, Level.ERROR)
        fields = {"message": str(self.failure)} if failed else {}
        self._parts.announcer.event(code, Level.ERROR if failed else Level.OK, fields)
        run = replace(self.run, config=settings.config)
        for view_id, rev in settings.revisions.items():
            for message in end_messages(run, view_id, rev, self.worker.counts.last_window_id):
                self._parts.outbox.end(message, delay_ms=_STOP_DELAY_MS if self.stopped else None)

    def summary(self) -> Summary:
        """What it came to so far."""
        built = self._builder.counts
        return Summary(
            counts=self.worker.counts,
            fps=self._fps,
            dropped=self._newest.dropped,
            frames=built.frames,
            rejected={str(reason): count for reason, count in built.reasons.items()},
            window_s=self._window_s,
        )

    # WatchListener: called in the reader thread.

    def source_state(self, state: SourceState, detail: str) -> None:
        """Tell; see WatchListener."""
        was, self._was = self._was, state
        if state != "ended":  # its last window may still be in work
            self._parts.health.source(state)
        fields: dict[str, object] = {"message": detail, "source": self._watch.info.id}
        if state == "stalled":
            self._parts.announcer.event("SRC_STALLED", Level.WARN, fields)
        elif state == "lost":
            self._parts.announcer.event("SRC_LOST", Level.ERROR, fields)
        elif state == "streaming" and was in ("stalled", "lost"):
            self._parts.announcer.event("SRC_BACK", Level.OK, fields | {"epoch": self._builder.epoch})

    def source_frame(self, frame: Frame) -> None:
        """Count; see WatchListener."""
        self._parts.health.frame(frame.stamp_ns, time.monotonic_ns())

    def source_broken(self, reason: Reason) -> None:
        """Begin a new epoch; see WatchListener."""
        self._builder.restart(reason)

    def source_opened(self, info: SourceInfo) -> None:
        """Work out anew what is known of the source; see WatchListener. Raises SourceError if its rate is another."""
        if info == self.run.source:
            return
        run, fps = prepare_run(self._parts.live.config, self._parts.model.traits, info)
        if fps != self._fps:
            raise SourceError(f"{info.id} came back at a rate that makes windows of {fps:g} FPS, not {self._fps:g}")
        self._fit = fit_of(self._parts.live.config, self._parts.model.traits, info)
        self._runs = [*self._runs[-7:], (self._builder.epoch, self._ours(run))]
        self._tell_meta()

    def _run_of(self, epoch: int) -> Run:
        """What was known of the source in an epoch; -1 for now."""
        runs = self._runs
        return next((run for since, run in reversed(runs) if since <= epoch), runs[-1][1])

    def _ours(self, run: Run) -> Run:
        """With the id of this life of the node."""
        return replace(run, boot_id=self._parts.announcer.boot_id)

    def _fitted(self, image: Image) -> Image:
        return self._fit.image(image)

    def _read(self) -> None:
        self.worker.warm.wait()
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

    def _ending(self) -> tuple[str, SourceState]:
        """Event code, and the state of the source at the end."""
        if isinstance(self.failure, TooShortError):
            return "TOO_SHORT", "ended"
        if isinstance(self.failure, SourceError):
            return "SRC_LOST", "lost"
        if isinstance(self.failure, ConfigError):
            return "SRC_REFUSED", "closed"
        if isinstance(self.failure, EndpointError):
            return "NOT_DELIVERED", "closed"
        if self.failure is not None:
            return "MODEL_FAILED", "closed"
        return ("STOPPED", "closed") if self.stopped else ("SRC_ENDED", "ended")


def _patience(config: NodeConfig) -> Patience:
    source = config.source
    stall_s = None if source.stall_ms is None else source.stall_ms / 1000
    return Patience(stall_s=stall_s, open_s=source.open_timeout_s, max_reconnects=source.max_reconnects)
