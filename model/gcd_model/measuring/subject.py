"""What is measured: one checkpoint, one clip, one window."""

from collections.abc import Collection
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.clip import Clip, RenderOptions, View
from gcd_model.config import ModelConfig
from gcd_model.engine import Engine
from gcd_model.errors import OptionError
from gcd_model.measuring.probe import Probe
from gcd_model.measuring.report import StageName
from gcd_model.networks import empty_networks
from gcd_model.noise import unit_noise
from gcd_model.schedule import Schedule
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits

_MOTION_BUCKET = 127.0
_COARSE = 16


@dataclass(frozen=True, kw_only=True, slots=True)
class Work:
    """What a window is made of. height, width: of the frames, pixels. guidance: of the first and the last frame."""

    height: int
    width: int
    steps: int
    guidance: tuple[float, float]

    @classmethod
    def of(
        cls,
        config: ModelConfig,
        *,
        height: int | None = None,
        width: int | None = None,
        steps: int | None = None,
        guidance: tuple[float, float] | None = None,
    ) -> "Work":
        """What was asked for, and else what the checkpoint was made for.

        Raises OptionError for a size that the network cannot take.
        """
        work = cls(
            height=height or config.height,
            width=width or config.width,
            steps=steps or config.sampling.steps,
            guidance=guidance or config.sampling.guidance,
        )
        factor = config.size_factor
        if work.height % factor or work.width % factor:
            raise OptionError(
                f"height and width must be multiples of {factor} for this model, got {work.height}x{work.width}"
            )
        return work

    @property
    def options(self) -> RenderOptions:
        """The same for the synthesizer."""
        return RenderOptions(steps=self.steps, guidance=self.guidance, motion_bucket=_MOTION_BUCKET)

    def schedule(self, config: ModelConfig) -> Schedule:
        """The same for an engine."""
        return Schedule.of(config, self.options)


def still_clip(frames: int, height: int, width: int, fps: float) -> Clip:
    """One smooth picture, held: [frames, 3, height, width].

    Held, because diffusers knows one image token per clip and a still clip has no other; the noise that is added to the
    source frames differs from frame to frame, so all else does, too.
    """
    coarse = unit_noise((1, 3, max(2, height // _COARSE), max(2, width // _COARSE)), 7)
    smooth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return Clip(video=smooth.clamp(-1, 1).expand(frames, -1, -1, -1).contiguous(), fps=fps)


class Subject:
    """One implementation at work on one window, again and again."""

    def __init__(self, name: str, engine: Engine, traits: Traits, work: Work, stages: Collection[StageName]) -> None:
        """traits: of the networks that `engine` computes."""
        config = traits.diffusion
        self.name, self._work, self._traits = name, work, traits
        self.probe = Probe(engine, config, stages)
        self._synthesizer = Synthesizer(empty_networks(config), traits, self.probe)
        self._clip = still_clip(config.frames, work.height, work.width, traits.fps)

    def window(self, *, watched: bool = True) -> View:
        """Once through: the clip as the checkpoint's first view shows it.

        watched: `probe.spent` then tells what its stages took.
        """
        path = self._traits.plan_view()
        self.probe.begin(watched=watched)
        return self._synthesizer.render(self._synthesizer.encode(self._clip), [path], self._work.options)[0]


def relative_difference(ours: Tensor, other: Tensor) -> float:
    """Largest absolute difference over the largest absolute value of ours."""
    largest = ours.double().abs().max().clamp_min(torch.finfo(torch.float64).tiny)
    return ((ours.double() - other.double()).abs().max() / largest).item()
