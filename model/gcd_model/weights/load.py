"""Weights by path: loaded, inspected, converted.

Layouts are told by content: GCD's Lightning `.ckpt`, `svd.safetensors`, a diffusers folder, and our own
`.safetensors` with the config in its metadata. Everything is memory-mapped: what is not used is never read.
"""

import hashlib
import logging
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
    Layout,
    Leftover,
    NetworkReport,
    WeightsReport,
    precision,
)
from gcd_model.weights.families import (
    FAMILIES,
    Family,
    Provenance,
    at_trained_size,
    checked_family,
    combined,
    family_named,
    told_by_name,
    told_by_yaml,
)
from gcd_model.weights.infer import (
    NO_LEVELS,
    Hints,
    Match,
    Naming,
    diffusers_levels,
    gcd_levels,
    infer_config,
    match_weights,
    shapes_of,
)
from gcd_model.weights.names import Levels, assembled, diffusers_source, gcd_source, own_source
from gcd_model.weights.read import WeightsFile, read_file, read_weights
from gcd_model.weights.save import CARRIED, Report, write_published, write_safetensors

_log = logging.getLogger(__name__)

_SAMPLED_ABOVE = 512 << 20  # bytes; larger files are digested by samples
_SAMPLE, _SAMPLES, _END = 64 << 10, 64, 1 << 20
_USABLE = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
_NAMINGS: dict[Layout, Naming] = {
    "gcd-ckpt": gcd_source,
    "sgm-safetensors": gcd_source,
    "diffusers": diffusers_source,
    "gcd-node": own_source,
}


class Told(TypedDict, total=False):
    """What a caller says of a checkpoint; None leaves it to the file.

    family: its name, instead of what metadata, file name or a yaml beside the file tell. head_width, image_heads,
    frames: what published weights do not tell, instead of the published values.
    """

    family: str | None
    head_width: int | None
    image_heads: int | None
    frames: int | None


def load_weights(path: str | Path, *, ask_family: bool = True, **told: Unpack[Told]) -> LoadedWeights:
    """Load a checkpoint of any layout.

    Args:
        ask_family: warn where the family is not known; False for those who only want the weights. told: see `Told`.
    Raises:
        CheckpointError: the file is missing, damaged, hostile or of another architecture.
        OptionError: an option is unknown or contradicts the file.
    """
    with _about(path):
        examined = _examined(Path(path), told)
        state = {name: examined.tensor(name) for name in examined.match.sources}
        examined.networks.load_state_dict(state, assign=True, strict=True)
        if ask_family and examined.family is None:
            _log.warning(
                "the family of %s is not known: no limits are checked and --motion-bucket must be given; "
                "name it with --family %s",
                path,
                "|".join(FAMILIES),
            )
        card = examined.card
        return LoadedWeights(
            name=card.name,
            networks=examined.networks,
            family=examined.family,
            move_time=card.move_time,
            trained=card.trained,
            sha256_12=digest(examined.file.files)[:12],
            uncertainty_scale=card.uncertainty_scale,
            layout=examined.file.layout,
            carried=examined.carried,
        )


def load_adapted(base: LoadedWeights, adapter: Adapter) -> LoadedWeights:
    """A base and what was trained on it, as one. Raises CheckpointError as `adapted`; OptionError for its family."""
    card = adapter.card
    return replace(
        base,
        name=card.name,
        networks=adapted(base.diffusion, adapter),
        family=None if card.family is None else family_named(card.family),
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


def inspect_weights(path: str | Path, *, full_digest: bool = False, **told: Unpack[Told]) -> WeightsReport:
    """Say what a checkpoint holds; checks names and shapes as `load_weights` does, reads no weights.

    Args:
        full_digest: read the whole file for the digest, whatever its size.
    Raises: as `load_weights`.
    """
    with _about(path):
        examined = _examined(Path(path), told)
        file, card = examined.file, examined.card
        return WeightsReport(
            **{each.name: getattr(card, each.name) for each in fields(card)},
            path=str(path),
            layout=file.layout,
            told_by=examined.told_by,
            networks=_network_reports(examined),
            leftovers=tuple(
                Leftover(kind=kind, tensors=len(names), size=sum(file.tensors[name].nbytes for name in names))
                for kind, names in examined.match.leftovers.items()
            ),
            optimizer_size=file.optimizer_size,
            other_entries=file.other_entries,
            size=sum(part.stat().st_size for part in file.files),
            digest=digest(file.files, full=full_digest),
        )


def _network_reports(examined: "_Examined") -> tuple[NetworkReport, ...]:
    """Counts, precisions and stored bytes of every network."""
    shapes, reports = examined.networks.state_dict(), list[NetworkReport]()
    for network in dict.fromkeys(name.partition(".")[0] for name in examined.match.sources):
        dtypes = {name: examined.dtype(name) for name in examined.match.sources if name.partition(".")[0] == network}
        reports.append(
            NetworkReport(
                name=network,
                parameters=sum(shapes[name].numel() for name in dtypes),
                tensors=len(dtypes),
                dtypes=tuple(sorted({str(dtype).removeprefix("torch.") for dtype in dtypes.values()})),
                size=sum(shapes[name].numel() * dtype.itemsize for name, dtype in dtypes.items()),
            )
        )
    return tuple(reports)


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
    with _about(path):
        examined = _examined(Path(path), told)
        card = replace(examined.card, origin=digest(examined.file.files)[:12])
    if uncertainty_scale is not None:
        card = replace(card, uncertainty_scale=uncertainty_scale)
    state = {name: examined.tensor(name) for name in examined.match.sources}
    dtypes = {name: _written_dtype(name, examined.dtype(name), wanted) for name in state}
    if layout == "gcd-ckpt":
        state = {name: tensor.to(dtypes[name]) for name, tensor in state.items()}
        write_published(Path(out), state, card, carried=examined.carried, overwrite=overwrite)
    else:
        metadata = card.to_metadata()
        write_safetensors(Path(out), state, metadata, dtypes=dtypes, overwrite=overwrite, report=progress)
    return inspect_weights(out)


def _written_dtype(name: str, stored: torch.dtype, wanted: torch.dtype | None) -> torch.dtype:
    """The precision asked for; what computes in float32 is only ever widened."""
    narrows = wanted is not None and name.partition(".")[0] in FULL_PRECISION and wanted.itemsize < stored.itemsize
    return stored if wanted is None or narrows else wanted


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

    card: what it says of itself, or what was worked out. told_by: who named the family.
    """

    file: WeightsFile
    card: Card
    told_by: str | None
    family: Family | None
    networks: Networks | LiveNetworks
    match: Match

    def tensor(self, name: str) -> Tensor:
        """Our parameter of that name, made of mapped tensors."""
        source = self.match.sources[name]
        return assembled([self.file.tensors[published] for published in source.names], source.form)

    def dtype(self, name: str) -> torch.dtype:
        """Precision our parameter of that name is stored in."""
        return self.file.tensors[self.match.sources[name].names[0]].dtype

    @property
    def carried(self) -> dict[str, Tensor]:
        """Leftovers that its next owner may want."""
        leftovers = self.match.leftovers
        return {name: self.file.tensors[name] for kind in CARRIED for name in leftovers.get(kind, ())}


def _examined(path: Path, told: Told) -> _Examined:
    """Raises CheckpointError: the file does not fit, name by name. OptionError: what is told is impossible."""
    hints = Hints(**{key: told.get(key) for key in ("head_width", "image_heads", "frames")})
    named = told.get("family")
    option = Provenance(family=None if named is None else family_named(named).name, told_by="option")
    file = read_weights(path)
    stated = Card.from_metadata(file.metadata) if CONFIG_KEY in file.metadata else None
    known = combined(option, _told_by_card(stated), told_by_name(file.name), told_by_yaml(file.yaml))
    config = _inferred(file, known, hints) if stated is None else _with_frames(stated.config, hints)
    family = checked_family(known, config)
    if stated is None and isinstance(config, ModelConfig):
        config = at_trained_size(config, family)
    networks = _empty(config)
    levels = Levels.of(config) if isinstance(config, ModelConfig) else NO_LEVELS
    match = match_weights(shapes_of(networks.state_dict()), shapes_of(file.tensors), _NAMINGS[file.layout], levels)
    _require_usable(file, match)
    last = config.frames - 1
    card = Card(
        name=file.name if stated is None or not stated.name else stated.name,
        config=config,
        family=known.family,
        move_time=last if known.move_time is None else min(known.move_time, last),
        trained=stated is None or stated.trained,
        uncertainty_scale=None if stated is None else stated.uncertainty_scale,
    )
    return _Examined(file=file, card=card, told_by=known.told_by, family=family, networks=networks, match=match)


def _told_by_card(card: Card | None) -> Provenance:
    if card is None:
        return Provenance()
    family = None if card.family is None else family_named(card.family).name
    return Provenance(family=family, move_time=card.move_time, told_by="metadata")


def _inferred(file: WeightsFile, known: Provenance, hints: Hints) -> ModelConfig:
    """What is told counts, then what stands beside the weights, then what the name says."""
    names = ("head_width", "heads", "image_heads", "frames", "latent_scale")
    every = {name: getattr(hints, name) or getattr(file.hints, name) for name in names}
    hints = Hints(**every | {"frames": every["frames"] or known.frames})
    levels = diffusers_levels(file.tensors) if file.layout == "diffusers" else gcd_levels(file.tensors)
    return infer_config(shapes_of(file.tensors), _NAMINGS[file.layout], levels, hints)


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


def _empty(config: ModelConfig | LiveConfig) -> Networks | LiveNetworks:
    """Networks without storage."""
    try:
        return empty_networks(config)
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"describes networks that cannot be built ({error}); it is damaged") from error


def _require_usable(file: WeightsFile, match: Match) -> None:
    """Quantised weights have the right names and shapes and mean nothing without their scales."""
    used = [(name, file.tensors[name].dtype) for source in match.sources.values() for name in source.names]
    bad = {name: str(dtype).removeprefix("torch.") for name, dtype in used if dtype not in _USABLE}
    if bad:
        raise CheckpointError(
            f"{len(bad)} weights are stored as {', '.join(sorted(set(bad.values())))}, first: "
            f"{', '.join(list(bad)[:5])}; wanted are float32, float16 or bfloat16"
        )
