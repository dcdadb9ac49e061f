"""What training costs: memory of an update of the full model, clips a second, and how much of the device is used.

The full model's memory is counted without any device, see `memory_account`; the rest is measured where it runs, with
random weights and pictures, which cost what trained ones do.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import msgspec
import torch
from torch import Tensor

from gcd_model import FAMILIES, ModelConfig
from gcd_model.config import SMALL, SVD_14
from gcd_model.networks import Networks, empty_networks, random_networks
from gcd_train.data.batches import encode_frames
from gcd_train.recipe import LoraRecipe, LossRecipe, ModelRecipe, NoiseRecipe, OptimiserRecipe, UNetRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe
from gcd_train.training.conditioner import Conditioner
from gcd_train.training.distributed import recompute_blocks
from gcd_train.training.draws import Draws
from gcd_train.training.memory import PLANS, Account, Kept, Plan, account, kept_by_update
from gcd_train.training.objective import Batch, Denoiser, diffusion_loss, drop_streams
from gcd_train.training.optimiser import ParameterGroup, build_optimiser
from gcd_train.training.setup import Precision
from gcd_train.training.trainable import add_lora, halve_frozen, is_adapted, let_train

KUBRIC_CLIPS = 10_000 * 56
"""Clips of the published Kubric-4D recipe: iterations times batch."""
_LORA_RANK = 32
_PEAK_FLOPS = {"H100": 989e12, "H200": 989e12, "A100": 312e12, "L40S": 362e12, "L40": 181e12}
"""Dense bfloat16 arithmetic of whole devices, as their makers state it; the first name that fits counts."""


class MemoryRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Memory of one clip's update of the full model, gigabytes, counted. cached: no encoders, see `Account`."""

    name: str
    cached: bool
    weights: float
    gradients: float
    state: float
    activations: float
    encoders: float
    total: float


class SpeedRow(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Measured updates. clips_per_s: median. utilisation: arithmetic of the U-Net, forward and backward once, over what
    the device could do; None where that is not known. peak_gb: of the device's allocator, None on the CPU. hours: of
    the published Kubric-4D recipe at this speed; None for anything but the full model."""

    name: str
    updates: int
    clips_per_s: float
    lowest: float
    highest: float
    utilisation: float | None
    peak_gb: float | None
    hours: float | None


class TrainReport(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """device: its name. model: which was measured. tflop_per_clip: forward and backward of the measured U-Net, once."""

    device: str
    torch: str
    model: str
    clips: int
    tflop_per_clip: float
    memory: tuple[MemoryRow, ...]
    speed: tuple[SpeedRow, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class BenchTrainOptions:
    """full: measure the full model; else a small one of the same kind. clips: of an update. updates: measured ones,
    after `warm` others. eight_bit: 8-bit Adam (torchao) instead of plain Adam. recompute: see
    compute.checkpoint_activations. measure: also run updates."""

    full: bool
    clips: int = 1
    updates: int = 10
    warm: int = 3
    eight_bit: bool = False
    recompute: bool = True
    measure: bool = True


def bench_train(options: BenchTrainOptions, on_part: Callable[[str], None]) -> TrainReport:
    """Count and measure; `on_part` is told what comes next. Raises RecipeError where torchao is wanted and missing."""
    on_part("counting the memory of the full model")
    kept = kept_by_update(SVD_14)
    config = SVD_14 if options.full else SMALL
    flops = 3 * (kept if options.full else kept_by_update(config)).flops // 4
    frozen = "bfloat16" if torch.cuda.is_available() else "float32"  # CPU kernels are slow in it
    precision = Precision.of(ComputeRecipe(precision="bfloat16", frozen=frozen))
    speed: list[SpeedRow] = []
    if options.measure:
        for cached in (True, False):
            on_part(f"updates with the encoders' results {'cached' if cached else 'computed each time'}")
            speed.append(_measured(config, options, precision, flops, cached=cached))
    cuda = precision.device.type == "cuda"
    return TrainReport(
        device=torch.cuda.get_device_name() if cuda else f"CPU, {torch.get_num_threads()} threads",
        torch=str(torch.__version__),
        model="full (svd-14)" if options.full else "small",
        clips=options.clips,
        tflop_per_clip=flops / 1e12,
        memory=memory_rows(kept),
        speed=tuple(speed),
    )


def memory_rows(kept: Kept) -> tuple[MemoryRow, ...]:
    """The full model under every plan, with encoders and with a cache."""
    lora = Plan(
        name=f"LoRA, rank {_LORA_RANK}, bfloat16 base",
        weights=2,
        gradient=4,
        state=8,
        adapter=lora_parameters(SVD_14, LoraRecipe(rank=_LORA_RANK)),
    )
    return tuple(
        _memory_row(account(SVD_14, plan, kept, cached=cached), cached)
        for plan in (*PLANS, lora)
        for cached in (False, True)
    )


def lora_parameters(config: ModelConfig, recipe: LoraRecipe) -> int:
    """How many numbers training with adapters changes."""
    networks = empty_networks(config)
    with torch.device("meta"):
        add_lora(networks, recipe, seed=0)
    return sum(value.numel() for name, value in networks.named_parameters() if is_adapted(name, recipe))


def _memory_row(counted: Account, cached: bool) -> MemoryRow:
    return MemoryRow(
        name=counted.plan.name,
        cached=cached,
        weights=counted.weights,
        gradients=counted.gradients,
        state=counted.state,
        activations=counted.activations,
        encoders=counted.encoders,
        total=counted.total,
    )


def _measured(
    config: ModelConfig, options: BenchTrainOptions, precision: Precision, flops: int, *, cached: bool
) -> SpeedRow:
    """Time updates of random clips. cached: the frozen networks have run before the clock starts."""
    work = _Updates(config, options, precision, cached=cached)
    device, rates = precision.device, list[float]()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    for number in range(options.warm + options.updates):
        started = _clock(device)
        work.update(number)
        if number >= options.warm:
            rates.append(options.clips / (_clock(device) - started))
    most = _peak_flops(device)
    hours = KUBRIC_CLIPS / median(rates) / 3600 if options.full and device.type == "cuda" else None
    return SpeedRow(
        name="latents cached" if cached else "encoded each time",
        updates=options.updates,
        clips_per_s=median(rates),
        lowest=min(rates),
        highest=max(rates),
        utilisation=None if most is None else flops * median(rates) / most,
        peak_gb=torch.cuda.max_memory_allocated(device) / 1e9 if device.type == "cuda" else None,
        hours=hours,
    )


class _Updates:
    """Updates as the U-Net stage makes them, on random clips."""

    def __init__(self, config: ModelConfig, options: BenchTrainOptions, precision: Precision, *, cached: bool) -> None:
        self._recipe = _recipe(options)
        self._precision, self._options = precision, options
        networks = random_networks(config, seed=0)
        let_train(networks, ModelRecipe(), seed=0)
        if precision.half:
            halve_frozen(networks)
        self._networks: Networks = precision.placed(networks)
        self._denoiser = Denoiser(networks.unet, config.prediction, networks.camera)
        if options.recompute:
            recompute_blocks(self._denoiser, 1)
        trained = [parameter for parameter in self._denoiser.parameters() if parameter.requires_grad]
        self._optimiser = build_optimiser([ParameterGroup(parameters=trained)], self._recipe.optimiser)
        self._conditioner = Conditioner(config, self._recipe, precision, FAMILIES["kubric90"])
        self._kept = self._batch(0) if cached else None

    def update(self, number: int) -> None:
        """One."""
        batch = self._kept or self._batch(number)
        self._optimiser.zero_grad(set_to_none=True)
        draws = Draws(1, "bench", number, self._precision.device)
        loss = diffusion_loss(
            self._denoiser,
            batch,
            draws,
            self._precision,
            noise=self._recipe.noise,
            loss=self._recipe.loss,
            channel_weights=None,
            step=number,
        )
        loss.total.backward()
        self._optimiser.step()

    def _batch(self, number: int) -> Batch:
        config, device = self._networks.config, self._precision.device
        draws = Draws(0, "bench", number, device)
        rows = self._options.clips * config.frames
        source, target = (self._pictures(draws, rows) for _ in range(2))
        made = encode_frames(self._networks, self._recipe, source, target, draws)
        condition, tokens = drop_streams(made.source, made.tokens, config.frames, draws, self._recipe)
        return Batch(
            target=made.target,
            condition=condition,
            vector=self._conditioner.vector(torch.full((rows,), 100.0), rows),
            tokens=tokens,
            emphasis=made.emphasis,
            frames=config.frames,
            camera=draws.normal(rows, 13),
        )

    def _pictures(self, draws: Draws, rows: int) -> Tensor:
        config = self._networks.config
        return self._precision.frames(draws.normal(rows, 3, config.height, config.width).clamp(-1, 1))


def _recipe(options: BenchTrainOptions) -> UNetRecipe:
    return UNetRecipe(
        budget=Budget(updates=options.warm + options.updates),
        optimiser=OptimiserRecipe(kind="adam8bit" if options.eight_bit else "adam", rate=2e-5),
        source="pixels",
        noise=NoiseRecipe(),
        loss=LossRecipe(),
    )


def _clock(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def _peak_flops(device: torch.device) -> float | None:
    if device.type != "cuda":
        return None
    name = torch.cuda.get_device_name(device)
    return next((flops for part, flops in _PEAK_FLOPS.items() if part in name), None)
