"""An export run by onnxruntime, behind the same interface as torch.

Guidance, solver and all that lies between graphs stay in torch; one clip goes through a graph at a time. onnxruntime is
imported when the first export is loaded.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from gcd_model.clip import RenderOptions
from gcd_model.conditioning import Conditioning, camera_features
from gcd_model.config import ModelConfig
from gcd_model.denoiser import Denoiser
from gcd_model.errors import DeviceMemoryError, ModelError, OptionError
from gcd_model.geometry import Trajectory
from gcd_model.image_encoder import clip_pixels
from gcd_model.onnx_manifest import GraphName
from gcd_model.sampler import sample
from gcd_model.schedule import Schedule
from gcd_model.unet import StageInputs, StagePlan, UNetPlan

CPU_PROVIDER, CUDA_PROVIDER = "CPUExecutionProvider", "CUDAExecutionProvider"
TENSORRT_PROVIDER = "TensorrtExecutionProvider"
_MISSING = "an export needs onnxruntime, which is not installed: pip install 'gcd-node[onnx]'"
_MEMORY_WORDS = ("failed to allocate", "bad allocation", "out of memory")


class Graphs(Protocol):
    """The graphs of one export, ready to run."""

    def run(self, name: GraphName, *inputs: Tensor) -> tuple[Tensor, ...]:
        """One run. inputs: in the graph's order."""
        ...


class OnnxEngine:
    """The networks of an export, clip by clip. Source: `Engine`."""

    def __init__(self, graphs: Graphs, config: ModelConfig) -> None:
        self._graphs, self._config = graphs, config
        self._backbone = OnnxBackbone(graphs, config.frames)
        self._like = torch.zeros(())

    @property
    def like(self) -> Tensor:
        """See Engine: float32 on the CPU; onnxruntime copies to its own device."""
        return self._like

    def tokens(self, frames: Tensor) -> Tensor | None:
        """See Engine."""
        tower = self._config.image_encoder
        if tower is None:
            return None
        return self._frame_by_frame("image_encoder", clip_pixels(frames.to(self._like), tower.image_size))

    def condition_mean(self, frames: Tensor) -> Tensor:
        """See Engine. Raises OptionError for another size than the export's."""
        wanted = (self._config.height, self._config.width)
        if tuple(frames.shape[-2:]) != wanted:
            size = "x".join(map(str, frames.shape[-2:]))
            raise OptionError(
                f"this export takes frames of {wanted[0]}x{wanted[1]} alone, got {size}; "
                "export it again with --height and --width"
            )
        return self._frame_by_frame("condition_encoder", frames.to(self._like))

    def camera(self, path: Trajectory) -> Tensor | None:
        """See Engine; the features themselves, as the linear map that follows is part of a graph."""
        control = self._config.camera
        return None if control == "none" else camera_features(control, path)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """See Engine."""
        denoiser = Denoiser(self._backbone, given, schedule)
        return sample(denoiser, start, schedule.steps, progress=options.progress, cancel=options.cancel)

    def decode(self, latents: Tensor) -> Tensor:
        """See Engine."""
        return self._graphs.run("decoder", latents)[0]

    def _frame_by_frame(self, name: GraphName, frames: Tensor) -> Tensor:
        return torch.cat([self._graphs.run(name, frame)[0] for frame in frames.split(1)])


class OnnxBackbone:
    """The U-Net as graphs. Its plan has one entry for all stages, side by side, as the graphs take them.

    Source: `Backbone`.
    """

    def __init__(self, graphs: Graphs, frames: int) -> None:
        self._graphs, self._frames = graphs, frames

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """See Backbone."""
        steps = [self._embeddings(label, given) for label in labels.float().split(1)]
        crosses = None if given.tokens is None else self._crosses(given.tokens)
        packed = StagePlan(
            torch.stack([spatial for spatial, _ in steps]),
            torch.stack([temporal for _, temporal in steps]),
            None if crosses is None else crosses[0],
            None if crosses is None else crosses[1],
        )
        return UNetPlan((packed,), given.branches)

    def predict(self, rows: Tensor, condition: Tensor, inputs: tuple[StageInputs, ...]) -> Tensor:
        """See Backbone."""
        return torch.cat([self._graphs.run("step", *clip)[0] for clip in self._clips(rows, condition, inputs)])

    def _embeddings(self, label: Tensor, given: Conditioning) -> tuple[Tensor, Tensor]:
        """Of one step, all views: [K*T, sum of C] each."""
        told = [given.vector] if given.camera is None else [given.vector, given.camera]
        clips = zip(*(each.split(self._frames) for each in told), strict=True)
        spatial, temporal = zip(*(self._graphs.run("embeddings", label, *clip) for clip in clips), strict=True)
        return torch.cat(spatial), torch.cat(temporal)

    def _crosses(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        made = [self._graphs.run("crosses", clip) for clip in tokens.split(self._frames)]
        spatial, temporal = zip(*made, strict=True)
        return torch.cat(spatial), torch.cat(temporal)

    def _clips(self, rows: Tensor, condition: Tensor, inputs: tuple[StageInputs, ...]) -> list[tuple[Tensor, ...]]:
        """What each clip's step takes, in the graph's order."""
        (packed,) = inputs
        given = [each.split(self._frames) for each in (rows, condition, packed.spatial_embedding)]
        given.append(packed.temporal_embedding.split(self._frames))
        if packed.spatial_cross is not None and packed.temporal_cross is not None:
            given += [packed.spatial_cross.split(self._frames), packed.temporal_cross.split(1)]
        return list(zip(*given, strict=True))


class _Session(nn.Module):
    """A graph as a layer of torch, so that whatever looks between layers looks between graphs, too."""

    def __init__(self, session: Any) -> None:
        super().__init__()
        self.session = session
        self.names = [each.name for each in session.get_inputs()]

    def forward(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """One run on the CPU's tensors."""
        arrays = {
            name: tensor.detach().cpu().contiguous().numpy() for name, tensor in zip(self.names, inputs, strict=True)
        }
        found: list[np.ndarray] = self.session.run(None, arrays)
        return tuple(torch.from_numpy(array) for array in found)


class Sessions:
    """Graphs in onnxruntime's hands. Source: `Graphs`."""

    def __init__(self, files: dict[GraphName, Path], choice: "Providers") -> None:
        """Raises: OptionError if onnxruntime or a provider is not there; ModelError if it refuses a graph."""
        runtime = _runtime()
        choice.require_there(runtime.get_available_providers())
        self._sessions = {name: _Session(_session(runtime, path, choice)) for name, path in files.items()}

    def run(self, name: GraphName, *inputs: Tensor) -> tuple[Tensor, ...]:
        """See Graphs. Raises: DeviceMemoryError, ModelError."""
        try:
            return self._sessions[name](inputs)
        except Exception as error:
            if not type(error).__module__.startswith("onnxruntime"):
                raise
            raise _ours(error, name) from error


@dataclass(frozen=True, kw_only=True, slots=True)
class Providers:
    """Which of onnxruntime's execution providers compute, by its own names, best first; the CPU's always comes last.

    threads: of the CPU's. device: number of the GPU. cache: where TensorRT keeps what it has built. half: whether
        TensorRT may compute in float16.
    """

    names: tuple[str, ...] = ()
    threads: int = 1
    device: int = 0
    cache: Path | None = None
    half: bool = False

    def require_there(self, available: Sequence[str]) -> None:
        """Raises OptionError for a provider this onnxruntime was not built with."""
        absent = [name for name in self.names if name not in available]
        if absent:
            raise OptionError(
                f"onnxruntime has no {absent[0]} here, only {', '.join(available)}; "
                "install a build that has it, or leave the provider out"
            )

    def with_options(self) -> list[tuple[str, dict[str, str]]]:
        """As onnxruntime takes them."""
        named = [(name, self._options(name)) for name in self.names if name != CPU_PROVIDER]
        return [*named, (CPU_PROVIDER, {})]

    def _options(self, name: str) -> dict[str, str]:
        if name == CUDA_PROVIDER:
            return {"device_id": str(self.device)}
        if name != TENSORRT_PROVIDER:
            return {}
        told = {"device_id": str(self.device), "trt_fp16_enable": "True" if self.half else "False"}
        if self.cache is not None:
            told |= {"trt_engine_cache_enable": "True", "trt_engine_cache_path": str(self.cache)}
        return told


def _runtime() -> Any:
    if importlib.util.find_spec("onnxruntime") is None:
        raise OptionError(_MISSING)
    import onnxruntime

    return onnxruntime


def _session(runtime: Any, path: Path, choice: Providers) -> Any:
    options = runtime.SessionOptions()
    options.intra_op_num_threads = choice.threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads leave others the cores
    try:
        session = runtime.InferenceSession(str(path), options, providers=choice.with_options())
    except Exception as error:
        raise _ours(error, path.stem) from error
    refused = [name for name in choice.names if name not in session.get_providers()]
    if refused:
        raise OptionError(
            f"onnxruntime has {refused[0]} but could not start it for {path.name}; its libraries are not installed, "
            "or do not fit this machine"
        )
    return session


def _ours(error: Exception, graph: str) -> ModelError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    if any(words in reason.lower() for words in _MEMORY_WORDS):
        return DeviceMemoryError(f"{graph}: {reason} Render smaller frames, or a smaller model")
    return ModelError(f"onnxruntime cannot run {graph}: {reason}; export it again with this version")
