"""Low-rank adapters: what a finetuning adds to the weights of a base model, kept apart from them. Opens nothing.

    weight = base weight + alpha / rank * up @ down

Source: Hu et al. 2022, "LoRA: Low-Rank Adaptation of Large Language Models", section 4.1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Self

import msgspec
import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, FileError
from gcd_model.networks import Networks, empty_networks, weights_digest
from gcd_model.small_files import decode_json
from gcd_model.weights.card import ADAPTER_KEY, Card
from gcd_model.weights.infer import match_weights, shapes_of

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
    counted = {name: each for name, each in weights.items() if name.startswith("unet.") and not name.startswith(CAMERA)}
    return weights_digest({name: tensor.float() for name, tensor in counted.items()})


def adapted(networks: Networks, adapter: Adapter) -> Networks:
    """Base and adapter as plain networks, in the base's precision.

    Raises:
        CheckpointError: the adapter was trained on another base, or does not fit it.
    """
    config = adapter.card.diffusion
    digest = base_digest(widened(networks.state_dict(), config))
    if digest != adapter.base:
        raise CheckpointError(
            f"the adapter stands on the base {adapter.base}, these weights are {digest}; give the file it was "
            "trained from"
        )
    result, base = empty_networks(config), carried_over(networks, config)
    state, tensors, known = dict(base.weights), adapter.tensors, shapes_of(result.state_dict())
    for name, tensor in tensors.items():
        if not name.endswith((UP, DOWN)):
            if known.get(name) != tensor.shape:
                raise CheckpointError(f"the adapter holds {name} {list(tensor.shape)}, which the model does not have")
            state[name] = tensor
    for layer in {name.removesuffix(UP) for name in tensors if name.endswith(UP)}:
        weight, up, down = base.weights.get(f"{layer}.weight"), tensors[layer + UP], tensors.get(layer + DOWN)
        if weight is None or down is None or down.ndim != 2 or up.shape != (len(weight), len(down)):
            raise CheckpointError(f"{layer} is not whole: the adapter does not belong to this model, or is damaged")
        if weight.shape != (len(up), down.shape[1]):
            raise CheckpointError(f"{layer} does not fit: the adapter does not belong to this model, or is damaged")
        state[f"{layer}.weight"] = added(weight, up, down, adapter.alpha / adapter.rank)
    lacking = [name for name in base.fresh if name not in state]
    if lacking:
        raise CheckpointError(f"{len(lacking)} weights are neither in the base nor in the adapter, first: {lacking[0]}")
    result.load_state_dict(state, assign=True, strict=True)
    return result


def added(weight: Tensor, up: Tensor, down: Tensor, scale: float) -> Tensor:
    """weight + scale * up @ down, computed in float32, in the weight's precision."""
    return torch.addmm(weight.float(), up.float(), down.float(), alpha=scale).to(weight.dtype)


# --- weights of one model as the start of another --------------------------------------------------------------------


CAMERA = ("camera.", "unet.embed_camera.")
"""How names of the camera embedder and of its MLP in the U-Net begin."""

DIFFUSION = ("unet.", "camera.")
"""What the paper's "from scratch" leaves at random: the U-Net and the camera embedder."""


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
    given = widened(networks.state_dict(), config)
    if networks.config.vae.shared and not config.vae.shared:
        given = unshared(given)
    if networks.config.camera != config.camera:
        anew = (*anew, *CAMERA)
    wanted = empty_networks(config).state_dict()
    fresh = tuple(name for name in wanted if name.startswith(anew))
    weights = {name: tensor for name, tensor in given.items() if not name.startswith(anew)}
    expected = {name: shape for name, shape in shapes_of(wanted).items() if name not in fresh}
    try:
        match_weights({name: (name,) for name in expected}, expected, shapes_of(weights))
    except CheckpointError as error:
        raise CheckpointError(f"holds another model than is wanted: {error}") from error
    return CarriedOver(weights, fresh)


def widened(weights: Mapping[str, Tensor], config: ModelConfig) -> Mapping[str, Tensor]:
    """Weights of a model without a splat as those of one with it, whose channels start at zero: the same function."""
    stem = "unet.stem.weight"
    channels = config.unet.latent_channels, config.unet.condition_channels
    if config.splat == "none" or weights[stem].shape[1] != 2 * channels[0]:
        return weights
    return {**weights, stem: F.pad(weights[stem], (0, 0, 0, 0, 0, sum(channels) - 2 * channels[0]))}


def unshared(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of a model whose one encoder serves all frames, as those of a model with two; the same functions.

    The published target encoder has no 1x1 convolution at its end: it is multiplied into the last one before it, in
    double precision. The condition encoder keeps it.
    """
    own, quant = "target_encoder.", "target_encoder.quant."
    second = {n.replace(own, "own_condition_encoder.", 1): w for n, w in weights.items() if n.startswith(own)}
    target = {name: tensor for name, tensor in weights.items() if not name.startswith(quant)}
    weight, bias = (f"{own}conv_out.{leaf}" for leaf in ("weight", "bias"))
    mix, shift = (weights[f"{quant}{leaf}"].double() for leaf in ("weight", "bias"))
    mix = mix[:, :, 0, 0]
    target[weight] = torch.einsum("om,mihw->oihw", mix, weights[weight].double()).to(weights[weight].dtype)
    target[bias] = (mix @ weights[bias].double() + shift).to(weights[bias].dtype)
    return target | second
