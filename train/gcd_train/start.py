"""Where training starts: at random, from a weight file of any layout, or from scratch as the paper's ablation does.

A file is told by its content. `svd.safetensors` and a diffusers folder have no camera embedder, so that one starts at
random; a GCD checkpoint gives its own where it is steered alike. A diffusers folder has one encoder for all frames,
the paper's networks have two: both are made of it.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from gcd_model import ModelConfig, weights_path
from gcd_model.errors import CheckpointError
from gcd_model.networks import LoadedWeights, Networks
from gcd_model.weights.adapter import DIFFUSION, carried_over
from gcd_model.weights.load import load_weights
from gcd_train.errors import RecipeError
from gcd_train.recipe import ModelRecipe


def fresh_networks(config: ModelConfig, seed: int) -> Networks:
    """Networks as training starts with them: zero-initialised layers are zero."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Networks(config)


def start_networks(recipe: ModelRecipe, config: ModelConfig, seed: int) -> Networks:
    """What training starts from: random, or the recipe's weight file in float32 with what it lacks at random.

    Raises RecipeError if the file is missing, or holds another model, whose first weights that differ are named;
    CheckpointError as `load_weights`.
    """
    if recipe.weights is None:
        return fresh_networks(config, seed)
    if ":" not in recipe.weights and not Path(recipe.weights).exists():
        raise RecipeError(f"model.weights, {recipe.weights}, is not there; give its place: --set model.weights=FILE")
    networks = fresh_networks(config, seed)
    loaded = loaded_base(recipe.weights)
    try:
        over = carried_over(loaded.diffusion, config, anew=DIFFUSION if recipe.scratch else ())
    except CheckpointError as error:
        raise RecipeError(
            f"{recipe.weights} {error}; change [model], or give a file of the model it describes"
        ) from error
    networks.load_state_dict({name: value.float() for name, value in over.weights.items()}, strict=False)
    return networks


def carried_leftovers(recipe: ModelRecipe) -> Mapping[str, Tensor]:
    """Weights of the file training started from that nothing here uses; see gcd_model.weights.save."""
    return {} if recipe.weights is None else loaded_base(recipe.weights).carried


def loaded_base(path: str) -> LoadedWeights:
    """A weight file of any layout, or `package:NAME`, whatever its family. Raises CheckpointError."""
    return load_weights(weights_path(path), ask_family=False)
