"""Low-rank adapters: what a finetuning adds to the weights of a base model, kept apart from them. Opens nothing.

    weight = base weight + alpha / rank * up @ down

Source: Hu et al. 2022, "LoRA: Low-Rank Adaptation of Large Language Models", section 4.1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import msgspec
import torch
from torch import Tensor

from gcd_model.carry_over import CAMERA, carried_over
from gcd_model.errors import CheckpointError, FileError
from gcd_model.networks import Networks, empty_networks, weights_digest
from gcd_model.own_format import Card
from gcd_model.small_files import decode_json

ADAPTER_KEY = "gcd.adapter"
"""Metadata that only adapter files have."""

DOWN, UP = ".down", ".up"
"""Endings of an adapted layer's two factors, after the layer's own name."""

_MOST_ALPHA = 1e6  # anything near the end of float32 makes weights infinite


class _Facts(msgspec.Struct, frozen=True, kw_only=True):
    rank: Annotated[int, msgspec.Meta(ge=1)]
    alpha: Annotated[float, msgspec.Meta(ge=-_MOST_ALPHA, le=_MOST_ALPHA)]
    base: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Adapter:
    """What is added to a base model.

    base: `base_digest` of the weights it was trained on. card: of base and adapter together.
    tensors: `LAYER.down` [rank, in] and `LAYER.up` [out, rank] of linear layers, and whole weights that replace the
        base's under their own names, such as the camera embedder.
    """

    rank: int
    alpha: float
    base: str
    card: Card
    tensors: Mapping[str, Tensor]

    def to_metadata(self) -> dict[str, str]:
        """As safetensors metadata: text to text."""
        facts = _Facts(rank=self.rank, alpha=self.alpha, base=self.base)
        return self.card.to_metadata() | {ADAPTER_KEY: msgspec.json.encode(facts).decode()}

    @classmethod
    def of_file(cls, metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> Self:
        """Raises CheckpointError if it is no adapter, or damaged."""
        if ADAPTER_KEY not in metadata:
            raise CheckpointError(
                "is no adapter; wanted is a file that `gcd-train train` wrote with model.train = lora"
            )
        try:
            facts = decode_json(metadata[ADAPTER_KEY], _Facts)
        except FileError as error:
            raise CheckpointError(f"its metadata {error}; export the adapter again") from error
        card = Card.from_metadata(metadata)
        return cls(rank=facts.rank, alpha=facts.alpha, base=facts.base, card=card, tensors=tensors)


def base_digest(weights: Mapping[str, Tensor]) -> str:
    """Twelve digits that name the U-Net an adapter stands on, whatever layout it lies in; float32 values count.

    The camera embedder does not: an adapter may bring its own.
    """
    counted = {
        name: tensor.float() for name, tensor in weights.items() if name.startswith("unet.") and not _is_camera(name)
    }
    return weights_digest(counted)


def adapted(networks: Networks, adapter: Adapter) -> Networks:
    """Base and adapter as plain networks, in the base's precision.

    Raises:
        CheckpointError: the adapter was trained on another base, or does not fit it.
    """
    digest = base_digest(networks.state_dict())
    if digest != adapter.base:
        raise CheckpointError(
            f"the adapter stands on the base {adapter.base}, these weights are {digest}; give the file it was "
            "trained from"
        )
    config = adapter.card.diffusion
    base = carried_over(networks, config)
    state = merged(base.weights, adapter)
    lacking = [name for name in base.fresh if name not in state]
    if lacking:
        raise CheckpointError(f"{len(lacking)} weights are neither in the base nor in the adapter, first: {lacking[0]}")
    result = empty_networks(config)
    result.load_state_dict(state, assign=True, strict=True)
    return result


def merged(weights: Mapping[str, Tensor], adapter: Adapter) -> dict[str, Tensor]:
    """Plain weights: the factors added in float32, whole weights put in place. Raises CheckpointError as `adapted`."""
    state, scale = dict(weights), adapter.alpha / adapter.rank
    layers = {name.removesuffix(UP) for name in adapter.tensors if name.endswith(UP)}
    for layer in layers:
        weight, up, down = (_found(source, f"{layer}{end}") for source, end in _parts(state, adapter.tensors))
        if weight.shape != (up.shape[0], down.shape[1]) or up.shape[1] != down.shape[0]:
            raise CheckpointError(
                f"{layer} is {list(weight.shape)}, its factors are {list(up.shape)} and {list(down.shape)}"
            )
        state[f"{layer}.weight"] = added(weight, up, down, scale)
    whole = {name: tensor for name, tensor in adapter.tensors.items() if not name.endswith((UP, DOWN))}
    known = empty_networks(adapter.card.diffusion).state_dict()
    for name, tensor in whole.items():
        if name not in known or known[name].shape != tensor.shape:
            raise CheckpointError(f"the adapter holds {name} {list(tensor.shape)}, which the model does not have")
    return state | whole


def added(weight: Tensor, up: Tensor, down: Tensor, scale: float) -> Tensor:
    """weight + scale * up @ down, computed in float32, in the weight's precision."""
    return torch.addmm(weight.float(), up.float(), down.float(), alpha=scale).to(weight.dtype)


def _parts(state: Mapping[str, Tensor], factors: Mapping[str, Tensor]) -> tuple[tuple[Mapping[str, Tensor], str], ...]:
    return (state, ".weight"), (factors, UP), (factors, DOWN)


def _found(source: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in source:
        raise CheckpointError(f"{name} is missing: the adapter does not belong to this model, or is damaged")
    return source[name]


def _is_camera(name: str) -> bool:
    return name.startswith(CAMERA)
