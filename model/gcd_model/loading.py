"""From the name of a checkpoint to a synthesizer on a device."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Unpack, get_args

import msgspec
import torch

from gcd_model.config import SMALL
from gcd_model.engines.onnx import load_export
from gcd_model.engines.onnx_export import ExportPrecision, Manifest, Report, export_onnx, is_export, require_onnx
from gcd_model.errors import OptionError
from gcd_model.live.blocks import layout
from gcd_model.live.config import LIVE_TINY
from gcd_model.live.synthesizer import LiveSynthesizer
from gcd_model.networks import LiveNetworks, LoadedWeights, random_networks, weights_digest
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import Traits
from gcd_model.weights.card import FAMILIES, FULL_PRECISION, LIVE, Card, Hints, family_named, precision
from gcd_model.weights.load import Told, load_adapted, load_weights, read_adapter, weights_path

EngineName = Literal["torch", "cuda", "onnxruntime"]
"""What can compute networks; see `Engine`."""
ENGINES: tuple[EngineName, ...] = get_args(EngineName)

_LOG = logging.getLogger(__name__)


def load_synthesizer(
    source: str | Path,
    *,
    device: str = "auto",
    dtype: str | None = None,
    adapter: str | Path | None = None,
    engine: EngineName | None = None,
    providers: Sequence[str] = (),
    **told: Unpack[Told],
) -> Synthesizer | LiveSynthesizer:
    """A checkpoint, ready to run.

    Args:
        source: a path; `package:NAME`, weights that ship with the package; or `random:FAMILY`, small random networks
            whose views are noise. The folder of an export is run by onnxruntime, anything else by torch.
        device: "auto" (CUDA where there is one), "cpu", "cuda" or "cuda:N".
        dtype: "float32", "bfloat16" or "float16"; else float32 on the CPU, bfloat16 on CUDA. The VAE decoder
            stays float32 (on CUDA torch may use TF32 in its convolutions, see torch.backends.cudnn). The live model
            computes in bfloat16 also on a CPU that multiplies in it (Intel AMX). "float8", for the engine "cuda": as
            bfloat16, but attention and feed-forward of the U-Net multiply in 8 bits (e4m3).
        told: family, head_width, image_heads, frames, see `Told`.
        adapter: file of a low-rank adapter that was trained on these weights; family and path are then the adapter's.
        engine: what computes the networks: "torch" as they are, or "cuda", compiled and as CUDA graphs, for a GPU; it
            settles the decoder's precision itself, see `CudaOptions`. "onnxruntime" runs the folder of an export,
            and nothing else does. None: what the source is for.
        providers: of onnxruntime, see `load_export`.
    Raises:
        CheckpointError: see `load_weights`; or the adapter was trained on other weights.
        OptionError: an option is unknown or contradicts the checkpoint.
    """
    if is_export(source):
        if engine not in (None, "onnxruntime"):
            raise OptionError(
                f"{source} is an export, which the engine onnxruntime runs; for {engine} give the weights it was "
                "made from"
            )
        if any(option is not None for option in (*told.values(), dtype, adapter)):
            raise OptionError(
                f"{source} is an export and says all of itself; leave out family, dtype, head width, image heads, "
                "frames and adapter, or export the weights again with them"
            )
        return load_export(source, device=device, providers=providers)
    if engine == "onnxruntime" or providers:
        raise OptionError(
            f"the engine onnxruntime runs exports, and {source} is none; "
            f"make one: gcd-node export --weights {source} --onnx FOLDER"
        )
    place = device_named(device, engine)
    _stored_in(dtype or "float32", engine)  # before anything is loaded
    return placed_synthesizer(loaded_weights(source, adapter=adapter, **told), place, dtype=dtype, engine=engine)


def loaded_weights(source: str | Path, *, adapter: str | Path | None = None, **told: Unpack[Told]) -> LoadedWeights:
    """Weights by any name that `load_synthesizer` takes but an export's; arguments and errors are its."""
    kind, _, name = str(source).partition(":")
    if isinstance(source, str) and kind == "random":
        if any(option is not None for key, option in told.items() if key != "frames"):
            raise OptionError(f"{source} takes neither family, head width nor image heads; leave them out")
        loaded = random_weights(name, frames=told.get("frames"))
    else:
        loaded = load_weights(weights_path(source), **told)
    return loaded if adapter is None else load_adapted(loaded, read_adapter(adapter))


def export_weights(
    source: str | Path,
    out: str | Path,
    *,
    precision: ExportPrecision = "float32",
    height: int | None = None,
    width: int | None = None,
    adapter: str | Path | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
    **told: Unpack[Told],
) -> Manifest:
    """Write every network of a checkpoint as an ONNX graph; arguments and errors as `loaded_weights` and `export_onnx`
    have them."""
    require_onnx()
    loaded = loaded_weights(source, adapter=adapter, **told)
    return export_onnx(
        loaded, out, precision=precision, height=height, width=width, overwrite=overwrite, progress=progress
    )


def placed_synthesizer(
    loaded: LoadedWeights, device: torch.device, *, dtype: str | None = None, engine: EngineName | None = None
) -> Synthesizer | LiveSynthesizer:
    """Weights that were loaded or made elsewhere, ready to run; what has device and precision stays in its file.

    Raises OptionError as `load_synthesizer`.
    """
    networks, live = loaded.networks, isinstance(loaded.networks, LiveNetworks)
    if loaded.card.family is None:
        _LOG.warning(
            "the family of %s is not known: no limits are checked and --motion-bucket must be given; name it with "
            "--family %s",
            loaded.card.name,
            "|".join(FAMILIES),
        )
    name = dtype or default_precision(device, live=live)
    traits = Traits.of(loaded.card, sha256_12=loaded.card.origin, precision=name, device=str(device))
    if isinstance(networks, LiveNetworks):
        if dtype == "float16":
            raise OptionError(
                f"{loaded.card.name} is the live model, which was not trained for float16; take bfloat16 or float32"
            )
        if engine not in (None, "torch"):
            raise OptionError(
                f"{loaded.card.name} is the live model, which torch runs as it is; leave engine {engine} out"
            )
        networks = networks.to(device, precision(name), memory_format=layout(device))  # pyright: ignore
        return LiveSynthesizer(networks, traits)
    for part, module in networks.named_children():
        module.to(device, torch.float32 if part in FULL_PRECISION else _stored_in(name, engine))
    if engine != "cuda":
        return Synthesizer(networks, traits)
    from gcd_model.engines.cuda import CudaEngine, CudaOptions  # torch.compile takes seconds to import

    options = CudaOptions(float8=name == "float8")
    return Synthesizer(networks, traits, CudaEngine(networks, options))


def _stored_in(name: str, engine: EngineName | None) -> torch.dtype:
    """What weights are kept in that compute in this precision. Raises OptionError."""
    if name == "float8" and engine != "cuda":
        raise OptionError("float8 is for the engine cuda alone; take it, or bfloat16")
    return precision("bfloat16" if name == "float8" else name)


def random_weights(family: str, *, frames: int | None = None) -> LoadedWeights:
    """Small random networks with the camera control of a family; always the same ones."""
    Hints(frames=frames)  # checks it
    chosen = family_named(family)
    if chosen is LIVE:
        networks = random_networks(msgspec.structs.replace(LIVE_TINY, frames=frames or LIVE_TINY.frames), seed=0)
    else:
        width = 0 if chosen.camera == "none" else SMALL.unet.camera_width
        unet, frames = msgspec.structs.replace(SMALL.unet, camera_width=width), frames or SMALL.frames
        config = msgspec.structs.replace(SMALL, camera=chosen.camera, unet=unet, frames=frames)
        networks = random_networks(config, seed=0)
    card = Card(
        name=f"random-{family}",
        config=networks.config,
        family=chosen,
        move_time=0 if chosen is LIVE else networks.config.frames - 1,
        trained=False,
        origin=weights_digest(networks.state_dict()),
    )
    return LoadedWeights(card=card, networks=networks)


def placement(name: str, engine: EngineName | None, dtype: str | None, *, live: bool) -> tuple[torch.device, str]:
    """Device and precision that `load_synthesizer` would choose. Raises OptionError."""
    device = device_named(name, engine)
    return device, dtype or default_precision(device, live=live)


def default_precision(device: torch.device, *, live: bool) -> str:
    """What networks compute in where nobody says: bfloat16 on CUDA; of the live model on a CPU that has it, too."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # older versions of torch cannot tell
    fast = any(bool(capabilities.get(name, False)) for name in ("amx_bf16", "avx512_bf16"))
    return "bfloat16" if device.type == "cuda" or (live and fast) else "float32"


def device_named(name: str, engine: EngineName | None = None) -> torch.device:
    """The device, which is there and which the engine can use. Raises OptionError, as `load_synthesizer`."""
    if engine not in (None, *ENGINES):
        raise OptionError(f"the engine must be one of {', '.join(ENGINES)}, got {engine!r}")
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    kind, _, index = name.partition(":")
    if kind not in ("cpu", "cuda") or (index and not index.isdecimal()) or (kind == "cpu" and index):
        raise OptionError(f"device must be auto, cpu, cuda or cuda:N, got {name!r}")
    if kind == "cuda" and int(index or 0) >= torch.cuda.device_count():
        raise OptionError(f"device {name} was asked for, this machine has {torch.cuda.device_count()} CUDA devices")
    if engine == "cuda" and kind != "cuda":
        raise OptionError(f"the engine cuda needs a CUDA device, got {name}; take the engine torch")
    return torch.device(name)
