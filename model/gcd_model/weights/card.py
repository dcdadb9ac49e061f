"""Our weight files: safetensors with the config in the metadata. Pure: text and bytes in, text and bytes out."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

import msgspec
import torch

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.live.config import LiveConfig
from gcd_model.small_files import decode_json

FORMAT = "1"
CONFIG_KEY = "gcd.config"
LINE = 64
"""Bytes of a cache line, and of what torch aligns memory to."""
NO_DIFFUSION = "is the live model, which has no U-Net and no VAE: this is for diffusion models"
_SCALE_KEY = "gcd.uncertainty_scale"

PRECISIONS: dict[str, torch.dtype] = {
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}
"""What --dtype takes."""

FULL_PRECISION = ("decoder",)
"""Networks that compute in float32 whatever --dtype says: what they make is looked at."""

_DTYPES = {torch.float64: "F64", torch.float32: "F32", torch.bfloat16: "BF16", torch.float16: "F16"}


def precision(name: str) -> torch.dtype:
    """The dtype of that name. Raises OptionError for another."""
    if name not in PRECISIONS:
        raise OptionError(f"dtype must be one of {', '.join(PRECISIONS)}, got {name!r}")
    return PRECISIONS[name]


@dataclass(frozen=True, kw_only=True, slots=True)
class Card:
    """What our files say about themselves besides the weights.

    family: a name of FAMILIES or None. move_time: frame in which the goal pose is reached.
    trained: False for random weights. origin: digest of the file this one was converted from, or "".
    uncertainty_scale: see `Traits`; a positive number, or None.
    """

    name: str
    config: ModelConfig | LiveConfig
    family: str | None
    move_time: int
    trained: bool = True
    origin: str = ""
    uncertainty_scale: float | None = None

    def __post_init__(self) -> None:
        scale = self.uncertainty_scale
        if scale is not None and not 0 < scale < math.inf:
            raise OptionError(f"the uncertainty scale must be a positive number, got {scale:g}; measure it again")
        if not 0 <= self.move_time < self.config.frames:
            raise OptionError(f"move_time must be one of the {self.config.frames} frames, got {self.move_time}")

    @property
    def diffusion(self) -> ModelConfig:
        """The config of a diffusion model. Raises CheckpointError for the live model's."""
        if isinstance(self.config, LiveConfig):
            raise CheckpointError(f"{self.name or 'it'} {NO_DIFFUSION}")
        return self.config

    def to_metadata(self) -> dict[str, str]:
        """As safetensors metadata: text to text."""
        scale = self.uncertainty_scale
        return {
            "gcd.format": FORMAT,
            CONFIG_KEY: msgspec.json.encode(self.config).decode(),
            "gcd.name": self.name,
            "gcd.family": self.family or "",
            "gcd.move_time": str(self.move_time),
            "gcd.trained": "true" if self.trained else "false",
            "gcd.origin": self.origin,
            **({} if scale is None else {_SCALE_KEY: repr(scale)}),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """Raises CheckpointError for another format or a damaged config."""
        if metadata.get("gcd.format", FORMAT) != FORMAT:
            raise CheckpointError(
                f"its format is {metadata['gcd.format']!r}, this version reads {FORMAT!r}; install a newer gcd-node"
            )
        try:
            return cls(
                name=metadata.get("gcd.name", ""),
                config=_config(metadata[CONFIG_KEY]),
                family=metadata.get("gcd.family") or None,
                move_time=int(metadata["gcd.move_time"]),
                trained=metadata.get("gcd.trained", "true") != "false",
                origin=metadata.get("gcd.origin", ""),
                uncertainty_scale=None if _SCALE_KEY not in metadata else float(metadata[_SCALE_KEY]),
            )
        except (KeyError, ValueError, ArithmeticError) as error:
            raise CheckpointError(f"its metadata cannot be used ({error}); convert the weights again") from error


class _Kind(msgspec.Struct):
    kind: str = ""


def _config(text: str) -> ModelConfig | LiveConfig:
    return decode_json(text, LiveConfig if decode_json(text, _Kind).kind == "live" else ModelConfig)


@dataclass(frozen=True, slots=True)
class Entry:
    """One tensor to be written."""

    shape: tuple[int, ...]
    dtype: torch.dtype

    @property
    def size(self) -> int:
        """Bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def file_order(entries: Mapping[str, Entry]) -> list[str]:
    """Names as their tensors follow each other: whole cache lines first, then widest type first, then by name.

    So each lies where its type may, and all but the small ones of odd sizes begin with a cache line when the file is
    mapped, as memory that torch allocates does: some processors' kernels round otherwise elsewhere.
    """
    return sorted(entries, key=lambda name: (entries[name].size % LINE != 0, -entries[name].dtype.itemsize, name))


def header(entries: Mapping[str, Entry], metadata: Mapping[str, str]) -> bytes:
    """The head of a safetensors file whose tensors follow in `file_order`.

    Eight bytes of length, then JSON padded with spaces to the end of a cache line. Source: the safetensors format.
    """
    content: dict[str, object] = {"__metadata__": dict(metadata)}
    start = 0
    for name in file_order(entries):
        entry = entries[name]
        offsets = [start, start + entry.size]
        content[name] = {"dtype": _DTYPES[entry.dtype], "shape": list(entry.shape), "data_offsets": offsets}
        start = offsets[1]
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % LINE)
    return len(text).to_bytes(8, "little") + text


# --- what can be said about a checkpoint without loading it ----------------------------------------------------------


Layout = Literal["gcd-ckpt", "sgm-safetensors", "diffusers", "gcd-node"]
"""Lightning checkpoint of GCD; `svd.safetensors` and its like; diffusers folder; our own format."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NetworkReport:
    """One network of a checkpoint. dtypes: as stored, for example ("float16",). size: bytes as stored."""

    name: str
    parameters: int
    tensors: int
    dtypes: tuple[str, ...]
    size: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Leftover:
    """Weights that are recognised and not used. size: bytes as stored."""

    kind: str
    tensors: int
    size: int


@dataclass(frozen=True, kw_only=True, slots=True)
class WeightsReport:
    """What `gcd-node weights inspect` shows.

    uncertainty_scale: see `Traits`.
    family: None if unknown; told_by: "option", "metadata", "file name" or "yaml".
    optimizer_size: bytes of optimizer state, which is never read; 0 without. other_entries: further top-level names.
    size: bytes on disk, all files together. digest: see `digest`.
    """

    path: str
    name: str
    layout: Layout
    config: ModelConfig | LiveConfig
    family: str | None
    told_by: str | None
    move_time: int
    trained: bool
    networks: tuple[NetworkReport, ...]
    leftovers: tuple[Leftover, ...]
    optimizer_size: int
    other_entries: tuple[str, ...]
    size: int
    digest: str
    uncertainty_scale: float | None = None

    @property
    def sha256_12(self) -> str:
        """First 12 digits of the digest: what views carry."""
        return self.digest[:12]

    @property
    def parameters(self) -> int:
        """All parameters that are used."""
        return sum(network.parameters for network in self.networks)
