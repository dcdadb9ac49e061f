"""The model a node has loaded. It may be exchanged for a lighter one while the node lives."""

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from msgspec.structs import replace
from torch import nn
from torch.nn.modules.module import register_module_forward_pre_hook

from gcd_model import (
    CameraMount,
    Cancelled,
    Clip,
    FrameSynthesizer,
    ModelError,
    OptionError,
    RenderOptions,
    Sampler,
    Traits,
    Trajectory,
    ViewSynthesizer,
    sampler_of,
)
from gcd_node.config import ModelSection
from gcd_node.errors import ModelFailedError, NodeError


@contextmanager
def model_errors() -> Generator[None]:
    """Around a call of the model: what is unforeseen becomes ModelFailedError, so that nothing else is blamed."""
    try:
        yield
    except (ModelError, NodeError):
        raise
    except Exception as error:
        raise ModelFailedError(f"the model broke: {type(error).__name__}: {error}") from error


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


def drawing_options(section: ModelSection) -> RenderOptions:
    """What [model] says of drawing; without a seed, which is the window's."""
    return RenderOptions(
        quality=section.quality,
        steps=section.steps,
        solver=section.solver,
        guidance=section.guidance,
        guidance_interval=section.guidance_interval,
        samples=section.samples,
        motion_bucket=section.motion_bucket,
    )


def sampler_in_use(section: ModelSection, traits: Traits) -> Sampler:
    """The same in full: what [model] leaves out as quality and checkpoint have it."""
    return sampler_of(traits.config.sampling, drawing_options(section))


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
def interruptible(cancel: threading.Event) -> Generator[None]:
    """Within the block, once `cancel` is set, the next layer of any network that this thread calls raises Cancelled:
    in an encoder, a denoising step or a decoder alike. Changes no result; costs a microsecond a layer."""
    thread = threading.get_ident()

    def look(module: nn.Module, _: Any) -> None:
        if cancel.is_set() and threading.get_ident() == thread:
            raise Cancelled(f"cancelled before a layer ({type(module).__name__})")

    hook = register_module_forward_pre_hook(look)
    try:
        yield
    finally:
        hook.remove()


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
