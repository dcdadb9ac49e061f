"""A file's weights are worked out: architecture, family, and where each parameter stands. Opens nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict

import msgspec
import torch
from torch import Tensor

from gcd_model.config import ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.live.config import LiveConfig
from gcd_model.networks import LiveNetworks, Networks, empty_networks
from gcd_model.weights.adapter import ADAPTER_KEY
from gcd_model.weights.card import CONFIG_KEY, Card, Layout, Leftover, NetworkReport
from gcd_model.weights.families import (
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
    Hints,
    Match,
    Naming,
    Shapes,
    diffusers_levels,
    gcd_levels,
    infer_config,
    match_weights,
)
from gcd_model.weights.names import GCD_UNET, Levels, assembled, diffusers_source, gcd_source, own_source

_NO_LEVELS = Levels(attention=(), unet_blocks=0, vae_levels=0, vae_blocks=0, image_layers=0)
_USABLE = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
_NAMINGS: dict[Layout, Naming] = {
    "gcd-ckpt": gcd_source,
    "sgm-safetensors": gcd_source,
    "diffusers": diffusers_source,
    "gcd-node": own_source,
}


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

    @property
    def shapes(self) -> Shapes:
        """Published names and shapes."""
        return {name: tuple(tensor.shape) for name, tensor in self.tensors.items()}


def layout_of(tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None) -> Layout:
    """Layout of a single file; metadata: of safetensors, None for a pickle.

    Raises: CheckpointError for names of no layout known here.
    """
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


class Told(TypedDict, total=False):
    """What a caller may say of a checkpoint, see `Options`."""

    family: str | None
    head_width: int | None
    image_heads: int | None
    frames: int | None


@dataclass(frozen=True, kw_only=True, slots=True)
class Options:
    """What the user says about a checkpoint; None leaves it to the file.

    family: its name, instead of what metadata, file name or a yaml beside the file tell. head_width, image_heads,
    frames: what published weights do not tell, instead of the published values.
    """

    family: str | None = None
    head_width: int | None = None
    image_heads: int | None = None
    frames: int | None = None

    def __post_init__(self) -> None:
        if self.family is not None:
            family_named(self.family)
        self.over(Hints())

    def over(self, hints: Hints) -> Hints:
        """The hints with what the user says put over them. Raises OptionError for impossible values."""
        given = {"head_width": self.head_width, "image_heads": self.image_heads, "frames": self.frames}
        return replace(hints, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True, kw_only=True, slots=True)
class Examined:
    """A checkpoint whose every weight has its place; `networks` is still empty."""

    name: str
    file: WeightsFile
    networks: Networks | LiveNetworks
    match: Match
    family: Family | None
    told_by: str | None
    move_time: int
    trained: bool
    uncertainty_scale: float | None

    def tensor(self, name: str) -> Tensor:
        """Our parameter of that name, made of mapped tensors."""
        source = self.match.sources[name]
        return assembled([self.file.tensors[published] for published in source.names], source.form)

    def stored_dtype(self, name: str) -> torch.dtype:
        """Precision our parameter of that name is stored in."""
        return self.file.tensors[self.match.sources[name].names[0]].dtype


def examine(file: WeightsFile, options: Options) -> Examined:
    """Work a file out.

    Raises:
        CheckpointError: it does not fit, name by name. OptionError: an option contradicts it.
    """
    card = Card.from_metadata(file.metadata) if CONFIG_KEY in file.metadata else None
    told = combined(
        Provenance(family=None if options.family is None else family_named(options.family).name, told_by="option"),
        _told_by_card(card),
        told_by_name(file.name),
        told_by_yaml(file.yaml),
    )
    config = _inferred(file, told, options) if card is None else _with_options(card.config, options)
    family = checked_family(told, config)
    if isinstance(config, ModelConfig) and card is None:
        config = at_trained_size(config, family)
    networks = _empty(config)
    expected = {name: tuple(tensor.shape) for name, tensor in networks.state_dict().items()}
    levels = Levels.of(config) if isinstance(config, ModelConfig) else _NO_LEVELS
    match = match_weights(expected, file.shapes, _NAMINGS[file.layout], levels)
    _require_usable(file, match)
    last = config.frames - 1
    return Examined(
        name=file.name if card is None or not card.name else card.name,
        file=file,
        networks=networks,
        match=match,
        family=family,
        told_by=told.told_by,
        move_time=last if told.move_time is None else min(told.move_time, last),
        trained=card is None or card.trained,
        uncertainty_scale=None if card is None else card.uncertainty_scale,
    )


def _told_by_card(card: Card | None) -> Provenance:
    if card is None:
        return Provenance()
    family = None if card.family is None else family_named(card.family).name
    return Provenance(family=family, move_time=card.move_time, told_by="metadata")


def _inferred(file: WeightsFile, told: Provenance, options: Options) -> ModelConfig:
    hints = file.hints if file.hints.frames is not None else replace(file.hints, frames=told.frames)
    levels = diffusers_levels(file.tensors) if file.layout == "diffusers" else gcd_levels(file.tensors)
    return infer_config(file.shapes, _NAMINGS[file.layout], levels, options.over(hints))


def _with_options(config: ModelConfig | LiveConfig, options: Options) -> ModelConfig | LiveConfig:
    """Our files state their heads; only the number of frames may be changed."""
    stated: dict[str, int] = {}
    if isinstance(config, ModelConfig):
        stated["head_width"] = config.unet.head_width
        if config.image_encoder is not None:
            stated["image_heads"] = config.image_encoder.heads
    for name, value in stated.items():
        given = getattr(options, name)
        if given is not None and given != value:
            raise OptionError(f"{name} is {value} in this file, which states it itself, got {given}; leave it out")
    return config if options.frames is None else msgspec.structs.replace(config, frames=options.frames)


def _empty(config: ModelConfig | LiveConfig) -> Networks | LiveNetworks:
    """Networks without storage."""
    try:
        return empty_networks(config)
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"describes networks that cannot be built ({error}); it is damaged") from error


def _require_usable(file: WeightsFile, match: Match) -> None:
    """Quantised weights have the right names and shapes and mean nothing without their scales."""
    names = [name for source in match.sources.values() for name in source.names]
    bad = [name for name in names if file.tensors[name].dtype not in _USABLE]
    if bad:
        kinds = sorted({str(file.tensors[name].dtype).removeprefix("torch.") for name in bad})
        raise CheckpointError(
            f"{len(bad)} weights are stored as {', '.join(kinds)}, first: {', '.join(bad[:5])}; wanted are float32, "
            "float16 or bfloat16"
        )


def network_reports(examined: Examined) -> tuple[NetworkReport, ...]:
    """Counts, precisions and stored bytes of every network."""
    by_network: dict[str, list[str]] = {}
    for name in examined.match.sources:
        by_network.setdefault(name.partition(".")[0], []).append(name)
    shapes = examined.networks.state_dict()
    reports: list[NetworkReport] = []
    for network, names in by_network.items():
        dtypes = {name: examined.stored_dtype(name) for name in names}
        counts = {name: shapes[name].numel() for name in names}
        reports.append(
            NetworkReport(
                name=network,
                parameters=sum(counts.values()),
                tensors=len(names),
                dtypes=tuple(sorted({str(dtype).removeprefix("torch.") for dtype in dtypes.values()})),
                size=sum(counts[name] * dtypes[name].itemsize for name in names),
            )
        )
    return tuple(reports)


def leftover_reports(examined: Examined) -> tuple[Leftover, ...]:
    """Recognised weights that stay behind, by kind."""
    tensors = examined.file.tensors
    return tuple(
        Leftover(kind=kind, tensors=len(names), size=sum(tensors[name].nbytes for name in names))
        for kind, names in examined.match.leftovers.items()
    )
