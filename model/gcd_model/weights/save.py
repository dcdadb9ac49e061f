"""Weights into files: our own `.safetensors`, and the `.ckpt` of the released code. An exporter, so it opens files."""

import os
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.adapter import Adapter, unshared
from gcd_model.weights.card import NOTES, Card, packed
from gcd_model.weights.infer import RELEASED, infer_config, shapes_of
from gcd_model.weights.names import Levels, published_names

CARRIED = ("CLIP text tower", "decoder of the condition VAE", "LPIPS")
"""Leftovers worth carrying from file to file; averages and tables of the old weights are not."""


@contextmanager
def whole(out: Path, *, replaces: bool) -> Generator[Path]:
    """Where to write a file or make a folder that becomes `out` once it is complete, or never.

    replaces: whether what is there may go.
    Raises: OptionError if it may not, or its folder is missing; CheckpointError if it cannot be written.
    """
    if not out.parent.is_dir():
        raise OptionError(f"{out}: there is no folder {out.parent}; make it first")
    if os.path.lexists(out) and not replaces:
        raise OptionError(f"{out} exists; give another name, or allow weights or an export to be overwritten")
    partial, former = (out.with_name(f".{out.name}.{os.getpid()}.{end}") for end in ("partial", "former"))
    try:
        yield partial
        if partial.is_file():
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
        if out.is_dir():
            out.rename(former)
        partial.replace(out)
        former.unlink() if former.is_symlink() else shutil.rmtree(former, ignore_errors=True)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{out}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    finally:
        partial.unlink() if partial.is_file() else shutil.rmtree(partial, ignore_errors=True)


def write_safetensors(
    out: Path, state: Mapping[str, Tensor], metadata: Mapping[str, str], *, overwrite: bool = False
) -> None:
    """Write weights as one of our files; mapped ones pass through without ever being held.

    Raises: OptionError if `out` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    _require_suffix(out, ".safetensors")
    with whole(out, replaces=overwrite) as partial:
        save_file({name: _alone(tensor) for name, tensor in state.items()}, partial, packed(metadata))


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
    """Write weights as the `.ckpt` of the released trainer: plain containers and tensors, no optimizer state.

    Args:
        weights: by our names. carried: see `gcd_state`. updates: of the optimizer, for `global_step`.
    Raises: as `write_safetensors`; OptionError if the published layout cannot hold such networks.
    """
    _require_suffix(out, ".ckpt")
    notes = replace(card, config=_published_config(card.diffusion)).to_metadata()
    root = {
        "epoch": 0,
        "global_step": updates,
        "pytorch-lightning_version": "2.1.0",
        "state_dict": {n: _alone(tensor) for n, tensor in gcd_state(weights, card.diffusion, carried).items()},
        "loops": {},
        "callbacks": {},
        "optimizer_states": [],
        "lr_schedulers": [],
        "hparams_name": "kwargs",
        "hyper_parameters": {NOTES: notes},
    }
    with whole(out, replaces=overwrite) as partial, partial.open("wb") as file:
        torch.save(root, file)


def _require_suffix(out: Path, suffix: str) -> None:
    if out.suffix != suffix:
        raise OptionError(f"{out}: this layout is a {suffix.removeprefix('.')} file; give it a name that ends so")


def _alone(tensor: Tensor) -> Tensor:
    """The tensor on the CPU, with no more storage behind it than its own numbers: torch would write all of it."""
    tensor = tensor.detach().cpu().contiguous()
    return tensor.clone() if tensor.untyped_storage().nbytes() > tensor.nbytes else tensor


# --- the names and shapes of the released code -----------------------------------------------------------------------


def gcd_state(weights: Mapping[str, Tensor], config: ModelConfig, carried: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """All weights by published name.

    Args:
        weights: by our names. carried: leftovers of the file they came from, by published name.
    Raises:
        OptionError: the published layout cannot say this architecture: whoever reads its names and shapes would build
            other networks.
    """
    if config.is_ours:
        raise OptionError("the published layout holds the paper's networks only; keep our own .safetensors for this")
    weights = unshared(weights) if config.vae.shared else weights
    state = {published_names(name, "gcd", Levels.of(config))[0]: tensor.detach() for name, tensor in weights.items()}
    config = _published_config(config)
    try:
        told = infer_config(shapes_of(state), "gcd", RELEASED)
    except CheckpointError as error:
        raise OptionError(f"the published layout cannot say this architecture: {error}") from error
    for part in ("camera", "unet", "vae", "image_encoder"):
        if getattr(told, part) != getattr(config, part):
            raise OptionError(
                f"the published layout cannot say this architecture: its {part} would be read as "
                f"{getattr(told, part)}; keep our own .safetensors for it"
            )
    return {**carried, **state}


def _published_config(config: ModelConfig) -> ModelConfig:
    """The config as the published layout tells it: with one encoder for targets and one for conditions."""
    return msgspec.structs.replace(config, vae=msgspec.structs.replace(config.vae, shared=False))
