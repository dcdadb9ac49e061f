"""Weights into files: our own `.safetensors`, and the `.ckpt` of the released code. An exporter, so it opens files.

Every file appears under its name only once it is complete, and replaces another only when that is allowed.
"""

import json
import os
import shutil
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import msgspec
import torch
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.adapter import Adapter, unshared
from gcd_model.weights.card import NOTES, Card
from gcd_model.weights.infer import Hints, gcd_levels, infer_config, shapes_of
from gcd_model.weights.names import Levels, gcd_source

Report = Callable[[int, int], None]
"""Called with (bytes written, bytes)."""

_LINE = 64
"""Bytes of a cache line, and of what torch aligns memory to."""
_DTYPES = {torch.float64: "F64", torch.float32: "F32", torch.bfloat16: "BF16", torch.float16: "F16"}
_LIGHTNING = "2.1.0"

CARRIED = ("CLIP text tower", "decoder of the condition VAE", "LPIPS")
"""Leftovers worth carrying from file to file; averages and tables of the old weights are not."""


def write_safetensors(
    out: Path,
    state: Mapping[str, Tensor],
    metadata: Mapping[str, str],
    *,
    dtypes: Mapping[str, torch.dtype] | None = None,
    overwrite: bool,
    report: Report | None = None,
) -> None:
    """Write one tensor after the other, mapped ones without ever holding the file.

    First all of whole cache lines, then the widest type, then by name: so all but small ones of odd sizes begin with a
    cache line when the file is mapped, as memory that torch allocates does: some processors' kernels round otherwise
    elsewhere. (The library's own writer aligns to eight bytes, and wants all tensors at once.)

    Args:
        dtypes: to be written in, where it is not the tensor's own.
    Raises: OptionError if `out` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    kinds = {name: tensor.dtype for name, tensor in state.items()} | dict(dtypes or {})
    sizes = {name: tensor.numel() * kinds[name].itemsize for name, tensor in state.items()}
    order = sorted(state, key=lambda name: (sizes[name] % _LINE != 0, -kinds[name].itemsize, name))
    content: dict[str, object] = {"__metadata__": dict(metadata)}
    done, end = 0, 0
    for name in order:
        place = [end, end := end + sizes[name]]
        content[name] = {"dtype": _DTYPES[kinds[name]], "shape": list(state[name].shape), "data_offsets": place}
    header = json.dumps(content, separators=(",", ":")).encode()
    header += b" " * (-(8 + len(header)) % _LINE)
    with _whole_or_nothing(out, ".safetensors", overwrite=overwrite) as file:
        file.write(len(header).to_bytes(8, "little") + header)
        for name in order:
            tensor = state[name].detach().to("cpu", kinds[name]).contiguous()
            file.write(tensor.flatten().view(torch.uint8).numpy().data)
            done += sizes[name]
            if report is not None:
                report(done, end)


def write_adapter(out: Path, adapter: Adapter, *, overwrite: bool) -> None:
    """Write an adapter as `.safetensors`. Raises: as `write_safetensors`."""
    write_safetensors(out, adapter.tensors, adapter.to_metadata(), overwrite=overwrite)


def write_published(
    out: Path,
    weights: Mapping[str, Tensor],
    card: Card,
    *,
    carried: Mapping[str, Tensor],
    updates: int = 0,
    overwrite: bool = False,
) -> None:
    """Write weights as the `.ckpt` of the released trainer, without optimizer state.

    Args:
        weights: by our names. carried: see `gcd_state`. updates: of the optimizer, for `global_step`.
    Raises: as `write_safetensors`; OptionError if the published layout cannot hold such networks.
    """
    state = {name: _alone(value) for name, value in gcd_state(weights, card.diffusion, carried).items()}
    notes = replace(card, config=published_config(card.diffusion)).to_metadata()
    with _whole_or_nothing(out, ".ckpt", overwrite=overwrite) as file:
        torch.save(_lightning_checkpoint(state, notes, updates), file)


def _alone(tensor: Tensor) -> Tensor:
    """The tensor on the CPU, with no more storage behind it than its own numbers: torch would write all of it."""
    tensor = tensor.detach().cpu().contiguous()
    return tensor.clone() if tensor.untyped_storage().nbytes() > tensor.nbytes else tensor


@contextmanager
def _whole_or_nothing(out: Path, suffix: str, *, overwrite: bool) -> Generator[BinaryIO]:
    """A file that appears under its name only once it is complete."""
    _require_writable(out, suffix, overwrite=overwrite)
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(out)
    except OSError as error:
        raise CheckpointError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _require_writable(out: Path, suffix: str, *, overwrite: bool) -> None:
    if out.suffix != suffix:
        raise OptionError(f"{out}: this layout is a {suffix.removeprefix('.')} file; give it a name that ends so")
    if not out.parent.is_dir():
        raise OptionError(f"{out}: there is no folder {out.parent}; make it first")
    if out.exists() and not overwrite:
        raise OptionError(f"{out} exists; give another name, or allow it to be overwritten")


# --- the `.ckpt` of the released code --------------------------------------------------------------------------------


def published_config(config: ModelConfig) -> ModelConfig:
    """The config as the published layout tells it: with one encoder for targets and one for conditions."""
    return msgspec.structs.replace(config, vae=msgspec.structs.replace(config.vae, shared=False))


def gcd_state(weights: Mapping[str, Tensor], config: ModelConfig, carried: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """All weights by published name.

    Args:
        weights: by our names. carried: leftovers of the file they came from, by published name.
    Raises:
        OptionError: the published layout cannot say this architecture.
    """
    if config.is_ours:
        raise OptionError("the published layout holds the paper's networks only; keep our own .safetensors for this")
    weights = unshared(weights) if config.vae.shared else weights
    levels, state = Levels.of(config), dict[str, Tensor]()
    for name, tensor in weights.items():
        source = gcd_source(name, levels)
        assert source is not None, f"{name} has no published name"
        state[source.names[0]] = tensor.detach()
    _require_told(state, published_config(config))
    return {**carried, **state}


def _lightning_checkpoint(state: dict[str, Tensor], notes: dict[str, str], updates: int) -> dict[str, object]:
    """What stands at the root of a Lightning checkpoint: plain containers and tensors, no optimizer state."""
    return {
        "epoch": 0,
        "global_step": updates,
        "pytorch-lightning_version": _LIGHTNING,
        "state_dict": state,
        "loops": {},
        "callbacks": {},
        "optimizer_states": [],
        "lr_schedulers": [],
        "hparams_name": "kwargs",
        "hyper_parameters": {NOTES: notes},
    }


def _require_told(state: Mapping[str, Tensor], config: ModelConfig) -> None:
    """Whether a reader of the names and shapes alone would build these networks."""
    shapes = shapes_of(state)
    try:
        told = infer_config(shapes, gcd_source, gcd_levels(shapes), Hints())
    except CheckpointError as error:
        raise OptionError(f"the published layout cannot say this architecture: {error}") from error
    wrong = [
        part for part in ("camera", "unet", "vae", "image_encoder") if getattr(told, part) != getattr(config, part)
    ]
    if wrong:
        raise OptionError(
            f"the published layout cannot say this architecture: its {wrong[0]} would be read as "
            f"{getattr(told, wrong[0])}; keep our own .safetensors for it"
        )


@contextmanager
def whole_folder(out: Path, *, is_ours: Callable[[Path], bool] | None) -> Generator[Path]:
    """A folder that appears under its name only once it is complete.

    is_ours: whether a folder that is there may be replaced; None: never.
    Raises: OptionError, CheckpointError where it cannot be.
    """
    if not out.parent.is_dir():
        raise OptionError(f"{out}: there is no folder {out.parent}; make it first")
    if os.path.lexists(out) and (is_ours is None or not is_ours(out)):
        raise OptionError(f"{out} exists; give another name, or allow an export to be overwritten")
    partial, former = (out.with_name(f".{out.name}.{os.getpid()}.{end}") for end in ("partial", "former"))
    try:
        partial.mkdir()
        yield partial
        if out.exists():
            out.rename(former)
        partial.rename(out)
        shutil.rmtree(former, ignore_errors=True)
    except OSError as error:
        raise CheckpointError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
