"""The student and its own sampler, with gradients through every step.

Source: Martin Garcia et al. 2024, "Fine-Tuning Image-Conditional Diffusion Models is Easier than You Think": a
conditional diffusion model is finetuned end to end, as it will be used, with the losses of what is wanted of it.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from gcd_model import ModelConfig
from gcd_model.clip import RenderOptions
from gcd_model.sampler import sample
from gcd_model.schedule import Schedule
from gcd_train.draws import Draws
from gcd_train.objective import Batch, Denoiser, draw_noise


def schedule_of(config: ModelConfig, steps: int) -> Schedule:
    """The shipped sampler's schedule for that many steps, without guidance."""
    return Schedule.of(config, RenderOptions(steps=steps, guidance=(1.0, 1.0)))


def start_of(batch: Batch, config: ModelConfig, draws: Draws) -> Tensor:
    """Unit noise to start from, [N, C, h, w]; one draw for all frames of a clip where the model is sampled so."""
    return draw_noise(draws, batch.target.shape, batch.frames, float(config.sampling.shared_noise))


def drawn_steps(numbers: Sequence[int], draws: Draws) -> int:
    """One of the numbers of steps."""
    return numbers[int(draws.below(len(numbers), 1))]


def sampled(denoiser: Denoiser, batch: Batch, noise: Tensor, schedule: Schedule) -> Tensor:
    """From noise to a sample, as the synthesizer does it; gradients reach the weights through all steps.

    Args:
        noise: unit, [N, C, h, w].
    Returns:
        Latents [N, C, h, w], scaled.
    """
    levels: list[float] = schedule.sigmas.tolist()

    def denoise(x: Tensor, step: int) -> Tensor:
        sigma = torch.full(x.shape[:1], levels[step], device=x.device)
        return denoiser(x, sigma, batch)

    return sample(denoise, schedule.start(noise[None], 1)[0], schedule.steps)
