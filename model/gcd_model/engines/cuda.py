"""The networks as a GPU runs them best: compiled blocks, a whole denoising step as one CUDA graph.

Every part also runs on a CPU, compiled or not and without graphs, which is how most of it is tested.
"""

import copy
import logging
import math
import os
from collections.abc import Callable, Generator, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.conditioning import Conditioning, ImageTransformerLayer
from gcd_model.diffusion import RenderOptions, Schedule, unit_noise, watched
from gcd_model.engines.graphs import CudaGraphs, RecordedCall, Recorder, StepMemory, Update, recent, solved
from gcd_model.engines.torch import Engine, NetworkName
from gcd_model.layers import Attention, Downsample, FeedForward, ResBlock, Upsample, VideoResBlock, prepare
from gcd_model.networks import Networks
from gcd_model.unet import Stage
from gcd_model.vae import PixelAttention, TemporalDecoder, to_pixels

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class CudaOptions:
    """What the engine does to be fast.

    backend: of torch.compile; None runs the blocks as they are. tuned: inductor tries kernels for each shape, which
        takes many times as long to compile. graphs: record steps, encoders and decoder as CUDA
        graphs. channels_last: lay convolutions out as tensor cores read them. joined: query, key and value of an
        attention are one product. float8: the U-Net's attention and feed-forward multiply in 8 bits.
    decoder: its precision; "checked" means float16, else bfloat16, where its pictures reach 50 dB against float32,
        see `checked_decoder`.
    """

    backend: str | None = "inductor"
    tuned: bool = False
    graphs: bool = True
    channels_last: bool = True
    joined: bool = True
    float8: bool = False
    decoder: Literal["checked", "float32", "float16", "bfloat16"] = "checked"


class CudaEngine(Engine):
    """Not for several threads at once."""

    def __init__(
        self, networks: Networks, options: CudaOptions | None = None, recorder: Recorder | None = None
    ) -> None:
        """Take the networks over: they are laid out and compiled in place.

        recorder: what replays work; by default as `options` and the device say.
        """
        options = options or CudaOptions()
        networks.requires_grad_(False)
        prepare(networks)
        if options.decoder == "checked":
            networks.decoder, psnr = checked_decoder(networks)
            _LOG.info("decoder in %s: %.1f dB from float32", networks.decoder.stem.weight.dtype, psnr)
        elif options.decoder != "float32":  # a copy: others may share its weights
            networks.decoder = copy.deepcopy(networks.decoder).to(getattr(torch, options.decoder))
        if options.channels_last:
            channels_last(networks)
        if options.joined:
            join_attention(networks)
        if options.float8:
            multiply_in_float8(networks.unet)
        prepare(networks)
        super().__init__(networks)
        self._beat: Callable[[], object] = lambda: None  # called before each piece of code is compiled
        self._update = _compiled(networks, options, lambda: self._beat())
        on_gpu = options.graphs and self.like.device.type == "cuda"
        with self._on_device():
            self._recorder = recorder or (CudaGraphs() if on_gpu else Recorder())
        self._memories: dict[Hashable, StepMemory] = {}
        self._calls: dict[Hashable, RecordedCall] = {}

    def forget(self) -> None:
        """Drop what was recorded, and with it the memory it holds."""
        self._memories.clear()
        self._calls.clear()
        self._recorder.forget()

    def _on_device(self) -> AbstractContextManager[object]:
        """Streams, events and graphs are of the current device."""
        device = self.like.device
        return torch.cuda.device(device) if device.type == "cuda" else nullcontext()

    @contextmanager
    def _at_work(self) -> Generator[None]:
        """When the device is full, what was recorded is dropped, so that its memory is free again."""
        try:
            with torch.inference_mode(), self._on_device():
                yield
        except torch.OutOfMemoryError:
            self.forget()
            raise

    def compute(self, name: NetworkName, given: Tensor) -> Tensor:
        with self._at_work():
            work = partial(super().compute, name)
            key = name, given.shape, given.dtype
            return recent(self._calls, key, lambda: RecordedCall(work, given, self._recorder))(given)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """See Engine. One view and sample after the other: so no number of them has code or graphs of its own, and none
        that comes is compiled while views are awaited."""
        views, clips = len(start), list[Tensor]()
        for k in range(views):
            part = options
            if options.progress is not None:
                part = replace(options, progress=partial(_tell, options.progress, k, views))
            clips.append(self._sample(start[k : k + 1], of_view(given, k, views), schedule, part))
        return torch.cat(clips)

    def _sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """With somebody to tell or to ask, each step is waited for before the next is queued; while code is compiled,
        progress is told of again."""
        start, widths = start.to(self.like.device), [1 + guided for guided in schedule.guided]
        done = torch.cuda.Event(blocking=True) if start.is_cuda and (options.cancel or options.progress) else None
        if options.progress is not None:
            self._beat = partial(options.progress, 0, len(widths))
        with self._at_work():
            memory = recent(
                self._memories,
                (start.shape, given.latents.shape, given.tokens is None),
                lambda: StepMemory(self, self._update, start, given, schedule),
            )
            memory.load(start, given, schedule)
            if memory.record(set(widths), self._recorder):
                memory.load(start, given, schedule)
            for i in watched(len(widths), options):
                memory.step(i, widths[i])
                if done is not None:
                    done.record()
                    done.synchronize()  # of the event alone: the device does not notice
            return memory.x.clone()


def _tell(progress: Callable[[int, int], object], k: int, views: int, done: int, steps: int) -> None:
    progress(k * steps + done, views * steps)


def of_view(given: Conditioning, k: int, views: int) -> Conditioning:
    """The rows of one of so many views, of both guidance branches if there are two."""
    frames = len(given.vector) // views

    def rows(batch: Any) -> Any:
        is_batch = isinstance(batch, Tensor)
        return batch.unflatten(0, (-1, views, frames))[:, k].flatten(0, 1) if is_batch else batch

    return Conditioning(**{field.name: rows(getattr(given, field.name)) for field in fields(given)})


def _compiled(networks: Networks, options: CudaOptions, beat: Callable[[], object]) -> Update:
    if options.backend is None:
        return solved
    if options.backend == "inductor":
        keep_compiled()
    backend = _heard(options.backend, beat, tuned=options.tuned)
    compile_regions(networks, backend)
    return torch.compile(solved, backend=backend, fullgraph=True, dynamic=False)


# --- compiling networks region by region -----------------------------------------------------------------------------


Backend: TypeAlias = Callable[[Any, Any], Any]

_REGIONS = (Stage, VideoResBlock, ResBlock, PixelAttention, ImageTransformerLayer, Downsample, Upsample)
_SHAPES = 256  # of one kind of region: the U-Net has about 20, with and without the unconditional branch
_ALL_SHAPES = 4096  # of all kinds together, as torch counts them by the code that every module's call begins with


def regions(model: nn.Module) -> Iterator[nn.Module]:
    """The parts that are compiled, outermost first found."""
    if isinstance(model, _REGIONS):
        yield model
        return
    for child in model.children():
        yield from regions(child)


def compile_regions(model: nn.Module, backend: str | Backend) -> int:
    """Compile every region, in place, when it is first called; how many there are. backend: of torch.compile."""
    from torch._dynamo import config  # takes seconds

    # all blocks of a kind share one piece of code, which torch compiles for eight shapes unless told otherwise
    name = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # before torch 2.7
    for each, least in ((name, _SHAPES), (f"accumulated_{name}", _ALL_SHAPES)):
        setattr(config, each, max(least, getattr(config, each)))
    found = list(regions(model))
    for region in found:
        region.compile(backend=backend, fullgraph=True, dynamic=False)
    return len(found)


def _heard(name: str, beat: Callable[[], object], *, tuned: bool = False) -> Backend:
    """A backend of torch.compile that says when it begins to compile something. tuned: see CudaOptions."""
    from torch._dynamo import lookup_backend  # takes seconds
    from torch._inductor import list_mode_options

    compiler = lookup_backend(name)
    how = {"config_patches": list_mode_options("max-autotune-no-cudagraphs")} if tuned and name == "inductor" else {}

    def compiled(graph: Any, inputs: Any) -> Any:
        beat()
        return compiler(graph, inputs, **how)

    return compiled


def channels_last(model: nn.Module) -> None:
    """Lay convolution weights out as tensor cores read them; what they make is then laid out so, too."""
    orders = {4: torch.channels_last, 5: torch.channels_last_3d}
    for module in model.modules():
        if isinstance(module, nn.Conv2d | nn.Conv3d):
            weight = module.weight.contiguous(memory_format=orders[module.weight.ndim])
            module.weight = nn.Parameter(weight, requires_grad=False)


class Float8(NamedTuple):
    """A matrix [N, M] in 8 bits: values float8_e4m3fn [N, M], scales float32 [N, 1], one a row, so that its largest
    number is the largest there is."""

    values: Tensor
    scales: Tensor

    @classmethod
    def of(cls, matrix: Tensor) -> Self:
        """The nearest to it."""
        largest = torch.finfo(torch.float8_e4m3fn).max
        scales = matrix.abs().amax(-1, keepdim=True).float().clamp(min=1e-12) / largest
        return cls((matrix / scales).clamp(-largest, largest).to(torch.float8_e4m3fn), scales)


def linear(x: Tensor, weight: Tensor | Float8, bias: Tensor | None = None) -> Tensor:
    """As F.linear; by a weight in 8 bits, x [..., M] is rounded to 8 bits, too, row by row."""
    if isinstance(weight, Tensor):
        return F.linear(x, weight, bias)
    rows, matrix = Float8.of(x.flatten(0, -2)), weight.values.t()
    made = torch._scaled_mm(  # pyright: ignore[reportPrivateUsage, reportPrivateImportUsage]  there is no other door to it
        rows.values, matrix, scale_a=rows.scales, scale_b=weight.scales.t(), out_dtype=torch.bfloat16
    )
    made = made.to(x.dtype).unflatten(0, x.shape[:-1])
    return made if bias is None else made + bias


class Float8Linear(nn.Linear):
    """A linear layer by `float8`, its weight in 8 bits."""

    float8: Float8

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  torch's name
        """input: [..., M]."""
        return linear(input, self.float8, self.bias)


def multiply_in_float8(model: nn.Module) -> None:
    """Have attention and feed-forward multiply in 8 bits, in place; not what an adapter changes, nor sides that are no
    multiple of 16, which no GPU multiplies so."""
    for module in model.modules():
        layers = list(module.children()) if isinstance(module, Attention | FeedForward) else []
        if isinstance(module, JoinedAttention) and isinstance(module.joint, Tensor):
            layers = [module.out]  # query, key and value are parts of the joint product
            module.joint = module.joint if module.joint.shape[1] % 16 else Float8.of(module.joint)
        for layer in layers:
            if type(layer) is nn.Linear and not (layer.in_features % 16 or layer.out_features % 16):
                vars(layer)["float8"], layer.__class__ = Float8.of(layer.weight), Float8Linear


class JoinedAttention(Attention):
    """Attention whose query, key and value are one product. joint: their weights, of which theirs are now parts."""

    joint: Tensor | Float8

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, L, C]."""
        query, key, value = map(self._split, linear(x, self.joint).chunk(3, dim=-1))
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(1, 2).flatten(2))


def join_attention(model: nn.Module) -> None:
    """Make every attention a JoinedAttention, in place and in no more memory; not one that an adapter changes."""
    for module in model.modules():
        layers = (module.query, module.key, module.value) if type(module) is Attention else ()
        if layers and all(type(layer) is nn.Linear for layer in layers):
            joint = torch.cat([layer.weight for layer in layers])
            for layer, part in zip(layers, joint.chunk(3), strict=True):
                layer.weight.data = part
            module.__class__ = JoinedAttention
            module.joint = joint


def keep_compiled() -> None:
    """Have all that is compiled kept for later processes: in GCD_CACHE_DIR, else the user's cache folder.

    What TORCHINDUCTOR_CACHE_DIR and TRITON_CACHE_DIR say already stands.
    """
    own = os.environ.get("GCD_CACHE_DIR")
    root = Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gcd-node"
    folder = root / "compiled" / torch.__version__
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))
    os.environ.setdefault("TRITON_CACHE_DIR", str(folder / "triton"))


# --- whether the decoder may compute in half precision ---------------------------------------------------------------


WANTED_DB = 50.0
"""PSNR against float32 from which half precision is used: less than one level of 8 bits, on average."""

_COARSE = 16
_SEED = 11
_FRAMES = 4  # decoding all of a clip in float32 without graphs takes more memory than anything else does


@torch.inference_mode()
def checked_decoder(networks: Networks) -> tuple[TemporalDecoder, float]:
    """The decoder in float16, which has three bits more, or else in bfloat16, which no activation is too large for, if
    its pictures of a test clip are good enough for that; and their PSNR, infinite for float32."""
    config, full = networks.config, networks.decoder
    height, width = config.height, config.width  # a smooth random picture with a fine pattern, a pixel on each frame
    coarse = unit_noise((1, 3, max(2, height // _COARSE), max(2, width // _COARSE)), _SEED)
    picture = F.interpolate(coarse, size=(height, width), mode="bilinear")[0] + 0.2 * unit_noise(
        (3, height, width), _SEED, 1
    )
    frames = torch.stack([picture.roll(t, dims=-1) for t in range(min(config.frames, _FRAMES))]).clamp(-1, 1)
    encoder = networks.condition_encoder
    latents = torch.cat([encoder(each[None].to(encoder.stem.weight)).mean for each in frames]).float()
    truth = to_pixels(full(latents.to(full.stem.weight), len(latents)))
    for precision in (torch.float16, torch.bfloat16):
        half = copy.deepcopy(full).to(precision)
        if (psnr := psnr_db(to_pixels(half(latents.to(precision), len(latents))), truth)) > WANTED_DB:
            return half, psnr
    return full, math.inf


def psnr_db(ours: Tensor, truth: Tensor) -> float:
    """Peak signal to noise ratio of pictures in [0, 1]; infinite for equal ones, 0 if there is NaN or Inf."""
    error = F.mse_loss(ours.float(), truth.float()).item()
    if not math.isfinite(error):
        return 0.0
    return math.inf if error == 0 else -10 * math.log10(error)
