"""The life of a node as ROS 2 counts it: its states, the transitions between them, and the work of each (wire protocol,
section 6).

    unconfigured --configure--> inactive --activate--> active
         ^            cleanup      |  ^   deactivate      |
         +-------------------------+  +-------------------+          shutdown from each of the three: finalized

The states of the source and of the model are beside this one: a lost source does not leave active.
"""

import enum
import gc
import logging
import threading
import time
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from msgspec.structs import replace

from gcd_model import Traits
from gcd_node.frame import FrameSource, SourceInfo
from gcd_node.model import LoadModel, ModelSlot
from gcd_node.pipeline import MODEL_FAILED, Stream, Summary
from gcd_node.recorder import Recorder
from gcd_node.sources import LIVE_KINDS, OakSource, SourceConfig
from gcd_node.status import Announcer
from gcd_node.views import LiveConfig, VirtualViews
from gcd_node.work import WindowReport

_LOG = logging.getLogger(__name__)
_LOOK_S, _HURRY_S = 0.1, 2.0

Verb: TypeAlias = Literal["configure", "activate", "deactivate", "cleanup", "shutdown"]
"""What may be asked of a node's life."""


class State(enum.IntEnum):
    """The primary states 1 to 4, and those a node passes through; the numbers are ROS 2's lifecycle ids."""

    UNCONFIGURED = 1
    INACTIVE = 2
    ACTIVE = 3
    FINALIZED = 4
    CONFIGURING = 10
    CLEANINGUP = 11
    SHUTTINGDOWN = 12
    ACTIVATING = 13
    DEACTIVATING = 14
    ERRORPROCESSING = 15

    @property
    def label(self) -> str:
        """As it is said on the wire: lower case."""
        return self.name.lower()

    @property
    def settled(self) -> bool:
        """Whether the node stays here until a command comes."""
        return self <= State.FINALIZED


_LIVING = frozenset({State.UNCONFIGURED, State.INACTIVE, State.ACTIVE})
PATHS: Mapping[Verb, tuple[frozenset[State], State, State]] = types.MappingProxyType(
    {
        "configure": (frozenset({State.UNCONFIGURED}), State.CONFIGURING, State.INACTIVE),
        "activate": (frozenset({State.INACTIVE}), State.ACTIVATING, State.ACTIVE),
        "deactivate": (frozenset({State.ACTIVE}), State.DEACTIVATING, State.INACTIVE),
        "cleanup": (frozenset({State.INACTIVE}), State.CLEANINGUP, State.UNCONFIGURED),
        "shutdown": (_LIVING, State.SHUTTINGDOWN, State.FINALIZED),
    }
)
"""Of each verb: where it may be asked, the state meanwhile, and where it leads."""


class Lifecycle:
    """Where a node stands, and one transition at a time: `begin`, from any thread; who began sets `state` at last."""

    def __init__(self) -> None:
        self.state = State.UNCONFIGURED
        self._order = threading.Lock()

    def refusal(self, verb: Verb) -> str | None:
        """Why `verb` cannot be begun now; None if it can."""
        allowed, passing, goal = PATHS[verb]
        state = self.state
        if state in allowed:
            return None
        expected = " or ".join(sorted(each.label for each in allowed))
        busy = "" if state.settled else "; wait until that is over"
        already = " already" if state in (passing, goal) else ""
        return f"{verb} is for a node that is {expected}, this one is {state.label}{already}{busy}"

    def begin(self, verb: Verb) -> str | None:
        """Enter the state between; or say why that cannot be, and change nothing."""
        with self._order:
            refusal = self.refusal(verb)
            if refusal is None:
                self.state = PATHS[verb][1]
            return refusal


@dataclass(frozen=True, kw_only=True, slots=True)
class Parts:
    """What a node is made of: see sources.open_source() and session.load_model(); tests give others."""

    open_source: Callable[[SourceConfig], FrameSource]
    load_model: LoadModel


class Transitions:
    """The parts that work. `configure`, `activate`, `deactivate` and `cleanup` may take long; each
    either succeeds or raises and leaves nothing half done.

    stream: the activation under way. summary: of the last one. failure: what it ended with, None if it ended well.
    model_failed: the model has to be loaded anew.
    """

    def __init__(
        self,
        live: LiveConfig,
        announcer: Announcer,
        parts: Parts,
        recorder: Recorder,
        on_window: Callable[[WindowReport], None] | None,
    ) -> None:
        self._live, self._announcer, self._health = live, announcer, announcer.health
        self._parts, self._recorder, self._on_window = parts, recorder, on_window
        self._model: ModelSlot | None = None
        self._source: FrameSource | None = None  # open already, for the next activation
        self._info: SourceInfo | None = None
        self._first = (0, 0)
        self._interrupted = False
        self._stuck: Stream | None = None
        self.stream: Stream | None = None
        self.summary = Summary()
        self.failure: Exception | None = None
        self.model_failed = False

    @property
    def traits(self) -> Traits | None:
        """The model's, None without one."""
        return None if self._model is None else self._model.traits

    @property
    def source_info(self) -> SourceInfo | None:
        """Of the source in use, or used last."""
        stream = self.stream
        return self._info if stream is None else stream.context.source

    @property
    def left_behind(self) -> bool:
        """Whether a thread that should have ended still has not."""
        return self._stuck is not None and not self._stuck.join(0.0)

    def configure(self) -> None:
        """Load the model, and check the views. A recording is opened, so that a bad one is known at once. Raises
        SourceError, CheckpointError, ConfigError, OptionError, PoseError."""
        if self._live.config.source.kind not in LIVE_KINDS:
            self._source = self._open()
        try:
            self._health.model = "loading"
            self._model = ModelSlot(self._live.config.model, self._parts.load_model)
            VirtualViews(self._model.traits).sync(self._live.settings())
        except BaseException:
            self.cleanup()
            raise
        self._health.model = "ready"

    def activate(self) -> None:
        """Open the source, and let views come once the model is warm. Raises SourceAbsentError: there is no such
        camera; SourceError, ConfigError, OptionError, PoseError."""
        assert self._model is not None, "the lifecycle configures before it activates"
        self._health.forget_reasons()
        self._health.source("connecting")
        source, self._source, self.failure = self._source, None, None
        try:
            source = self._open() if source is None else source
            stream = Stream(
                self._live,
                self._announcer,
                self._model,
                source,
                reopen=lambda before: self._parts.open_source(same_camera(self._live.config.source, before)),
                first=self._first,
                on_window=self._on_window,
                recorder=self._recorder,
            )
        except BaseException:
            self._health.source("closed")
            if source is not None:
                source.close()
            raise
        self.stream = stream
        if self._interrupted:
            stream.interrupt()
        stream.start()
        stream.worker.warm.wait()

    def deactivate(self) -> None:
        """Stop the stream, if it has not ended by itself, and say how it ended."""
        stream = self.stream
        if stream is None:
            return
        if not stream.over:
            stream.interrupt()
        if not self._has_ended(stream):
            _LOG.error("a thread of the stream does not end; it is left behind")
            self._stuck = stream
        self.stream = None
        self._info, self._first = stream.context.source, stream.next
        self.summary, self.failure = stream.summary(), stream.failure
        self.model_failed = stream.announce_end() == MODEL_FAILED
        del stream
        gc.collect()  # its pixels hang on objects that refer to each other

    def cleanup(self) -> None:
        """Let go of the model."""
        self._release()
        gc.collect()
        self._health.model = "absent"

    def interrupt(self) -> None:
        """End what is under way soon, for good; from another thread than the transitions'."""
        self._interrupted = True
        stream = self.stream
        if stream is not None:
            stream.interrupt()

    def close(self, patience_s: float) -> None:
        """Let everything go, in whatever state, without a word. patience_s: for threads to end."""
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.interrupt()
            if not stream.join(patience_s):
                self._stuck = stream
        self._release()

    def _has_ended(self, stream: Stream) -> bool:
        """Wait for its threads: as long as a step of the model may take, or less once the node is stopping."""
        begun_s = time.monotonic()
        while not stream.join(_LOOK_S):
            if time.monotonic() - begun_s > (_HURRY_S if self._interrupted else self._live.config.life.hang_s):
                return False
        return True

    def _release(self) -> None:
        source, self._source, self._model, self.model_failed = self._source, None, None, False
        if source is not None:
            source.close()

    def _open(self) -> FrameSource:
        source = self._parts.open_source(self._live.config.source)
        self._info = source.info
        return source


def same_camera(config: SourceConfig, before: SourceInfo) -> SourceConfig:
    """Settings that open the camera again that was open before. An OAK that was taken because it was the only one is
    asked for by its id: another one, plugged in meanwhile, stands elsewhere and has another lens."""
    if isinstance(config, OakSource) and config.device is None:
        return replace(config, device=before.id)
    return config
