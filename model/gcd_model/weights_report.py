"""What can be said about a checkpoint without loading it."""

from dataclasses import dataclass
from typing import Literal

from gcd_model.config import ModelConfig
from gcd_model.live.config import LiveConfig

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
    size: bytes on disk, all files together. digest: see `checkpoints.digest`.
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
