"""Learned perceptual distance: how differently a network trained on photographs sees two pictures.

Source: Zhang et al. 2018, Eq. 1, as version 0.1 of its weights wants it: features of VGG16 or AlexNet (Krizhevsky 2014)
trained on ImageNet, and a learned weight for each channel. The weights are the user's own.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Self, cast

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.errors import ShapeError
from gcd_train.errors import DataError
from gcd_train.evaluation.metrics import require_same_shape

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


_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, RGB in [0, 1]
_LEAST_NORM = 1e-10


@dataclass(frozen=True, kw_only=True, slots=True)
class Lpips:
    """Distances by one network. See `open`.

    network: "vgg" or "alex"; figures of the two cannot be compared. identity: digest of the weights in use.
    """

    weights: LpipsWeights
    identity: str

    @classmethod
    def open(cls, folder: Path | str, *, device: str = "cpu") -> Self:
        """Read the weights that lie in a folder.

        The folder holds torchvision's `vgg16-*.pth` and the published linear weights `vgg.pth`, or `alexnet-*.pth` and
        `alex.pth`; of both pairs VGG16 is taken. Nothing but tensors is read from them.

        Raises:
            DataError: a file is missing, damaged or another one than wanted.
        """
        weights = read_weights(Path(folder), device)
        digest = hashlib.sha256()
        for tensor in weights.tensors:
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
        return cls(weights=weights, identity=f"{weights.network.name}-{digest.hexdigest()[:12]}")

    @property
    def network(self) -> str:
        return self.weights.network.name

    def __call__(self, views: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame, 0 for equal ones: [T, 3, H, W] each -> float32 [T].

        Raises:
            ShapeError: shapes differ, or pictures are too small for the network.
        """
        return self.of_draws(views[None], targets)[0]

    @torch.no_grad()
    def of_draws(self, draws: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame of several draws to one target, whose features are worked out once.

        Args:
            draws: [S, T, 3, H, W]. targets: [T, 3, H, W].
        Returns:
            float32 [S, T] on the CPU.
        """
        require_same_shape(draws[0], targets)
        least = self.weights.network.least_pixels
        if min(targets.shape[-2:]) < least:
            raise ShapeError(f"LPIPS wants pictures of at least {least} pixels a side, got {list(targets.shape[-2:])}")
        both = (torch.cat([draws[:, t], targets[t : t + 1]]) for t in range(len(targets)))
        return torch.stack([self._of_frame(pictures.float()).cpu() for pictures in both], dim=1)

    def _of_frame(self, pictures: Tensor) -> Tensor:
        """Distances of all pictures but the last to the last: [S+1, 3, H, W] -> [S]."""
        stages = zip(self._features(pictures), self.weights.heads, strict=True)
        return torch.stack([_apart(features, head) for features, head in stages]).sum(dim=0)

    def _features(self, pictures: Tensor) -> Iterator[Tensor]:
        """What the network makes of pictures [N, 3, H, W] at the end of each stage: [N, C, h, w]."""
        device = self.weights.heads[0].device
        x = (pictures.to(device) - _colour(_MEAN, device)) / _colour(_DEVIATION, device)
        for stage, filters in zip(self.weights.network.stages, self.weights.filters, strict=True):
            if stage.pool:
                x = F.max_pool2d(x, stage.pool, stride=2)
            for convolution, (weight, bias) in zip(stage.convolutions, filters, strict=True):
                x = F.conv2d(x, weight, bias, stride=convolution.stride, padding=convolution.padding).relu()
            yield x


def _apart(features: Tensor, head: Tensor) -> Tensor:
    """Weighted squared distance of unit vectors, mean over places, of all features but the last to the last."""
    unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + _LEAST_NORM)
    return F.conv2d((unit[:-1] - unit[-1:]).square(), head).mean(dim=(1, 2, 3))


def _colour(values: tuple[float, float, float], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device).view(1, 3, 1, 1)
