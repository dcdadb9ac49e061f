"""Weights by path: loaded, inspected, converted.

Layouts are told by content: GCD's Lightning `.ckpt`, `svd.safetensors`, a diffusers folder, and our own
`.safetensors` with the config in its metadata. Everything is memory-mapped: what is not used is never read.
"""

import hashlib
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import BinaryIO, Literal, TypedDict, Unpack

import msgspec
import torch
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.live.config import LiveConfig
from gcd_model.networks import LiveNetworks, LoadedWeights, Networks, empty_networks, weights_digest
from gcd_model.weights.adapter import Adapter, adapted
from gcd_model.weights.card import (
    CONFIG_KEY,
    FULL_PRECISION,
    Card,
    Hints,
    Layout,
    family_named,
    precision,
    require_family,
)
from gcd_model.weights.infer import infer_config, match_weights, shapes_of
from gcd_model.weights.names import Levels, Naming, assembled, published_names
from gcd_model.weights.read import WeightsFile, read_file, read_weights
from gcd_model.weights.save import CARRIED, write_published, write_safetensors

PACKAGED = Path(__file__).parent
"""Where the weights that ship with the package lie."""
_SAMPLED_ABOVE = 512 << 20  # bytes; larger files are digested by samples
_SAMPLE, _SAMPLES, _END = 64 << 10, 64, 1 << 20
_USABLE = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
_NAMINGS: dict[Layout, Naming] = {"diffusers": "diffusers", "gcd-node": "own"}  # others have Stability's names


class Told(TypedDict, total=False):
    """What a caller says of a checkpoint; None leaves it to the file.

    family: its name, instead of what metadata, file name or a yaml beside the file tell. head_width, image_heads: what
    weights of other than the published widths do not tell. frames: instead of the published number.
    """

    family: str | None
    head_width: int | None
    image_heads: int | None
    frames: int | None


def weights_path(source: str | Path) -> Path:
    """File of weights; `package:NAME` ships with the package. Raises CheckpointError, listing what there is."""
    kind, _, name = str(source).partition(":")
    if not isinstance(source, str) or kind != "package":
        return Path(source)
    path = PACKAGED / f"{name}.safetensors"
    if Path(name).name == name and path.is_file():
        return path
    there = ", ".join(sorted(file.stem for file in PACKAGED.glob("*.safetensors")))
    raise CheckpointError(
        f"no weights called {name!r} ship with the package; there are: {there or 'none'}. "
        "Give a path, or random:kubric90 to try things out with random weights"
    )


def load_weights(path: str | Path, **told: Unpack[Told]) -> LoadedWeights:
    """Load a checkpoint of any layout. told: see `Told`.

    Raises:
        CheckpointError: the file is missing, damaged, hostile, of another architecture, or its heads are not known.
        OptionError: an option is unknown or contradicts the file.
    """
    with _about(path):
        examined = _examined(Path(path), told)
        examined.networks.load_state_dict(examined.state(), assign=True, strict=True)
        return LoadedWeights(
            card=replace(examined.card, origin=digest(examined.file.files)[:12]),
            networks=examined.networks,
            layout=examined.file.layout,
            carried=examined.carried,
        )


def load_adapted(base: LoadedWeights, adapter: Adapter) -> LoadedWeights:
    """A base and what was trained on it, as one. Raises CheckpointError as `adapted`;"""
    weights = {f"{base.card.origin}.{name}": tensor for name, tensor in adapter.tensors.items()}
    return replace(
        base,
        card=replace(
            adapter.card,
            trained=base.card.trained and adapter.card.trained,
            uncertainty_scale=None,
            origin=weights_digest(weights),
        ),
        networks=adapted(base.diffusion, adapter),
    )


def read_adapter(path: str | Path) -> Adapter:
    """Map an adapter's file. Raises CheckpointError if it is missing, damaged or no adapter."""
    with _about(path):
        file = read_file(Path(path))
        return Adapter.of_file({} if file.is_pickle else file.metadata, file.tensors)


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

    optimizer_size: bytes of optimizer state, which is never read; 0 without. other_entries: further top-level names.
    size: bytes on disk, all files together. digest: see `digest`.
    """

    path: str
    layout: Layout
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


def inspect_weights(path: str | Path, *, full_digest: bool = False, **told: Unpack[Told]) -> WeightsReport:
    """Say what a checkpoint holds; checks names and shapes as `load_weights` does, reads no weights.

    Args:
        full_digest: read the whole file for the digest, whatever its size.
    Raises: as `load_weights`.
    """
    with _about(path):
        examined = _examined(Path(path), told)
        file, used = examined.file, dict[str, list[tuple[Tensor, torch.dtype]]]()
        for name, tensor in examined.networks.state_dict().items():
            used.setdefault(name.partition(".")[0], []).append((tensor, file.tensors[examined.sources[name][0]].dtype))
        return WeightsReport(
            **{each.name: getattr(examined.card, each.name) for each in fields(examined.card)},
            path=str(path),
            layout=file.layout,
            networks=tuple(
                NetworkReport(
                    name=network,
                    parameters=sum(tensor.numel() for tensor, _ in tensors),
                    tensors=len(tensors),
                    dtypes=tuple(sorted({str(dtype).removeprefix("torch.") for _, dtype in tensors})),
                    size=sum(tensor.numel() * dtype.itemsize for tensor, dtype in tensors),
                )
                for network, tensors in used.items()
            ),
            leftovers=tuple(
                Leftover(kind=kind, tensors=len(names), size=sum(file.tensors[name].nbytes for name in names))
                for kind, names in examined.leftovers.items()
            ),
            optimizer_size=file.optimizer_size,
            other_entries=file.other_entries,
            size=sum(part.stat().st_size for part in file.files),
            digest=digest(file.files, full=full_digest),
        )


def convert_weights(
    path: str | Path,
    out: str | Path,
    *,
    layout: Literal["gcd-node", "gcd-ckpt"] = "gcd-node",
    dtype: str | None = None,
    uncertainty_scale: float | None = None,
    overwrite: bool = False,
    **told: Unpack[Told],
) -> WeightsReport:
    """Write a checkpoint of any layout as our own `.safetensors`, or as GCD's `.ckpt`.

    Args:
        layout: "gcd-node" leaves behind what inference does not use; "gcd-ckpt" is for the released code, see
            `gcd_state`.
        dtype: store in this precision, which holds all weights that change in memory; else as it is. What computes in
            float32 (the decoder) is never narrowed.
        uncertainty_scale: what was measured, instead of what the file says; see `Traits`.
    Returns:
        The report of the new file.
    Raises: as `load_weights`; OptionError if `out` exists and `overwrite` is not set, or the layout cannot hold it.
    """
    wanted = None if dtype is None else precision(dtype)
    with _about(path):
        examined = _examined(Path(path), told)
        card = replace(examined.card, origin=digest(examined.file.files)[:12])
        state = {name: _stored_as(name, tensor, wanted) for name, tensor in examined.state().items()}
    if uncertainty_scale is not None:
        card = replace(card, uncertainty_scale=uncertainty_scale)
    if layout == "gcd-ckpt":
        write_published(Path(out), state, card, carried=examined.carried, overwrite=overwrite)
    else:
        write_safetensors(Path(out), state, card.to_metadata(), overwrite=overwrite)
    return inspect_weights(out)


def _stored_as(name: str, tensor: Tensor, wanted: torch.dtype | None) -> Tensor:
    """In the precision asked for; what computes in float32 is only ever widened."""
    narrows = wanted is not None and name.partition(".")[0] in FULL_PRECISION and wanted.itemsize < tensor.itemsize
    return tensor if wanted is None or narrows else tensor.to(wanted)


def save_weights(networks: Networks | LiveNetworks, out: str | Path, card: Card, *, overwrite: bool = False) -> None:
    """Write networks as they are, for example after training. Raises: as `write_safetensors`."""
    write_safetensors(Path(out), networks.state_dict(), card.to_metadata(), overwrite=overwrite)


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


@contextmanager
def _about(path: str | Path) -> Generator[None]:
    """Every error about a file begins with its name."""
    try:
        yield
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}; check the path") from error


# --- a file worked out: architecture, family, and where each parameter stands -----------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class _Examined:
    """A checkpoint whose every weight has its place; `networks` is still empty.

    card: what it says of itself, or what was worked out. sources: for each of our names, the file's. leftovers: names,
    by kind.
    """

    file: WeightsFile
    card: Card
    networks: Networks | LiveNetworks
    sources: dict[str, tuple[str, ...]]
    leftovers: dict[str, list[str]]

    def state(self) -> dict[str, Tensor]:
        """Our parameters, made of mapped tensors."""
        held, axes = self.file.tensors, {n: each.ndim for n, each in self.networks.state_dict().items()}
        return {name: assembled(names, [held[n] for n in names], axes[name]) for name, names in self.sources.items()}

    @property
    def carried(self) -> dict[str, Tensor]:
        """Leftovers that its next owner may want."""
        return {name: self.file.tensors[name] for kind in CARRIED for name in self.leftovers.get(kind, ())}


def _examined(path: Path, told: Told) -> _Examined:
    """Raises CheckpointError: the file does not fit, name by name. OptionError: what is told is impossible."""
    named = told.get("family")
    options = Hints(**told | {"family": None if named is None else family_named(named)})  # pyright: ignore
    file = read_weights(path)
    naming, shapes = _NAMINGS.get(file.layout, "gcd"), shapes_of(file.tensors)
    stated = Card.from_metadata(file.metadata) if CONFIG_KEY in file.metadata else None
    if stated is None:
        known = options.over(file.hints)
        config = infer_config(shapes, naming, known)
    else:
        known = options.over(Hints(move_time=stated.move_time, family=stated.family), file.hints)
        config = _with_frames(stated.config, options)
    if known.family is not None:
        require_family(known.family, config)
    try:
        networks = empty_networks(config)
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"describes networks that cannot be built ({error}); it is damaged") from error
    expected = shapes_of(networks.state_dict())
    levels = Levels.of(config) if isinstance(config, ModelConfig) else Levels()
    sources = {name: published_names(name, naming, levels) or (name,) for name in expected}
    leftovers = match_weights(sources, expected, shapes)
    unusable = [name for names in sources.values() for name in names if file.tensors[name].dtype not in _USABLE]
    if unusable:  # quantised weights have the right names and shapes and mean nothing without their scales
        stored = sorted({str(file.tensors[name].dtype).removeprefix("torch.") for name in unusable})
        raise CheckpointError(
            f"{len(unusable)} weights are stored as {', '.join(stored)}, first: {', '.join(unusable[:5])}; wanted are "
            "float32, float16 or bfloat16"
        )
    last = config.frames - 1
    card = Card(
        name=file.name if stated is None or not stated.name else stated.name,
        config=config,
        family=known.family,
        move_time=last if known.move_time is None else min(known.move_time, last),
        trained=stated is None or stated.trained,
        uncertainty_scale=None if stated is None else stated.uncertainty_scale,
    )
    return _Examined(file=file, card=card, networks=networks, sources=sources, leftovers=leftovers)


def _with_frames(config: ModelConfig | LiveConfig, hints: Hints) -> ModelConfig | LiveConfig:
    """Our files state their heads; only the number of frames may be changed."""
    if isinstance(config, ModelConfig):
        tower = config.image_encoder
        stated = {"head_width": config.unet.head_width} | ({} if tower is None else {"image_heads": tower.heads})
        for name, value in stated.items():
            given = getattr(hints, name)
            if given is not None and given != value:
                raise OptionError(f"{name} is {value} in this file, which states it itself, got {given}; leave it out")
    return config if hints.frames is None else msgspec.structs.replace(config, frames=hints.frames)
