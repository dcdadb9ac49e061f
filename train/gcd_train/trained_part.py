"""Which part of the networks the U-Net stage trains; everything else stays bit for bit what it was."""

from typing import Any

from torch import nn

from gcd_model.networks import Networks
from gcd_train.lora import add_lora, is_adapted
from gcd_train.recipe import ModelRecipe

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
