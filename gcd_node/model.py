"""The model a node has loaded: how it is tried, interrupted and left idle, what it gives up, level by level, when its
device has no memory left (docs/node.md, F11), and when it counts as failed."""

import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Container, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypeAlias, TypeVar

import torch
from msgspec.structs import replace
from torch import nn
from torch.nn.modules.module import register_module_forward_pre_hook

from gcd_model import (
    CameraMount,
    Cancelled,
    Clip,
    DeviceMemoryError,
    FrameSynthesizer,
    ModelError,
    NonFiniteError,
    OptionError,
    RenderOptions,
    Trajectory,
    ViewSynthesizer,
)
from gcd_node.config import ModelSection
from gcd_node.errors import ModelFailedError, NodeError
from gcd_node.health import Health, Level, ModelState
from gcd_node.remote import RemoteSynthesizer
from gcd_node.status import Announcer

Made = TypeVar("Made")

_LOG = logging.getLogger(__name__)
_TRIES, _SPAN_S = 3, 60.0
_BAD_WINDOWS_IN_A_ROW = 3


@contextmanager
def model_errors() -> Generator[None]:
    """Around a call of the model: what is unforeseen becomes ModelFailedError, so that nothing else is blamed."""
    try:
        yield
    except (ModelError, NodeError):
        raise
    except Exception as error:
        raise ModelFailedError(f"the model broke: {type(error).__name__}: {error}") from error


Failure = NonFiniteError | DeviceMemoryError
"""What a step of the model may come to instead; it may be tried again."""


def tried(step: Callable[[], Made]) -> Made | Failure:
    """What a step came to, or failed with: without its traceback, which keeps the model's work in memory."""
    try:
        return step()
    except (NonFiniteError, DeviceMemoryError) as error:
        return error.with_traceback(None)


LoadModel = Callable[[ModelSection], ViewSynthesizer]
"""Loads the model of a launch file; see session.load_model()."""


class ModelSlot:
    """Holds the model; the only reference to it, so that an exchange gives the memory back first.

    traits: of the model in use.
    """

    def __init__(self, section: ModelSection, load: LoadModel) -> None:
        """Load it. Raises as `load`."""
        self._section, self._load = section, load
        self._synthesizer: ViewSynthesizer | None = None
        self.traits = self.synthesizer.traits

    @property
    def synthesizer(self) -> ViewSynthesizer:
        """The model in use, frame by frame if it can; loaded anew if the last exchange did not succeed."""
        if self._synthesizer is None:
            loaded = self._load(self._section)
            self._synthesizer = loaded.streaming() if isinstance(loaded, FrameSynthesizer) else loaded
            self.traits = self._synthesizer.traits
        return self._synthesizer

    @property
    def local(self) -> ViewSynthesizer | None:
        """What renders in this process: the model; of one that computes elsewhere its fallback, None without one."""
        return self.synthesizer.fallback if isinstance(self.synthesizer, RemoteSynthesizer) else self.synthesizer

    def forget_frames(self) -> None:
        """What a model that works frame by frame remembers of the frames before; others remember nothing."""
        if isinstance(self._synthesizer, FrameSynthesizer):
            self._synthesizer.reset()

    @property
    def streams(self) -> bool:
        """Whether it works frame by frame, and one frame goes on where the one before ended."""
        return isinstance(self._synthesizer, FrameSynthesizer)

    @property
    def can_halve(self) -> bool:
        """Whether bfloat16 weights would be smaller, and the device is one that gains by them."""
        return self.traits.device.startswith("cuda") and self.traits.precision == "float32"

    def halve(self) -> None:
        """Let the model go and load it in bfloat16. Raises as `load`."""
        self._synthesizer, self._section = None, replace(self._section, dtype="bfloat16")
        _ = self.synthesizer


def render_grey(
    synthesizer: ViewSynthesizer, paths: Sequence[Trajectory], mount: CameraMount | None, options: RenderOptions
) -> None:
    """Render a grey clip along paths, encoded a frame at a time as windows are.

    Args:
        mount: of the source camera.
    Raises:
        NonFiniteError, DeviceMemoryError, Cancelled: see ViewSynthesizer.render.
    """
    traits = synthesizer.traits
    height, width = traits.config.height, traits.config.width
    if traits.device == "cpu":  # half of each: a whole rendering takes longer than all that happens only once
        with contextlib.suppress(OptionError):
            traits.check_size(height // 2, width // 2)
            height, width = height // 2, width // 2
    grey = Clip(video=torch.zeros(1, 3, height, width), fps=traits.fps, mount=mount)
    encoded = synthesizer.encode(grey)
    synthesizer.render(encoded.followed_by(*[encoded] * (traits.config.frames - 1)), paths, options)


@contextmanager
def interruptible(cancel: threading.Event, threads: Container[int]) -> Generator[None]:
    """Within the block, once `cancel` is set, the next layer of any network that one of these threads calls raises
    Cancelled: in an encoder, a denoising step or a decoder alike. Changes no result; costs a microsecond a layer.

    threads: their identities. One hook for all: PyTorch's list of them must not change while a network works.
    """

    def look(module: nn.Module, _: Any) -> None:
        if cancel.is_set() and threading.get_ident() in threads:
            raise Cancelled(f"cancelled before a layer ({type(module).__name__})")

    hook = register_module_forward_pre_hook(look)
    try:
        yield
    finally:
        hook.remove()


class Pulse:
    """When each of the model's threads began the step that it is at; tells the node's health whether any is at one."""

    def __init__(self, health: Health, given_up: "Sequence[GiveUp]") -> None:
        """given_up: what is not asked of the device any more."""
        self._health, self._given_up = health, given_up
        self._begun_s: dict[int, float] = {}
        self._order = threading.Lock()

    @property
    def silent_s(self) -> float:
        """How long one of them has been at one step; 0 while all rest, or one loads a model."""
        with self._order:
            return max(0.0, time.monotonic() - min(self._begun_s.values(), default=math.inf))

    def beat(self) -> None:
        """This thread begins a step."""
        self._begin(time.monotonic(), "degraded" if self._given_up else "busy")

    def load(self, state: ModelState = "loading") -> None:
        """This thread begins to load a model or to warm it up, which takes as long as it takes."""
        self._begin(math.inf, state)

    def rest(self) -> None:
        """This thread waits for work."""
        with self._order:
            self._begun_s.pop(threading.get_ident(), None)
            if not self._begun_s:
                self._health.model = "degraded" if self._given_up else "ready"

    def _begin(self, at_s: float, state: ModelState) -> None:
        with self._order:
            self._begun_s[threading.get_ident()] = at_s
            self._health.model = state


class IdleTimer:
    """Says whether views have had no subscriber for a while. It counts only those that are there when it is asked."""

    def __init__(self, idle_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin as if a subscriber had just left. idle_s: patience, seconds; 0 for never. clock: monotonic seconds."""
        self._idle_s, self._clock = idle_s, clock
        self._watched_s = clock()

    def is_idle(self, subscribers: int) -> bool:
        """Whether there was none for `idle_s`. subscribers: of views, now; those of the input alone do not count."""
        now_s = self._clock()
        if subscribers > 0:
            self._watched_s = now_s
        return 0 < self._idle_s < now_s - self._watched_s


# What it gives up.

GiveUp: TypeAlias = Literal["views one by one", "bfloat16", "half the steps", "a single view"]
"""One thing less that is asked of the device: only one view is in memory at a time; weights are loaded anew in
bfloat16; half as many steps; the first view alone, with one sample. In this order."""


def oom_levels(*, views: int, samples: int, steps: int, can_halve: bool, can_part: bool = True) -> list[GiveUp]:
    """The way down from what was asked; what would change nothing is left out.

    views, samples, steps: as asked. can_halve: the weights are wider than bfloat16, on a device that gains by it.
    can_part: views may be rendered one by one.
    """
    levels: dict[GiveUp, bool] = {
        "views one by one": views > 1 and can_part,
        "bfloat16": can_halve,
        "half the steps": steps > 1,
        "a single view": views > 1 or samples > 1,
    }
    return [name for name, changes in levels.items() if changes]


class FailureCounter:
    """Counts what went wrong, tells it, and says when to give up. Belongs to the model thread.

    Of the device's memory it only ever asks less, until the next activation.
    """

    def __init__(self, announcer: Announcer, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: monotonic seconds."""
        self._announcer, self._clock = announcer, clock
        self._to_come: list[GiveUp] | None = None  # unknown until the device was full
        self.given_up: list[GiveUp] = []
        self._full_s: deque[float] = deque(maxlen=_TRIES)
        self._bad_in_a_row = 0

    def success(self) -> None:
        """A window came out well."""
        self._bad_in_a_row = 0

    def out_of_memory(self, window_id: int, error: DeviceMemoryError, levels: Sequence[GiveUp]) -> None:
        """The device was full: from here on less is asked of it. levels: down from what is asked; see oom_levels().

        Raises:
            ModelFailedError: nothing is left to give up, and it was full three times within a minute.
        """
        self._announcer.health.count("oom_count")
        self._to_come = list(levels) if self._to_come is None else self._to_come
        if self._to_come:
            self.given_up.append(self._to_come.pop(0))
        else:
            self._full_s.append(self._clock())
        rung = self.given_up[-1] if self.given_up else "as asked"
        _LOG.warning("window %d: %s; from here on: %s", window_id, error, rung)
        fields = {"window_id": window_id, "rung": rung, "message": str(error)}
        self._announcer.event("GPU_OOM", Level.ERROR, fields)
        if len(self._full_s) == _TRIES and self._full_s[-1] - self._full_s[0] <= _SPAN_S:
            raise ModelFailedError(
                f"the device had no memory three times within a minute although little is asked ({rung}): "
                f"{error} Free memory, or use a smaller model"
            )

    def not_a_number(self, fields: Mapping[str, object]) -> None:
        """A window came out with NaN or Inf, and so did its retry. fields: what it takes to render it again.

        Raises:
            ModelFailedError: the third in a row.
        """
        self._bad_in_a_row += 1
        self._announcer.health.count("nan_windows")
        self._announcer.event("MODEL_NAN", Level.ERROR, fields)
        if self._bad_in_a_row >= _BAD_WINDOWS_IN_A_ROW:
            raise ModelFailedError(
                f"{self._bad_in_a_row} windows in a row came out with NaN; none was published. "
                'Try dtype = "float32", and look at them with `gcd-node weights inspect`'
            )
