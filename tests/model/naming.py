"""Weights of our modules under the published names, so that other implementations can load them.

The names come from the tables that load checkpoints, read the other way round; those are tested against the
published lists elsewhere.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from gcd_model.config import ImageEncoderConfig, UNetConfig, VAEConfig
from gcd_model.unet import VideoUNet
from gcd_model.weights.names import GCD_UNET, Levels, Source, diffusers_source, gcd_source


def levels_of(
    unet: UNetConfig | None = None, vae: VAEConfig | None = None, tower: ImageEncoderConfig | None = None
) -> Levels:
    """The counts that block numbers depend on, where only one network is at hand."""
    return Levels(
        attention=() if unet is None else unet.attention,
        unet_blocks=0 if unet is None else unet.blocks_per_level,
        vae_levels=0 if vae is None else len(vae.multipliers),
        vae_blocks=0 if vae is None else vae.blocks_per_level,
        image_layers=0 if tower is None else tower.layers,
    )


def released_unet(unet: VideoUNet, *, gradients: bool = False) -> dict[str, Tensor]:
    """Weights (or gradients, where there is one) as the released code calls them: `input_blocks.0.0.weight`."""
    levels, released = levels_of(unet=unet.config), dict[str, Tensor]()
    for name, parameter in unet.named_parameters():
        source = gcd_source(f"unet.{name}", levels)
        assert source is not None
        value = parameter.grad if gradients else parameter.detach()
        if value is not None:
            released[source.names[0].removeprefix(f"{GCD_UNET}.")] = value
    return released


def diffusers_state(module: nn.Module, own: str, folder: str, levels: Levels) -> dict[str, Tensor]:
    """State of the diffusers (or transformers) module that corresponds to ours.

    own: what `Networks` calls our module. folder: what precedes the names of theirs, "unet/".
    """
    state = dict[str, Tensor]()
    for name, value in module.state_dict().items():
        source = diffusers_source(f"{own}.{name}", levels)
        assert source is not None, f"diffusers has no {own}.{name}"
        state |= {published.removeprefix(folder): part for published, part in taken_apart(value, source).items()}
    return state


def taken_apart(tensor: Tensor, source: Source) -> dict[str, Tensor]:
    """The published tensors that make one of ours: the inverse of `assembled`."""
    if source.form == "stacked":
        return dict(zip(source.names, (part.clone() for part in tensor.chunk(3)), strict=True))
    if source.form == "transposed":
        return {source.names[0]: tensor.T.contiguous()}
    return {source.names[0]: tensor[:, :, 0, 0].contiguous() if source.form == "pixelwise" else tensor.clone()}


def on_meta(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The same shapes without storage (weights that never leave the host included)."""
    return {name: torch.empty_like(value, device="meta") for name, value in weights.items()}
