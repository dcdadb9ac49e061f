"""The model thread: takes windows, renders every view of each, hands the messages over. Owns the device."""

import hashlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch

from gcd_model import (
    Augmentation,
    Cancelled,
    Clip,
    DeviceMemoryError,
    NonFiniteError,
    RenderOptions,
    View,
    ViewSynthesizer,
)
from gcd_node.capture import Newest
from gcd_node.envelope import EndMessage, NoteTopic, ViewMessage
from gcd_node.errors import ModelFailedError
from gcd_node.frame_pacer import FramePacer
from gcd_node.header import OriginHeader
from gcd_node.preprocess import to_clip_tensor
from gcd_node.publisher_options import PublisherStats
from gcd_node.view_message import Rendered, Run, messages, origin
from gcd_node.virtual_view import VirtualView
from gcd_node.window import FrameWindow

_LOG = logging.getLogger(__name__)
_BAD_WINDOWS_IN_A_ROW = 3
_KEPT = 1000  # a node runs for weeks


class Outbox(Protocol):
    """Where messages go: a Publisher, or a list in a test."""

    def send(self, message: ViewMessage) -> object:
        """Hand over a view."""
        ...

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        """Hand over an end-of-stream, to follow the last view."""
        ...

    def note(self, topic: NoteTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        """Hand over a status, event or meta note."""
        ...

    def hurry(self) -> None:
        """Stop waiting for readers."""
        ...

    @property
    def stats(self) -> PublisherStats:
        """What has left."""
        ...


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


class ModelWorker:
    """Renders windows until there are no more, it is cancelled, or the model has failed."""

    def __init__(
        self,
        run: Run,
        synthesizer: ViewSynthesizer,
        views: Sequence[VirtualView],
        outbox: Outbox,
        on_window: Callable[[WindowReport], None] | None = None,
    ) -> None:
        self.counts = WorkCounts()
        self._run, self._synthesizer, self._views, self._outbox = run, synthesizer, views, outbox
        self._on_window = on_window
        self.warm = threading.Event()  # the first window may come
        self._pacer = FramePacer(outbox.send)
        self._newest_goal_ns: dict[str, int] = {}
        self._cancel = threading.Event()
        self._bad_in_a_row = 0

    def cancel(self) -> None:
        """Abandon the window in work at its next denoising step; from any thread."""
        self._cancel.set()

    def work(self, newest: Newest[FrameWindow]) -> None:
        """Take windows and publish their views.

        Raises:
            ModelFailedError: three windows in a row could not be used.
            whatever the source failed with, once its last window is done.
        """
        try:
            if self._run.config.source.pace == "realtime":
                self._warm_up()
            self.warm.set()
            while (window := newest.take()) is not None:
                self._render_or_count(window)
        except Cancelled:
            _LOG.info("the window in work was abandoned")
        finally:
            self.warm.set()
            self._pacer.finish(abandon=self._cancel.is_set())

    def _warm_up(self) -> None:
        """Render a grey clip in one step, so that the first window does not pay for what happens only once."""
        config = self._run.traits.config
        video = torch.zeros(config.frames, 3, config.height, config.width)
        grey = Clip(video=video, fps=self._run.traits.fps, mount=self._run.mount)
        try:
            features = self._synthesizer.encode(grey)
            self._synthesizer.render(features, [view.planned() for view in self._views], self._options(0, steps=1))
        except (NonFiniteError, DeviceMemoryError) as error:
            _LOG.warning("the warm-up came to nothing: %s", error)  # windows are dealt with one by one

    def _options(self, seed: int, *, steps: int | None) -> RenderOptions:
        model = self._run.config.model
        return RenderOptions(
            steps=steps,
            guidance=model.guidance,
            samples=model.samples,
            seed=seed,
            motion_bucket=model.motion_bucket,
            cancel=self._cancel,
        )

    def _render_or_count(self, window: FrameWindow) -> None:
        """One retry with another seed; a window that fails again is counted and not published."""
        failure: Exception | None = None
        for attempt in (0, 1):
            try:
                self._publish(window, window_seed(self._run.config.digest, window.window_id, attempt))
            except (NonFiniteError, DeviceMemoryError) as error:
                failure = error
                _LOG.warning("window %d, attempt %d: %s", window.window_id, attempt + 1, error)
            else:
                self._bad_in_a_row = 0
                return
        self._count_bad(window, failure)

    def _count_bad(self, window: FrameWindow, failure: Exception | None) -> None:
        is_nan = isinstance(failure, NonFiniteError)
        self.counts.nan_windows += is_nan
        self._bad_in_a_row += 1
        fields = {"code": "MODEL_NAN" if is_nan else "GPU_OOM", "level": 2, "window_id": window.window_id}
        self._outbox.note("event", origin(self._run), fields)
        if self._bad_in_a_row >= _BAD_WINDOWS_IN_A_ROW:
            raise ModelFailedError(
                f"{self._bad_in_a_row} windows in a row came out with NaN or found no memory; none was published. "
                'Try dtype = "float32", fewer views and samples, and `gcd-node weights inspect`'
            )

    def _publish(self, window: FrameWindow, seed: int) -> None:
        started_ns = time.monotonic_ns()
        rendered = self._render(window, seed)
        ended_ns = time.monotonic_ns()
        steps = self._run.config.model.steps or self._run.traits.config.sampling.steps
        for virtual, view in zip(self._views, rendered, strict=True):
            described = Rendered(
                window=window,
                view=view,
                view_id=virtual.view_id,
                view_rev=virtual.rev,
                started_ns=started_ns,
                ended_ns=ended_ns,
                steps=steps,
                seed=seed,
            )
            self._send(self._unsent(messages(self._run, described)), window.fps)
        self._count(window, (ended_ns - started_ns) / 1e9)

    def _unsent(self, made: Sequence[ViewMessage]) -> list[ViewMessage]:
        """Without single frames of moments that an overlapping window has sent before."""
        kept: list[ViewMessage] = []
        for message in made:
            if message.topic.endswith("/frm"):
                stamp_ns = message.header.t_capture_ns[0]
                if stamp_ns <= self._newest_goal_ns.get(message.topic, stamp_ns - 1):
                    continue
                self._newest_goal_ns[message.topic] = stamp_ns
            kept.append(message)
        return kept

    def _send(self, made: Sequence[ViewMessage], fps: float) -> None:
        """Single frames leave at the rhythm they were taken in, unless nobody waits for the clock."""
        realtime = self._run.config.source.pace == "realtime"
        frames_sent = 0
        for message in made:
            is_frame = message.topic.endswith("/frm")
            self._pacer.send(message, frames_sent / fps if is_frame and realtime else 0.0)
            frames_sent += is_frame

    def _render(self, window: FrameWindow, seed: int) -> list[View]:
        model = self._run.config.model
        video = torch.from_numpy(to_clip_tensor(window.images))
        clip = Clip(video=video, fps=window.fps, mount=self._run.mount)
        features = self._synthesizer.encode(clip, Augmentation(strength=model.cond_aug, seed=seed))
        paths = [view.trajectory(window.stamps_ns[-1], window.epoch) for view in self._views]
        return self._synthesizer.render(features, paths, self._options(seed, steps=model.steps))

    def _count(self, window: FrameWindow, seconds: float) -> None:
        self.counts.windows += 1
        self.counts.last_window_id = window.window_id
        self.counts.render_s.append(seconds)
        age_ms = (time.monotonic_ns() - window.arrival_ns) / 1e6
        self.counts.age_ms.append(age_ms)
        if self._on_window is not None:
            self._on_window(WindowReport(window=window, render_s=seconds, age_ms=age_ms))


def window_seed(config_digest: str, window_id: int, attempt: int) -> int:
    """The seed of a window: the same in every run of a configuration, below 2^48 so that JSON holds it."""
    text = f"{config_digest}/{window_id}/{attempt}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")
