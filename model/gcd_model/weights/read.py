"""Weight files mapped and told apart by their content: the only place that opens checkpoints to read.

Nothing in a file is ever executed, see `RestrictedPickle`.
"""

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from gcd_model.errors import CheckpointError, FileError
from gcd_model.small_files import decode_json, read_small
from gcd_model.weights.card import ADAPTER_KEY, CONFIG_KEY, Layout
from gcd_model.weights.infer import Hints
from gcd_model.weights.names import GCD_UNET
from gcd_model.weights.pickle import Contents, RestrictedPickle, check_storages, contents

_LARGEST_YAML = 1 << 18
_LARGEST_HEADER = 1 << 24  # SVD has 0.4 MB; the library takes 100 MB, and builds gigabytes from them
_HEAD = 512
_FETCH_AGAIN = "fetch it again and compare its size with the publisher's"
_SAVE_AGAIN = "load it where it was made and write it again with torch.save (torch 1.6 or newer)"


@dataclass(frozen=True, kw_only=True, slots=True)
class WeightsFile:
    """A checkpoint as it lies on the disk: mapped tensors by published name, and what comes with them.

    name: of the file, without suffix, or of the folder. files: all that hold weights. yaml: text of the
    configuration beside it, or "". See `WeightsReport` for the others.
    """

    name: str
    layout: Layout
    files: tuple[Path, ...]
    tensors: Mapping[str, Tensor]
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])
    hints: Hints = field(default_factory=Hints)
    yaml: str = ""
    optimizer_size: int = 0
    other_entries: tuple[str, ...] = ()


def read_weights(path: Path) -> WeightsFile:
    """Map a file or folder and tell its layout by its content. Raises CheckpointError, OSError."""
    if not path.exists():
        raise CheckpointError("there is no such file or folder; check the path")
    if path.is_dir():
        return _read_folder(path)
    held, metadata = read_file(path)
    return WeightsFile(
        name=path.stem,
        layout=_layout_of(held.tensors, metadata),
        files=(path,),
        tensors=held.tensors,
        metadata=held.notes if metadata is None else metadata,
        yaml=_yaml_beside(path),
        optimizer_size=held.optimizer_size,
        other_entries=held.other_entries,
    )


def _layout_of(tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None) -> Layout:
    """Layout of a single file; metadata: of safetensors, None for a pickle."""
    if metadata is not None and ADAPTER_KEY in metadata:
        raise CheckpointError(
            "is an adapter, which is nothing without its base: give the base, and this as the adapter; or join them "
            "with `gcd-train lora merge`"
        )
    if metadata is not None and CONFIG_KEY in metadata:
        return "gcd-node"
    if any(name.startswith(f"{GCD_UNET}.") for name in tensors):
        return "gcd-ckpt" if metadata is None else "sgm-safetensors"
    if any(name.startswith(("down_blocks.", "vision_model.", "encoder.down_blocks.")) for name in tensors):
        raise CheckpointError(
            "is one part of a diffusers model; give the folder that holds unet, vae and image_encoder"
        )
    first = ", ".join(list(tensors)[:5]) or "none"
    raise CheckpointError(
        f"holds {len(tensors)} tensors of no layout known here, first: {first}; wanted are names of GCD or Stable "
        f"Video Diffusion ({GCD_UNET}...), a diffusers folder or a file of `gcd-node weights convert`"
    )


def _yaml_beside(path: Path) -> str:
    """Text of the training configuration a published checkpoint comes with, or "" """
    yaml = path.with_suffix(".yaml")
    if not yaml.is_file():
        return ""
    with yaml.open("rb") as file:
        return file.read(_LARGEST_YAML).decode("utf-8", errors="replace")


# --- a single file ---------------------------------------------------------------------------------------------------


def read_file(path: Path) -> tuple[Contents, dict[str, str] | None]:
    """What a single file holds, and the metadata if it is safetensors. Raises CheckpointError, OSError."""
    if _is_zip(path):
        return _read_zip(path), None
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            return Contents(tensors), file.metadata() or {}
    except SafetensorError as error:
        raise CheckpointError(f"is damaged or truncated safetensors ({error}); {_FETCH_AGAIN}") from error


def _is_zip(path: Path) -> bool:
    """Tell a torch zip from safetensors. Raises CheckpointError, which names what it is instead, and the remedy."""
    if not path.is_file():
        raise CheckpointError("is neither a file nor a folder; give a checkpoint")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if size == 0:
        raise CheckpointError(f"is empty (0 bytes); {_FETCH_AGAIN}")
    if head.startswith(b"PK\x03\x04"):
        return True
    if head.startswith(b"version https://git-lfs"):
        raise CheckpointError("is a Git LFS pointer, not the weights themselves; run `git lfs pull` where it lies")
    if head.lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise CheckpointError("is a web page, not weights: the download needs another address or a login")
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04")) or head[257:262] == b"ustar":
        raise CheckpointError(f"was written in torch's old format, before zip, and cannot be mapped; {_SAVE_AGAIN}")
    if head[8:9] != b"{":
        raise CheckpointError(
            "is neither a torch zip (.ckpt) nor safetensors; wanted are GCD's .ckpt, svd.safetensors, a diffusers "
            "folder or a file of `gcd-node weights convert`"
        )
    length = int.from_bytes(head[:8], "little")
    if length > _LARGEST_HEADER:
        raise CheckpointError(f"has a safetensors header of {length} bytes, too long to be true; {_FETCH_AGAIN}")
    if 8 + length > size:
        raise CheckpointError(f"ends within its header ({size} bytes, the header alone has {length}); {_FETCH_AGAIN}")
    return False


def _read_zip(path: Path) -> Contents:
    """Tensors of a torch zip: views of one private mapping of the file, whatever else stands in it."""
    if path.suffix == ".safetensors":  # torch goes by the suffix
        raise CheckpointError("is a torch zip under the name .safetensors; rename it to .ckpt")
    try:
        with zipfile.ZipFile(path) as archive:
            _check_archive(archive.infolist())
            check_storages(archive)
        reader = cast("Any", RestrictedPickle)
        return contents(torch.load(str(path), map_location="cpu", mmap=True, weights_only=False, pickle_module=reader))
    except CheckpointError:
        raise
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"is a truncated or damaged torch zip ({error}); {_FETCH_AGAIN}") from error
    except Exception as error:  # a damaged or hostile pickle can raise anything at all
        raise CheckpointError(f"cannot be unpickled ({type(error).__name__}: {error}); {_FETCH_AGAIN}") from error


def _check_archive(entries: Sequence[zipfile.ZipInfo]) -> None:
    """Whether a zip is a checkpoint torch can map. Raises CheckpointError if not."""
    if any(entry.filename.endswith("constants.pkl") for entry in entries):
        raise CheckpointError("is a TorchScript program, which would be executed; wanted are weights only")
    if "data.pkl" not in {entry.filename.partition("/")[2] for entry in entries}:
        raise CheckpointError("is a zip without data.pkl, not a torch checkpoint; unpack it if it only wraps one")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise CheckpointError(f"is a zip whose tensors are compressed and cannot be mapped; {_SAVE_AGAIN}")


# --- a diffusers folder ----------------------------------------------------------------------------------------------


Facts = TypeVar("Facts", bound=msgspec.Struct)

_PARTS = ("unet", "vae", "image_encoder")
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
    weight_map: dict[str, str]


def _read_folder(path: Path) -> WeightsFile:
    absent = [part for part in _PARTS if not (path / part).is_dir()]
    if absent:
        raise CheckpointError(f"is a folder without {', '.join(absent)}; a diffusers folder has {', '.join(_PARTS)}")
    tensors: dict[str, Tensor] = {}
    files: list[Path] = []
    for part in _PARTS:
        for file in _part_files(path / part):
            files.append(file)
            try:
                tensors |= {f"{part}/{name}": tensor for name, tensor in read_file(file)[0].tensors.items()}
            except CheckpointError as error:
                raise CheckpointError(f"its file {part}/{file.name} {error}") from error
    return WeightsFile(
        name=path.resolve().name, layout="diffusers", files=tuple(files), tensors=tensors, hints=_folder_hints(path)
    )


def _part_files(folder: Path) -> list[Path]:
    """The weights files of one part: full precision before float16, safetensors before pickles, whole before shards."""
    names = sorted(entry.name for entry in folder.iterdir())
    stems = ("diffusion_pytorch_model", "model", "pytorch_model")
    chosen = next(
        (
            name
            for ending in (".safetensors", ".bin")
            for variant in ("", ".fp16")
            for stem in stems
            for name in (f"{stem}{variant}{ending}", f"{stem}{ending}.index{variant}.json")
            if name in names
        ),
        None,
    )
    if chosen is None:
        raise CheckpointError(
            f"its folder {folder.name} holds no weights (found: {', '.join(names[:5]) or 'nothing'}); wanted is "
            "diffusion_pytorch_model.safetensors or model.safetensors, with .fp16 or an index as diffusers writes them"
        )
    if not chosen.endswith(".json"):
        return [folder / chosen]
    shards = sorted(set(_facts(folder / chosen, _Index).weight_map.values()))
    for shard in shards:
        if "/" in shard or "\\" in shard or shard in ("", ".", ".."):
            raise CheckpointError(f"its index {chosen} names the shard {shard!r}; wanted are plain file names")
    absent = [shard for shard in shards if not (folder / shard).exists()]
    if absent:
        raise CheckpointError(
            f"its folder {folder.name} lacks {len(absent)} shards, first: {absent[0]}; {_FETCH_AGAIN}"
        )
    return [folder / shard for shard in shards]


def _folder_hints(path: Path) -> Hints:
    """What the three config.json files tell; each may be absent."""
    unet = _facts(path / "unet" / "config.json", _UNetFacts)
    vae = _facts(path / "vae" / "config.json", _VAEFacts)
    tower = _facts(path / "image_encoder" / "config.json", _ImageFacts)
    if tower.hidden_act != "gelu":
        raise CheckpointError(f"its image tower has activation {tower.hidden_act!r}; supported is 'gelu'")
    return Hints(
        heads=unet.num_attention_heads,
        image_heads=tower.num_attention_heads,
        frames=unet.num_frames,
        latent_scale=vae.scaling_factor,
    )


def _facts(file: Path, kind: type[Facts]) -> Facts:
    """What a small file tells; nothing where it is absent."""
    try:
        return decode_json(read_small(file), kind) if file.exists() or file.is_symlink() else kind()
    except FileError as error:
        raise CheckpointError(f"its file {file.parent.name}/{file.name} {error}") from error
