"""How near views are to what the camera would have seen: PSNR, SSIM, sharpness, flicker, class maps, LPIPS.

Pictures are float [T, 3, H, W] in [0, 1]; masks are bool [T, H, W]; class maps are uint8 [..., H, W] of class ids.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
import torch.nn.functional as F
from kornia.filters import spatial_gradient
from torch import Tensor, nn

from gcd_model.errors import ShapeError
from gcd_train.errors import DataError

NO_CLASS = 255
"""Id of pixels that belong to no class, unless an ontology has 256: not counted in targets, wrong in predictions."""

_VOID_NAMES = frozenset({"void", "unlabelled", "unlabeled"})
EQUAL_DB = 100.0
"""What equal pictures score, so that means stay finite."""
_SMALLEST_ERROR = 10 ** (-EQUAL_DB / 10)
_WINDOW, _BORDER = 7, 3  # pixels
_SAMPLE = _WINDOW**2 / (_WINDOW**2 - 1)
_C1, _C2 = 0.01**2, 0.03**2


def require_same_shape(first: Tensor, second: Tensor) -> None:
    """Raises ShapeError unless a view and its target have one shape."""
    if first.shape != second.shape:
        raise ShapeError(f"view and target must have one shape, got {list(first.shape)} and {list(second.shape)}")


def psnr(views: Tensor, targets: Tensor) -> Tensor:
    """Peak signal-to-noise ratio of each frame over all its pixels and colours, dB: [T]. Equal frames score 100."""
    require_same_shape(views, targets)
    return _to_db(((views - targets) ** 2).mean(dim=(1, 2, 3)))


def masked_psnr(views: Tensor, targets: Tensor, mask: Tensor) -> Tensor:
    """`psnr` with the squared error averaged over the pixels of a mask and all colours: [T]; NaN where it is empty."""
    require_same_shape(views, targets)
    return _to_db(masked_mean(((views - targets) ** 2).mean(dim=1), mask))


def _to_db(error: Tensor) -> Tensor:
    """Mean squared error of pictures in [0, 1] as a signal-to-noise ratio; NaN stays NaN."""
    return -10.0 * torch.log10(error.clamp(min=_SMALLEST_ERROR))


def pixel_deviation(draws: Tensor) -> Tensor:
    """Diversity, as `View.std`: population standard deviation over draws [S, T, 3, H, W], channel mean: [T, H, W]."""
    return draws.std(dim=0, correction=0).mean(dim=1)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean over a mask's pixels of each frame: values and mask [T, H, W] -> [T]; NaN where the mask is empty."""
    if mask.shape != values.shape:
        raise ShapeError(f"a mask must be [T, H, W] = {list(values.shape)}, got {list(mask.shape)}")
    return torch.where(mask, values, 0.0).sum(dim=(1, 2)) / mask.sum(dim=(1, 2))


def gradient_map(pictures: Tensor) -> Tensor:
    """Length of the Sobel gradient at each pixel, mean over colours, in brightness per pixel: [T, H, W].

    A view's mean over its target's is the gradient energy: 1 is as sharp as the target, below blurred, above noisy.
    """
    gradient = spatial_gradient(pictures, mode="sobel", order=1, normalized=True)  # [T, 3, 2, H, W]
    across, down = gradient.unbind(dim=2)
    return torch.hypot(across, down).mean(dim=1)  # a norm over two of five dimensions takes ten times as long


def frame_change(pictures: Tensor) -> Tensor:
    """Mean absolute difference between each frame and the next: [T-1].

    A view's over its target's is the flicker: above 1 the view changes more than the scene does.
    """
    return (pictures[1:] - pictures[:-1]).abs().mean(dim=(1, 2, 3))


def ssim_map(views: Tensor, targets: Tensor) -> Tensor:
    """Structural similarity around each pixel that has a whole window, mean over colours: float64 [T, H-6, W-6].

    As scikit-image defines it by default: windows of 7 x 7 pixels of equal weight, sample covariances (N - 1), K1 =
    0.01, K2 = 0.03 and a data range of 1. Differences of nearly equal squares are taken, so it is done in float64.

    Raises: ShapeError: shapes differ, or a picture is smaller than the window.
    Source: Wang et al. 2004, Eq. 13.
    """
    require_same_shape(views, targets)
    if min(views.shape[-2:]) < _WINDOW:
        raise ShapeError(f"SSIM wants pictures of at least {_WINDOW} pixels a side, got {list(views.shape[-2:])}")
    return torch.stack([_likeness(*both) for both in zip(views.double(), targets.double(), strict=True)])


def _likeness(view: Tensor, target: Tensor) -> Tensor:
    """`ssim_map` of one frame, [3, H, W] each; of a whole clip at once it takes half as long again."""
    mean_a, mean_b = _window_mean(view), _window_mean(target)
    both, squares = mean_a * mean_b, mean_a**2 + mean_b**2
    covariance = _SAMPLE * (_window_mean(view * target) - both)
    variances = _SAMPLE * (_window_mean(view * view + target * target) - squares)
    return ((2 * both + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))).mean(dim=0)


def _window_mean(values: Tensor) -> Tensor:
    """Mean of each whole window: [C, H, W] -> [C, H-6, W-6]; sums of seven as 4 + 2 + 1, along each axis."""
    for axis in (-1, -2):
        long = values.shape[axis]
        pairs = values.narrow(axis, 0, long - 1) + values.narrow(axis, 1, long - 1)
        fours = pairs.narrow(axis, 0, long - 3) + pairs.narrow(axis, 2, long - 3)
        count = long - _WINDOW + 1
        values = fours.narrow(axis, 0, count) + pairs.narrow(axis, 4, count) + values.narrow(axis, 6, count)
    return values / _WINDOW**2


def window_mask(mask: Tensor) -> Tensor:
    """The pixels of `ssim_map` that count for a mask: bool [T, H, W] -> [T, H-6, W-6].

    The mask is eroded three times by a cross, so that windows lie mostly inside it.
    """
    for _ in range(_BORDER):
        middle, beside = mask[..., 1:-1, 1:-1], mask[..., 1:-1, :-2] & mask[..., 1:-1, 2:]
        mask = middle & beside & mask[..., :-2, 1:-1] & mask[..., 2:, 1:-1]
    return mask


def void_ids(names: Sequence[str]) -> tuple[int, ...]:
    """Ids of the entries of an ontology that stand for no class: "Void", "unlabelled", whatever the case.

    None of an ontology with 256 entries, which leaves no id for what has no class.
    """
    if len(names) > NO_CLASS:
        return ()
    return tuple(label for label, name in enumerate(names) if name.strip().lower() in _VOID_NAMES)


def without_classes(labels: Tensor, void: Sequence[int]) -> Tensor:
    """A class map, uint8 of any shape, with `NO_CLASS` where an id of `void` stood."""
    if not void:
        return labels
    return labels.masked_fill(torch.isin(labels, torch.tensor(void, dtype=labels.dtype)), NO_CLASS)


def confusion_matrix(predicted: Tensor, target: Tensor, count: int) -> Tensor:
    """Pixels of each target class (rows) by predicted class (columns): int64 [count, count].

    Matrices of several pictures add up. Raises ShapeError where shapes differ or an id is `count` or more.
    """
    require_same_shape(predicted, target)
    _require_known(predicted, target, count)
    pairs = target.long().flatten() * count + predicted.long().flatten()
    return torch.bincount(pairs, minlength=count * count).view(count, count)


def frame_confusions(predicted: Tensor, target: Tensor, count: int, mask: Tensor | None = None) -> Tensor:
    """`confusion_matrix` of each frame, without pixels whose target has no class: int64 [T, count, count + 1].

    The last column holds pixels whose prediction has no class: they are wrong, and taken for none of the others.

    Args:
        predicted, target: uint8 [T, H, W]. mask: bool [T, H, W], the pixels that count; None for all.
    Raises:
        ShapeError: shapes differ, or an id other than `NO_CLASS` is `count` or more.
    """
    require_same_shape(predicted, target)
    counted = _of_a_class(target, count)
    counted = counted if mask is None else counted & mask
    said, true = predicted[counted], target[counted]
    known = _of_a_class(said, count)
    _require_known(said[known], true, count)
    frames, columns = len(target), count + 1
    frame = torch.arange(frames).view(-1, 1, 1).expand(target.shape)[counted]
    cells = (frame * count + true.long()) * columns + torch.where(known, said.long(), count)
    return torch.bincount(cells, minlength=frames * count * columns).view(frames, count, columns)


def named_confusion(predicted: Tensor, target: Tensor, names: Sequence[str]) -> Tensor:
    """`frame_confusions` of all frames together, int64 [K, K + 1], for the K classes of these names: those that stand
    for no class do not count where they are true."""
    void = void_ids(names)
    said, true = (without_classes(labels.cpu(), void) for labels in (predicted, target))
    return frame_confusions(said, true, len(names)).sum(dim=0)


def class_iou(confusion: Tensor) -> Tensor:
    """Intersection over union of each class, float64 [K]; NaN for one that is neither predicted nor there.

    confusion: [K, K], or [K, K + 1] with a last column for predictions of no class.
    """
    both = confusion.diagonal().double()
    return both / (confusion.sum(dim=0)[: len(confusion)] + confusion.sum(dim=1) - both)


def mean_iou(confusion: Tensor) -> float:
    """Mean over the classes that are predicted or there, of the confusions of a whole set; NaN if none is."""
    return float(class_iou(confusion).nanmean())


def _of_a_class(labels: Tensor, count: int) -> Tensor:
    """Where ids are those of a class, or of none that is known."""
    return labels != NO_CLASS if count <= NO_CLASS else torch.ones_like(labels, dtype=torch.bool)


def _require_known(predicted: Tensor, target: Tensor, count: int) -> None:
    if any(labels.numel() and int(labels.max()) >= count for labels in (predicted, target)):
        raise ShapeError(f"class ids must be below {count}; are the two ontologies the same?")


_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, RGB in [0, 1]
_LEAST_NORM = 1e-10
PUBLISHED = {
    "vgg16-397923af.pth": "397923af",
    "alexnet-owt-7be5be79.pth": "7be5be79",
    "vgg.pth": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    "alex.pth": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
}
"""How the SHA-256 of the published files begins. Source: torchvision, whose files are named after it; the linear
weights of version 0.1 as lpips 0.1.4 on PyPI holds them."""


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


@dataclass(frozen=True, slots=True)
class _Kind:
    """How a network is found and used: files of its features and of its linear weights, places of the features that are
    compared among torchvision's, and a side of the smallest picture."""

    made: Callable[[], nn.Sequential]
    features: str
    linear: str
    compared: tuple[int, ...]
    least_pixels: int


_KINDS = {
    "vgg": _Kind(_vgg16, "vgg16-397923af.pth", "vgg.pth", (3, 8, 15, 22, 29), 16),
    "alex": _Kind(_alexnet, "alexnet-owt-7be5be79.pth", "alex.pth", (1, 4, 7, 9, 11), 31),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Lpips:
    """Learned perceptual distance: how differently a network trained on photographs sees two pictures.

    network: "vgg" or "alex"; figures of the two cannot be compared. heads: weights of channels, [1, C, 1, 1] by stage.
    identity: digest of the weights in use, which are the user's own, see `open`.
    Source: Zhang et al. 2018, Eq. 1, as version 0.1 of its weights wants it: features of VGG16 or AlexNet (Krizhevsky
    2014) trained on ImageNet, and a learned weight for each channel.
    """

    network: str
    features: nn.Sequential
    heads: tuple[Tensor, ...]
    identity: str

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Read the weights that lie in a folder.

        The folder holds torchvision's `vgg16-397923af.pth` and the published linear weights `vgg.pth`, or
        `alexnet-owt-7be5be79.pth` and `alex.pth`; of both pairs VGG16 is taken. Nothing but tensors is read from them.

        Raises:
            DataError: a file is missing, or its digest is not that of the published one, see `PUBLISHED`.
        """
        name, path, linear = _files(Path(folder))
        features, digest = _KINDS[name].made(), hashlib.sha256()
        state = _read(path, [f"features.{key}" for key in features.state_dict()])
        heads = _read(linear, [f"lin{stage}.model.1.weight" for stage in range(len(_KINDS[name].compared))])
        for tensor in (*state, *heads):
            digest.update(tensor.contiguous().numpy().tobytes())
        features.load_state_dict(dict(zip(features.state_dict(), state, strict=True)))
        return cls(
            network=name,
            features=features.eval().requires_grad_(False),
            heads=tuple(heads),
            identity=f"{name}-{digest.hexdigest()[:12]}",
        )

    @torch.no_grad()
    def __call__(self, draws: Tensor, targets: Tensor) -> Tensor:
        """Distance of each frame of several draws to one target, 0 for equal ones.

        Args:
            draws: [S, T, 3, H, W]. targets: [T, 3, H, W].
        Returns:
            float32 [S, T].
        Raises:
            ShapeError: shapes differ, or pictures are too small for the network.
        """
        require_same_shape(draws[0], targets)
        least = _KINDS[self.network].least_pixels
        if min(targets.shape[-2:]) < least:
            raise ShapeError(f"LPIPS wants pictures of at least {least} pixels a side, got {list(targets.shape[-2:])}")
        mean, deviation = (torch.tensor(values).view(1, 3, 1, 1) for values in (_MEAN, _DEVIATION))
        frames: list[Tensor] = []
        for t in range(len(targets)):
            pictures = torch.cat([draws[:, t], targets[t : t + 1]]).float()  # [S+1, 3, H, W], the target last
            x, apart = (pictures - mean) / deviation, list[Tensor]()
            for place, layer in enumerate(self.features):
                x = layer(x)
                if place in _KINDS[self.network].compared:
                    unit = x / (x.square().sum(dim=1, keepdim=True).sqrt() + _LEAST_NORM)
                    squared = (unit[:-1] - unit[-1:]).square()
                    apart.append(F.conv2d(squared, self.heads[len(apart)]).mean(dim=(1, 2, 3)))
            frames.append(torch.stack(apart).sum(dim=0))
        return torch.stack(frames, dim=1)


def _files(folder: Path) -> tuple[str, Path, Path]:
    """The network to use and its two files: the first of which both are there."""
    for name, kind in _KINDS.items():
        features, linear = folder / kind.features, folder / kind.linear
        if features.is_file() and linear.is_file():
            return name, features, linear
    held = ", ".join(sorted(path.name for path in folder.glob("*.pth"))) or "no .pth file"
    wanted = " or ".join(f"{kind.features} and {kind.linear}" for kind in _KINDS.values())
    raise DataError(f"no LPIPS weights in {folder}: wanted {wanted}, got {held}")


def _read(path: Path, names: Sequence[str]) -> list[Tensor]:
    """Tensors of a published file by their names. Raises DataError where it is another file or damaged."""
    try:
        with path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot read the LPIPS weights {path}: {error}") from error
    if not found.startswith(PUBLISHED[path.name]):
        raise DataError(
            f"{path} is not the published file: its SHA-256 begins with {found[:8]}, wanted "
            f"{PUBLISHED[path.name][:8]}; fetch it again"
        )
    held: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return [held[name].detach().float() for name in names]
