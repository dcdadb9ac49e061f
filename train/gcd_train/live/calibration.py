"""After the last stage: how likely a class must be, how wide the spread is, and which source is of another world.

The losses make rare classes count for more, so their logits are too high by the logarithm of that; a share of it is
taken back. All is read off held-out clips, and written into biases and the config.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from gcd_model.live.depth_net import DepthOutput, depth_inputs, read_depth
from gcd_model.live.paint_net import filled
from gcd_model.networks import LiveNetworks
from gcd_train.evaluation.metrics import class_iou, confusion_matrix
from gcd_train.live.batches import some_of, to_video, with_true_references
from gcd_train.live.clips import read_clip
from gcd_train.live.measure_figures import SpreadHistogram, fit_spread
from gcd_train.live.measure_methods import LiveModel
from gcd_train.live.paint_training import HeldOutViews

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_FRAMES = slice(1, 14, 4)
_FAMILIAR = 400
"""So many clips of the training say what is familiar."""
_DOUBT = 1.1
"""A source counts as another world's from so many times the highest score of a held-out clip."""


@torch.no_grad()
def calibrate(
    networks: LiveNetworks,
    learned: Sequence[Path],
    paths: Sequence[Path],
    views: HeldOutViews,
    depth_weights: Tensor,
    paint_weights: Tensor,
) -> None:
    """Changes the class biases of both networks, what is familiar, and the config's spread and threshold.

    learned: clips of the training. paths, views: of held-out clips. depth_weights, paint_weights: [K], how much the
    losses made of each class.
    """
    networks.eval()
    config = networks.config
    depth_head, paint_head = networks.depth.head.out, networks.paint.head.out
    _take_back(depth_head, 2 * config.depth.bins - 1, depth_weights, lambda: _source_classes(networks, paths))
    _take_back(paint_head, 3, paint_weights, lambda: _view_classes(networks, views))
    _learn_familiar(networks, learned, np.random.default_rng(0))
    networks.config = msgspec.structs.replace(
        config, spread_shift=_spread_shift(networks, paths), ood_threshold=_threshold(networks, paths)
    )


def _take_back(
    head: nn.Conv2d, first: int, weights: Tensor, classes: Callable[[], Iterator[tuple[Tensor, Tensor]]]
) -> None:
    """Lower the biases of the classes, which begin at `first`, by that share of the weights with the best mean IoU.

    classes: pairs of logits [N, K, H, W] and labels [N, H, W].
    """
    assert head.bias is not None
    count, excess = len(weights), weights.log().cpu()
    confusions = torch.zeros(len(_SHARES), count, count, dtype=torch.int64)
    for logits, labels in classes():
        for confusion, share in zip(confusions, _SHARES, strict=True):
            made = (logits.cpu() - share * excess[:, None, None]).argmax(1)
            confusion += confusion_matrix(made.to(torch.uint8), labels.to(torch.uint8), count)
    means = [class_iou(each)[each.sum(1) > 0].mean() for each in confusions]
    best = _SHARES[int(torch.stack(means).argmax())]
    head.bias[first : first + count] -= (best * excess).to(head.bias)


def _source_classes(networks: LiveNetworks, paths: Sequence[Path]) -> Iterator[tuple[Tensor, Tensor]]:
    device = next(networks.parameters()).device
    for path in paths:
        source = with_true_references(read_clip(path), "source")
        output = networks.depth(
            depth_inputs(source.video, source.rays, source.ground()).to(device), source.sweeps(networks.config.depth)
        )
        yield output.classes[_FRAMES], source.labels[_FRAMES]


def _view_classes(networks: LiveNetworks, views: HeldOutViews) -> Iterator[tuple[Tensor, Tensor]]:
    for view in views.on(next(networks.parameters()).device):
        made = networks.paint.first_step(view.seen, filled(view.seen), networks.config.sigma_max, detail=False)
        yield made.classes, view.labels.cpu()


def _spread_shift(networks: LiveNetworks, paths: Sequence[Path]) -> tuple[float, float, float]:
    """Of painted, seen before and seen now, so that the 90 % interval holds 90 %."""
    networks.config = msgspec.structs.replace(networks.config, spread_shift=(0.0, 0.0, 0.0))
    model, histogram = LiveModel(networks=networks), SpreadHistogram()
    for path in paths:
        clip = read_clip(path)
        views, truth = model.views(clip), (to_video(clip.arrays["target.rgb"]) + 1) / 2
        assert views.log_variance is not None
        assert views.visibility is not None
        histogram.add((views.video - truth)[1:], views.log_variance[1:], views.visibility[1:])
    return fit_spread(histogram)


def _threshold(networks: LiveNetworks, paths: Sequence[Path]) -> float:
    def score(output: DepthOutput) -> float:
        return float(networks.familiarity.score(output.summary, read_depth(output, networks.config.depth).entropy))

    frames = range(14)[_FRAMES]
    means = [
        np.mean([[score(output) for output in _outputs(networks, path, t)] for t in frames], axis=0).max()
        for path in paths
    ]
    return min(_DOUBT * float(max(means)), 1.0)


def _learn_familiar(networks: LiveNetworks, paths: Sequence[Path], random: np.random.Generator) -> None:
    """From a frame of each of some clips that were learned from."""
    some = [paths[i] for i in random.permutation(len(paths))[:_FAMILIAR]]
    outputs = (each for path in some for each in _outputs(networks, path, int(random.integers(14))))
    networks.familiarity.fit(torch.cat([each.summary for each in outputs]).cpu())


def _outputs(networks: LiveNetworks, path: Path, t: int) -> Iterator[DepthOutput]:
    """Of a frame of a clip's source: with its mount and an earlier frame, and without."""
    device = next(networks.parameters()).device
    frame = some_of(with_true_references(read_clip(path, slice(t + 1)), "source"), slice(-1, None))
    ground = frame.ground()
    told = depth_inputs(frame.video, frame.rays, ground).to(device)
    yield networks.depth(told, frame.sweeps(networks.config.depth).to(device))
    yield networks.depth(depth_inputs(frame.video, frame.rays, torch.zeros_like(ground)).to(device))
