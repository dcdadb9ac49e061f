"""Any engine, with a stopwatch beside every stage."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.conditioning import Conditioning
from gcd_model.config import ModelConfig
from gcd_model.engine import Engine
from gcd_model.geometry import Trajectory
from gcd_model.measuring.report import StageName
from gcd_model.measuring.stopwatch import Spent, Stopwatch
from gcd_model.noise import unit_noise
from gcd_model.schedule import Schedule

Made = TypeVar("Made")

_NOTHING = Spent(0.0, 0.0)


class Probe:
    """Implements Engine: passes every call on and notes what it took.

    What belongs to a stage that was not asked for is not computed: zeros, or noise, of the same shape stand in.
    """

    def __init__(self, engine: Engine, config: ModelConfig, stages: Collection[StageName]) -> None:
        self._engine, self._config = engine, config
        self._wanted = set(stages) | ({"tower", "encode", "step", "decode"} if "window" in stages else set())
        self._watch = Stopwatch(engine.like.device)
        self._watched = True
        self._spent: dict[StageName, Spent] = {}
        self._evaluations: list[Spent] = []

    def begin(self, *, watched: bool = True) -> None:
        """Forget the last window and start the clock. watched: note what stages take, for which a GPU is waited for."""
        self._spent, self._evaluations, self._watched = {}, [], watched
        self._watch.lap()

    @property
    def spent(self) -> dict[StageName, list[Spent]]:
        """Of the last window: what each stage took; of the steps, those after the first if there are any."""
        found: dict[StageName, list[Spent]] = {}
        for stage, each in self._spent.items():
            found[stage] = [each]
        steps = self._evaluations[1:] or self._evaluations
        if steps:
            found["step"] = steps
        return found

    @property
    def like(self) -> Tensor:
        """See Engine."""
        return self._engine.like

    def tokens(self, frames: Tensor) -> Tensor | None:
        """See Engine."""
        tower = self._config.image_encoder
        if tower is None:
            return None
        if "tower" in self._wanted:
            return self._timed("tower", lambda: self._engine.tokens(frames))
        return self.like.new_zeros(len(frames), tower.output_width)

    def condition_mean(self, frames: Tensor) -> Tensor:
        """See Engine."""
        if "encode" in self._wanted:
            return self._timed("encode", lambda: self._engine.condition_mean(frames))
        vae, (height, width) = self._config.vae, frames.shape[-2:]
        shape = (len(frames), vae.latent_channels, height // vae.down_factor, width // vae.down_factor)
        return unit_noise(shape, 1).to(self.like)

    def camera(self, path: Trajectory) -> Tensor | None:
        """See Engine."""
        return self._engine.camera(path)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """See Engine."""
        if "step" not in self._wanted:
            return start / schedule.sigmas[0].item()
        if not self._watched:
            return self._engine.sample(start, given, schedule, options)
        self._watch.lap()

        def note(done: int, steps: int) -> None:
            self._evaluations.append(self._watch.lap())
            if options.progress is not None:
                options.progress(done, steps)

        return self._engine.sample(start, given, schedule, replace(options, progress=note))

    def decode(self, latents: Tensor) -> Tensor:
        """See Engine."""
        if "decode" in self._wanted:
            return self._timed("decode", lambda: self._engine.decode(latents))
        factor = self._config.vae.down_factor
        return torch.zeros(len(latents), 3, latents.shape[-2] * factor, latents.shape[-1] * factor)

    def _timed(self, stage: StageName, work: Callable[[], Made]) -> Made:
        if not self._watched:
            return work()
        self._watch.lap()
        made = work()
        self._spent[stage] = self._spent.get(stage, _NOTHING) + self._watch.lap()
        return made
