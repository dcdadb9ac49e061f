"""Weights from files; the only place of the package that opens any to read. `weights_export` writes them.

Layouts are told by content: GCD's Lightning `.ckpt`, `svd.safetensors`, a diffusers folder, and our own
`.safetensors` with the config in its metadata. Everything is memory-mapped: what is not used, such as optimizer
state, is never read. Nothing in a file is ever executed, see `restricted_pickle`.

Longer than other files because reading is allowed nowhere else; naming, matching and formats live next door.
"""

import hashlib
import logging
import zipfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gcd_model.adapter import Adapter, adapted
from gcd_model.diffusers_folder import PARTS, chosen_file, folder_hints, shards
from gcd_model.errors import CheckpointError, FileError
from gcd_model.examination import (
    Examined,
    Options,
    WeightsFile,
    examine,
    layout_of,
    leftover_reports,
    network_reports,
)
from gcd_model.families import FAMILIES, family_named
from gcd_model.file_kind import FETCH_AGAIN, HEAD, FileKind, check_archive, file_kind
from gcd_model.gcd_layout import CARRIED
from gcd_model.lightning import Contents, contents
from gcd_model.live.view import LiveNetworks
from gcd_model.networks import LoadedWeights, Networks, weights_digest
from gcd_model.own_format import Card, Entry, precision
from gcd_model.restricted_pickle import RestrictedPickle, check_storages
from gcd_model.small_files import read_small
from gcd_model.weights_export import Report, own_content, write_published, write_safetensors, written_dtype
from gcd_model.weights_report import WeightsReport

_log = logging.getLogger(__name__)

_LARGEST_YAML = 1 << 18
_SAMPLED_ABOVE = 512 << 20  # bytes; larger files are digested by samples
_SAMPLE, _SAMPLES, _END = 64 << 10, 64, 1 << 20


def load_weights(
    path: str | Path,
    *,
    family: str | None = None,
    head_width: int | None = None,
    image_heads: int | None = None,
    frames: int | None = None,
    ask_family: bool = True,
) -> LoadedWeights:
    """Load a checkpoint of any layout.

    Args:
        family: name of the family, instead of what metadata, file name or a yaml beside the file tell.
        ask_family: warn where nobody knows it; False for those who only want the weights.
        head_width, image_heads, frames: what published weights do not tell, instead of the published values.
    Raises:
        CheckpointError: the file is missing, damaged, hostile or of another architecture.
        OptionError: an option is unknown or contradicts the file.
    """
    options = Options(family=family, head_width=head_width, image_heads=image_heads, frames=frames)
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
        held, metadata = _read_file(path)
        return Adapter.of_file(metadata or {}, held.tensors)


def inspect_weights(
    path: str | Path,
    *,
    family: str | None = None,
    head_width: int | None = None,
    image_heads: int | None = None,
    frames: int | None = None,
    full_digest: bool = False,
) -> WeightsReport:
    """Say what a checkpoint holds; checks names and shapes as `load_weights` does, reads no weights.

    Args:
        full_digest: read the whole file for the digest, whatever its size.
    Raises: as `load_weights`.
    """
    options = Options(family=family, head_width=head_width, image_heads=image_heads, frames=frames)
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
    family: str | None = None,
    head_width: int | None = None,
    image_heads: int | None = None,
    frames: int | None = None,
    uncertainty_scale: float | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
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
    options = Options(family=family, head_width=head_width, image_heads=image_heads, frames=frames)
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


# --- reading -------------------------------------------------------------------------------------------------------


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


def read_weights(path: Path) -> WeightsFile:
    """Map a file or folder and tell its layout by its content. Raises CheckpointError, OSError."""
    if not path.exists():
        raise CheckpointError("there is no such file or folder; check the path")
    if path.is_dir():
        return _read_folder(path)
    held, metadata = _read_file(path)
    return WeightsFile(
        name=path.stem,
        layout=layout_of(held.tensors, metadata),
        files=(path,),
        tensors=held.tensors,
        metadata=held.notes if metadata is None else metadata,
        yaml=_yaml_beside(path),
        optimizer_size=held.optimizer_size,
        other_entries=held.other_entries,
    )


def _read_folder(path: Path) -> WeightsFile:
    absent = [part for part in PARTS if not (path / part).is_dir()]
    if absent:
        raise CheckpointError(f"is a folder without {', '.join(absent)}; a diffusers folder has {', '.join(PARTS)}")
    files = {part: _part_files(path / part) for part in PARTS}
    tensors = {
        f"{part}/{name}": tensor for part in PARTS for file in files[part] for name, tensor in _read_part(file).items()
    }
    configs = [path / part / "config.json" for part in PARTS]
    return WeightsFile(
        name=path.resolve().name,
        layout="diffusers",
        files=tuple(file for part in PARTS for file in files[part]),
        tensors=tensors,
        hints=folder_hints(*(_text(config) if config.exists() else None for config in configs)),
    )


def _part_files(folder: Path) -> list[Path]:
    """The weights files of one part of a diffusers folder."""
    chosen = folder / chosen_file((entry.name for entry in folder.iterdir()), folder.name)
    if chosen.suffix != ".json":
        return [chosen]
    files = [folder / name for name in shards(_text(chosen), f"{folder.name}/{chosen.name}")]
    absent = [file.name for file in files if not file.exists()]
    if absent:
        raise CheckpointError(f"its folder {folder.name} lacks {len(absent)} shards, first: {absent[0]}; {FETCH_AGAIN}")
    return files


def _text(file: Path) -> str:
    try:
        return read_small(file)
    except FileError as error:
        raise CheckpointError(f"its file {file.parent.name}/{file.name} {error}") from error


def _read_part(file: Path) -> dict[str, Tensor]:
    try:
        return _read_file(file)[0].tensors
    except CheckpointError as error:
        raise CheckpointError(f"its file {file.parent.name}/{file.name} {error}") from error


def _read_file(path: Path) -> tuple[Contents, dict[str, str] | None]:
    """What a single file holds, and the metadata if it is safetensors."""
    if _kind(path) == "zip":
        return _read_zip(path), None
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            return Contents(tensors), file.metadata() or {}
    except SafetensorError as error:
        raise CheckpointError(f"is damaged or truncated safetensors ({error}); {FETCH_AGAIN}") from error


def _kind(path: Path) -> FileKind:
    if not path.is_file():
        raise CheckpointError("is neither a file nor a folder; give a checkpoint")
    with path.open("rb") as file:
        return file_kind(file.read(HEAD), path.stat().st_size)


def _read_zip(path: Path) -> Contents:
    """Tensors of a torch zip: views of one private mapping of the file, whatever else stands in it."""
    if path.suffix == ".safetensors":  # torch goes by the suffix
        raise CheckpointError("is a torch zip under the name .safetensors; rename it to .ckpt")
    try:
        with zipfile.ZipFile(path) as archive:
            check_archive(archive.infolist())
            check_storages(archive)
        reader = cast("Any", RestrictedPickle)
        return contents(torch.load(str(path), map_location="cpu", mmap=True, weights_only=False, pickle_module=reader))
    except CheckpointError:
        raise
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"is a truncated or damaged torch zip ({error}); {FETCH_AGAIN}") from error
    except Exception as error:  # a damaged or hostile pickle can raise anything at all
        raise CheckpointError(f"cannot be unpickled ({type(error).__name__}: {error}); {FETCH_AGAIN}") from error


def _yaml_beside(path: Path) -> str:
    """Text of the training configuration a published checkpoint comes with, or "" """
    yaml = path.with_suffix(".yaml")
    if not yaml.is_file():
        return ""
    with yaml.open("rb") as file:
        return file.read(_LARGEST_YAML).decode("utf-8", errors="replace")
