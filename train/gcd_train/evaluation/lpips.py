"""Learned perceptual distance: how differently a network trained on photographs sees two pictures.

Source: Zhang et al. 2018, Eq. 1, as version 0.1 of its weights wants it: features of VGG16 or AlexNet (Krizhevsky 2014)
trained on ImageNet, and a learned weight for each channel. The weights are the user's own.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Self, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.errors import ShapeError
from gcd_train.errors import DataError
from gcd_train.evaluation.metrics import require_same_shape

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, RGB in [0, 1]
_LEAST_NORM = 1e-10
_SHOWN = 120  # letters of torch's own words in a message
_WANTED = (
    "wanted torchvision's vgg16-*.pth and the linear weights vgg.pth, or alexnet-*.pth and alex.pth, in one folder"
)


def _vgg16() -> nn.Sequential:
    layers, inputs = list[nn.Module](), 3
    for outputs, convolutions in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers += [nn.MaxPool2d(2)] if layers else []
        for _ in range(convolutions):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
    return nn.Sequential(*layers)


def _alexnet() -> nn.Sequential:
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU()),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Kind:
    """features, linear: files the weights come in. compared: places of the features that are, among torchvision's.

    least_pixels: a side of the smallest picture.
    """

    features: str
    linear: str
    compared: tuple[int, ...]
    channels: tuple[int, ...]
    least_pixels: int


_KINDS = {
    "vgg": _Kind(
        features="vgg16-*.pth",
        linear="vgg.pth",
        compared=(3, 8, 15, 22, 29),
        channels=(64, 128, 256, 512, 512),
        least_pixels=16,
    ),
    "alex": _Kind(
        features="alexnet-*.pth",
        linear="alex.pth",
        compared=(1, 4, 7, 9, 11),
        channels=(64, 192, 384, 256, 256),
        least_pixels=31,
    ),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Lpips:
    """Distances by one network. See `open`.

    network: "vgg" or "alex"; figures of the two cannot be compared. heads: weights of channels, [1, C, 1, 1] by stage.
    identity: digest of the weights in use.
    """

    network: str
    features: nn.Sequential
    heads: tuple[Tensor, ...]
    identity: str

    @classmethod
    def open(cls, folder: Path | str, *, device: str = "cpu") -> Self:
        """Read the weights that lie in a folder.

        The folder holds torchvision's `vgg16-*.pth` and the published linear weights `vgg.pth`, or `alexnet-*.pth` and
        `alex.pth`; of both pairs VGG16 is taken. Nothing but tensors is read from them.

        Raises:
            DataError: a file is missing, damaged or another one than wanted.
        """
        name, path, linear = _files(Path(folder))
        features, body, weights = _vgg16() if name == "vgg" else _alexnet(), _read(path), _read(linear)
        digest = hashlib.sha256()
        state = {
            key: _taken(body, f"features.{key}", tuple(blank.shape), path)
            for key, blank in features.state_dict().items()
        }
        heads = tuple(
            _taken(weights, f"lin{number}.model.1.weight", (1, channels, 1, 1), linear)
            for number, channels in enumerate(_KINDS[name].channels)
        )
        for tensor in (*state.values(), *heads):
            digest.update(tensor.contiguous().numpy().tobytes())
        features.load_state_dict(state)
        return cls(
            network=name,
            features=features.to(device).eval().requires_grad_(False),
            heads=tuple(each.to(device) for each in heads),
            identity=f"{name}-{digest.hexdigest()[:12]}",
        )

    def __call__(self, views: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame, 0 for equal ones: [T, 3, H, W] each -> float32 [T]. Raises ShapeError."""
        return self.of_draws(views[None], targets)[0]

    @torch.no_grad()
    def of_draws(self, draws: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame of several draws to one target, whose features are worked out once.

        Args:
            draws: [S, T, 3, H, W]. targets: [T, 3, H, W].
        Returns:
            float32 [S, T] on the CPU.
        Raises:
            ShapeError: shapes differ, or pictures are too small for the network.
        """
        require_same_shape(draws[0], targets)
        least = _KINDS[self.network].least_pixels
        if min(targets.shape[-2:]) < least:
            raise ShapeError(f"LPIPS wants pictures of at least {least} pixels a side, got {list(targets.shape[-2:])}")
        both = (torch.cat([draws[:, t], targets[t : t + 1]]) for t in range(len(targets)))
        return torch.stack([self._of_frame(pictures.float()).cpu() for pictures in both], dim=1)

    def _of_frame(self, pictures: Tensor) -> Tensor:
        """Distances of all pictures but the last to the last: [S+1, 3, H, W] -> [S]."""
        device = self.heads[0].device
        mean, deviation = (torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (_MEAN, _DEVIATION))
        x, apart = (pictures.to(device) - mean) / deviation, list[Tensor]()
        for place, layer in enumerate(self.features):
            x = layer(x)
            if place in _KINDS[self.network].compared:
                unit = x / (x.square().sum(dim=1, keepdim=True).sqrt() + _LEAST_NORM)
                squared = (unit[:-1] - unit[-1:]).square()
                apart.append(F.conv2d(squared, self.heads[len(apart)]).mean(dim=(1, 2, 3)))
        return torch.stack(apart).sum(dim=0)


def _files(folder: Path) -> tuple[str, Path, Path]:
    """The network to use and its two files: the first of which both are there."""
    if not folder.is_dir():
        raise DataError(f"no LPIPS weights in {folder}: it is no folder; {_WANTED}")
    for name, kind in _KINDS.items():
        features, linear = sorted(folder.glob(kind.features)), folder / kind.linear
        if features and linear.is_file():
            if len(features) > 1:
                raise DataError(f"{folder} holds {len(features)} files {kind.features}; leave one of them")
            return name, features[0], linear
    held = ", ".join(sorted(path.name for path in folder.glob("*.pth"))) or "no .pth file"
    raise DataError(f"no LPIPS weights in {folder}: {_WANTED}, got {held}")


def _read(path: Path) -> Mapping[str, object]:
    """What a file of named tensors holds; code in it is never run."""
    try:
        if not path.is_file():
            raise ValueError("it is no regular file")
        held: object = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged pickle raises depends on which byte is wrong
        cause = shorten(str(error).strip().split("\n")[0].split(". ")[0], _SHOWN, placeholder=" ...")
        raise DataError(f"cannot read the LPIPS weights {path}: {cause}; fetch the file again") from error
    if not isinstance(held, Mapping):
        raise DataError(f"the LPIPS weights {path} must be named tensors, got {type(held).__name__}; {_WANTED}")
    return cast("Mapping[str, object]", held)


def _taken(held: Mapping[str, object], name: str, shape: tuple[int, ...], path: Path) -> Tensor:
    """One tensor of a file. Raises DataError if it lacks it, or has it in another shape or with a value not finite."""
    tensor = held.get(name)
    if not isinstance(tensor, Tensor) or tuple(tensor.shape) != shape:
        got = list(tensor.shape) if isinstance(tensor, Tensor) else "none"
        raise DataError(f"{path} must hold {name} of {list(shape)}, got {got}; {_WANTED}")
    if not tensor.isfinite().all():
        raise DataError(f"{name} in {path} holds values that are not finite; fetch the file again")
    return tensor.detach().float()
