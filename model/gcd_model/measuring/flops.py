"""Arithmetic of a window, counted from shapes on the meta device: the same way for every implementation.

There the counter sees scaled-dot-product attention; on a CPU it does not.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from gcd_model.clip import RenderOptions
from gcd_model.conditioning import Conditioning
from gcd_model.config import ModelConfig
from gcd_model.engine import Engine
from gcd_model.measuring.report import StageName
from gcd_model.measuring.subject import Work

_META = torch.device("meta")


@torch.inference_mode()
def window_flops(engine: Engine, config: ModelConfig, work: Work) -> dict[StageName, int]:
    """Operations of each stage, multiplications and additions apart. engine: on the meta device.

    What is prepared once a window counts for the window, and not for a step.
    """
    frames = _empty(config.frames, 3, work.height, work.width)
    latents = _empty(config.frames, config.vae.latent_channels, *_latent_size(config, work))
    first, step = _sampling(engine, config, work)
    counted: dict[StageName, int] = {
        "tower": 0 if config.image_encoder is None else _counted(lambda: engine.tokens(frames)),
        "encode": _counted(lambda: engine.condition_mean(frames)),
        "step": step,
        "decode": _counted(lambda: engine.decode(latents)),
    }
    sampling = first + (work.steps - 1) * step
    counted["window"] = counted["tower"] + counted["encode"] + sampling + counted["decode"]
    return counted


def _sampling(engine: Engine, config: ModelConfig, work: Work) -> tuple[int, int]:
    """Of the first step, with what is prepared before it, and of a further one."""
    schedule = replace(work, steps=2).schedule(config)
    start = _empty(1, config.frames, config.vae.latent_channels, *_latent_size(config, work))
    given, so_far = _conditioning(config, work, schedule.branches), list[int]()
    with FlopCounterMode(display=False) as counter:
        options = RenderOptions(progress=lambda _, __: so_far.append(counter.get_total_flops()))
        engine.sample(start, given, schedule, options)
    first, second = so_far
    return first, second - first


def _conditioning(config: ModelConfig, work: Work, branches: int) -> Conditioning:
    frames, unet = config.frames, config.unet
    return Conditioning(
        vector=_empty(frames, unet.vector_width),
        camera=_empty(frames, unet.camera_width) if unet.camera_width else None,
        tokens=None if unet.context_width is None else _empty(branches * frames, unet.context_width),
        latents=_empty(branches * frames, unet.condition_channels, *_latent_size(config, work)),
        branches=branches,
    )


def _latent_size(config: ModelConfig, work: Work) -> tuple[int, int]:
    return work.height // config.vae.down_factor, work.width // config.vae.down_factor


def _counted(work: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def _empty(*shape: int) -> Tensor:
    return torch.empty(shape, device=_META)
