"""Weight files mapped and told apart by their content: the only place that opens checkpoints to read.

Nothing in a file is ever executed, see `RestrictedPickle`.
"""

import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import msgspec
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gcd_model.errors import CheckpointError, FileError
from gcd_model.small_files import decode_json, read_small
from gcd_model.weights.examine import WeightsFile, layout_of
from gcd_model.weights.infer import Hints
from gcd_model.weights.pickle import Contents, RestrictedPickle, check_storages, contents

_LARGEST_YAML = 1 << 18


def read_weights(path: Path) -> WeightsFile:
    """Map a file or folder and tell its layout by its content. Raises CheckpointError, OSError."""
    if not path.exists():
        raise CheckpointError("there is no such file or folder; check the path")
    if path.is_dir():
        return _read_folder(path)
    held, metadata = read_file(path)
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
        return read_file(file)[0].tensors
    except CheckpointError as error:
        raise CheckpointError(f"its file {file.parent.name}/{file.name} {error}") from error


def read_file(path: Path) -> tuple[Contents, dict[str, str] | None]:
    """What a single file holds, and the metadata if it is safetensors."""
    if _kind(path) == "zip":
        return _read_zip(path), None
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            return Contents(tensors), file.metadata() or {}
    except SafetensorError as error:
        raise CheckpointError(f"is damaged or truncated safetensors ({error}); {FETCH_AGAIN}") from error


def _kind(path: Path) -> "FileKind":
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


# --- a diffusers folder ----------------------------------------------------------------------------------------------


Facts = TypeVar("Facts", bound=msgspec.Struct)

PARTS = ("unet", "vae", "image_encoder")
"""The folders that hold weights; the others are not needed."""


class _UNetFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Of unet/config.json, which has many more entries: what weights do not tell."""

    num_attention_heads: int | tuple[int, ...] | None = None
    num_frames: int | None = None


class _VAEFacts(msgspec.Struct, frozen=True, kw_only=True):
    scaling_factor: float | None = None


class _ImageFacts(msgspec.Struct, frozen=True, kw_only=True):
    num_attention_heads: int | None = None
    hidden_act: str = "gelu"


class _Index(msgspec.Struct, frozen=True, kw_only=True):
    weight_map: dict[str, str] = {}


def folder_hints(unet: str | None, vae: str | None, image_encoder: str | None) -> Hints:
    """What the three config.json files tell; each may be absent.

    Raises: CheckpointError for broken JSON, or an activation the image tower here does not compute.
    """
    unet_facts = _decoded(unet, _UNetFacts, "unet/config.json")
    image_facts = _decoded(image_encoder, _ImageFacts, "image_encoder/config.json")
    if image_facts.hidden_act != "gelu":
        raise CheckpointError(f"its image tower has activation {image_facts.hidden_act!r}; supported is 'gelu'")
    return Hints(
        heads=unet_facts.num_attention_heads,
        image_heads=image_facts.num_attention_heads,
        frames=unet_facts.num_frames,
        latent_scale=_decoded(vae, _VAEFacts, "vae/config.json").scaling_factor,
    )


def _decoded(text: str | None, kind: type[Facts], name: str) -> Facts:
    try:
        return kind() if text is None else decode_json(text, kind)
    except FileError as error:
        raise CheckpointError(f"{name} {error}") from error


def chosen_file(names: Iterable[str], part: str) -> str:
    """The file to read of one folder: a weights file, or the index of a sharded one.

    Full precision before float16, safetensors before pickles.
    Raises: CheckpointError if there is none.
    """
    names = sorted(names)
    for ending in (".safetensors", ".bin"):
        for variant in ("", ".fp16"):
            for stem in ("diffusion_pytorch_model", "model", "pytorch_model"):
                for name in (f"{stem}{variant}{ending}", f"{stem}{ending}.index{variant}.json"):
                    if name in names:
                        return name
    found = ", ".join(names[:5]) or "nothing"
    raise CheckpointError(
        f"its folder {part} holds no weights (found: {found}); wanted is diffusion_pytorch_model.safetensors or "
        "model.safetensors, with .fp16 or an index as diffusers writes them"
    )


def shards(index: str, name: str) -> list[str]:
    """File names an index lists, each once; `name` is its own, for messages.

    Raises: CheckpointError for broken JSON, or names that leave the folder.
    """
    files = _decoded(index, _Index, f"its index {name}").weight_map.values()
    for shard in files:
        if "/" in shard or "\\" in shard or shard in ("", ".", ".."):
            raise CheckpointError(f"its index {name} names the shard {shard!r}; wanted are plain file names")
    return sorted(set(files))


# --- what a file is, by its first bytes ------------------------------------------------------------------------------


HEAD = 512
"""How many first bytes `file_kind` wants."""

FETCH_AGAIN = "fetch it again and compare its size with the publisher's"
SAVE_AGAIN = "load it where it was made and write it again with torch.save (torch 1.6 or newer)"
_LARGEST_HEADER = 1 << 24  # SVD has 0.4 MB; the library takes 100 MB, and builds gigabytes from them

FileKind = Literal["zip", "safetensors"]


def file_kind(head: bytes, size: int) -> FileKind:
    """Tell a torch zip from safetensors.

    Args:
        head: the first HEAD bytes. size: of the whole file.
    Raises:
        CheckpointError: names what it is instead, and the remedy.
    """
    if size == 0:
        raise CheckpointError(f"is empty (0 bytes); {FETCH_AGAIN}")
    if head.startswith(b"PK\x03\x04"):
        return "zip"
    if head.startswith(b"version https://git-lfs"):
        raise CheckpointError("is a Git LFS pointer, not the weights themselves; run `git lfs pull` where it lies")
    if head.lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise CheckpointError("is a web page, not weights: the download needs another address or a login")
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04")) or head[257:262] == b"ustar":
        raise CheckpointError(f"was written in torch's old format, before zip, and cannot be mapped; {SAVE_AGAIN}")
    if head[8:9] == b"{":
        return _safetensors(int.from_bytes(head[:8], "little"), size)
    raise CheckpointError(
        "is neither a torch zip (.ckpt) nor safetensors; wanted are GCD's .ckpt, svd.safetensors, a diffusers "
        "folder or a file of `gcd-node weights convert`"
    )


def _safetensors(length: int, size: int) -> FileKind:
    if length > _LARGEST_HEADER:
        raise CheckpointError(f"has a safetensors header of {length} bytes, too long to be true; {FETCH_AGAIN}")
    if 8 + length > size:
        raise CheckpointError(f"ends within its header ({size} bytes, the header alone has {length}); {FETCH_AGAIN}")
    return "safetensors"


def check_archive(entries: Sequence[zipfile.ZipInfo]) -> None:
    """Whether a zip is a checkpoint torch can map. Raises CheckpointError if not."""
    inner = {entry.filename.partition("/")[2] for entry in entries}
    if any(entry.filename.endswith("constants.pkl") for entry in entries):
        raise CheckpointError("is a TorchScript program, which would be executed; wanted are weights only")
    if "data.pkl" not in inner:
        raise CheckpointError("is a zip without data.pkl, not a torch checkpoint; unpack it if it only wraps one")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise CheckpointError(f"is a zip whose tensors are compressed and cannot be mapped; {SAVE_AGAIN}")
