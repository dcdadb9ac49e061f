"""The networks as a GPU runs them best: compiled blocks, a whole denoising step as one CUDA graph.

Every part also runs on a CPU, compiled or not and without graphs, which is how most of it is tested.
"""

import copy
import logging
import math
import os
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Literal, Self, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.conditioning import Conditioning, ImageTransformerLayer
from gcd_model.diffusion import RenderOptions, Schedule, unit_noise, watched
from gcd_model.engines.graphs import CudaGraphs, Recent, RecordedCall, Recorder, StepMemory, Update, solved
from gcd_model.engines.torch import NetworkName, TorchEngine
from gcd_model.layers import Downsample, ResBlock, Upsample, VideoResBlock, prepare
from gcd_model.networks import Networks
from gcd_model.unet import Stage
from gcd_model.vae import PixelAttention, TemporalDecoder, to_pixels

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class CudaOptions:
    """What the engine does to be fast.

    backend: of torch.compile; None runs the blocks as they are. graphs: record steps, encoders and decoder as CUDA
        graphs. channels_last: lay convolutions out as tensor cores read them.
    decoder: its precision; "checked" means bfloat16 where its pictures reach 50 dB against float32, see
        `checked_decoder`.
    """

    backend: str | None = "inductor"
    graphs: bool = True
    channels_last: bool = True
    decoder: Literal["checked", "float32", "bfloat16"] = "checked"

    @classmethod
    def of_device(cls, device: torch.device) -> Self:
        """Everything on a GPU, and nothing on a CPU, where none of it would gain."""
        return cls() if device.type == "cuda" else cls(backend=None, channels_last=False, decoder="float32")


class CudaEngine(TorchEngine):
    """Implements Engine. Not for several threads at once."""

    def __init__(
        self, networks: Networks, options: CudaOptions | None = None, recorder: Recorder | None = None
    ) -> None:
        """Take the networks over: they are laid out and compiled in place; give a `twin` of those that others use.

        recorder: what replays work; by default as `options` and the device say.
        """
        options = CudaOptions.of_device(networks.unet.stem.weight.device) if options is None else options
        networks.requires_grad_(False)
        prepare(networks)
        if options.decoder == "bfloat16":
            networks.decoder = copy.deepcopy(networks.decoder).to(torch.bfloat16)  # others may share its weights
        elif options.decoder == "checked":
            networks.decoder, psnr = checked_decoder(networks)
            _LOG.info("decoder in %s: %.1f dB from float32 in bfloat16", networks.decoder.stem.weight.dtype, psnr)
        if options.channels_last:
            channels_last(networks)
        prepare(networks)
        super().__init__(networks)
        self._update: Update = solved
        if options.backend is not None:
            if options.backend == "inductor":
                keep_compiled(cache_folder())
            compile_regions(networks, options.backend)
            self._update = torch.compile(solved, backend=options.backend, fullgraph=True, dynamic=False)
        on_gpu = options.graphs and self.like.device.type == "cuda"
        self._recorder = recorder or (CudaGraphs() if on_gpu else Recorder())
        self._memories: Recent[StepMemory] = Recent()
        self._calls: Recent[RecordedCall] = Recent()

    def forget(self) -> None:
        """Drop what was recorded, and with it the memory it holds."""
        self._memories.clear()
        self._calls.clear()
        self._recorder.forget()

    @contextmanager
    def _forgetful(self) -> Generator[None]:
        """When the device is full, what was recorded is dropped, so that its memory is free again."""
        try:
            with torch.inference_mode():
                yield
        except torch.OutOfMemoryError:
            self.forget()
            raise

    def compute(self, name: NetworkName, given: Tensor) -> Tensor:
        with self._forgetful():
            work = partial(super().compute, name)
            key = name, given.shape, given.dtype
            return self._calls.get(key, lambda: RecordedCall(work, given, self._recorder))(given)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """See Engine. With somebody to tell or to ask, each step is waited for before the next is queued."""
        start, widths = start.to(self.like.device), [1 + guided for guided in schedule.guided]
        done = torch.cuda.Event(blocking=True) if start.is_cuda and (options.cancel or options.progress) else None
        with self._forgetful():
            memory = self._memories.get(
                (start.shape, given.latents.shape, given.tokens is None),
                lambda: StepMemory(self, self._update, start, given, schedule),
            )
            memory.begin(start, given, schedule)
            if memory.record(set(widths), self._recorder):
                memory.begin(start, given, schedule)
            for i in watched(len(widths), options):
                memory.seek(i)
                memory.advance(widths[i])
                if done is not None:
                    done.record()
                    done.synchronize()  # of the event alone: the device does not notice
            return memory.result()


# --- compiling networks region by region -----------------------------------------------------------------------------


Model = TypeVar("Model", bound=nn.Module)

_REGIONS = (Stage, VideoResBlock, ResBlock, PixelAttention, ImageTransformerLayer, Downsample, Upsample)
_SHAPES = 256  # of one kind of region: the U-Net has about 20, with and without the unconditional branch


def twin(model: Model) -> Model:
    """The same network with the same weights in memory, to be compiled without touching the first.

    To move or to convert one of the two would do so to both.
    """
    memo: dict[int, object] = {id(each): each for each in chain(model.parameters(), model.buffers())}
    return copy.deepcopy(model, memo).eval()


def regions(model: nn.Module) -> Iterator[nn.Module]:
    """The parts that are compiled, outermost first found."""
    if isinstance(model, _REGIONS):
        yield model
        return
    for child in model.children():
        yield from regions(child)


def compile_regions(model: nn.Module, backend: str) -> None:
    """Compile every region, in place, when it is first called. backend: of torch.compile."""
    from torch._dynamo import config  # takes seconds

    # all blocks of a kind share one piece of code, which torch compiles for eight shapes unless told otherwise
    name = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # before torch 2.7
    setattr(config, name, max(_SHAPES, getattr(config, name)))
    for region in regions(model):
        region.compile(backend=backend, fullgraph=True, dynamic=False)


def channels_last(model: nn.Module) -> None:
    """Lay convolution weights out as tensor cores read them; what they make is then laid out so, too."""
    orders = {4: torch.channels_last, 5: torch.channels_last_3d}
    for module in model.modules():
        if isinstance(module, nn.Conv2d | nn.Conv3d):
            weight = module.weight.contiguous(memory_format=orders[module.weight.ndim])
            module.weight = nn.Parameter(weight, requires_grad=False)


def cache_folder() -> Path:
    """Where compiled code lies unless TORCHINDUCTOR_CACHE_DIR says otherwise; GCD_CACHE_DIR names another."""
    own = os.environ.get("GCD_CACHE_DIR")
    root = Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gcd-node"
    return root / "compiled" / torch.__version__


def keep_compiled(folder: Path) -> None:
    """Have all that is compiled in this process kept in a folder, so that the next one finds it.

    What TORCHINDUCTOR_CACHE_DIR and TRITON_CACHE_DIR say already stands.
    """
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))
    os.environ.setdefault("TRITON_CACHE_DIR", str(folder / "triton"))


# --- whether the decoder may compute in bfloat16 ---------------------------------------------------------------------


WANTED_DB = 50.0
"""PSNR against float32 from which bfloat16 is used: less than one level of 8 bits, on average."""

_COARSE = 16
_SEED = 11
_FRAMES = 4  # decoding all of a clip in float32 without graphs takes more memory than anything else does


@torch.inference_mode()
def checked_decoder(networks: Networks) -> tuple[TemporalDecoder, float]:
    """The decoder, in bfloat16 if its pictures of a test clip are good enough for that; and their PSNR."""
    config, full = networks.config, networks.decoder
    frames = drifting_clip(min(config.frames, _FRAMES), config.height, config.width)
    encoder = networks.condition_encoder
    latents = torch.cat([encoder(each[None].to(encoder.stem.weight)).mean for each in frames]).float()
    half = copy.deepcopy(full).to(torch.bfloat16)
    psnr = psnr_db(*(to_pixels(each(latents.to(each.stem.weight), len(latents))) for each in (half, full)))
    return half if psnr > WANTED_DB else full, psnr


def drifting_clip(frames: int, height: int, width: int) -> Tensor:
    """A smooth random picture with a fine pattern that moves by a pixel a frame: [frames, 3, height, width]."""
    coarse = unit_noise((1, 3, max(2, height // _COARSE), max(2, width // _COARSE)), _SEED)
    smooth = F.interpolate(coarse, size=(height, width), mode="bilinear")[0]
    fine = 0.2 * unit_noise((3, height, width), _SEED, 1)
    return torch.stack([(smooth + fine).roll(t, dims=-1) for t in range(frames)]).clamp(-1, 1)


def psnr_db(ours: Tensor, truth: Tensor) -> float:
    """Peak signal to noise ratio of pictures in [0, 1]; infinite for equal ones, 0 if there is NaN or Inf."""
    error = F.mse_loss(ours.float(), truth.float()).item()
    if not math.isfinite(error):
        return 0.0
    return math.inf if error == 0 else -10 * math.log10(error)
