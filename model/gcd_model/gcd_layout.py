"""Weights under the published names of GCD's checkpoints, for those who run the released code. Opens nothing.

The names come from the table that reads such checkpoints. Besides what a model uses, published files hold weights that
nothing uses: they are carried over from the file training started from, and left out without one.
"""

from collections.abc import Mapping

import msgspec
from torch import Tensor

from gcd_model.architecture import Hints, gcd_levels, infer_config
from gcd_model.carry_over import unshared
from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.own_format import Card
from gcd_model.weight_names import Levels, gcd_source

CARRIED = ("CLIP text tower", "decoder of the condition VAE", "LPIPS")
"""Leftovers worth carrying from file to file; averages and tables of the old weights are not."""

NOTES = "gcd_node"
"""Where in a checkpoint's hyper-parameters our card stands."""

_LIGHTNING = "2.1.0"


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
    return {**carried, **state}


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
