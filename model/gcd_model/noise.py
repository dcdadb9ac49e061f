"""Noise levels, preconditioning and random draws."""

from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.config import Prediction, SamplingConfig


@dataclass(frozen=True, slots=True)
class Preconditioning:
    """The four coefficients of a denoiser, shaped like the noise level they were made from."""

    c_skip: Tensor
    c_out: Tensor
    c_in: Tensor
    c_noise: Tensor


def preconditioning(sigma: Tensor, prediction: Prediction = "v") -> Preconditioning:
    """Coefficients that turn the raw network F into the denoiser D.

        D(x, sigma) = c_skip * x + c_out * F(c_in * x, c_noise)

    Args:
        sigma: noise level, positive, any shape.
        prediction: "v" as published; "x0", where F is the clean sample itself, is ours, for small networks.
    Source: Karras et al. 2022, Eq. 7, with the v-prediction coefficients of Stable Video Diffusion (sigma_data 1).
    """
    scale = (sigma**2 + 1).rsqrt()
    if prediction == "x0":
        skip, out = torch.zeros_like(sigma), torch.ones_like(sigma)
        return Preconditioning(c_skip=skip, c_out=out, c_in=scale, c_noise=sigma.log() / 4)
    return Preconditioning(c_skip=scale**2, c_out=-sigma * scale, c_in=scale, c_noise=sigma.log() / 4)


def edm_sigmas(config: SamplingConfig, steps: int) -> Tensor:
    """Noise levels of the sampler, from sigma_max down to sigma_min, then 0: float64 [steps + 1].

    One step uses sigma_max alone.
    Source: Karras et al. 2022, Eq. 5, with the range that Stable Video Diffusion samples from.
    """
    high, low = config.sigma_max ** (1 / config.rho), config.sigma_min ** (1 / config.rho)
    ramp = torch.linspace(0, 1, steps, dtype=torch.float64)
    sigmas = (high + ramp * (low - high)) ** config.rho
    return torch.cat([sigmas, sigmas.new_zeros(1)])


def guidance_scale(first: float, last: float, frames: int) -> Tensor:
    """Guidance per frame, linear from the first to the last: float64 [T]. Source: Blattmann et al. 2023 (SVD)."""
    return torch.linspace(first, last, frames, dtype=torch.float64)


def unit_noise(shape: tuple[int, ...], seed: int, stream: int = 0) -> Tensor:
    """Standard normal float32, the same on every device.

    seed, stream: draws with another seed or another stream (sample number) are independent.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + stream * 0xBF58476D1CE4E5B9 + 1) % 2**63
    return torch.randn(shape, generator=torch.Generator().manual_seed(mixed))
