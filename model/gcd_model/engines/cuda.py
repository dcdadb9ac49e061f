"""The networks as a GPU runs them best: compiled blocks, a whole denoising step as one CUDA graph.

Every part also runs on a CPU, compiled or not and without graphs, which is how most of it is tested.
"""

import logging
import os
from collections.abc import Callable, Generator, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import torch
from torch import Tensor, nn

from gcd_model.conditioning import Conditioning, ImageTransformerLayer
from gcd_model.diffusion import (
    GuidedDenoiser,
    RenderOptions,
    Schedule,
    StepInputs,
    advanced,
    denoised,
    evaluated,
    watched,
)
from gcd_model.engines.gpu_layout import channels_last, checked_decoder, join_attention, multiply_in_float8
from gcd_model.engines.torch import Engine, NetworkName
from gcd_model.layers import Downsample, ResBlock, Upsample, VideoResBlock, prepare
from gcd_model.networks import Networks
from gcd_model.unet import Stage
from gcd_model.vae import PixelAttention

_LOG = logging.getLogger(__name__)
Kept = TypeVar("Kept")


@dataclass(frozen=True, kw_only=True, slots=True)
class CudaOptions:
    """What the engine does to be fast.

    backend: of torch.compile; None runs the blocks as they are. tuned: inductor tries kernels for each shape, which
        takes many times as long to compile. graphs: record steps, encoders and decoder as CUDA graphs.
    arranged: lay convolutions out as tensor cores read them, make query, key and value of an attention one product.
    float8: the U-Net's attention and feed-forward multiply in 8 bits.
    half_decoder: decode in float16, else bfloat16, where its pictures reach 50 dB against float32, see
        `checked_decoder`.
    """

    backend: str | None = "inductor"
    tuned: bool = False
    graphs: bool = True
    arranged: bool = True
    float8: bool = False
    half_decoder: bool = True


class CudaEngine(Engine):
    """Not for several threads at once."""

    def __init__(
        self, networks: Networks, options: CudaOptions | None = None, recorder: "Recorder | None" = None
    ) -> None:
        """Take the networks over: they are laid out and compiled in place.

        recorder: what replays work; by default as `options` and the device say.
        """
        options = options or CudaOptions()
        networks.requires_grad_(False)
        prepare(networks)
        if options.half_decoder:
            networks.decoder, psnr = checked_decoder(networks)
            _LOG.info("decoder in %s: %.1f dB from float32", networks.decoder.stem.weight.dtype, psnr)
        if options.arranged:
            channels_last(networks)
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
        self._calls: dict[Hashable, RecordedCall] = {}

    def forget(self) -> None:
        """Drop what was recorded, and with it the memory it holds."""
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

    def _called(self, key: Hashable, work: "Work", given: "Tensors") -> Sequence[Tensor]:
        """What work gives, in memory that it keeps; recorded for the shapes of what it is given."""
        shapes = tuple(None if each is None else (each.shape, each.dtype) for each in given)
        return recent(self._calls, (key, shapes), lambda: RecordedCall(work, given, self._recorder))(given)

    def compute(self, name: NetworkName, given: Tensor) -> Tensor:
        with self._at_work():
            return self._called(name, partial(self._network, name), (given,))[0].clone()

    def _network(self, name: NetworkName, given: Tensor) -> tuple[Tensor]:
        return (super().compute(name, given),)

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
        start, steps = start.to(self.like.device), len(schedule.steps)
        done = torch.cuda.Event(blocking=True) if start.is_cuda and (options.cancel or options.progress) else None
        with self._at_work():
            denoiser, x, before = GuidedDenoiser(self, given, schedule, start), start, start
            for i in watched(steps, options):
                if options.progress is not None:
                    self._beat = partial(options.progress, i, steps)
                branches = 1 + schedule.guided[i]
                x, before = self._called(branches, partial(self._step, branches), (x, before, *denoiser.inputs(i)))
                if done is not None:
                    done.record()
                    done.synchronize()  # of the event alone: the device does not notice
            if options.progress is not None:
                self._beat = partial(options.progress, steps, steps)
            return x.clone()

    def _step(self, branches: int, x: Tensor, before: Tensor, *inputs: Any) -> tuple[Tensor, Tensor]:
        given = StepInputs(*inputs)
        return self._update(x, before, evaluated(self, x, given, branches), given)


def _tell(progress: Callable[[int, int], object], k: int, views: int, done: int, steps: int) -> None:
    progress(k * steps + done, views * steps)


def of_view(given: Conditioning, k: int, views: int) -> Conditioning:
    """The rows of one of so many views, of both guidance branches if there are two."""
    shape = (-1, views, len(given.vector) // views)

    def rows(batch: Any) -> Any:
        return None if batch is None else batch.unflatten(0, shape)[:, k].flatten(0, 1)

    return Conditioning(**{field.name: rows(getattr(given, field.name)) for field in fields(given)})


Update: TypeAlias = Callable[[Tensor, Tensor, Tensor, StepInputs], tuple[Tensor, Tensor]]
"""`solved`, as it is or compiled."""


def solved(x: Tensor, before: Tensor, raw: Tensor, inputs: StepInputs) -> tuple[Tensor, Tensor]:
    """What follows the network in a step, preconditioning, guidance and solver: the next x, and D of this step.

    x, before: [K, T, C, h, w], float32. raw: [R, K, T, C, h, w], what the network said, R = 2 with guidance.
    """
    *_, keep, gain = inputs.numbers.unbind()
    clean = denoised(x, raw, inputs)
    return advanced(x, clean, before, keep, gain), clean


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


def compile_regions(model: nn.Module, backend: str | Backend) -> None:
    """Compile every region, in place, when it is first called. backend: of torch.compile."""
    from torch._dynamo import config  # takes seconds

    # all blocks of a kind share one piece of code, which torch compiles for eight shapes unless told otherwise
    name = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # before torch 2.7
    for each, least in ((name, _SHAPES), (f"accumulated_{name}", _ALL_SHAPES)):
        setattr(config, each, max(least, getattr(config, each)))
    for region in regions(model):
        region.compile(backend=backend, fullgraph=True, dynamic=False)


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


# --- work recorded once and replayed with one call: no Python and no allocation between its kernels -------------------


Replay = Callable[[], object]
"""Does the recorded work again, on the same memory."""

_WARM_RUNS = 2  # the first compiles and lets cuDNN choose, the second shows that neither is left to do
_MOST_KEPT = 16  # of all kinds of work together: a step guided or not, encoders, decoder


class Recorder:
    """What turns work into a replay: this one does the work anew each time, for a CPU and where graphs are not wanted.

    The work reads and writes memory that stays where it is, and never asks what a tensor holds.
    """

    def record(self, work: Replay) -> Replay:
        """The work, done at least once, ready to be done again and again. Raises torch.OutOfMemoryError."""
        work()
        return work

    def forget(self) -> None:
        """What was recorded is used no more."""


class CudaGraphs(Recorder):
    """Records CUDA graphs.

    All share one pool of memory, so that together they take as much as the largest: what a graph leaves in the pool
    must be copied out before another is replayed. Other threads may use the device meanwhile.
    """

    def __init__(self) -> None:
        self.forget()

    def record(self, work: Replay) -> Replay:
        """On a stream of its own, as compiled code may ask which one it is on. cuDNN tries its ways of convolving and
        takes the fastest: worth it for what is done again and again, not where every run must give the same."""
        graph, side, main = torch.cuda.CUDAGraph(), torch.cuda.Stream(), torch.cuda.current_stream()
        before = torch.backends.cudnn.benchmark
        torch.backends.cudnn.benchmark = not torch.backends.cudnn.deterministic
        try:
            side.wait_stream(main)
            with torch.cuda.stream(side):
                for _ in range(_WARM_RUNS):
                    work()
            main.wait_stream(side)
            with (
                torch.compiler.set_stance("fail_on_recompile"),  # a compiler at work would be recorded, too
                torch.cuda.graph(graph, pool=self._pool, stream=side, capture_error_mode="thread_local"),
            ):
                work()
        except RuntimeError as error:  # ending a broken capture raises, too, and hides why it broke
            if isinstance(error.__context__, torch.OutOfMemoryError):
                raise error.__context__ from None
            raise
        finally:
            torch.backends.cudnn.benchmark = before
        return graph.replay

    def forget(self) -> None:
        """A pool without graphs gives its memory back."""
        self._pool = torch.cuda.graph_pool_handle()


def recent(kept: dict[Hashable, Kept], key: Hashable, make: Callable[[], Kept], limit: int = _MOST_KEPT) -> Kept:
    """What is kept of this key, made where there is none; beyond the limit the one not used for longest goes."""
    if key not in kept:
        while len(kept) >= limit:
            del kept[next(iter(kept))]
        kept[key] = make()
    kept[key] = kept.pop(key)  # the last one is the one last used
    return kept[key]


Tensors: TypeAlias = Sequence[Tensor | None]
Work: TypeAlias = Callable[..., Sequence[Tensor]]


class RecordedCall:
    """A function of tensors, or None in their place, to tensors: recorded for the shapes of `given`."""

    def __init__(self, work: Work, given: Tensors, recorder: Recorder) -> None:
        self._given = [None if each is None else each.clone() for each in given]
        self._made = [torch.empty_like(each) for each in work(*self._given)]  # lies outside the pool of the graphs

        def once() -> None:
            for memory, made in zip(self._made, work(*self._given), strict=True):
                memory.copy_(made)

        self._replay = recorder.record(once)

    def __call__(self, given: Tensors) -> Sequence[Tensor]:
        """The function of `given`, in memory that the next call overwrites."""
        for memory, value in zip(self._given, given, strict=True):
            if memory is not None and value is not None:
                memory.copy_(value)
        self._replay()
        return self._made
