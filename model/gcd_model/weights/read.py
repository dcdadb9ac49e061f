"""Weight files mapped and told apart by their content: the only place that opens checkpoints to read.

Nothing in a file is ever executed, see `pickle.py`.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import msgspec
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils import _pytree as pytree

from gcd_model.errors import CheckpointError, FileError
from gcd_model.small_files import decode_json, read_small
from gcd_model.weights.card import ADAPTER_KEY, CONFIG_KEY, NOTES, Hints, Layout, told_by_name, told_by_yaml, unpacked
from gcd_model.weights.names import GCD_UNET
from gcd_model.weights.pickle import SAVE_AGAIN, Placeholder, read_pickle

_LARGEST_YAML = 1 << 18
_LARGEST_HEADER = 1 << 24  # SVD has 0.4 MB; the library takes 100 MB, and builds gigabytes from them
_HEAD = 512
_FETCH_AGAIN = "fetch it again and compare its size with the publisher's"


@dataclass(frozen=True, kw_only=True, slots=True)
class WeightsFile:
    """A checkpoint as it lies on the disk: mapped tensors by published name, and what comes with them.

    name: of the file, without suffix, or of the folder. files: all that hold weights. hints: of what lies beside them.
    metadata: our notes of a pickle, or a safetensors file's own. optimizer_size: bytes. other_entries: names of further
    top-level entries of a pickle.
    """

    name: str
    files: tuple[Path, ...]
    tensors: Mapping[str, Tensor]
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])
    hints: Hints = field(default_factory=Hints)
    is_pickle: bool = False
    optimizer_size: int = 0
    other_entries: tuple[str, ...] = ()

    @property
    def layout(self) -> Layout:
        """By content. Raises CheckpointError if it is none that is known here."""
        names = self.tensors
        if not self.is_pickle and ADAPTER_KEY in self.metadata:
            raise CheckpointError(
                "is an adapter, which is nothing without its base: give the base, and this as the adapter; or join "
                "them with `gcd-train lora merge`"
            )
        if not self.is_pickle and CONFIG_KEY in self.metadata:
            return "gcd-node"
        if any(name.startswith(f"{GCD_UNET}.") for name in names):
            return "gcd-ckpt" if self.is_pickle else "sgm-safetensors"
        if any(name.startswith("unet/") for name in names):
            return "diffusers"
        if any(name.startswith(("down_blocks.", "vision_model.", "encoder.down_blocks.")) for name in names):
            raise CheckpointError(
                "is one part of a diffusers model; give the folder that holds unet, vae and image_encoder"
            )
        raise CheckpointError(
            f"holds {len(names)} tensors of no layout known here, first: {', '.join(list(names)[:5]) or 'none'}; "
            f"wanted are names of GCD or Stable Video Diffusion ({GCD_UNET}...), a diffusers folder or a file of "
            "`gcd-node weights convert`"
        )


def read_weights(path: Path) -> WeightsFile:
    """Map a file or folder. Raises CheckpointError, OSError."""
    if not path.exists():
        raise CheckpointError("there is no such file or folder; check the path")
    if path.is_dir():
        return _read_folder(path)
    read, yaml, text = read_file(path), path.with_suffix(".yaml"), ""
    if yaml.is_file():  # the training configuration a published checkpoint comes with
        with yaml.open("rb") as file:
            text = file.read(_LARGEST_YAML).decode("utf-8", errors="replace")
    return replace(read, hints=told_by_name(path.stem).over(told_by_yaml(text)))


# --- a single file ---------------------------------------------------------------------------------------------------


def read_file(path: Path) -> WeightsFile:
    """What a single file holds. Raises CheckpointError, OSError."""
    try:
        if _is_zip(path):
            with path.open("rb") as opened:
                return _sorted_out(path, read_pickle(path, opened))
        with safe_open(path, framework="pt", device="cpu") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
            return _of_one(path, tensors, metadata=unpacked(file.metadata() or {}))
    except (CheckpointError, OSError):
        raise
    except SafetensorError as error:
        raise CheckpointError(f"is damaged or truncated safetensors ({error}); {_FETCH_AGAIN}") from error
    except zipfile.BadZipFile as error:
        raise CheckpointError(f"is a truncated or damaged torch zip ({error}); {_FETCH_AGAIN}") from error
    except Exception as error:  # a damaged or hostile pickle can raise anything at all
        raise CheckpointError(f"cannot be unpickled ({type(error).__name__}: {error}); {_FETCH_AGAIN}") from error


def _of_one(path: Path, tensors: Mapping[str, Tensor], **more: Any) -> WeightsFile:
    return WeightsFile(name=path.stem, files=(path,), tensors=tensors, **more)


def _is_zip(path: Path) -> bool:
    """Tell a torch zip from safetensors. Raises CheckpointError, which names what it is instead, and the remedy."""
    if not path.is_file():
        raise CheckpointError("is neither a file nor a folder; give a checkpoint")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(b"PK\x03\x04"):
        return True
    if size == 0:
        raise CheckpointError(f"is empty (0 bytes); {_FETCH_AGAIN}")
    if head.startswith(b"version https://git-lfs"):
        raise CheckpointError("is a Git LFS pointer, not the weights themselves; run `git lfs pull` where it lies")
    if head.lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        raise CheckpointError("is a web page, not weights: the download needs another address or a login")
    if head.startswith((b"\x80\x02", b"\x80\x03", b"\x80\x04")) or head[257:262] == b"ustar":
        raise CheckpointError(f"was written in torch's old format, before zip, and cannot be mapped; {SAVE_AGAIN}")
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


_WEIGHTS, _OPTIMIZER = "state_dict", "optimizer_states"


def _sorted_out(path: Path, root: object) -> WeightsFile:
    """Sort out what a pickle holds at its root: `state_dict` and companions, or tensors alone.

    Raises:
        CheckpointError: no weights, or something else than tensors among them. Elsewhere anything may stand.
    """
    if not isinstance(root, dict):
        raise CheckpointError(f"holds {_what(root)}, wanted a dictionary with the entry {_WEIGHTS!r}")
    entries = cast("dict[object, object]", root)
    if _WEIGHTS not in entries:
        if not any(isinstance(value, Tensor) for value in entries.values()):
            names = ", ".join(str(key) for key in list(entries)[:5])
            raise CheckpointError(f"has no entry {_WEIGHTS!r} (found: {names}); it holds no weights")
        return _of_one(path, _weights(entries), is_pickle=True)
    moments = {id(leaf): leaf for leaf in pytree.tree_leaves(entries.get(_OPTIMIZER)) if isinstance(leaf, Tensor)}
    facts = entries.get("hyper_parameters")
    notes = cast("dict[object, object]", facts).get(NOTES) if isinstance(facts, dict) else None
    texts = cast("dict[object, object]", notes).items() if isinstance(notes, dict) else ()
    return _of_one(
        path,
        _weights(entries[_WEIGHTS]),
        metadata={key: value for key, value in texts if isinstance(key, str) and isinstance(value, str)},
        is_pickle=True,
        optimizer_size=sum(tensor.nbytes for tensor in moments.values()),
        other_entries=tuple(str(key) for key in entries if key not in (_WEIGHTS, _OPTIMIZER)),
    )


def _weights(state: object) -> dict[str, Tensor]:
    if not isinstance(state, dict):
        raise CheckpointError(f"its {_WEIGHTS} is {_what(state)}, wanted a dictionary of tensors")
    found: dict[str, Tensor] = {}
    for name, value in cast("dict[object, object]", state).items():
        if not isinstance(name, str) or not isinstance(value, Tensor):
            raise CheckpointError(
                f"{_what(value)} stands among the weights, at {name!r}: refused; wanted are tensors only"
            )
        there = value.untyped_storage().nbytes()
        if value.nbytes > there:  # a few bytes can claim to be a huge tensor by repeating themselves; real ones do not
            raise CheckpointError(f"{name} claims {value.nbytes} bytes and stores {there}: refused")
        found[name] = value
    return found


def _what(value: object) -> str:
    if isinstance(value, Placeholder):
        return f"an object of {value.origin}"
    if isinstance(value, type):
        return f"the class {getattr(value, 'origin', value.__name__)}"
    return f"a {type(value).__name__}"


# --- a diffusers folder ----------------------------------------------------------------------------------------------


_STEMS, _PARTS = ("diffusion_pytorch_model", "model"), ("unet", "vae", "image_encoder")
"""The folders that hold weights; the others are not needed."""


class _Config(msgspec.Struct, frozen=True, kw_only=True):
    """Of the three config.json, which have many more entries: what weights do not tell."""

    num_attention_heads: int | tuple[int, ...] | None = None
    num_frames: int | None = None
    scaling_factor: float | None = None
    hidden_act: str = "gelu"


def _read_folder(path: Path) -> WeightsFile:
    absent = [part for part in _PARTS if not (path / part).is_dir()]
    if absent:
        raise CheckpointError(f"is a folder without {', '.join(absent)}; a diffusers folder has {', '.join(_PARTS)}")
    tensors: dict[str, Tensor] = {}
    files = [_part_file(path / part) for part in _PARTS]
    for part, file in zip(_PARTS, files, strict=True):
        try:
            tensors |= {f"{part}/{name}": tensor for name, tensor in read_file(file).tensors.items()}
        except CheckpointError as error:
            raise CheckpointError(f"its file {part}/{file.name} {error}") from error
    unet, vae, tower = (_facts(path / part / "config.json") for part in _PARTS)
    if tower.hidden_act != "gelu":
        raise CheckpointError(f"its image tower has activation {tower.hidden_act!r}; supported is 'gelu'")
    if not isinstance(tower.num_attention_heads, int | None):
        raise CheckpointError("its image_encoder/config.json gives heads of several levels, wanted is one number")
    hints = Hints(
        heads=unet.num_attention_heads,
        image_heads=tower.num_attention_heads,
        frames=unet.num_frames,
        latent_scale=vae.scaling_factor,
    )
    name = path.resolve().name
    return WeightsFile(name=name, files=tuple(files), tensors=tensors, hints=hints.over(told_by_name(name)))


def _part_file(folder: Path) -> Path:
    """The weights file of one part, whole, as safetensors: full precision before float16."""
    names = (f"{stem}{variant}.safetensors" for variant in ("", ".fp16") for stem in _STEMS)
    for file in map(folder.joinpath, names):
        if file.exists():
            return file
    there = ", ".join(sorted(entry.name for entry in folder.iterdir())[:5])
    raise CheckpointError(
        f"its folder {folder.name} holds no weights (found: {there or 'nothing'}); wanted is "
        "diffusion_pytorch_model.safetensors or model.safetensors, whole, or with .fp16, as diffusers writes them"
    )


def _facts(file: Path) -> _Config:
    """What a small file tells; nothing where it is absent."""
    try:
        return decode_json(read_small(file), _Config) if file.exists() or file.is_symlink() else _Config()
    except FileError as error:
        raise CheckpointError(f"its file {file.parent.name}/{file.name} {error}") from error
