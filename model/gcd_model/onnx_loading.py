"""From the folder of an export to a synthesizer that onnxruntime computes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from gcd_model.errors import OptionError
from gcd_model.families import family_named
from gcd_model.networks import empty_networks
from gcd_model.onnx_engine import CUDA_PROVIDER, TENSORRT_PROVIDER, OnnxEngine, Providers, Sessions
from gcd_model.onnx_export import read_manifest
from gcd_model.onnx_manifest import GraphName, Manifest
from gcd_model.own_format import Card
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits

_TENSORRT_CACHE = "tensorrt"


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
    chosen = replace(
        _providers(device, providers), cache=folder / _TENSORRT_CACHE, half=manifest.precision == "float16"
    )
    if TENSORRT_PROVIDER in chosen.names:
        (folder / _TENSORRT_CACHE).mkdir(exist_ok=True)
    files: dict[GraphName, Path] = {name: folder / record.files[0].name for name, record in manifest.graphs.items()}
    engine = OnnxEngine(Sessions(files, chosen), card.diffusion)
    return Synthesizer(empty_networks(card.diffusion), _traits(card, manifest), engine)


def _providers(device: str, names: Sequence[str]) -> Providers:
    kind, _, index = device.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (index and not (index.isdecimal() and kind == "cuda")):
        raise OptionError(f"device must be auto, cpu, cuda or cuda:N, got {device!r}")
    chosen = tuple(names) or ((CUDA_PROVIDER,) if kind == "cuda" else ())
    return Providers(names=chosen, threads=torch.get_num_threads(), device=int(index or 0))


def _traits(card: Card, manifest: Manifest) -> Traits:
    return Traits(
        name=card.name,
        config=card.config,
        family=None if card.family is None else family_named(card.family),
        move_time=card.move_time,
        sha256_12=manifest.sha256_12,
        precision=manifest.precision,
        device="cpu",
        trained=card.trained,
        uncertainty_scale=card.uncertainty_scale,
    )
