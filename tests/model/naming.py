"""Weights of our modules under the published names, so that other implementations can load them.

The names come from the table that loads checkpoints, read the other way round; it is tested against the published lists
elsewhere.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from gcd_model.unet import VideoUNet
from gcd_model.weights.names import GCD_UNET, Levels, published_names, taken_apart


def released_unet(unet: VideoUNet, *, gradients: bool = False) -> dict[str, Tensor]:
    """Weights (or gradients, where there is one) as the released code calls them: `input_blocks.0.0.weight`."""
    levels = Levels(attention=unet.config.attention, unet_blocks=unet.config.blocks_per_level)
    released = dict[str, Tensor]()
    for name, parameter in unet.named_parameters():
        value = parameter.grad if gradients else parameter.detach()
        if value is not None:
            released[published_names(f"unet.{name}", "gcd", levels)[0].removeprefix(f"{GCD_UNET}.")] = value
    return released


def diffusers_state(module: nn.Module, own: str, folder: str) -> dict[str, Tensor]:
    """State of the diffusers (or transformers) module that corresponds to ours.

    own: what `Networks` calls our module. folder: what precedes the names of theirs, "unet/".
    """
    state = dict[str, Tensor]()
    for name, value in module.state_dict().items():
        parts = taken_apart(published_names(f"{own}.{name}", "diffusers", Levels()), value)
        state |= {published.removeprefix(folder): part for published, part in parts.items()}
    return state


def on_meta(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same shapes without storage (weights that never leave the host included)."""
    return {name: torch.empty_like(value, device="meta") for name, value in weights.items()}
