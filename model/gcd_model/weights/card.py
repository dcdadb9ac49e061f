"""What our weight files say about themselves, and what can be said about any checkpoint without loading it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Self

import msgspec
import torch

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, FileError, OptionError
from gcd_model.live.config import LiveConfig
from gcd_model.small_files import decode_json
from gcd_model.weights.families import Family, family_named

FORMAT = "1"
CONFIG_KEY, ADAPTER_KEY = "gcd.config", "gcd.adapter"
"""Metadata that our weight files have, and those of adapters alone."""
NOTES = "gcd_node"
"""Where in the hyper-parameters of a `.ckpt` our card stands."""
_PACKED = "gcd"
"""The one entry of a safetensors file that holds all of ours, as JSON: the library writes several in an order of the
moment, and the same weights must be the same bytes. Files of before have them apart."""
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


def packed(metadata: Mapping[str, str]) -> dict[str, str]:
    """Metadata as our files hold it."""
    return {_PACKED: msgspec.json.encode(metadata).decode()}


def unpacked(metadata: Mapping[str, str]) -> dict[str, str]:
    """The inverse of `packed`. Raises CheckpointError if it is damaged."""
    try:
        return {**metadata, **decode_json(metadata.get(_PACKED, "{}"), dict[str, str])}
    except FileError as error:
        raise CheckpointError(f"its metadata {error}; convert the weights again") from error


def precision(name: str) -> torch.dtype:
    """The dtype of that name. Raises OptionError for another."""
    if name not in PRECISIONS:
        raise OptionError(f"dtype must be one of {', '.join(PRECISIONS)}, got {name!r}")
    return PRECISIONS[name]


@dataclass(frozen=True, kw_only=True, slots=True)
class Card:
    """What our files say about themselves besides the weights.

    family: None if nobody could tell; then no limits are checked.
    move_time: frame in which the goal pose is reached; 0 for a direct checkpoint.
    trained: False for random weights, whose pictures are noise.
    origin: digest of the file this one was converted from, or "".
    uncertainty_scale: the deviation over samples times this covers the truth as often as it says, as was measured on
        held-out clips; a positive number, None where nobody did.
    """

    name: str
    config: ModelConfig | LiveConfig
    family: Family | None
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
    def live(self) -> bool:
        """Whether it is the live model, which needs to know the lens and takes a mount, depth and odometry."""
        return isinstance(self.config, LiveConfig)

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
            "gcd.family": "" if self.family is None else self.family.name,
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
            config, family = metadata[CONFIG_KEY], metadata.get("gcd.family")
            return cls(
                name=metadata.get("gcd.name", ""),
                config=decode_json(config, LiveConfig if decode_json(config, _Kind).kind == "live" else ModelConfig),
                family=family_named(family) if family else None,
                move_time=int(metadata["gcd.move_time"]),
                trained=metadata.get("gcd.trained", "true") != "false",
                origin=metadata.get("gcd.origin", ""),
                uncertainty_scale=None if _SCALE_KEY not in metadata else float(metadata[_SCALE_KEY]),
            )
        except (KeyError, ValueError, ArithmeticError) as error:
            raise CheckpointError(f"its metadata cannot be used ({error}); convert the weights again") from error


class _Kind(msgspec.Struct):
    kind: str = ""


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
class WeightsReport(Card):
    """What `gcd-node weights inspect` shows: what the checkpoint says of itself, or what was worked out, and the rest.

    told_by: who named the family: "option", "metadata", "file name" or "yaml".
    optimizer_size: bytes of optimizer state, which is never read; 0 without. other_entries: further top-level names.
    size: bytes on disk, all files together. digest: see `digest`.
    """

    path: str
    layout: Layout
    told_by: str | None
    networks: tuple[NetworkReport, ...]
    leftovers: tuple[Leftover, ...]
    optimizer_size: int
    other_entries: tuple[str, ...]
    size: int
    digest: str

    @property
    def sha256_12(self) -> str:
        """First 12 digits of the digest: what views carry."""
        return self.digest[:12]

    @property
    def parameters(self) -> int:
        """All parameters that are used."""
        return sum(network.parameters for network in self.networks)
