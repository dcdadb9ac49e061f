"""The node: source, reader thread, model thread and publisher, started and stopped together."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

from gcd_model import Traits, ViewSynthesizer
from gcd_node.capture import Newest, read
from gcd_node.config import NodeConfig
from gcd_node.envelope import NoteTopic
from gcd_node.errors import SourceError, TooShortError
from gcd_node.frame import FrameSource
from gcd_node.model_worker import ModelWorker, Outbox, WindowReport, WorkCounts
from gcd_node.preparation import fit_of, prepare_run
from gcd_node.record_json import to_json
from gcd_node.view_message import camera_matrix, end_messages, origin
from gcd_node.virtual_view import virtual_views
from gcd_node.window import FrameWindow, WindowBuilder

_TICK_S = 0.1
_STATUS_PERIOD_S = 1.0
_STOP_DELAY_MS = 100


@dataclass(frozen=True, kw_only=True, slots=True)
class Summary:
    """What a run came to. fps: of a window. window_s: from one window to the next. dropped: windows never rendered."""

    counts: WorkCounts
    fps: float
    dropped: int
    frames: int
    rejected: dict[str, int] = field(default_factory=dict[str, int])
    window_s: float


class Node:
    """One run over one source. `run` blocks; `stop` may be called from any thread or signal handler."""

    def __init__(
        self,
        config: NodeConfig,
        synthesizer: ViewSynthesizer,
        source: FrameSource,
        outbox: Outbox,
        on_window: Callable[[WindowReport], None] | None = None,
    ) -> None:
        """Check everything that can be checked without a frame.

        Raises:
            ConfigError, ViewRangeError, ViewFixedError: see prepare_run() and virtual_views().
            OptionError: the motion number cannot be worked out and was not given.
        """
        self._info, fps = prepare_run(config, synthesizer.traits, source.info)
        self._source, self._outbox = source, outbox
        self._views = virtual_views(config, synthesizer.traits, self._info.mount)
        if config.model.motion_bucket is None:
            for view in self._views:
                synthesizer.traits.motion_bucket(view.planned())
        fit = fit_of(config, synthesizer.traits)
        fit.crop_box(source.info.width, source.info.height)
        self._builder = WindowBuilder(
            frames=synthesizer.traits.config.frames,
            fps=fps,
            stride=config.window.stride,
            max_skew=config.window.max_skew,
            source_fps=source.info.fps_nominal,
            fit=fit.image,
        )
        self._newest = Newest[FrameWindow](lossless=config.source.pace == "lockstep")
        self._worker = ModelWorker(self._info, synthesizer, self._views, outbox, on_window)
        self._window_s = (config.window.stride or self._builder.frames) / fps
        self._failure: Exception | None = None
        self._stopped = False
        self._beats = 0

    @property
    def traits(self) -> Traits:
        """The model's."""
        return self._info.traits

    def run(self) -> Summary:
        """Work until the source ends or `stop` is called, then announce the end of every view.

        Raises:
            SourceError: the source was lost, or gave too few frames. ModelFailedError: see ModelWorker.work().
        """
        self._note("meta", self._meta())
        self._note("status", self._status("activating", "connecting"))
        reader = threading.Thread(target=read, args=(self._source, self._builder, self._newest), name="reader")
        model = threading.Thread(target=self._work, name="model")
        model.start()
        try:
            self._worker.warm.wait()
            reader.start()
            self._watch(model)
        finally:
            self._close()
            model.join()
            if reader.ident is not None:
                reader.join()
        self._announce_end()
        if self._failure is not None:
            raise self._failure
        return self._summary()

    def stop(self) -> None:
        """End soon: no new window begins, the one in work is abandoned at its next step."""
        self._stopped = True
        self._worker.cancel()
        self._outbox.hurry()
        self._close()

    def _close(self) -> None:
        self._newest.close()
        self._source.close()

    def _work(self) -> None:
        try:
            self._worker.work(self._newest)
        except Exception as error:
            self._failure = error

    def _watch(self, model: threading.Thread) -> None:
        next_s = 0.0
        told: dict[str, int] = {}
        while model.is_alive():
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + _STATUS_PERIOD_S
                self._note("status", self._status("active", "streaming"))
            self._note_new_reasons(told)
            model.join(_TICK_S)

    def _note_new_reasons(self, told: dict[str, int]) -> None:
        """An event for every kind of trouble that has happened since the last look."""
        for reason, count in self._builder.counts.reasons.items():
            if count > told.get(reason, 0):
                self._note("event", {"code": reason, "level": 1, "count": count})
                told[reason] = count

    def _announce_end(self) -> None:
        code, source, model = self._end_reason()
        self._note("event", {"code": code, "level": 0 if self._failure is None else 2})
        status = self._status("inactive", source)
        if self._failure is not None:
            status |= {"level": 2, "reasons": [*self._info.ood, code]}
        self._note("status", status | {"model": {**self._model_status(), "state": model}})
        delay_ms = _STOP_DELAY_MS if self._stopped else None
        for view in self._views:
            for message in end_messages(self._info, view.view_id, view.rev, self._worker.counts.last_window_id):
                self._outbox.end(message, delay_ms=delay_ms)

    def _end_reason(self) -> tuple[str, str, str]:
        """Event code, and the states of source and model at the end."""
        if isinstance(self._failure, TooShortError):
            return "TOO_SHORT", "ended", "ready"
        if isinstance(self._failure, SourceError):
            return "SRC_LOST", "lost", "ready"
        if self._failure is not None:
            return "MODEL_FAILED", "closed", "failed"
        return ("STOPPED", "closed", "ready") if self._stopped else ("SRC_ENDED", "ended", "ready")

    def _note(self, topic: NoteTopic, fields: dict[str, object]) -> None:
        self._outbox.note(topic, origin(self._info), fields)

    def _summary(self) -> Summary:
        built = self._builder.counts
        return Summary(
            counts=self._worker.counts,
            fps=self._builder.fps,
            dropped=self._newest.dropped,
            frames=built.frames,
            rejected={str(reason): count for reason, count in built.reasons.items()},
            window_s=self._window_s,
        )

    def _status(self, state: str, source: str) -> dict[str, object]:
        """As wire protocol, section 4, as far as this node knows it."""
        self._beats += 1
        built, sent = self._builder.counts, self._outbox.stats
        return {
            "state": state,
            "level": 1 if self._info.ood else 0,
            "reasons": list(self._info.ood),
            "source": {"state": source, "fps": self._info.source.fps_nominal, "dropped": built.dropped},
            "window": {
                "built": built.built,
                "rejected": sum(built.reasons.values()),
                "reason_counts": dict(built.reasons),
                "skipped": self._newest.dropped,
            },
            "model": self._model_status(),
            "publish": {"sent": sent.sent, "subs": sent.subscribers, "bytes": sent.bytes, "dropped": sent.dropped},
            "heartbeat_seq": self._beats,
        }

    def _model_status(self) -> dict[str, object]:
        counts = self._worker.counts
        recent_ms = sorted(1000.0 * seconds for seconds in tuple(counts.render_s))
        status: dict[str, object] = {"state": "busy", "nan_windows": counts.nan_windows}
        if recent_ms:
            status["ms_p50"] = round(recent_ms[len(recent_ms) // 2], 1)
            status["ms_p99"] = round(recent_ms[math.ceil(0.99 * len(recent_ms)) - 1], 1)
        return status

    def _meta(self) -> dict[str, object]:
        """What does not change during a run: weights, views, cameras, classes."""
        traits, camera = self._info.traits, self._info.intrinsics
        mount, pose = self._info.mount or traits.mount, self._info.config.source.pose
        assumed = pose is None or not pose.on_vehicle
        return {
            "weights": {
                "name": traits.name,
                "family": "unknown" if traits.family is None else traits.family.name,
                "sha256_12": traits.sha256_12,
                "trained": traits.trained,
            },
            "views": [view.view_id for view in self._views],
            "K": None if camera is None else list(camera_matrix(camera)),
            "mount": None if mount is None else {**asdict(mount), "assumed": assumed},
            "classes": [to_json(each) for each in self._info.classes],
            "size": [traits.config.width, traits.config.height],
            "fps": self._builder.fps,
            "cfg_digest": self._info.config.digest,
        }
