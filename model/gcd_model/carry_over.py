"""Weights of one model as the start of another of the same architecture. Pure: no file, no random numbers.

What may differ: the camera control (its embedder is then left out or starts anew), and whether one autoencoder serves
source and target frames, as in a diffusers folder, or two do, as published.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError
from gcd_model.networks import Networks, empty_networks

CAMERA = ("camera.", "unet.embed_camera.")
"""How names of the camera embedder and of its MLP in the U-Net begin."""

DIFFUSION = ("unet.", "camera.")
"""What the paper's "from scratch" leaves at random: the U-Net and the camera embedder."""

_ENCODER, _SECOND_ENCODER, _QUANT = "target_encoder.", "own_condition_encoder.", "target_encoder.quant."


@dataclass(frozen=True, slots=True)
class CarriedOver:
    """weights: by our names, as they are stored. fresh: names of the new model that nothing was found for."""

    weights: dict[str, Tensor]
    fresh: tuple[str, ...]


def carried_over(networks: Networks, config: ModelConfig, *, anew: tuple[str, ...] = ()) -> CarriedOver:
    """What a model of that config takes over from these networks.

    Args:
        anew: beginnings of names that are to start anew, whatever is there.
    Raises:
        CheckpointError: they are of another architecture; names the first weights that are missing, superfluous or
            of another shape.
    """
    given: Mapping[str, Tensor] = networks.state_dict()
    if networks.config.vae.shared and not config.vae.shared:
        given = unshared(given)
    if networks.config.camera != config.camera:
        anew = (*anew, *CAMERA)
    wanted = empty_networks(config).state_dict()
    fresh = tuple(name for name in wanted if name.startswith(anew))
    weights = {name: tensor for name, tensor in given.items() if not name.startswith(anew)}
    _require_fit(weights, {name: tensor for name, tensor in wanted.items() if not name.startswith(anew)})
    return CarriedOver(weights, fresh)


def _require_fit(given: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> None:
    missing = [name for name in wanted if name not in given]
    unknown = [name for name in given if name not in wanted]
    misshapen = [
        f"{name} wants {list(wanted[name].shape)}, got {list(tensor.shape)}"
        for name, tensor in given.items()
        if name in wanted and tensor.shape != wanted[name].shape
    ]
    faults = [
        f"{len(names)} weights are {what}, first: {names[0]}"
        for what, names in (("missing", missing), ("superfluous", unknown), ("misshapen", misshapen))
        if names
    ]
    if faults:
        raise CheckpointError(f"holds another model than is wanted: {'; '.join(faults)}")


def unshared(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of a model whose one encoder serves all frames, as those of a model with two; the same functions.

    The published target encoder has no 1x1 convolution at its end: it is multiplied into the last one before it. The
    condition encoder keeps it.
    """
    encoder = {name: tensor for name, tensor in weights.items() if name.startswith(_ENCODER)}
    others = {name: tensor for name, tensor in weights.items() if name not in encoder}
    second = {name.replace(_ENCODER, _SECOND_ENCODER, 1): tensor for name, tensor in encoder.items()}
    target = {name: tensor for name, tensor in encoder.items() if not name.startswith(_QUANT)}
    target |= _folded(encoder)
    return others | target | second


def _folded(encoder: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The encoder's last convolution and the 1x1 convolution after it, as one; multiplied in double precision."""
    names = [f"{_ENCODER}conv_out.{leaf}" for leaf in ("weight", "bias")]
    weight, bias = (encoder[name] for name in names)
    mix, shift = (encoder[f"{_QUANT}{leaf}"].double() for leaf in ("weight", "bias"))
    mix = mix[:, :, 0, 0]
    folded = torch.einsum("om,mihw->oihw", mix, weight.double())
    return {names[0]: folded.to(weight.dtype), names[1]: (mix @ bias.double() + shift).to(bias.dtype)}
