"""How one batch is sampled: noise levels, solver, guidance and where it applies."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.config import ModelConfig, Prediction
from gcd_model.noise import edm_sigmas, guidance_scale
from gcd_model.quality import sampler_of
from gcd_model.sampler import SolverStep, solver_steps


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """One run of the sampler, all of it known before it starts.

    sigmas: float64 [S + 1], falling to 0. steps: what the solver does with each D, one per noise level above 0.
    guidance: float64 [T], scale per frame. guided: per step, whether the unconditional branch counts, too.
    """

    sigmas: Tensor
    steps: tuple[SolverStep, ...]
    guidance: Tensor
    guided: tuple[bool, ...]
    prediction: Prediction

    @classmethod
    def of(cls, config: ModelConfig, options: RenderOptions | None = None) -> Self:
        """What `sampler_of` makes of the options."""
        sampler = sampler_of(config.sampling, RenderOptions() if options is None else options)
        sigmas = edm_sigmas(config.sampling, sampler.steps)
        first, last = sampler.guidance
        guides = (first, last) != (1.0, 1.0)
        low, high = sampler.guidance_interval or (0.0, float("inf"))
        return cls(
            sigmas=sigmas,
            steps=solver_steps(sampler.solver, sigmas),
            guidance=guidance_scale(first, last, config.frames),
            guided=tuple(guides and low <= sigma <= high for sigma in sigmas[:-1].tolist()),
            prediction=config.prediction,
        )

    @property
    def branches(self) -> int:
        """Rows the network is told of per view: 2 where any step is guided."""
        return 2 if any(self.guided) else 1

    @property
    def evaluations(self) -> int:
        """How often the network sees a view: guided steps count twice."""
        return len(self.steps) + sum(self.guided)

    def start(self, noise: Tensor, views: int) -> Tensor:
        """Unit noise [S, T, C, h, w] -> [views * S, T, C, h, w], as strong as the first level asks."""
        return noise.repeat(views, 1, 1, 1, 1) * torch.sqrt(self.sigmas[0] ** 2 + 1).item()
