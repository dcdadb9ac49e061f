"""The networks as a GPU runs them best: compiled blocks, a whole denoising step as one CUDA graph.

Every part also runs on a CPU, compiled or not and without graphs, which is how most of it is tested.
"""

import copy
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Concatenate, Literal, ParamSpec, Self, TypeVar

import torch
from torch import Tensor

from gcd_model.clip import RenderOptions
from gcd_model.compiled_regions import cache_folder, channels_last, compile_regions, keep_compiled
from gcd_model.conditioning import Conditioning
from gcd_model.cuda_graphs import CudaGraphs, Pace, Recent, RecordedCall, Recorder, Unrecorded
from gcd_model.decoder_check import checked_decoder
from gcd_model.denoiser import TorchBackbone
from gcd_model.engine import TorchEngine
from gcd_model.errors import Cancelled
from gcd_model.fused_step import StepMemory, Update, solved
from gcd_model.geometry import Trajectory
from gcd_model.image_encoder import clip_pixels
from gcd_model.layers import prepare
from gcd_model.networks import Networks
from gcd_model.schedule import Schedule

_LOG = logging.getLogger(__name__)

Given = ParamSpec("Given")
Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True, slots=True)
class CudaOptions:
    """What the engine does to be fast.

    backend: of torch.compile; None runs the blocks as they are. graphs: record steps, encoders and decoder as CUDA
        graphs. channels_last: lay convolutions out as tensor cores read them.
    decoder: its precision; "checked" means bfloat16 where its pictures reach 50 dB against float32, see
        `checked_decoder`.
    cache: folder of compiled code; None for the usual one, see `cache_folder`.
    """

    backend: str | None = "inductor"
    graphs: bool = True
    channels_last: bool = True
    decoder: Literal["checked", "float32", "bfloat16"] = "checked"
    cache: Path | None = None

    @classmethod
    def of_device(cls, device: torch.device) -> Self:
        """Everything on a GPU, and nothing on a CPU, where none of it would gain."""
        return cls() if device.type == "cuda" else cls(backend=None, channels_last=False, decoder="float32")


def _forgetful(
    method: Callable[Concatenate["CudaEngine", Given], Made],
) -> Callable[Concatenate["CudaEngine", Given], Made]:
    """The method; when the device is full, what was recorded is dropped, so that its memory is free again."""

    @wraps(method)
    def guarded(engine: "CudaEngine", *args: Given.args, **kwargs: Given.kwargs) -> Made:
        try:
            with torch.inference_mode():
                return method(engine, *args, **kwargs)
        except torch.OutOfMemoryError:
            engine.forget()
            raise

    return guarded


class CudaEngine:
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
        _settle_decoder(networks, options.decoder)
        if options.channels_last:
            channels_last(networks)
        prepare(networks)
        update = _compiled(networks, options)
        self._networks, self._update = networks, update
        self._plain = TorchEngine(networks)
        self._backbone = TorchBackbone(networks.unet)
        on_gpu = options.graphs and self.like.device.type == "cuda"
        self._recorder = recorder or (CudaGraphs() if on_gpu else Unrecorded())
        self._memories: Recent[StepMemory] = Recent()
        self._tower = RecordedCall(self._tokens_of, self._recorder)
        self._encoder = RecordedCall(lambda frames: networks.condition_encoder(frames).mean, self._recorder)
        self._decoder = RecordedCall(lambda latents: networks.decoder(latents, len(latents)), self._recorder)

    def forget(self) -> None:
        """Drop what was recorded, and with it the memory it holds."""
        self._memories.clear()
        for call in (self._tower, self._encoder, self._decoder):
            call.forget()
        self._recorder.forget()

    @property
    def like(self) -> Tensor:
        """See Engine."""
        return self._networks.unet.stem.weight

    @_forgetful
    def tokens(self, frames: Tensor) -> Tensor | None:
        """See Engine."""
        tower = self._networks.image_encoder
        if tower is None:
            return None
        return self._tower(clip_pixels(frames.to(self.like.device), tower.config.image_size).to(self.like))

    @_forgetful
    def condition_mean(self, frames: Tensor) -> Tensor:
        """See Engine."""
        return self._encoder(frames.to(self.like))

    @_forgetful
    def camera(self, path: Trajectory) -> Tensor | None:
        """See Engine."""
        return self._plain.camera(path)

    @_forgetful
    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """See Engine. With somebody to tell or to ask, each step is waited for before the next is queued."""
        start = start.to(self.like.device)
        widths = [2 if guided else 1 for guided in schedule.guided]
        memory = self._memories.get(
            (start.shape, given.latents.shape, given.tokens is None),
            lambda: StepMemory(self._backbone, self._update, start, given, schedule),
        )
        memory.begin(start, given, schedule)
        if memory.record(set(widths), self._recorder):
            memory.begin(start, given, schedule)
        pace = Pace(self.like.device)
        for i, branches in enumerate(widths):
            if options.cancel is not None and options.cancel.is_set():
                raise Cancelled(f"stopped before step {i + 1} of {len(widths)}")
            memory.seek(i)
            memory.advance(branches)
            if options.cancel is not None or options.progress is not None:
                pace.wait()
            if options.progress is not None:
                options.progress(i + 1, len(widths))
        return memory.result()

    @_forgetful
    def decode(self, latents: Tensor) -> Tensor:
        """See Engine."""
        return self._decoder(latents.to(self._networks.decoder.stem.weight)).float()

    def _tokens_of(self, pixels: Tensor) -> Tensor:
        tower = self._networks.image_encoder
        assert tower is not None, "only models with an image tower have tokens"
        return tower(pixels)


def _settle_decoder(networks: Networks, precision: str) -> None:
    if precision == "bfloat16":
        networks.decoder = copy.deepcopy(networks.decoder).to(torch.bfloat16)  # others may share its weights
    elif precision == "checked":
        choice = checked_decoder(networks)
        networks.decoder = choice.decoder
        _LOG.info("decoder in %s: %.1f dB from float32 in bfloat16", choice.decoder.stem.weight.dtype, choice.psnr_db)


def _compiled(networks: Networks, options: CudaOptions) -> Update:
    if options.backend is None:
        return solved
    if options.backend == "inductor":
        keep_compiled(options.cache or cache_folder())
    compile_regions(networks, options.backend)
    return torch.compile(solved, backend=options.backend, fullgraph=True, dynamic=False)
