"""The two networks that LPIPS is measured with, and their weights in the files that others publish."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import cast

import torch
from torch import Tensor

from gcd_train.errors import DataError

_TOLD = 120
"""Letters of torch's own words in a message."""
_WANTED = (
    "wanted torchvision's vgg16-*.pth and the linear weights vgg.pth, or alexnet-*.pth and alex.pth, in one folder"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Convolution:
    """A convolution and the rectifier after it. place: its number among torchvision's `features`. size: of a side."""

    place: int
    inputs: int
    outputs: int
    size: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True, kw_only=True, slots=True)
class Stage:
    """What lies between two compared features. pool: side of the maximum, by steps of 2, before it; 0 for none."""

    convolutions: tuple[Convolution, ...]
    pool: int = 0

    @property
    def channels(self) -> int:
        """Of the features that are compared."""
        return self.convolutions[-1].outputs


@dataclass(frozen=True, kw_only=True, slots=True)
class LpipsNetwork:
    """A feature stack. features, linear: files its weights come in. least_pixels: a side of the smallest picture."""

    name: str
    features: str
    linear: str
    least_pixels: int
    stages: tuple[Stage, ...]


def _vgg_stage(first: int, inputs: int, outputs: int, *, convolutions: int, pool: int = 2) -> Stage:
    """Convolutions of 3 x 3 at every second place from the first."""
    places = range(first, first + 2 * convolutions, 2)
    channels = (inputs, *[outputs] * (convolutions - 1))
    made = [Convolution(place=p, inputs=c, outputs=outputs) for p, c in zip(places, channels, strict=True)]
    return Stage(convolutions=tuple(made), pool=pool)


VGG16 = LpipsNetwork(
    name="vgg",
    features="vgg16-*.pth",
    linear="vgg.pth",
    least_pixels=16,
    stages=(
        _vgg_stage(0, 3, 64, convolutions=2, pool=0),
        _vgg_stage(5, 64, 128, convolutions=2),
        _vgg_stage(10, 128, 256, convolutions=3),
        _vgg_stage(17, 256, 512, convolutions=3),
        _vgg_stage(24, 512, 512, convolutions=3),
    ),
)

ALEXNET = LpipsNetwork(
    name="alex",
    features="alexnet-*.pth",
    linear="alex.pth",
    least_pixels=31,
    stages=(
        Stage(convolutions=(Convolution(place=0, inputs=3, outputs=64, size=11, stride=4, padding=2),)),
        Stage(convolutions=(Convolution(place=3, inputs=64, outputs=192, size=5, padding=2),), pool=3),
        Stage(convolutions=(Convolution(place=6, inputs=192, outputs=384),), pool=3),
        Stage(convolutions=(Convolution(place=8, inputs=384, outputs=256),)),
        Stage(convolutions=(Convolution(place=10, inputs=256, outputs=256),)),
    ),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class LpipsWeights:
    """filters: weight and bias of each convolution, by stage. heads: [1, C, 1, 1] of each stage; float32."""

    network: LpipsNetwork
    filters: tuple[tuple[tuple[Tensor, Tensor], ...], ...]
    heads: tuple[Tensor, ...]

    @property
    def tensors(self) -> Iterator[Tensor]:
        """All of them, in a fixed order."""
        for stage in self.filters:
            for pair in stage:
                yield from pair
        yield from self.heads


def read_weights(folder: Path, device: str) -> LpipsWeights:
    """The weights of a folder, see `Lpips.open`. Raises DataError."""
    network, features, linear = _files(folder)
    body, heads = _read(features), _read(linear)
    return LpipsWeights(
        network=network,
        filters=tuple(
            tuple(_filters(body, each, features, device) for each in stage.convolutions) for stage in network.stages
        ),
        heads=tuple(
            _taken(heads, f"lin{number}.model.1.weight", (1, stage.channels, 1, 1), linear).to(device)
            for number, stage in enumerate(network.stages)
        ),
    )


def _files(folder: Path) -> tuple[LpipsNetwork, Path, Path]:
    """The network to use and its two files: the first of which both are there."""
    if not folder.is_dir():
        raise DataError(f"no LPIPS weights in {folder}: it is no folder; {_WANTED}")
    for network in (VGG16, ALEXNET):
        features, linear = sorted(folder.glob(network.features)), folder / network.linear
        if features and linear.is_file():
            if len(features) > 1:
                raise DataError(f"{folder} holds {len(features)} files {network.features}; leave one of them")
            return network, features[0], linear
    held = ", ".join(sorted(path.name for path in folder.glob("*.pth"))) or "no .pth file"
    raise DataError(f"no LPIPS weights in {folder}: {_WANTED}, got {held}")


def _read(path: Path) -> Mapping[str, object]:
    """What a file of named tensors holds; code in it is never run."""
    try:
        if not path.is_file():
            raise ValueError("it is no regular file")
        held: object = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged pickle raises depends on which byte is wrong
        cause = str(error).strip().split("\n")[0].split(". ")[0]
        told = shorten(cause, _TOLD, placeholder=" ...")
        raise DataError(f"cannot read the LPIPS weights {path}: {told}; fetch the file again") from error
    if not isinstance(held, Mapping):
        raise DataError(f"the LPIPS weights {path} must be named tensors, got {type(held).__name__}; {_WANTED}")
    return cast("Mapping[str, object]", held)


def _filters(body: Mapping[str, object], each: Convolution, path: Path, device: str) -> tuple[Tensor, Tensor]:
    shape = (each.outputs, each.inputs, each.size, each.size)
    weight = _taken(body, f"features.{each.place}.weight", shape, path)
    return weight.to(device), _taken(body, f"features.{each.place}.bias", (each.outputs,), path).to(device)


def _taken(held: Mapping[str, object], name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """One tensor of a file. Raises DataError if it lacks it, or has it in another shape or with a value not finite."""
    tensor = held.get(name)
    if not isinstance(tensor, Tensor):
        raise DataError(f"the LPIPS weights {path} lack {name}; {_WANTED}")
    if tuple(tensor.shape) != shape:
        raise DataError(f"{name} in {path} must be {list(shape)}, got {list(tensor.shape)}; {_WANTED}")
    if not tensor.isfinite().all():
        raise DataError(f"{name} in {path} holds values that are not finite; fetch the file again")
    return tensor.detach().float()
