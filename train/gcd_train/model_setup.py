"""From a recipe to networks, and from a run's stages back to one set of weights."""

import hashlib

import msgspec
import torch
from torch import nn

from gcd_model import FAMILIES, Family, ModelConfig
from gcd_model.config import DRIVING_CLASSES, PLAIN_SMALL, SMALL, SVD_14, CameraControl
from gcd_model.errors import OptionError
from gcd_model.networks import Networks, empty_networks
from gcd_model.weights.save import gcd_state
from gcd_train.checkpoint import require_identity
from gcd_train.engine.states import newest_weights
from gcd_train.errors import RecipeError, RunError
from gcd_train.lora import plain_weights
from gcd_train.recipe import AnyStageName, ComputeRecipe, ModelRecipe, Recipe, UNetChanges, UNetRecipe, VAEChanges
from gcd_train.run_folder import RunFolder

_BASES: dict[str, ModelConfig] = {
    "plain-small": PLAIN_SMALL,
    "svd-14": SVD_14,
    "small": SMALL,
}
_DENOISER = ("unet.", "camera.")
_PREFIXES: dict[AnyStageName, tuple[str, ...]] = {
    "vae": ("target_encoder.", "decoder."),
    "unet": _DENOISER,
    "paired": _DENOISER,
}


def model_config(recipe: ModelRecipe) -> ModelConfig:
    """The networks a recipe asks for. Raises RecipeError where its changes contradict each other."""
    base = _steered(_BASES[recipe.base], _camera(recipe))
    try:
        changed = msgspec.structs.replace(
            base,
            unet=msgspec.structs.replace(base.unet, **_given(recipe.unet)),
            vae=msgspec.structs.replace(base.vae, **_given(recipe.vae)),
            prediction=recipe.prediction or base.prediction,
            sampling=msgspec.structs.replace(base.sampling, steps=recipe.steps or base.sampling.steps),
            frames=recipe.frames or base.frames,
            height=recipe.height or base.height,
            width=recipe.width or base.width,
            semantic_classes=DRIVING_CLASSES if recipe.base == "plain-small" and _paints(recipe) else (),
        )
        # msgspec does not check what `replace` makes; a round trip does
        config = msgspec.json.decode(msgspec.json.encode(changed), type=ModelConfig)
    except (OptionError, msgspec.ValidationError) as error:
        raise RecipeError(f"the recipe's [model] cannot be built: {error}") from error
    factor = config.size_factor
    if config.height % factor or config.width % factor:
        raise RecipeError(
            f"model.height and model.width must be multiples of {factor}, which these networks halve down to whole "
            f"numbers; got {config.height} and {config.width}"
        )
    return config


def _paints(recipe: ModelRecipe) -> bool:
    return family_of(recipe).output == "semantic"


def require_exportable(recipe: Recipe, config: ModelConfig) -> None:
    """Raises RecipeError, before anything is trained, if [export] asks for a layout that cannot hold these networks."""
    if "gcd-ckpt" not in recipe.export.layouts:
        return
    try:
        gcd_state(empty_networks(config).state_dict(), config, {})
    except OptionError as error:
        raise RecipeError(
            f'export.layouts asks for "gcd-ckpt", but {error}; leave it out: --set \'export.layouts=["gcd-node"]\''
        ) from error


def _steered(base: ModelConfig, camera: CameraControl) -> ModelConfig:
    """The base with that camera control."""
    if camera == base.camera:
        return base
    width = 0 if camera == "none" else base.unet.camera_width or base.unet.vector_width // 6  # as published: 128 of 768
    return msgspec.structs.replace(base, camera=camera, unet=msgspec.structs.replace(base.unet, camera_width=width))


def _camera(recipe: ModelRecipe) -> CameraControl:
    """How the model is steered. Raises RecipeError if its family has another kind of view."""
    base, family = _BASES[recipe.base], family_of(recipe)
    camera = recipe.camera or (base.camera if base.is_ours else family.camera)
    if (family.camera == "none") != (camera == "none"):
        raise RecipeError(
            f"the recipe's [model] is steered by camera = {camera!r}, its family {family.name} by {family.camera!r}; "
            "change model.camera or model.family"
        )
    return camera


def sampled_as_trained(config: ModelConfig, recipe: UNetRecipe) -> ModelConfig:
    """The config with the sampler that suits the recipe's noise: what ships is used as it was trained.

    Raises RecipeError if the sampler visits noise levels that the recipe never trains.
    """
    sampling, noise = config.sampling, recipe.noise_at(1.0)
    if noise.fixed_share == 1 and (sampling.steps, sampling.sigma_max) != (1, noise.fixed_sigma):
        raise RecipeError(
            f"the recipe trains sigma {noise.fixed_sigma:g} alone, the model is sampled in {sampling.steps} steps from "
            f"{sampling.sigma_max:g}: lower unet.noise.fixed_share, or take a base model of one step from that sigma"
        )
    shared = sampling.shared_noise if 0 < noise.shared < 1 else noise.shared == 1
    sampling = msgspec.structs.replace(sampling, augmentation=recipe.augmentation, shared_noise=shared)
    return msgspec.structs.replace(config, sampling=sampling)


def family_of(recipe: ModelRecipe) -> Family:
    """How the model is trained. Raises RecipeError for a family that is not known."""
    family = FAMILIES.get(recipe.family)
    if family is None:
        raise RecipeError(f"model.family must be one of {', '.join(FAMILIES)}, got {recipe.family!r}")
    return family


def digest_of(*values: object) -> str:
    """Eight digits that name plain values or structs: what a state belongs to."""
    return hashlib.sha256(msgspec.json.encode(values, order="deterministic")).hexdigest()[:8]


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


def fill(networks: Networks, folder: RunFolder, stage: AnyStageName, identity: str) -> int:
    """Copy what a stage trained into networks, averaged where it averages; returns the updates it took so far.

    identity: what its state must belong to. Weights that take no gradient need not be there. Raises RunError if it has
    not run, or if identity, names or shapes do not fit.
    """
    found = newest_weights(folder.stage(stage), stage)
    if found is None:
        raise RunError(f"{folder.state(stage)} is missing: run `gcd-train train ... --stage {stage}` first")
    path, state = found
    require_identity(path, state.identity, identity)
    known, best = networks.state_dict(), state.best
    given = {name: value for name, value in best.items() if name in known}
    frozen = {name for name, parameter in networks.named_parameters() if not parameter.requires_grad}
    wanted = (name for name in known if name.startswith(_PREFIXES.get(stage, ())) and name not in frozen)
    lacking = sorted(name for name in wanted if name not in given)
    wrong = [name for name, value in given.items() if value.shape != known[name].shape]
    if lacking or wrong:
        raise RunError(
            f"{path} does not fit the model: {len(lacking)} weights missing, {len(wrong)} of another shape, first: "
            f"{(lacking + wrong)[0]}; use the recipe it was trained with"
        )
    networks.load_state_dict(given, strict=False)
    return state.updates


def _given(changes: UNetChanges | VAEChanges) -> dict[str, object]:
    return {name: value for name, value in msgspec.structs.asdict(changes).items() if value is not None}


def copy_of(networks: Networks) -> Networks:
    """The same weights once more, on the CPU, adapters merged."""
    copy = Networks(networks.config)
    known = copy.state_dict()
    copy.load_state_dict({name: value for name, value in plain_weights(networks).items() if name in known})
    return copy
