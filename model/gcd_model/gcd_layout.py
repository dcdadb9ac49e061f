"""Weights under the published names of GCD's checkpoints, for those who run the released code. Opens nothing.

The names come from the table that reads such checkpoints. Besides what a model uses, published files hold weights that
nothing uses; they are carried over from the file training started from, or stood in for, so that a strict reader
finds every name. The VGG weights of LPIPS are never invented: without a file to take them from they are left out.
"""

from collections.abc import Mapping

import msgspec
import torch
from torch import Tensor

from gcd_model.architecture import Hints, gcd_levels, infer_config
from gcd_model.carry_over import unshared
from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.own_format import Card
from gcd_model.weight_names import GCD_CLIP, GCD_CONDITION_VAE, GCD_VAE, Levels, gcd_source

CARRIED = ("CLIP text tower", "decoder of the condition VAE", "LPIPS")
"""Leftovers worth carrying from file to file; averages and tables of the old weights are not."""

NOTES = "gcd_node"
"""Where in a checkpoint's hyper-parameters our card stands."""

_LIGHTNING = "2.1.0"
_WORDS, _TEXT_LENGTH = 49408, 77  # of CLIP's text tower
_ACROSS_FRAMES = (".time_stack.", ".mix_factor", ".time_mix_conv.")


def published_config(config: ModelConfig) -> ModelConfig:
    """The config as the published layout tells it: with one encoder for targets and one for conditions."""
    return msgspec.structs.replace(config, vae=msgspec.structs.replace(config.vae, shared=False))


def gcd_state(weights: Mapping[str, Tensor], config: ModelConfig, carried: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """All weights by published name.

    Args:
        weights: by our names. carried: leftovers of the file they came from, by published name.
    Raises:
        OptionError: the published layout cannot say this architecture.
    """
    if config.is_ours:
        raise OptionError("the published layout holds the paper's networks only; keep our own .safetensors for this")
    weights = unshared(weights) if config.vae.shared else weights
    levels, state = Levels.of(config), dict[str, Tensor]()
    for name, tensor in weights.items():
        source = gcd_source(name, levels)
        assert source is not None, f"{name} has no published name"
        state[source.names[0]] = tensor.detach()
    _require_told(state, published_config(config))
    return {**_stand_ins(state, config), **carried, **state}


def lightning_checkpoint(state: Mapping[str, Tensor], card: Card, updates: int) -> dict[str, object]:
    """What stands at the root of a Lightning checkpoint: plain containers and tensors, no optimizer state.

    updates: of the optimizer, so far.
    """
    return {
        "epoch": 0,
        "global_step": updates,
        "pytorch-lightning_version": _LIGHTNING,
        "state_dict": dict(state),
        "loops": {},
        "callbacks": {},
        "optimizer_states": [],
        "lr_schedulers": [],
        "hparams_name": "kwargs",
        "hyper_parameters": {NOTES: card.to_metadata()},
    }


def _require_told(state: Mapping[str, Tensor], config: ModelConfig) -> None:
    """Whether a reader of the names and shapes alone would build these networks."""
    shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
    try:
        told = infer_config(shapes, gcd_source, gcd_levels(shapes), Hints())
    except CheckpointError as error:
        raise OptionError(f"the published layout cannot say this architecture: {error}") from error
    wrong = [
        part for part in ("camera", "unet", "vae", "image_encoder") if getattr(told, part) != getattr(config, part)
    ]
    if wrong:
        raise OptionError(
            f"the published layout cannot say this architecture: its {wrong[0]} would be read as "
            f"{getattr(told, wrong[0])}; keep our own .safetensors for it"
        )


def _stand_ins(state: Mapping[str, Tensor], config: ModelConfig) -> dict[str, Tensor]:
    """Weights that nothing uses, for readers that want every name."""
    decoder = f"{GCD_VAE}.decoder."
    stand_ins = {
        name.replace(GCD_VAE, GCD_CONDITION_VAE, 1): tensor
        for name, tensor in state.items()
        if name.startswith(decoder) and not any(part in name for part in _ACROSS_FRAMES)
    }
    like = state[f"{decoder}conv_in.weight"]
    stand_ins[f"{GCD_CONDITION_VAE}.post_quant_conv.weight"] = torch.eye(like.shape[1]).to(like)[..., None, None]
    stand_ins[f"{GCD_CONDITION_VAE}.post_quant_conv.bias"] = like.new_zeros(like.shape[1])
    if config.image_encoder is None:
        return stand_ins
    width = config.image_encoder.output_width
    shapes = {
        "positional_embedding": (_TEXT_LENGTH, width),
        "text_projection": (width, width),
        "logit_scale": (),
        "token_embedding.weight": (_WORDS, width),
        "ln_final.weight": (width,),
        "ln_final.bias": (width,),
    }
    return stand_ins | {f"{GCD_CLIP}.{name}": like.new_zeros(shape) for name, shape in shapes.items()}
