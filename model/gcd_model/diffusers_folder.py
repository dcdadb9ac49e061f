"""How a diffusers folder is laid out: which files hold the weights, what its config.json files tell. Opens nothing."""

from collections.abc import Iterable
from typing import TypeVar

import msgspec

from gcd_model.architecture import Hints
from gcd_model.errors import CheckpointError, FileError
from gcd_model.small_files import decode_json

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
