"""What a model costs, stage by stage: ours and others on the same window, in turns, in one process.

`bench_model.py` is its command. What belongs to no stage that was asked for is not computed.
"""

import copy
import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from dataclasses import replace as with_changes
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Literal, get_args

import msgspec
import torch
from msgspec.structs import replace
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from gcd_model.clip import Clip, View
from gcd_model.conditioning import Conditioning
from gcd_model.config import SVD_14, ModelConfig
from gcd_model.diffusion import RenderOptions, Schedule, unit_noise
from gcd_model.engines.gpu_layout import psnr_db
from gcd_model.engines.torch import Engine, arrange
from gcd_model.errors import OptionError
from gcd_model.geometry import Trajectory
from gcd_model.layers import prepare
from gcd_model.live.synthesizer import LiveSynthesizer
from gcd_model.loading import device_named, load_synthesizer, placed_synthesizer, random_weights
from gcd_model.networks import LoadedWeights, Networks, empty_networks, random_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits
from gcd_model.weights.card import KUBRIC90, NO_DIFFUSION, Card
from gcd_model.weights.load import save_weights

FULL = "random:full"
"""The published architecture with random weights: 1.5 billion numbers in the U-Net alone, 6 GB in float32."""

StageName = Literal["tower", "encode", "step", "decode", "window"]
"""tower: image tokens of all frames, their resizing included. encode: source latents of all frames. step: one network
evaluation with its guidance; the first of a window, which also prepares what is constant over it, only where it is the
only one. decode: latents to pictures. window: a clip in memory to a view in memory."""
STAGES: tuple[StageName, ...] = get_args(StageName)

VARIANTS = {
    "ours on cuda": {},
    "ours on cuda, tuned": {"tuned": True},
    "ours on cuda, float8": {"float8": True},
    "ours on cuda, float32 decoder": {"half_decoder": False},
    "ours, compiled alone": {"graphs": False},
    "ours, graphs alone": {"backend": None, "arranged": False, "half_decoder": False},
}
"""Of the engine for a GPU, as its options have them; beside them there are "ours" (plain torch), "diffusers" and
"diffusers compiled"."""


# --- figures, as they go into JSON and come back -------------------------------------------------------------------


class StageFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """runs: how often it was measured. median_s, p95_s: by the clock. cpu_s: of all cores together, median.

    tflop: counted from shapes on the meta device, multiplications and additions apart.
    """

    stage: StageName
    runs: int
    median_s: float
    p95_s: float
    cpu_s: float
    tflop: float


class MemoryFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The most that a fresh process held that did this and nothing else, GB (1e9 bytes).

    resident_gb: pages of mapped weight files included. private_gb: without them. device_gb: of the GPU's allocator.
    """

    resident_gb: float
    private_gb: float
    device_gb: float | None = None


class Implementation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way of computing the same networks."""

    name: str
    stages: tuple[StageFigures, ...]
    memory: MemoryFigures | None = None


class Difference(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of another implementation's window from ours: largest difference over our largest value; PSNR of the pictures,
    which in half precision says more."""

    name: str
    latents: float
    pictures: float | None
    psnr_db: float | None = None


class ModelBench(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="model", tag_field="kind"):
    """Everything measured of one model. parameters: in millions. implementations: ours first."""

    model: str
    parameters: float
    frames: int
    height: int
    width: int
    steps: int
    guidance: tuple[float, float]
    precision: str
    device: str
    threads: int
    implementations: tuple[Implementation, ...]
    differences: tuple[Difference, ...] = ()


# --- what is measured ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Work:
    """What a window is made of. height, width: of the frames, pixels. guidance: of the first and the last frame."""

    height: int
    width: int
    steps: int
    guidance: tuple[float, float]

    @property
    def options(self) -> RenderOptions:
        return RenderOptions(steps=self.steps, guidance=self.guidance, motion_bucket=127.0)


def load_measured(
    weights: str, *, device: str = "auto", dtype: str | None = None, stages: Collection[StageName] = STAGES
) -> Synthesizer:
    """What `load_synthesizer` loads, or FULL. stages: of FULL, networks of stages not asked for are small ones."""
    if weights == FULL:
        place = device_named(device)
        with place:  # drawn where it is used: on one thread of a CPU that takes a minute
            full = _full_size(stages)
        return placed_synthesizer(full, place, dtype=dtype)
    made = load_synthesizer(weights, device=device, dtype=dtype)
    if isinstance(made, LiveSynthesizer):
        raise OptionError(f"{made.traits.name} {NO_DIFFUSION}")
    return made


def save_random(weights: str, out: Path, stages: Collection[StageName] = STAGES) -> None:
    """Random weights as a file, so that processes can map it into memory. weights: random:FAMILY or FULL."""
    loaded = _full_size(stages) if weights == FULL else random_weights(weights.removeprefix("random:"))
    save_weights(loaded.networks, out, loaded.card)


def _full_size(stages: Collection[StageName]) -> LoadedWeights:
    """SVD_14, where networks of no stage asked for are narrow; what they hand on has the same shape."""
    tower, vae = SVD_14.image_encoder, SVD_14.vae
    if tower is not None and not {"window", "tower"} & set(stages):
        tower = replace(tower, width=64, layers=1, heads=1, hidden_width=64)
    if not {"window", "encode", "decode"} & set(stages):
        vae = replace(vae, width=32, blocks_per_level=1)
    networks = random_networks(replace(SVD_14, image_encoder=tower, vae=vae), seed=0)
    last = networks.config.frames - 1
    card = Card(name="random-full", config=networks.config, family=KUBRIC90, move_time=last, trained=False)
    return LoadedWeights(card=card, networks=networks)


def engine_named(name: str, networks: Networks) -> Engine:
    """An engine for networks on any device, meta too. Tensors are shared wherever that is possible."""
    if name == "ours":
        networks.requires_grad_(False)
        prepare(networks)
        if next(networks.unet.parameters()).device.type == "cpu":
            arrange(networks)
        return Engine(networks)
    if name in VARIANTS:
        from gcd_model.engines.cuda import CudaEngine, CudaOptions

        on_cpu = not networks.unet.stem.weight.is_cuda  # where nothing of what a GPU gains by is tried unasked
        options = VARIANTS[name] or (VARIANTS["ours, graphs alone"] if on_cpu else {})
        return CudaEngine(_twin(networks), CudaOptions(**options))
    from diffusers_peer import DiffusersEngine, compile_modules, diffusers_modules

    modules = diffusers_modules(networks)
    return DiffusersEngine(compile_modules(modules) if name == "diffusers compiled" else modules)


def _twin(networks: Networks) -> Networks:
    """The same weights in memory, to be laid out and compiled without touching networks that others use."""
    memo: dict[int, object] = {id(each): each for each in chain(networks.parameters(), networks.buffers())}
    return copy.deepcopy(networks, memo).eval()


def still_clip(frames: int, height: int, width: int, fps: float) -> Clip:
    """One smooth picture, held: diffusers knows one image token a clip; the noise still differs by frame."""
    coarse = unit_noise((1, 3, max(2, height // 16), max(2, width // 16)), 7)
    smooth = torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")
    return Clip(video=smooth.clamp(-1, 1).expand(frames, -1, -1, -1).contiguous(), fps=fps)


class Subject:
    """One implementation at work on one window, again and again."""

    def __init__(self, name: str, engine: Engine, traits: Traits, work: Work, stages: Collection[StageName]) -> None:
        config = traits.diffusion
        self.name, self._work, self._traits = name, work, traits
        self.probe = Probe(engine, config, stages)
        self._synthesizer = Synthesizer(empty_networks(config), traits, self.probe)
        self._clip = still_clip(config.frames, work.height, work.width, traits.fps)

    def window(self, *, watched: bool = True) -> View:
        """Once through. watched: `probe.spent` then tells what its stages took."""
        self.probe.begin(watched=watched)
        features = self._synthesizer.encode(self._clip)
        return self._synthesizer.render(features, [self._traits.plan_view()], self._work.options)[0]


# --- measuring -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spent:
    """wall_s: by the clock. cpu_s: of this process, user and system, all threads added up."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: "Spent") -> "Spent":
        return Spent(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


class Stopwatch:
    """Counts from where it was started last. On a GPU it waits until the device has done what it was given."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._at = self._now()

    def lap(self) -> Spent:
        before, self._at = self._at, self._now()
        return Spent(self._at[0] - before[0], self._at[1] - before[1])

    def _now(self) -> tuple[float, float]:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter(), time.process_time()


class Probe:
    """Implements Engine: passes every call on and notes what it took.

    What belongs to a stage that was not asked for is not computed: zeros, or noise, of the same shape stand in.
    """

    def __init__(self, engine: Engine, config: ModelConfig, stages: Collection[StageName]) -> None:
        self._engine, self._config = engine, config
        self._wanted = set(STAGES) if "window" in stages else set(stages)
        self._watch = Stopwatch(engine.like.device)
        self._watched = True
        self._spent: dict[StageName, Spent] = {}
        self._evaluations: list[Spent] = []

    def begin(self, *, watched: bool = True) -> None:
        """Forget the last window and start the clock. watched: note what stages take, for which a GPU is waited for."""
        self._spent, self._evaluations, self._watched = {}, [], watched
        self._watch.lap()

    @property
    def spent(self) -> dict[StageName, list[Spent]]:
        """Of the last window: what each stage took; of the steps, those after the first if there are any."""
        steps = self._evaluations[1:] or self._evaluations
        return {stage: [each] for stage, each in self._spent.items()} | ({"step": steps} if steps else {})

    @property
    def like(self) -> Tensor:
        return self._engine.like

    def tokens(self, frames: Tensor) -> Tensor | None:
        tower = self._config.image_encoder
        if tower is None:
            return None
        if "tower" in self._wanted:
            return self._timed("tower", lambda: self._engine.tokens(frames))
        return self.like.new_zeros(len(frames), tower.output_width)

    def condition_mean(self, frames: Tensor) -> Tensor:
        if "encode" in self._wanted:
            return self._timed("encode", lambda: self._engine.condition_mean(frames))
        vae, (height, width) = self._config.vae, frames.shape[-2:]
        shape = (len(frames), vae.latent_channels, height // vae.down_factor, width // vae.down_factor)
        return unit_noise(shape, 1).to(self.like)

    def camera(self, path: Trajectory) -> Tensor | None:
        return self._engine.camera(path)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        if "step" not in self._wanted:
            return start / schedule.steps[0].sigma
        if not self._watched:
            return self._engine.sample(start, given, schedule, options)
        self._watch.lap()
        note = with_changes(options, progress=lambda _, __: self._evaluations.append(self._watch.lap()))
        return self._engine.sample(start, given, schedule, note)

    def decode(self, latents: Tensor) -> Tensor:
        if "decode" in self._wanted:
            return self._timed("decode", lambda: self._engine.decode(latents))
        factor = self._config.vae.down_factor
        return torch.zeros(len(latents), 3, latents.shape[-2] * factor, latents.shape[-1] * factor)

    def _timed(self, stage: StageName, work: Callable[[], Tensor]) -> Tensor:
        if not self._watched:
            return work()
        self._watch.lap()
        made = work()
        self._spent[stage] = self._spent.get(stage, Spent(0.0, 0.0)) + self._watch.lap()
        return made


def bench_model(
    synthesizer: Synthesizer,
    implementations: Sequence[str],
    stages: Sequence[StageName],
    *,
    repeats: int = 3,
    warm: int = 1,
    bare: bool = False,
    count: bool = True,
    on_part: Callable[[str], None] = lambda _: None,
    **given: object,
) -> ModelBench:
    """Measure a checkpoint.

    Args:
        implementations: the first is what the others are compared with. repeats: windows after `warm` others.
        bare: leave the camera's embedding out, as beside a peer: diffusers has none. count: also count arithmetic.
        given: of a `Work`, where it is not as the checkpoint was made for.
    """
    if any(name.startswith("diffusers") for name in implementations):
        _require_diffusers()
        bare = True
    networks, traits = _comparable(synthesizer, bare=bare)
    work = _work(traits.diffusion, given)
    subjects = [Subject(name, engine_named(name, networks), traits, work, stages) for name in implementations]
    rounds = _Rounds(subjects, stages, networks.unet.stem.weight.device)
    for number in range(warm + repeats):
        rounds.run(number + 1, keep=number >= warm, on_part=on_part)
    on_part("counting the arithmetic")
    counted = {name: _counted_flops(name, traits, work) if count else {} for name in implementations}
    return ModelBench(
        model=traits.name,
        parameters=sum(value.numel() for value in networks.state_dict().values()) / 1e6,
        frames=traits.config.frames,
        height=work.height,
        width=work.width,
        steps=work.steps,
        guidance=work.guidance,
        precision=traits.precision,
        device=traits.device,
        threads=torch.get_num_threads(),
        implementations=tuple(
            Implementation(name=name, stages=rounds.figures(name, counted[name])) for name in implementations
        ),
        differences=rounds.differences(decoded=bool({"decode", "window"} & set(stages))),
    )


def _require_diffusers() -> None:
    missing = [name for name in ("diffusers", "transformers") if find_spec(name) is None]
    if missing:
        raise OptionError(f"--peer diffusers needs {' and '.join(missing)}; pip install diffusers transformers")


def _comparable(synthesizer: Synthesizer, *, bare: bool) -> tuple[Networks, Traits]:
    """The networks that all sides compute, and what they are."""
    if not bare:
        return synthesizer.networks, synthesizer.traits
    from diffusers_peer import require_published, without_camera

    synthesizer.networks.eval()  # drops what was derived from the weights: the stripped ones derive their own
    stripped = without_camera(synthesizer.networks)
    require_published(stripped.config)
    return stripped, with_changes(synthesizer.traits, config=stripped.config)


def _work(config: ModelConfig, given: dict) -> Work:
    usual = {"height": config.height, "width": config.width}
    usual |= {"steps": config.sampling.steps, "guidance": config.sampling.guidance}
    work = Work(**(usual | {name: value for name, value in given.items() if value is not None}))
    factor = config.size_factor
    if work.height % factor or work.width % factor:
        raise OptionError(
            f"height and width must be multiples of {factor} for this model, got {work.height}x{work.width}"
        )
    return work


class _Rounds:
    """Windows of all subjects in turns, and what they took."""

    def __init__(self, subjects: Sequence[Subject], stages: Sequence[StageName], device: torch.device) -> None:
        self._subjects, self._stages, self._watch = subjects, stages, Stopwatch(device)
        self._alone = device.type == "cuda" and "window" in stages  # watching stages makes the host wait between them
        self._spent: dict[tuple[str, StageName], list[Spent]] = {}
        self._views: dict[str, View] = {}

    def run(self, number: int, *, keep: bool, on_part: Callable[[str], None]) -> None:
        """One window of each; the other way round every second time, so that none always comes first."""
        for subject in self._subjects if number % 2 else reversed(self._subjects):
            on_part(f"window {number}: {subject.name}")
            self._watch.lap()
            self._views[subject.name] = subject.window()
            spent, whole = subject.probe.spent, self._watch.lap()
            if self._alone:
                subject.window(watched=False)
                whole = self._watch.lap()
            for stage, each in (spent | {"window": [whole]}).items():
                if keep:
                    self._spent.setdefault((subject.name, stage), []).extend(each)

    def figures(self, name: str, flops: dict[StageName, int]) -> tuple[StageFigures, ...]:
        """Of the stages that were asked for and that this model has."""
        there = [stage for stage in self._stages if (name, stage) in self._spent]
        return tuple(_figures(stage, self._spent[name, stage], flops.get(stage, 0)) for stage in there)

    def differences(self, *, decoded: bool) -> tuple[Difference, ...]:
        """Of the last windows, against the first subject's. decoded: whether the pictures are real."""
        first, *others = (subject.name for subject in self._subjects)
        ours = self._views[first]
        return tuple(
            Difference(
                name=name,
                latents=_relative_difference(ours.latents, self._views[name].latents),
                pictures=_relative_difference(ours.samples, self._views[name].samples) if decoded else None,
                psnr_db=psnr_db(self._views[name].samples, ours.samples) if decoded else None,
            )
            for name in others
        )


def _figures(stage: StageName, spent: Sequence[Spent], flops: int) -> StageFigures:
    walls = sorted(each.wall_s for each in spent)
    return StageFigures(
        stage=stage,
        runs=len(walls),
        median_s=median(walls),
        p95_s=walls[math.ceil(0.95 * (len(walls) - 1))],
        cpu_s=median(each.cpu_s for each in spent),
        tflop=flops / 1e12,
    )


def _relative_difference(ours: Tensor, other: Tensor) -> float:
    """Largest absolute difference over the largest absolute value of ours."""
    largest = ours.double().abs().max().clamp_min(torch.finfo(torch.float64).tiny)
    return ((ours.double() - other.double()).abs().max() / largest).item()


# --- arithmetic, counted on the meta device, where the counter sees attention; on a CPU it does not ------------------


@torch.inference_mode()
def _counted_flops(name: str, traits: Traits, work: Work) -> dict[StageName, int]:
    """Operations of each stage; compiling changes nothing in it. What is prepared once counts for the window."""
    config = traits.diffusion
    engine = engine_named("diffusers" if name.startswith("diffusers") else "ours", empty_networks(config))
    height, width = work.height // config.vae.down_factor, work.width // config.vae.down_factor
    frames = _empty(config.frames, 3, work.height, work.width)
    latents = _empty(config.frames, config.vae.latent_channels, height, width)
    first, step = _sampling(engine, config, with_changes(work, steps=2), (height, width))
    counted: dict[StageName, int] = {
        "tower": 0 if config.image_encoder is None else _counted(lambda: engine.tokens(frames)),
        "encode": _counted(lambda: engine.condition_mean(frames)),
        "step": step,
        "decode": _counted(lambda: engine.decode(latents)),
    }
    sampling = first + (work.steps - 1) * step
    return counted | {"window": counted["tower"] + counted["encode"] + sampling + counted["decode"]}


def _sampling(engine: Engine, config: ModelConfig, work: Work, size: tuple[int, int]) -> tuple[int, int]:
    """Of the first step, with what is prepared before it, and of a further one."""
    frames, unet, schedule = config.frames, config.unet, Schedule.of(config, work.options)
    branches = schedule.branches
    given = Conditioning(
        vector=_empty(frames, unet.vector_width),
        camera=_empty(frames, unet.camera_width) if unet.camera_width else None,
        tokens=None if unet.context_width is None else _empty(branches * frames, unet.context_width),
        latents=_empty(branches * frames, unet.condition_channels, *size),
    )
    so_far: list[int] = []
    with FlopCounterMode(display=False) as counter:
        options = RenderOptions(progress=lambda _, __: so_far.append(counter.get_total_flops()))
        engine.sample(_empty(1, frames, config.vae.latent_channels, *size), given, schedule, options)
    first, second = so_far
    return first, second - first


def _counted(work: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def _empty(*shape: int) -> Tensor:
    return torch.empty(shape, device="meta")
