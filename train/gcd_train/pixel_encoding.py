"""The frozen networks on the frames of a batch: fresh augmentation noise, targets drawn from their posterior."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from gcd_model.image_encoder import clip_pixels
from gcd_model.networks import Networks
from gcd_train.recipe import UNetRecipe
from gcd_train.training.draws import Draws
from gcd_train.training.losses import COLOUR_WEIGHTS, class_emphasis

Made = TypeVar("Made")

_AT_ONCE = 14  # frames; changes memory, not the result


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedFrames:
    """N frames. target: [N, C, h, w], scaled. source: [N, C, h, w], not scaled. tokens: [N, D] or None.

    emphasis: [N, 1, h, w] of `class_emphasis`, or None.
    """

    target: Tensor
    source: Tensor
    tokens: Tensor | None
    emphasis: Tensor | None


@torch.no_grad()
def encode_frames(
    networks: Networks, recipe: UNetRecipe, source: Tensor, target: Tensor, draws: Draws
) -> EncodedFrames:
    """What the frozen networks make of frames [N, 3, H, W] in [-1, 1].

    The augmentation is noise on the pixels that the condition encoder sees, and on nothing else; the image tower sees
    clean frames. Source: Generative Camera Dolly, as released.
    """
    noisy = source + recipe.augmentation * draws.normal(*source.shape)
    moments = [_in_kept_precision(networks.target_encoder, frames) for frames in target.split(_AT_ONCE)]
    unit = draws.normal(target.shape[0], *moments[0].mean.shape[1:])
    parts = zip(moments, unit.split(_AT_ONCE), strict=True)
    latents = torch.cat([part.sample(noise).float() for part, noise in parts]) * networks.config.vae.scale
    by_colour = COLOUR_WEIGHTS[recipe.loss.class_weights]
    size = (latents.shape[-2], latents.shape[-1])
    return EncodedFrames(
        target=latents,
        source=_in_parts(lambda frames: _in_kept_precision(networks.condition_encoder, frames).mean, noisy),
        tokens=_tokens(networks, source),
        emphasis=class_emphasis(target, by_colour, size) if by_colour else None,
    )


def _tokens(networks: Networks, source: Tensor) -> Tensor | None:
    tower = networks.image_encoder
    if tower is None:
        return None
    size = tower.config.image_size
    return _in_parts(lambda frames: _in_kept_precision(tower, clip_pixels(frames, size)), source)


def _in_parts(network: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    return torch.cat([network(part).float() for part in frames.split(_AT_ONCE)])


def _in_kept_precision(network: Callable[[Tensor], Made], frames: Tensor) -> Made:
    """What a network makes of frames in the precision its weights are kept in."""
    assert isinstance(network, nn.Module), "weights are asked for their precision"
    return network(frames.to(next(network.parameters()).dtype))
