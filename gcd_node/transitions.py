"""What a node consists of while it lives: the model, and while it is active the stream. Built up and taken down by
the transitions of its life, one at a time."""

import gc
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from msgspec.structs import replace

from gcd_model import Traits
from gcd_node.frame import FrameSource, SourceInfo
from gcd_node.health import Health
from gcd_node.inference import WindowReport, WorkerParts
from gcd_node.messages import Run
from gcd_node.model import LoadModel, ModelSlot
from gcd_node.pipeline import FrameTap, ResumePoint, Stream, Summary
from gcd_node.publisher import MessageSink
from gcd_node.source_config import LIVE_KINDS, OakSource, SourceConfig
from gcd_node.status import Announcer
from gcd_node.stream_context import prepare_run
from gcd_node.views import LiveConfig, VirtualViews

_LOG = logging.getLogger(__name__)
_LOOK_S = 0.1
_HURRY_S = 2.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Parts:
    """What a node is made of; tests give others.

    open_source: see sources.open_source(). load_model: see session.load_model().
    """

    open_source: Callable[[SourceConfig], FrameSource]
    load_model: LoadModel


@dataclass(frozen=True, kw_only=True, slots=True)
class Links:
    """Through what a node speaks. on_over: called when a stream has ended. tap: sees every frame."""

    sink: MessageSink
    health: Health
    announcer: Announcer
    on_over: Callable[[], None]
    on_window: Callable[[WindowReport], None] | None = None
    tap: FrameTap | None = None


class Transitions:
    """The parts that work. `configure`, `activate`, `deactivate` and `cleanup` may take long; each either succeeds or
    raises and leaves nothing half done."""

    def __init__(self, live: LiveConfig, parts: Parts, links: Links) -> None:
        self.live = live
        self._parts, self._links = parts, links
        self._model: ModelSlot | None = None
        self._source: FrameSource | None = None
        self._info: SourceInfo | None = None
        self._stream: Stream | None = None
        self._prepared: tuple[Run, float] | None = None
        self._begin = ResumePoint()
        self._interrupted = False
        self._said: tuple[str, ...] = ()
        self.summary = Summary()
        """Of the last activation."""
        self.model_failed = False
        """Whether the model has to be loaded anew."""
        self.failure: Exception | None = None
        """What the last activation ended with, None if it ended well."""
        self._stuck: list[Stream] = []

    @property
    def is_live(self) -> bool:
        """Whether the source is a camera, rather than a recording."""
        return self.live.config.source.kind in LIVE_KINDS

    @property
    def traits(self) -> Traits | None:
        """The model's, None without one."""
        return None if self._model is None else self._model.traits

    @property
    def source_info(self) -> SourceInfo | None:
        """Of the source in use, or used last."""
        return self._info if self._stream is None else self._stream.run.source

    @property
    def left_behind(self) -> bool:
        """Whether a thread that should have ended still has not."""
        self._stuck = [stream for stream in self._stuck if not stream.join(0.0)]
        return bool(self._stuck)

    @property
    def stream(self) -> Stream | None:
        """The activation under way."""
        return self._stream

    @property
    def has_ended(self) -> bool:
        """Whether there is a stream, and it has ended by itself."""
        stream = self._stream
        return stream is not None and stream.over

    def configure(self) -> None:
        """Check the configuration and load the model. A recording is opened, so that a bad one is known at once.

        Raises:
            SourceError, CheckpointError, ConfigError, OptionError, PoseError: see there.
        """
        if not self.is_live:
            self._source = self._opened()
        try:
            self._links.health.model("loading")
            self._model = ModelSlot(self.live.config.model, self._parts.load_model)
            self._check(self._model.traits)
        except BaseException:
            self.cleanup()
            raise
        self._links.health.model("ready")

    def activate(self) -> None:
        """Open the source, and let views come once the model is warm.

        Raises:
            SourceAbsentError: there is no such camera. SourceError, ConfigError, OptionError, PoseError: see there.
        """
        model = self._model
        assert model is not None, "the lifecycle configures before it activates"
        for code in self._said:
            self._links.health.clear_reason(code)
        self._links.health.source("connecting")
        source, self._source, self.failure = self._source, None, None
        try:
            source = self._opened() if source is None else source
            stream = self._new_stream(model, source)
        except BaseException:
            self._links.health.source("closed")
            if source is not None:
                source.close()
            raise
        self._stream = stream
        if self._interrupted:
            stream.interrupt()
        stream.start()
        stream.worker.warm.wait()

    def deactivate(self) -> None:
        """Stop the stream, if it has not ended by itself, and say how it ended."""
        stream = self._stream
        if stream is None:
            return
        if not stream.over:
            stream.interrupt()
        if not self._has_ended(stream):
            _LOG.error("a thread of the stream does not end; it is left behind")
            self._stuck.append(stream)
        self._stream = None
        self._info, self.summary, self.failure = stream.run.source, stream.summary(), stream.failure
        self._begin, self._said = stream.end, stream.reasons
        self.model_failed = stream.model_failed
        stream.announce_end()
        del stream
        gc.collect()  # its pixels hang on objects that refer to each other

    def cleanup(self) -> None:
        """Let go of the model."""
        self._release()
        gc.collect()
        self._links.health.model("absent")

    def interrupt(self) -> None:
        """End what is under way soon, for good; from another thread than the transitions'."""
        self._interrupted = True
        stream = self._stream
        if stream is not None:
            stream.interrupt()

    def close(self, patience_s: float) -> None:
        """Let everything go, in whatever state, without a word. patience_s: for threads to end."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.interrupt()
            if not stream.join(patience_s):
                self._stuck.append(stream)
        self._release()

    def _has_ended(self, stream: Stream) -> bool:
        """Wait for its threads: as long as a step of the model may take, or less while the node is told to stop."""
        begun_s = time.monotonic()
        while not stream.join(_LOOK_S):
            if time.monotonic() - begun_s > (_HURRY_S if self._interrupted else self.live.config.life.hang_s):
                return False
        return True

    def _release(self) -> None:
        source, self._source, self._model = self._source, None, None
        self.model_failed = False
        if source is not None:
            source.close()

    def _opened(self) -> FrameSource:
        source = self._parts.open_source(self.live.config.source)
        self._info = source.info
        return source

    def _check(self, traits: Traits) -> None:
        """Everything about views and source that can be known before the source streams."""
        self._prepared = None
        if self._source is not None:
            self._prepared = prepare_run(self.live.config, traits, self._source.info)
        mount = None if self._prepared is None else self._prepared[0].mount
        VirtualViews(traits).following(self.live.settings(), mount)

    def _new_stream(self, model: ModelSlot, source: FrameSource) -> Stream:
        links = self._links
        worker = WorkerParts(
            model=model,
            live=self.live,
            sink=links.sink,
            health=links.health,
            announcer=links.announcer,
            on_window=links.on_window,
        )
        prepared, self._prepared = self._prepared, None
        if prepared is None:
            prepared = prepare_run(self.live.config, model.traits, source.info)
        return Stream(
            worker, source, prepared, reopen=self._reopen, begin=self._begin, on_over=links.on_over, tap=links.tap
        )

    def _reopen(self, before: SourceInfo) -> FrameSource:
        return self._parts.open_source(same_camera(self.live.config.source, before))


def same_camera(config: SourceConfig, before: SourceInfo) -> SourceConfig:
    """Settings that open the camera again that was open before.

    An OAK that was taken because it was the only one is asked for by its id from then on: another one, plugged in
    meanwhile, stands elsewhere and has another lens. Everything else is found where it was.
    """
    if isinstance(config, OakSource) and config.device is None:
        return replace(config, device=before.id)
    return config
