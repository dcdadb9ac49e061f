"""Which part of the networks the U-Net stage trains: all of it, its temporal layers, or low-rank adapters."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.layers import Attention, FeedForward, TokenAttention
from gcd_model.networks import Networks
from gcd_model.weights.adapter import DOWN, UP, Adapter, added
from gcd_model.weights.card import Card
from gcd_train.recipe import LoraRecipe, ModelRecipe
from gcd_train.training.distributed import whole

_ALL = ("unet.", "camera.")
_CAMERA = ("camera.", "unet.embed_camera.")
_TEMPORAL = (".temporal.", ".positions.", ".share.")
_DORMANT = ".dormant."


def let_train(networks: Networks, recipe: ModelRecipe, seed: int) -> None:
    """Let the recipe's part of the networks take gradients, and no other; adapters are put in place for "lora".

    As published ("all"): the whole U-Net and the camera embedder; image tower and both autoencoders stay frozen.
    """
    if recipe.train == "lora":
        add_lora(networks, recipe.lora, seed)
    for name, parameter in networks.named_parameters():
        parameter.requires_grad_(is_trained(name, recipe))


def halve_frozen(networks: nn.Module) -> None:
    """Keep what takes no gradients in bfloat16, in place; published weights that cannot matter stay as they are."""
    for name, parameter in networks.named_parameters():
        if not parameter.requires_grad and _DORMANT not in name:
            parameter.data = parameter.data.bfloat16()


def thaw(networks: Networks) -> None:
    """Undo `let_train` for the stages that follow: every parameter may take gradients but those that cannot matter."""
    for name, parameter in networks.named_parameters():
        parameter.requires_grad_(_DORMANT not in name)


def is_trained(name: str, recipe: ModelRecipe) -> bool:
    """Whether the U-Net stage changes the parameter of that name in `Networks`."""
    if not name.startswith(_ALL) or _DORMANT in name:
        return False
    if recipe.train == "lora":
        return is_adapted(name, recipe.lora)
    return recipe.train == "all" or is_temporal(name) or name.startswith(_CAMERA)


def is_temporal(name: str) -> bool:
    """Whether a parameter of the U-Net works across frames: layers, frame positions, the share of space and time."""
    return name.startswith("unet.") and any(part in name for part in _TEMPORAL)


def keep_trained_alone(module: nn.Module) -> None:
    """Let a module's state hold only what takes gradients, so that states on disk are as small as what is trained.

    The published weights that cannot matter count as trained: they stay in the state of a whole U-Net.
    """
    frozen = {n for n, parameter in module.named_parameters() if not parameter.requires_grad and _DORMANT not in n}
    if not frozen:
        return
    frozen |= {name for name, _ in module.named_parameters() if _DORMANT in name}

    def leave_out(_module: nn.Module, state: dict[str, Any], prefix: str, _metadata: object) -> None:
        for name in frozen:
            state.pop(prefix + name, None)

    def expect_none(_module: nn.Module, keys: Any) -> None:  # torch's named tuple of lists has no public name
        keys.missing_keys[:] = [name for name in keys.missing_keys if name not in frozen]

    module.register_state_dict_post_hook(leave_out)
    module.register_load_state_dict_post_hook(expect_none)


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
        for parent in list(networks.unet.modules()):
            for name in _LAYERS.get(type(parent), ()):
                layer = getattr(parent, name)
                assert isinstance(layer, nn.Linear), f"{name} is no linear layer"
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
    if name.startswith(_CAMERA):
        return recipe.camera
    return recipe.stem and name.startswith("unet.stem.")
