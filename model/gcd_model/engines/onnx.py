"""An export run by onnxruntime, behind the same interface as torch.

Guidance, solver and all that lies between graphs stay in torch; one clip goes through a graph at a time. onnxruntime is
imported when the first export is loaded.
"""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gcd_model.conditioning import Conditioning, camera_features
from gcd_model.engines.onnx_export import MANIFEST, read_manifest
from gcd_model.engines.torch import Engine, NetworkName
from gcd_model.errors import CheckpointError, DeviceMemoryError, ModelError, OptionError
from gcd_model.geometry import Trajectory
from gcd_model.networks import Networks, empty_networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits
from gcd_model.unet import UNetPlan
from gcd_model.weights.card import Card

CPU_PROVIDER, CUDA_PROVIDER = "CPUExecutionProvider", "CUDAExecutionProvider"
TENSORRT_PROVIDER = "TensorrtExecutionProvider"
_MISSING = "an export needs onnxruntime, which is not installed: pip install 'gcd-node[onnx]'"
_GRAPHS = {"condition_encoder", "embeddings", "step", "decoder"}
_TOWER_GRAPHS = {"image_encoder", "crosses"}
_MEMORY_WORDS = ("failed to allocate", "bad allocation", "out of memory")

Provider = tuple[str, dict[str, str]]
"""One of onnxruntime's execution providers, by its own name and options."""


def load_export(folder: str | Path, *, device: str = "auto", providers: Sequence[str] = ()) -> Synthesizer:
    """An export, ready to run. Its synthesizer's networks are empty: the weights are in the graphs.

    Args:
        device: "auto" and "cpu" mean the CPU, "cuda" or "cuda:N" onnxruntime's CUDA provider.
        providers: onnxruntime's execution providers by its own names, best first, instead of what `device` means.
    Raises:
        CheckpointError: the folder is damaged. OptionError: onnxruntime or a provider is not there.
    """
    folder, manifest = Path(folder), read_manifest(folder)
    card = Card.from_metadata(manifest.card)
    wanted = _GRAPHS if card.diffusion.image_encoder is None else _GRAPHS | _TOWER_GRAPHS
    if manifest.graphs.keys() != wanted:
        raise CheckpointError(f"{folder}: its {MANIFEST} must name {', '.join(sorted(wanted))}; export it again")
    chosen = provider_options(device, providers, folder / "tensorrt", half=manifest.precision == "float16")
    files = {name: folder / next(iter(parts)) for name, parts in manifest.graphs.items()}
    traits = Traits.of(card, sha256_12=manifest.sha256_12, precision=manifest.precision, device="cpu")
    networks = empty_networks(card.diffusion)
    return Synthesizer(networks, traits, OnnxEngine(Sessions(files, chosen), networks))


def provider_options(device: str, names: Sequence[str], cache: Path, *, half: bool) -> list[Provider]:
    """As onnxruntime takes them; the CPU's comes last. cache: where TensorRT keeps what it has built. half: whether it
    may compute in float16."""
    kind, _, index = device.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (index and not (index.isdecimal() and kind == "cuda")):
        raise OptionError(f"device must be auto, cpu, cuda or cuda:N, got {device!r}")
    names = tuple(names) or ((CUDA_PROVIDER,) if kind == "cuda" else ())
    options: dict[str, dict[str, str]] = {CUDA_PROVIDER: {"device_id": index or "0"}}
    if TENSORRT_PROVIDER in names:
        cache.mkdir(exist_ok=True)
        options[TENSORRT_PROVIDER] = {
            "device_id": index or "0",
            "trt_fp16_enable": str(half),
            "trt_engine_cache_enable": "True",
            "trt_engine_cache_path": str(cache),
        }
    return [*((name, options.get(name, {})) for name in names if name != CPU_PROVIDER), (CPU_PROVIDER, {})]


class OnnxEngine(Engine):
    """The networks of an export, clip by clip. networks: without storage; the weights are in the graphs."""

    def __init__(self, graphs: "Sessions", networks: Networks) -> None:
        super().__init__(networks)
        self._graphs, self._config = graphs, networks.config

    @property
    def like(self) -> Tensor:
        return torch.zeros(())  # float32 on the CPU; onnxruntime copies to its own device

    def condition_mean(self, frames: Tensor) -> Tensor:
        """See Engine. Raises OptionError for another size than the export's."""
        height, width = self._config.height, self._config.width
        if tuple(frames.shape[-2:]) != (height, width):
            size = "x".join(map(str, frames.shape[-2:]))
            raise OptionError(
                f"this export takes frames of {height}x{width} alone, got {size}; "
                "export it again with --height and --width"
            )
        return super().condition_mean(frames)

    def camera(self, path: Trajectory) -> Tensor | None:
        """See Engine; the features themselves, as the linear map that follows is part of a graph."""
        control = self._config.camera
        return None if control == "none" else camera_features(control, path)

    def decode(self, latents: Tensor) -> Tensor:
        return self._graphs.run("decoder", latents)

    def compute(self, name: NetworkName, given: Tensor) -> Tensor:
        return torch.cat([self._graphs.run(name, frame) for frame in given.split(1)])

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        rows = [given.vector] if given.camera is None else [given.vector, given.camera]
        steps = [self._clip_by_clip("embeddings", *rows, label=label) for label in labels.split(1)]
        crosses = None if given.tokens is None else self._clip_by_clip("crosses", given.tokens)
        return UNetPlan(torch.stack(steps), crosses)

    def predict(self, rows: Tensor, condition: Tensor, embeddings: Tensor, crosses: Tensor | None) -> Tensor:
        inputs = [rows, condition, embeddings] if crosses is None else [rows, condition, embeddings, crosses]
        return self._clip_by_clip("step", *inputs)

    def _clip_by_clip(self, name: str, *rows: Tensor, label: Tensor | None = None) -> Tensor:
        first = () if label is None else (label,)
        clips = zip(*(each.split(self._config.frames) for each in rows), strict=True)
        return torch.cat([self._graphs.run(name, *first, *clip) for clip in clips])


class _Session(nn.Module):
    """A graph as a layer of torch, so that whatever looks between layers looks between graphs, too."""

    def __init__(self, session: Any) -> None:
        super().__init__()
        self.session = session

    def forward(self, inputs: Sequence[Tensor]) -> Tensor:
        arrays = (each.detach().cpu().contiguous().numpy() for each in inputs)
        feed = {given.name: array for given, array in zip(self.session.get_inputs(), arrays, strict=True)}
        return torch.from_numpy(self.session.run(None, feed)[0])


class Sessions:
    """The graphs of one export, in onnxruntime's hands."""

    def __init__(self, files: dict[str, Path], providers: Sequence[Provider] = ((CPU_PROVIDER, {}),)) -> None:
        """Raises: OptionError if onnxruntime or a provider is not there; ModelError if it refuses a graph."""
        if importlib.util.find_spec("onnxruntime") is None:
            raise OptionError(_MISSING)
        import onnxruntime

        available = onnxruntime.get_available_providers()
        absent = [name for name, _ in providers if name not in available]
        if absent:
            raise OptionError(
                f"onnxruntime has no {absent[0]} here, only {', '.join(available)}; "
                "install a build that has it, or leave the provider out"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = torch.get_num_threads(), 1
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting threads leave others cores
        self._sessions: dict[str, _Session] = {}
        for name, path in files.items():
            try:
                session = onnxruntime.InferenceSession(str(path), options, providers=list(providers))
            except Exception as error:
                raise _ours(error, name) from error
            refused = [provider for provider, _ in providers if provider not in session.get_providers()]
            if refused:
                raise OptionError(
                    f"onnxruntime has {refused[0]} but could not start it for {path.name}; its libraries are not "
                    "installed, or do not fit this machine"
                )
            self._sessions[name] = _Session(session)

    def run(self, name: str, *inputs: Tensor) -> Tensor:
        """A graph's output. inputs: in the graph's order. Raises: DeviceMemoryError, ModelError."""
        try:
            return self._sessions[name](inputs)
        except Exception as error:
            if not type(error).__module__.startswith("onnxruntime"):
                raise
            raise _ours(error, name) from error


def _ours(error: Exception, graph: str) -> ModelError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    if any(words in reason.lower() for words in _MEMORY_WORDS):
        return DeviceMemoryError(f"{graph}: {reason} Render smaller frames, or a smaller model")
    return ModelError(f"onnxruntime cannot run {graph}: {reason}; export it again with this version")
