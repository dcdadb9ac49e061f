"""Weights into files: our own `.safetensors`, and the `.ckpt` of the released code. An exporter, so it opens files.

Every file appears under its name only once it is complete, and replaces another only when that is allowed.
"""

import os
import shutil
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import msgspec
import torch
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.adapter import Adapter, unshared
from gcd_model.weights.card import FULL_PRECISION, Card, Entry, file_order, header
from gcd_model.weights.infer import Hints, gcd_levels, infer_config
from gcd_model.weights.names import Levels, gcd_source

Report = Callable[[int, int], None]
"""Called with (bytes written, bytes)."""


@dataclass(frozen=True, slots=True)
class Content:
    """What goes into a file: what is to be written of each tensor, where it comes from, and the metadata."""

    entries: dict[str, Entry]
    tensor: Callable[[str], Tensor]
    metadata: Mapping[str, str]


def written_dtype(name: str, stored: torch.dtype, wanted: torch.dtype | None) -> torch.dtype:
    """The precision asked for; what computes in float32 is only ever widened. name: ours."""
    if wanted is None or (name.partition(".")[0] in FULL_PRECISION and wanted.itemsize < stored.itemsize):
        return stored
    return wanted


def own_content(entries: Mapping[str, Entry], tensor: Callable[[str], Tensor], card: Card) -> Content:
    """Networks in our own layout."""
    return Content(dict(entries), tensor, card.to_metadata())


def write_safetensors(out: Path, content: Content, *, overwrite: bool, report: Report | None = None) -> None:
    """Write one tensor after the other: at any time no more than one of them is held twice.

    Raises: OptionError if `out` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    entries = content.entries
    done, total = 0, sum(entry.size for entry in entries.values())
    with _whole_or_nothing(out, ".safetensors", overwrite=overwrite) as file:
        file.write(header(entries, content.metadata))
        for name in file_order(entries):
            tensor = content.tensor(name).detach().to("cpu", entries[name].dtype).contiguous()
            file.write(tensor.flatten().view(torch.uint8).numpy().data)
            done += entries[name].size
            if report is not None:
                report(done, total)


def write_adapter(out: Path, adapter: Adapter, *, overwrite: bool) -> None:
    """Write an adapter as `.safetensors`. Raises: as `write_safetensors`."""
    entries = {name: Entry(tuple(tensor.shape), tensor.dtype) for name, tensor in adapter.tensors.items()}
    content = Content(entries, adapter.tensors.__getitem__, adapter.to_metadata())
    write_safetensors(out, content, overwrite=overwrite)


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
    card = replace(card, config=published_config(card.diffusion))
    with _whole_or_nothing(out, ".ckpt", overwrite=overwrite) as file:
        torch.save(lightning_checkpoint(state, card, updates), file)


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


CARRIED = ("CLIP text tower", "decoder of the condition VAE", "LPIPS")
"""Leftovers worth carrying from file to file; averages and tables of the old weights are not."""

NOTES = "gcd_node"
"""Where in a checkpoint's hyper-parameters our card stands."""

_LIGHTNING = "2.1.0"


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


def lightning_checkpoint(state: Mapping[str, Tensor], card: Card, updates: int) -> dict[str, object]:
    """What stands at the root of a Lightning checkpoint: plain containers and tensors, no optimizer state.

    updates: of the optimizer, so far.
    """
    return {
        "epoch": 0,
        "global_step": updates,
        "pytorch-lightning_version": _LIGHTNING,
        "state_dict": dict(state),
        "loops": {},
        "callbacks": {},
        "optimizer_states": [],
        "lr_schedulers": [],
        "hparams_name": "kwargs",
        "hyper_parameters": {NOTES: card.to_metadata()},
    }


def _require_told(state: Mapping[str, Tensor], config: ModelConfig) -> None:
    """Whether a reader of the names and shapes alone would build these networks."""
    shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
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
