"""Low-rank adapters on the U-Net: a few weights beside each linear layer, trained while the layer itself stays.

    y = W x + b + alpha / rank * up (down x),    down [rank, in] random, up [out, rank] zero at the start

On query, key, value and output of every self-attention, within frames and across them, on value and output of the
image token's attention, and on both layers of every feed-forward network. Query and key of the image token's attention
are left out: with one token they cannot change anything.

Source: Hu et al. 2022, "LoRA: Low-Rank Adaptation of Large Language Models", section 4.1.
"""

import math
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.layers import Attention, FeedForward, TokenAttention
from gcd_model.networks import Networks
from gcd_model.weights.adapter import DOWN, UP, Adapter, added
from gcd_model.weights.card import Card
from gcd_train.engine.parallel import whole
from gcd_train.recipe import LoraRecipe

_LAYERS: dict[type[nn.Module], tuple[str, ...]] = {
    Attention: ("query", "key", "value", "out"),
    TokenAttention: ("value", "out"),
    FeedForward: ("expand", "contract"),
}


class LowRankLinear(nn.Linear):
    """A linear layer and its adapter. weight, bias: the layer's own. down: [rank, in]. up: [out, rank]."""

    def __init__(self, base: nn.Linear, rank: int, alpha: float) -> None:
        super().__init__(base.in_features, base.out_features, bias=False, device="meta")
        self.weight, self.bias = base.weight, base.bias
        self.scale = alpha / rank
        self.down = nn.Parameter(base.weight.new_empty(rank, base.in_features, dtype=torch.float32))
        self.up = nn.Parameter(base.weight.new_zeros(base.out_features, rank, dtype=torch.float32))
        nn.init.kaiming_uniform_(self.down, a=math.sqrt(5))

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  the name in torch
        """[..., in] -> [..., out]."""
        beside = F.linear(F.linear(input, self.down.to(input.dtype)), self.up.to(input.dtype))
        return F.linear(input, self.weight, self.bias) + self.scale * beside

    def merged(self) -> Tensor:
        """The weight of the plain layer that computes the same, [out, in]."""
        return added(whole(self.weight), whole(self.up), whole(self.down), self.scale)


def alpha_of(recipe: LoraRecipe) -> float:
    """What the recipe's alpha is."""
    return float(recipe.rank) if recipe.alpha is None else recipe.alpha


def add_lora(networks: Networks, recipe: LoraRecipe, seed: int) -> None:
    """Put adapters beside the U-Net's layers, in place; the networks compute what they did before."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for parent, name, layer in list(_adaptable(networks.unet)):
            setattr(parent, name, LowRankLinear(layer, recipe.rank, alpha_of(recipe)))


def merge_lora(networks: Networks) -> None:
    """Turn adapters and their layers into plain layers, in place; nothing to do without adapters."""
    for parent in list(networks.unet.modules()):
        for name, layer in list(parent.named_children()):
            if isinstance(layer, LowRankLinear):
                plain = nn.Linear(layer.in_features, layer.out_features, bias=False, device="meta")
                plain.weight, plain.bias = nn.Parameter(layer.merged()), layer.bias
                setattr(parent, name, plain)


def plain_weights(networks: Networks) -> dict[str, Tensor]:
    """All weights by name as they would be without adapters, those merged in. Where processes share them, all ask."""
    layers = {name: layer for name, layer in networks.named_modules() if isinstance(layer, LowRankLinear)}
    factors = {f"{name}{end}" for name in layers for end in (UP, DOWN)}
    state = {name: whole(value) for name, value in networks.state_dict().items() if name not in factors}
    return state | {f"{name}.weight": layer.merged().detach() for name, layer in layers.items()}


def adapter_of(networks: Networks, recipe: LoraRecipe, card: Card, base: str) -> Adapter:
    """What was trained beside a base, on its own. base: `base_digest` of the networks before training."""
    trained = {name: value.detach() for name, value in networks.named_parameters() if is_adapted(name, recipe)}
    return Adapter(rank=recipe.rank, alpha=alpha_of(recipe), base=base, card=card, tensors=trained)


def is_adapted(name: str, recipe: LoraRecipe) -> bool:
    """Whether training with adapters changes the parameter of that name."""
    if name.startswith("unet.") and name.endswith((UP, DOWN)):
        return True
    if name.startswith(("camera.", "unet.embed_camera.")):
        return recipe.camera
    return recipe.stem and name.startswith("unet.stem.")


def _adaptable(unet: nn.Module) -> Iterator[tuple[nn.Module, str, nn.Linear]]:
    for parent in unet.modules():
        for name in _LAYERS.get(type(parent), ()):
            layer = getattr(parent, name)
            assert isinstance(layer, nn.Linear), f"{name} is no linear layer"
            yield parent, name, layer
