"""Weights into files: our own `.safetensors`, and the `.ckpt` of the released code. An exporter, so it opens files.

Every file appears under its name only once it is complete, and replaces another only when that is allowed.
"""

import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor

from gcd_model.adapter import Adapter
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.gcd_layout import gcd_state, lightning_checkpoint, published_config
from gcd_model.own_format import FULL_PRECISION, Card, Entry, file_order, header

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
