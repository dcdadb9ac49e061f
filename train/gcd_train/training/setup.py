"""From a recipe to networks on a device: config, arithmetic, first weights, draws, and what they are told of a clip."""

import hashlib
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
import torch
from torch import Tensor, nn

from gcd_model import weights_path
from gcd_model.conditioning import relative_pose_features, spherical_features
from gcd_model.config import DRIVING_CLASSES, PLAIN_SMALL, SMALL, SVD_14, ModelConfig, with_splat
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.geometry import Trajectory, motion_bucket
from gcd_model.layers import sinusoid
from gcd_model.networks import LoadedWeights, Networks, empty_networks
from gcd_model.weights.adapter import DIFFUSION, carried_over, widened
from gcd_model.weights.card import FAMILIES, Family
from gcd_model.weights.load import load_weights
from gcd_model.weights.save import gcd_state
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.recipe import ModelRecipe, Recipe, StudentRecipe, UNetChanges, UNetRecipe, VAEChanges
from gcd_train.recipe_data import AnyStageName, ComputeRecipe
from gcd_train.training.checkpoint import newest_weights, require_identity
from gcd_train.training.monitor import RunFolder
from gcd_train.training.trainable import plain_weights

_BASES: dict[str, ModelConfig] = {
    "plain-small": PLAIN_SMALL,
    "svd-14": SVD_14,
    "small": SMALL,
}
_PREFIXES: dict[AnyStageName, tuple[str, ...]] = {
    "vae": ("target_encoder.", "decoder."),
    "unet": ("unet.", "camera."),
}


def model_config(recipe: ModelRecipe) -> ModelConfig:
    """The networks a recipe asks for. Raises RecipeError where its changes contradict each other."""
    base, family = _BASES[recipe.base], family_of(recipe)
    camera, paints = recipe.camera or (base.camera if base.is_ours else family.camera), family.output == "semantic"
    if (family.camera == "none") != (camera == "none"):
        raise RecipeError(
            f"the recipe's [model] is steered by camera = {camera!r}, its family {family.name} by {family.camera!r}; "
            "change model.camera or model.family"
        )
    if camera != base.camera:  # as published: 128 of 768
        width = 0 if camera == "none" else base.unet.camera_width or base.unet.vector_width // 6
        unet = msgspec.structs.replace(base.unet, camera_width=width)
        base = msgspec.structs.replace(base, camera=camera, unet=unet)
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
            semantic_classes=DRIVING_CLASSES if recipe.base == "plain-small" and paints else (),
        )
        changed = with_splat(changed, recipe.splat)
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


def run_config(recipe: Recipe) -> ModelConfig:
    """The networks of a run: a student's are its teacher's, sampled in the student's steps and without guidance.

    Raises:
        RecipeError: as `model_config`; a teacher of another family or path than the recipe says, or noise levels that
            do not fall. CheckpointError: the teacher's file is missing or cannot be read.
    """
    student, weights = recipe.student, recipe.model.weights
    if student is None or weights is None:
        return model_config(recipe.model)
    teacher = loaded_base(weights)
    config, family = teacher.diffusion.config, family_of(recipe.model)
    if teacher.card.family not in (None, family):
        raise RecipeError(f"{weights} is of the family {teacher.card.family.name}; set model.family to it")
    goal = recipe.data.goal_frame(config.frames)
    if teacher.card.move_time != goal:
        raise RecipeError(
            f"{weights} is at its goal in frame {teacher.card.move_time}, the recipe's [data] says frame {goal}; set "
            "data.path, or data.move_time"
        )
    return student_config(config, student)


def student_config(teacher: ModelConfig, recipe: StudentRecipe) -> ModelConfig:
    """The teacher's networks, sampled in the student's steps and without guidance.

    Raises RecipeError for noise levels that do not fall.
    """
    sampling = teacher.sampling
    high, low = recipe.sigma_max or sampling.sigma_max, recipe.sigma_min or sampling.sigma_min
    if recipe.steps > 1 and low >= high:
        raise RecipeError(f"student.sigma_min must be below sigma_max, got {low:g} and {high:g}; change one of them")
    changed = msgspec.structs.replace(sampling, steps=recipe.steps, sigma_max=high, sigma_min=low, guidance=(1.0, 1.0))
    return msgspec.structs.replace(teacher, sampling=changed)


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
    """How the model is trained. Raises RecipeError for a family that is not known."""
    family = FAMILIES.get(recipe.family)
    if family is None:
        raise RecipeError(f"model.family must be one of {', '.join(FAMILIES)}, got {recipe.family!r}")
    return family


def digest_of(*values: object) -> str:
    """Eight digits that name plain values or structs: what a state belongs to."""
    return hashlib.sha256(msgspec.json.encode(values, order="deterministic")).hexdigest()[:8]


def fill(networks: Networks, folder: RunFolder, stage: AnyStageName, identity: str) -> int:
    """Copy what a stage trained into networks, averaged where it averages; returns the updates it took so far.

    identity: what its state must belong to. Weights that take no gradient need not be there. Raises RunError if it has
    not run, or if identity, names or shapes do not fit.
    """
    found = newest_weights(folder.stage(stage), stage)
    if found is None:
        raise RunError(f"{folder.stage(stage)} has no state: run `gcd-train train ... --stage {stage}` first")
    require_identity(found.path, found.note.identity, identity)
    known, best = networks.state_dict(), found.best
    given = {name: value for name, value in best.items() if name in known}
    frozen = {name for name, parameter in networks.named_parameters() if not parameter.requires_grad}
    wanted = (name for name in known if name.startswith(_PREFIXES.get(stage, ())) and name not in frozen)
    lacking = sorted(name for name in wanted if name not in given)
    wrong = [name for name, value in given.items() if value.shape != known[name].shape]
    if lacking or wrong:
        raise RunError(
            f"{found.path} does not fit the model: {len(lacking)} weights missing, {len(wrong)} of another shape, "
            f"first: {(lacking + wrong)[0]}; use the recipe it was trained with"
        )
    networks.load_state_dict(given, strict=False)
    return found.note.updates


def _given(changes: UNetChanges | VAEChanges) -> dict[str, object]:
    return {name: value for name, value in msgspec.structs.asdict(changes).items() if value is not None}


def copy_of(networks: Networks) -> Networks:
    """The same weights once more, on the CPU, adapters merged."""
    copy = Networks(networks.config)
    known = copy.state_dict()
    copy.load_state_dict({name: value for name, value in plain_weights(networks).items() if name in known})
    return copy


class Draws:
    """The randomness of one update, which follows from seed, stage and update alone: a resumed run draws what it would
    have drawn.

    Whole numbers are drawn on the CPU, noise on the device that uses it; on the CPU both come from one generator.
    number: of the update, or of the batch where an update takes several; what comes in a fixed order goes by it.
    """

    def __init__(self, seed: int, stage: str, update: int, device: torch.device) -> None:
        digest = hashlib.sha256(f"{seed}/{stage}/{update}".encode()).digest()
        mixed = int.from_bytes(digest[:8], "little") >> 1
        self.number, self._device = update, device
        self._host = torch.Generator().manual_seed(mixed)
        self._there = self._host if device.type == "cpu" else torch.Generator(device).manual_seed(mixed)

    def below(self, limit: int, count: int) -> Tensor:
        """`count` whole numbers 0 <= n < limit, int64 on the CPU."""
        return torch.randint(limit, (count,), generator=self._host)

    def order(self, count: int) -> list[int]:
        """The numbers 0 <= n < count in random order."""
        return torch.randperm(count, generator=self._host).tolist()

    def normal(self, *shape: int) -> Tensor:
        """Standard normal float32 on the device."""
        return torch.randn(shape, generator=self._there, device=self._device)

    def chance(self, probability: float, count: int) -> Tensor:
        """`count` flags on the device, each true with the given probability."""
        return torch.rand(count, generator=self._there, device=self._device) < probability


Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True, slots=True)
class Precision:
    """A device, the arithmetic on it, and the memory layout of pictures."""

    device: torch.device
    half: bool
    channels_last: bool

    @classmethod
    def of(cls, recipe: ComputeRecipe) -> "Precision":
        """As a recipe asks. Raises RecipeError for a device that is not there."""
        there = torch.cuda.is_available()
        if recipe.device == "cuda" and not there:
            raise RecipeError('compute.device is "cuda" but this machine has no CUDA device; use "auto" or "cpu"')
        device = torch.device("cuda" if there and recipe.device != "cpu" else "cpu")
        # CPU kernels are slow in it, so only weights kept in it make a CPU compute in it
        kept = "bfloat16" in (recipe.weights, recipe.frozen)
        half = kept or (recipe.precision == "bfloat16" and device.type == "cuda")
        return cls(device, half, recipe.channels_last)

    def arithmetic(self) -> AbstractContextManager[object]:
        """Context in which networks compute in bfloat16, if asked for; weights stay float32."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.half else nullcontext()

    def placed(self, module: Module) -> Module:
        """The module on the device, in training mode; if asked for with channels innermost, which is faster."""
        module.to(self.device).train()
        for parameter in module.parameters() if self.channels_last else ():
            if parameter.ndim == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        return module

    def frames(self, rows: Tensor) -> Tensor:
        """[N, C, H, W] on the device, in the layout the networks like."""
        rows = rows.to(self.device)
        return rows.contiguous(memory_format=torch.channels_last) if self.channels_last else rows


def fresh_networks(config: ModelConfig, seed: int) -> Networks:
    """Networks as training starts with them: zero-initialised layers are zero, and so is what reads a splat, beside the
    same random numbers as without one."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        plain = Networks(with_splat(config, "none"))
    if config.splat == "none":
        return plain
    networks = empty_networks(config)
    networks.load_state_dict(widened(plain.state_dict(), config), assign=True)
    return networks


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
    loaded = loaded_base(recipe.weights, config)
    try:
        over = carried_over(loaded.diffusion, config, anew=DIFFUSION if recipe.scratch else ())
    except CheckpointError as error:
        raise RecipeError(
            f"{recipe.weights} {error}; change [model], or give a file of the model it describes"
        ) from error
    networks.load_state_dict({name: value.float() for name, value in over.weights.items()}, strict=False)
    return networks


def loaded_base(path: str, config: ModelConfig | None = None) -> LoadedWeights:
    """A weight file of any layout, or `package:NAME`, with the config's heads if it has none. See `load_weights`."""
    tower, width = (None, None) if config is None else (config.image_encoder, config.unet.head_width)
    heads = None if tower is None else tower.heads
    return load_weights(weights_path(path), head_width=width, image_heads=heads)


class Conditioner:
    """Condition channels, vectors and camera features of frames.

    family: says what motion number belongs to a camera path; None where nobody asks for one.
    """

    def __init__(
        self, config: ModelConfig, recipe: UNetRecipe, precision: Precision, family: Family | None = None
    ) -> None:
        self._config, self._recipe, self._precision, self._family = config, recipe, precision, family

    def vector(self, fps: Tensor, motion: Tensor) -> Tensor:
        """Micro-conditioning of N clips, [N, V]; see `micro_conditioning`. fps, motion: [N]."""
        numbers = torch.stack([fps.float(), motion.float().cpu(), torch.full(fps.shape, self._recipe.augmentation)], -1)
        return sinusoid(numbers.to(self._precision.device), self._config.unet.vector_width // 3).flatten(1)

    def motion(self, path: Trajectory) -> float:
        """The number that tells the network how far the camera goes: the family's for the path, else the recipe's.

        Raises DataError for a path without angles where the family works it out of those.
        """
        family = self._family
        if family is None or family.motion_bucket is not None or family.limits is None:
            return self._recipe.motion_bucket
        if path.goal_delta is None:
            raise DataError(f"family {family.name} works with angles about a centre, and these cameras have none")
        limits = family.limits
        return motion_bucket(
            path.goal_delta, max_azimuth_deg=limits.azimuth_deg, max_elevation_deg=limits.elevation_deg
        )

    def camera(self, path: Trajectory) -> Tensor | None:
        """What the network is steered by, [T, F]; None for a model with one fixed view.

        Raises DataError for a path without angles where the model is steered by those.
        """
        match self._config.camera:
            case "none":
                return None
            case "relative_pose":
                return relative_pose_features(path.source_from_target)
            case "spherical":
                if path.delta is None:
                    raise DataError("the model is steered by angles and radius, and these cameras are not on a sphere")
                return spherical_features(path.delta)


def mirrored_path(path: Trajectory) -> Trajectory:
    """The same path in the world seen in a mirror: left is right, the azimuth turns the other way."""
    sideways = torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    delta = path.delta
    return Trajectory(
        source_from_target=path.source_from_target * sideways[:, None] * sideways,
        delta=None if delta is None else delta * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64),
        source=path.source,
    )
