"""From a recipe to networks, and from a run's stages back to one set of weights."""

import hashlib
from collections.abc import Mapping

import msgspec
import torch
from torch import Tensor, nn

from gcd_model import FAMILIES, SMALL, SVD_14, Family, ModelConfig
from gcd_model.checkpoints import load_weights
from gcd_model.config import DRIVING_SMALL
from gcd_model.errors import OptionError
from gcd_model.geometry import driving_trajectory
from gcd_model.networks import Networks
from gcd_model.plane_warp import PathWarps, trained_mount
from gcd_train.checkpoint import load_state, require_identity
from gcd_train.errors import RecipeError, RunError
from gcd_train.recipe import ComputeRecipe, ModelRecipe, StageName, UNetChanges, UNetRecipe, VAEChanges
from gcd_train.run_folder import RunFolder

_BASES: dict[str, ModelConfig] = {"driving-small": DRIVING_SMALL, "svd-14": SVD_14, "small": SMALL}
_PREFIXES: dict[StageName, tuple[str, ...]] = {
    "vae": ("target_encoder.", "decoder."),
    "unet": ("unet.", "class_head.", "camera."),
    "decoder": ("plane_mix.",),
}


def model_config(recipe: ModelRecipe) -> ModelConfig:
    """The networks a recipe asks for. Raises RecipeError where its changes contradict each other."""
    base = _BASES[recipe.base]
    try:
        changed = msgspec.structs.replace(
            base,
            unet=msgspec.structs.replace(base.unet, **_given(recipe.unet)),
            vae=msgspec.structs.replace(base.vae, **_given(recipe.vae)),
            prediction=recipe.prediction or base.prediction,
            frames=recipe.frames or base.frames,
            height=recipe.height or base.height,
            width=recipe.width or base.width,
        )
        # msgspec does not check what `replace` makes; a round trip does
        return msgspec.json.decode(msgspec.json.encode(changed), type=ModelConfig)
    except (OptionError, msgspec.ValidationError) as error:
        raise RecipeError(f"the recipe's [model] cannot be built: {error}") from error


def sampled_as_trained(config: ModelConfig, recipe: UNetRecipe) -> ModelConfig:
    """The config with the sampler that suits the recipe's noise: what ships is used as it was trained.

    Raises RecipeError if the sampler visits noise levels that the recipe never trains.
    """
    sampling, noise = config.sampling, recipe.noise
    if noise.fixed_share == 1 and (sampling.steps, sampling.sigma_max) != (1, noise.fixed_sigma):
        raise RecipeError(
            f"the recipe trains sigma {noise.fixed_sigma:g} alone, the model is sampled in {sampling.steps} steps from "
            f"{sampling.sigma_max:g}: lower unet.noise.fixed_share, or take a base model of one step from that sigma"
        )
    shared = sampling.shared_noise if 0 < noise.shared < 1 else noise.shared == 1
    sampling = msgspec.structs.replace(sampling, augmentation=recipe.augmentation, shared_noise=shared)
    return msgspec.structs.replace(config, sampling=sampling)


def family_of(recipe: ModelRecipe) -> Family:
    """How the model is trained. Raises RecipeError for a family without one fixed view."""
    family = FAMILIES.get(recipe.family)
    if family is None or family.camera != "none" or family.motion_bucket is None:
        raise RecipeError(
            f"model.family must be one with a fixed view (driving, driving-semantic), got {recipe.family!r}; "
            "steered families come with their data sets"
        )
    return family


def digest_of(*values: object) -> str:
    """Eight digits that name plain values or structs: what a state belongs to."""
    return hashlib.sha256(msgspec.json.encode(values, order="deterministic")).hexdigest()[:8]


def weights_digest(weights: Mapping[str, Tensor]) -> str:
    """Twelve digits that name weights."""
    total = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        total.update(name.encode())
        total.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return total.hexdigest()[:12]


def compute_device(recipe: ComputeRecipe) -> torch.device:
    """Where to compute. Raises RecipeError if CUDA is asked for and missing."""
    there = torch.cuda.is_available()
    if recipe.device == "cuda" and not there:
        raise RecipeError('compute.device is "cuda" but this machine has no CUDA device; use "auto" or "cpu"')
    return torch.device("cuda" if there and recipe.device != "cpu" else "cpu")


def to_channels_last(module: nn.Module) -> None:
    """Let 2D convolution kernels have their channels innermost: faster on the CPU and with half precision."""
    for parameter in module.parameters():
        if parameter.ndim == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)


def path_warps(config: ModelConfig, device: torch.device) -> PathWarps | None:
    """The warps along the driving path for the trained mount; None for a model that does not warp."""
    plane = config.plane_warp
    if plane is None:
        return None
    mount = trained_mount(plane)
    path = driving_trajectory(frames=config.frames, move_time=config.frames - 1, mount=mount)
    warps = PathWarps(plane, mount, path, config.height, config.width, down_factor=config.vae.down_factor)
    return warps.to(device)


def fresh_networks(config: ModelConfig, seed: int) -> Networks:
    """Networks as training starts with them: zero-initialised layers are zero."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Networks(config)


def start_networks(recipe: ModelRecipe, config: ModelConfig, seed: int) -> Networks:
    """What training starts from: random, or the recipe's weight file in float32.

    Raises RecipeError if the file holds another model; CheckpointError as `load_weights`.
    """
    networks = fresh_networks(config, seed)
    if recipe.weights is None:
        return networks
    state = load_weights(recipe.weights, family=recipe.family).networks.state_dict()
    wanted = networks.state_dict()
    wrong = sorted(set(state) ^ set(wanted)) or [n for n, value in state.items() if value.shape != wanted[n].shape]
    if wrong:
        raise RecipeError(
            f"{recipe.weights} holds another model than [model] describes: {len(wrong)} weights differ, "
            f"first {wrong[0]}; change [model], or give a file of that shape"
        )
    networks.load_state_dict({name: value.float() for name, value in state.items()})
    return networks


def fill(networks: Networks, folder: RunFolder, stage: StageName, identity: str) -> None:
    """Copy what a stage trained into networks, averaged where it averages.

    identity: what its state must belong to. Raises RunError if it has not run, or if identity, names or shapes do not
    fit.
    """
    path = folder.state(stage)
    if not path.exists():
        raise RunError(f"{path} is missing: run `gcd-train train ... --stage {stage}` first")
    state = load_state(path, stage)
    require_identity(path, state, identity)
    known, best = networks.state_dict(), state.best
    given = {name: value for name, value in best.items() if name in known}
    lacking = sorted(name for name in known if name.startswith(_PREFIXES.get(stage, ())) and name not in given)
    wrong = [name for name, value in given.items() if value.shape != known[name].shape]
    if lacking or wrong:
        raise RunError(
            f"{path} does not fit the model: {len(lacking)} weights missing, {len(wrong)} of another shape, first: "
            f"{(lacking + wrong)[0]}; use the recipe it was trained with"
        )
    networks.load_state_dict(given, strict=False)


def _given(changes: UNetChanges | VAEChanges) -> dict[str, object]:
    return {name: value for name, value in msgspec.structs.asdict(changes).items() if value is not None}


def copy_of(networks: Networks, *, plane_mix: bool) -> Networks:
    """The same weights once more, on the CPU. plane_mix: keep that switch, if it is on; it is useless untrained."""
    config = networks.config if plane_mix else msgspec.structs.replace(networks.config, plane_mix=None)
    copy = Networks(config)
    known = copy.state_dict()
    copy.load_state_dict({name: value for name, value in networks.state_dict().items() if name in known})
    return copy
