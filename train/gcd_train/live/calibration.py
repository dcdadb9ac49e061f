"""The live model's figures that no loss has learned: after the last stage, read off held-out clips.

How likely a class is, how wide the spread of a colour, and from which score on a source is of another world.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from gcd_model.geometry import invert_rigid
from gcd_model.live.depth_net import DepthOutput, depth_inputs, read_depth
from gcd_model.live.eyes import Eyes, Floor, SeenWorld
from gcd_model.live.paint_net import filled
from gcd_model.live.synthesizer import Painter, ViewFrame
from gcd_model.networks import LiveNetworks
from gcd_train.data.sample import to_network
from gcd_train.evaluation.metrics import class_iou, confusion_matrix
from gcd_train.live.batches import Pictures, frame_of, pictures_of, with_true_references
from gcd_train.live.clips import STATES, LiveClip, read_clip
from gcd_train.live.paint_training import HeldOutViews

_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_FRAMES = slice(1, 14, 4)
_FAMILIAR = 400
"""So many clips of the training say what is familiar."""
_DOUBT = 1.1
"""A source counts as another world's from so many times the highest score of a held-out clip."""
_INTERVAL, _Z = 0.9, 1.6448536269514722
_BINS, _FARTHEST = 8000, 40.0
"""Of the histograms of shifts, which reach this far to both sides: steps of 0.01."""


@torch.no_grad()
def calibrate(
    networks: LiveNetworks,
    learned: Sequence[Path],
    paths: Sequence[Path],
    views: HeldOutViews,
    depth_weights: Tensor,
    paint_weights: Tensor,
) -> None:
    """After the last stage, on the CPU: how likely a class is, how wide the spread, and what is another world's.

    The losses make rare classes count for more, so their logits are too high by the logarithm of that; a share of it is
    taken back. All is read off held-out clips, and written into the class biases of both networks and into the config.

    learned: clips of the training. paths, views: of held-out clips. depth_weights, paint_weights: [K], how much the
    losses made of each class.
    """
    networks.eval()
    config = networks.config
    depth_head, paint_head = networks.depth.head.out, networks.paint.head.out
    sources = (with_true_references(read_clip(path)) for path in paths)
    outputs = ((networks.depth(depth_inputs(each.video, each.rays, each.ground()), each.sweeps(config.depth)), each)
               for each in sources)  # fmt: skip
    classes = ((output.classes[_FRAMES], each.labels[_FRAMES]) for output, each in outputs)
    _take_back(depth_head, 2 * config.depth.bins - 1, depth_weights, classes)
    made = ((networks.paint.first_step(each.seen, filled(each.seen), config.sigma_max, detail=False), each)
            for each in views.views)  # fmt: skip
    _take_back(paint_head, 3, paint_weights, ((painted.classes, each.labels) for painted, each in made))
    # what is familiar: a frame of each of some clips that were learned from
    random = np.random.default_rng(0)
    some = [learned[i] for i in random.permutation(len(learned))[:_FAMILIAR]]
    outputs = (each for path in some for each in _outputs(networks, path, int(random.integers(14))))
    networks.familiarity.fit(torch.cat([each.summary for each in outputs]))

    def ood_scores(path: Path, t: int) -> list[float]:
        return [
            float(networks.familiarity.score(each.summary, read_depth(each, config.depth).entropy))
            for each in _outputs(networks, path, t)
        ]

    scores = [np.mean([ood_scores(path, t) for t in range(14)[_FRAMES]], axis=0).max() for path in paths]
    # of painted, seen before and seen now, so that the 90 % interval holds 90 %
    networks.config = msgspec.structs.replace(config, spread_shift=(0.0, 0.0, 0.0))
    histogram = SpreadHistogram()
    for path in paths:
        clip = read_clip(path)
        source, truth = pictures_of(clip), (to_network(clip.arrays["target.rgb"]) + 1) / 2
        shown = frames_of(networks, clip, source, floors_of(source))[1:]
        for frame, true in zip(shown, truth[1:], strict=True):
            error = (frame.picture.clamp(-1, 1) + 1) / 2 - true
            histogram.add(error[None], frame.log_variance[None], frame.visibility[None])
    networks.config = msgspec.structs.replace(
        config, spread_shift=fit_spread(histogram), ood_threshold=min(_DOUBT * float(max(scores)), 1.0)
    )


def _take_back(head: nn.Conv2d, first: int, weights: Tensor, classes: Iterator[tuple[Tensor, Tensor]]) -> None:
    """Lower the biases of the classes, which begin at `first`, by that share of the weights with the best mean IoU.

    classes: pairs of logits [N, K, H, W] and labels [N, H, W].
    """
    assert head.bias is not None
    count, excess = len(weights), weights.log().cpu()  # of a training on the GPU
    confusions = torch.zeros(len(_SHARES), count, count, dtype=torch.int64)
    for logits, labels in classes:
        for confusion, share in zip(confusions, _SHARES, strict=True):
            confusion += confusion_matrix((logits - share * excess[:, None, None]).argmax(1), labels, count)
    means = [class_iou(each)[each.sum(1) > 0].mean() for each in confusions]
    best = _SHARES[int(torch.stack(means).argmax())]
    head.bias[first : first + count] -= (best * excess).to(head.bias)


def _outputs(networks: LiveNetworks, path: Path, t: int) -> Iterator[DepthOutput]:
    """Of a frame of a clip's source: with its mount and an earlier frame, and without."""
    frame = frame_of(path, t)
    ground = frame.ground()
    yield networks.depth(depth_inputs(frame.video, frame.rays, ground), frame.sweeps(networks.config.depth))
    yield networks.depth(depth_inputs(frame.video, frame.rays, torch.zeros_like(ground)))


def floors_of(source: Pictures) -> list[Floor]:
    """What a mount declares, of every frame."""
    return [Floor(up=up, height_m=float(height)) for up, height in zip(source.ups, source.heights_m, strict=True)]


def frames_of(
    networks: LiveNetworks,
    clip: LiveClip,
    source: Pictures,
    floors: Sequence[Floor],
    *,
    eyes: Eyes | None = None,
    steps: int | None = None,
) -> list[ViewFrame]:
    """What a live model shows of a clip, frame by frame as a node runs it. source: the clip's. eyes: others than its
    own. steps: of painting, None as trained."""
    eyes, config = eyes or Eyes(networks), networks.config
    world = SeenWorld(config, next(networks.parameters()).device)
    painter = Painter(networks, steps=steps or config.steps)
    lens, target_lens = source.lenses[0], clip.lens("target")
    moves = invert_rigid(clip.poses("source")) @ clip.poses("target")
    seen = (eyes.see(frame, lens=lens, floor=floor) for frame, floor in zip(source.video, floors, strict=True))
    return [painter.paint(world.place(each, [move], [target_lens]))[0] for each, move in zip(seen, moves, strict=True)]


class SpreadHistogram:
    """How many errors, channel by channel, need which shift of the log-variance, apart for each state of visibility."""

    def __init__(self) -> None:
        self.counts = torch.zeros(len(STATES), _BINS, dtype=torch.float64)

    def add(self, error: Tensor, log_variance: Tensor, visibility: Tensor) -> None:
        """error: [T, 3, H, W], view minus truth in [0, 1]. log_variance, visibility: [T, H, W], as published."""
        shift = 2 * (error.abs().clamp(min=1e-9) / _Z).log() - log_variance[:, None]  # inside where not above 0
        place = torch.ceil((shift + _FARTHEST) * (_BINS / (2 * _FARTHEST))).long().clamp(1, _BINS) - 1
        state = visibility[:, None].expand_as(error).long()
        self.counts += torch.bincount((state * _BINS + place).flatten(), minlength=self.counts.numel()).view(3, -1)

    @property
    def coverage(self) -> list[float]:
        """Share of errors inside the 90 % interval, by state; NaN for a state that never occurs."""
        inside = self.counts[:, : _BINS // 2].sum(1)
        return (inside / self.counts.sum(1)).tolist()


def fit_spread(histogram: SpreadHistogram) -> tuple[float, float, float]:
    """What to add to the log-variance of each state so that the 90 % interval holds 90 %; 0 for an absent state."""
    shifts: list[float] = []
    for counts in histogram.counts:
        share = counts.cumsum(0) / counts.sum()
        enough = int((share < _INTERVAL).sum()) + 1  # right edge of the first bin that reaches it
        shifts.append(enough * (2 * _FARTHEST / _BINS) - _FARTHEST if bool(counts.sum() > 0) else 0.0)
    return shifts[0], shifts[1], shifts[2]
