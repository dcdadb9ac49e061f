"""Weights by path: loaded, inspected, converted, saved.

Layouts are told by content: GCD's Lightning `.ckpt`, `svd.safetensors`, a diffusers folder, and our own
`.safetensors` with the config in its metadata. Everything is memory-mapped: what is not used is never read.
"""

import hashlib
import logging
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Literal, Unpack

from torch import Tensor

from gcd_model.errors import CheckpointError
from gcd_model.networks import LiveNetworks, LoadedWeights, Networks, weights_digest
from gcd_model.weights.adapter import Adapter, adapted
from gcd_model.weights.card import Card, Entry, WeightsReport, precision
from gcd_model.weights.examine import (
    Examined,
    Options,
    Told,
    examine,
    leftover_reports,
    network_reports,
)
from gcd_model.weights.families import FAMILIES, family_named
from gcd_model.weights.read import (
    read_file,
    read_weights,
)
from gcd_model.weights.save import CARRIED, Report, own_content, write_published, write_safetensors, written_dtype

_log = logging.getLogger(__name__)

_SAMPLED_ABOVE = 512 << 20  # bytes; larger files are digested by samples
_SAMPLE, _SAMPLES, _END = 64 << 10, 64, 1 << 20


def load_weights(
    path: str | Path,
    *,
    ask_family: bool = True,
    **told: Unpack[Told],
) -> LoadedWeights:
    """Load a checkpoint of any layout.

    Args:
        ask_family: warn where the family is not known; False for those who only want the weights. told: see `Options`.
    Raises:
        CheckpointError: the file is missing, damaged, hostile or of another architecture.
        OptionError: an option is unknown or contradicts the file.
    """
    options = Options(**told)
    examined = _examined(Path(path), options)
    with _about(path):
        networks = examined.networks
        state = {name: examined.tensor(name) for name in examined.match.sources}
        networks.load_state_dict(state, assign=True, strict=True)
        if ask_family and examined.family is None:
            _log.warning(
                "the family of %s is not known: no limits are checked and --motion-bucket must be given; "
                "name it with --family %s",
                path,
                "|".join(FAMILIES),
            )
        return LoadedWeights(
            name=examined.name,
            networks=networks,
            family=examined.family,
            move_time=examined.move_time,
            trained=examined.trained,
            sha256_12=digest(examined.file.files)[:12],
            uncertainty_scale=examined.uncertainty_scale,
            layout=examined.file.layout,
            carried=_carried(examined),
        )


def load_adapted(base: LoadedWeights, adapter: Adapter) -> LoadedWeights:
    """A base and what was trained on it, as one. Raises CheckpointError as `adapted`; OptionError for its family."""
    card = adapter.card
    family = None if card.family is None else family_named(card.family)
    return replace(
        base,
        name=card.name,
        networks=adapted(base.diffusion, adapter),
        family=family,
        move_time=card.move_time,
        trained=base.trained and card.trained,
        uncertainty_scale=None,
        sha256_12=weights_digest({f"{base.sha256_12}.{name}": tensor for name, tensor in adapter.tensors.items()}),
    )


def read_adapter(path: str | Path) -> Adapter:
    """Map an adapter's file. Raises CheckpointError if it is missing, damaged or no adapter."""
    path = Path(path)
    with _about(path):
        if not path.exists():
            raise CheckpointError("there is no such file; check the path")
        held, metadata = read_file(path)
        return Adapter.of_file(metadata or {}, held.tensors)


def inspect_weights(
    path: str | Path,
    *,
    full_digest: bool = False,
    **told: Unpack[Told],
) -> WeightsReport:
    """Say what a checkpoint holds; checks names and shapes as `load_weights` does, reads no weights.

    Args:
        full_digest: read the whole file for the digest, whatever its size.
    Raises: as `load_weights`.
    """
    options = Options(**told)
    examined = _examined(Path(path), options)
    file = examined.file
    with _about(path):
        return WeightsReport(
            path=str(path),
            name=examined.name,
            layout=file.layout,
            config=examined.networks.config,
            family=None if examined.family is None else examined.family.name,
            told_by=examined.told_by,
            move_time=examined.move_time,
            trained=examined.trained,
            networks=network_reports(examined),
            leftovers=leftover_reports(examined),
            optimizer_size=file.optimizer_size,
            other_entries=file.other_entries,
            size=sum(part.stat().st_size for part in file.files),
            digest=digest(file.files, full=full_digest),
            uncertainty_scale=examined.uncertainty_scale,
        )


def convert_weights(
    path: str | Path,
    out: str | Path,
    *,
    layout: Literal["gcd-node", "gcd-ckpt"] = "gcd-node",
    dtype: str | None = None,
    uncertainty_scale: float | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
    **told: Unpack[Told],
) -> WeightsReport:
    """Write a checkpoint of any layout as our own `.safetensors`, tensor by tensor, or as GCD's `.ckpt`.

    Args:
        layout: "gcd-node" leaves behind what inference does not use; "gcd-ckpt" is for the released code, see
            `gcd_state`, and holds all weights in memory where `dtype` changes them.
        dtype: store in this precision; else as it is. What computes in float32 (the decoder) is never narrowed.
        uncertainty_scale: what was measured, instead of what the file says; see `Traits`.
        progress: called with (bytes written, bytes).
    Returns:
        The report of the new file.
    Raises: as `load_weights`; OptionError if `out` exists and `overwrite` is not set, or the layout cannot hold it.
    """
    wanted = None if dtype is None else precision(dtype)
    options = Options(**told)
    examined = _examined(Path(path), options)
    with _about(path):
        card = Card(
            name=examined.name,
            config=examined.networks.config,
            family=None if examined.family is None else examined.family.name,
            move_time=examined.move_time,
            trained=examined.trained,
            origin=digest(examined.file.files)[:12],
            uncertainty_scale=examined.uncertainty_scale if uncertainty_scale is None else uncertainty_scale,
        )
    dtypes = {name: written_dtype(name, examined.stored_dtype(name), wanted) for name in examined.match.sources}
    if layout == "gcd-ckpt":
        state = {name: examined.tensor(name).to(dtype) for name, dtype in dtypes.items()}
        write_published(Path(out), state, card, carried=_carried(examined), overwrite=overwrite)
    else:
        shapes = examined.networks.state_dict()
        entries = {name: Entry(tuple(shapes[name].shape), kind) for name, kind in dtypes.items()}
        content = own_content(entries, examined.tensor, card)
        write_safetensors(Path(out), content, overwrite=overwrite, report=progress)
    return inspect_weights(out)


def save_weights(networks: Networks | LiveNetworks, out: str | Path, card: Card, *, overwrite: bool = False) -> None:
    """Write networks as they are, for example after training.

    Raises: OptionError if `out` exists and `overwrite` is not set; CheckpointError if it cannot be written.
    """
    state: dict[str, Tensor] = networks.state_dict()
    entries = {name: Entry(tuple(tensor.shape), tensor.dtype) for name, tensor in state.items()}
    write_safetensors(Path(out), own_content(entries, state.__getitem__, card), overwrite=overwrite)


def digest(files: tuple[Path, ...], *, full: bool = False) -> str:
    """SHA-256 that names weights: of the bytes of all files, one after the other.

    Above 512 MiB in all, unless `full`, of samples: of each file its size, the first and last MiB (where names,
    shapes and a zip's checksums stand) and 64 pieces of 64 KiB evenly spread. That takes no seconds, tells
    checkpoints apart, and does not vouch for every byte.
    """
    sampled = not full and sum(path.stat().st_size for path in files) > _SAMPLED_ABOVE
    total = hashlib.sha256()
    for path in files:
        with path.open("rb") as file:
            for piece in _samples(file, path.stat().st_size) if sampled else iter(lambda f=file: f.read(_END), b""):
                total.update(piece)
    return total.hexdigest()


def _samples(file: BinaryIO, size: int) -> Iterator[bytes]:
    yield size.to_bytes(8, "little")
    for start in (0, size - _END):
        file.seek(max(start, 0))
        yield file.read(_END)
    for i in range(_SAMPLES):
        file.seek(size * i // _SAMPLES)
        yield file.read(_SAMPLE)


# --- errors, leftovers -----------------------------------------------------------------------------------------------


@contextmanager
def _about(path: str | Path) -> Generator[None]:
    """Every error about a file begins with its name."""
    try:
        yield
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}; check the path") from error


def _carried(examined: Examined) -> dict[str, Tensor]:
    leftovers, tensors = examined.match.leftovers, examined.file.tensors
    return {name: tensors[name] for kind in CARRIED for name in leftovers.get(kind, ())}


def _examined(path: Path, options: Options) -> Examined:
    with _about(path):
        return examine(read_weights(path), options)
