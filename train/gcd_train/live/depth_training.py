"""How the depth network learns: the bin, the place within it, the class, and what moves."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.clip import palette
from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import SKY_M, DepthNet, DepthOutput, bin_width, depth_inputs, first_bin, read_depth
from gcd_train.evaluation.metrics import confusion_matrix
from gcd_train.live.batches import (
    PART_SEED,
    FrameBatches,
    Pictures,
    autocast,
    class_figures,
    class_weights,
    frame_of,
    generator_on,
    halved,
    on,
)
from gcd_train.live.clips import TrainingClips, evenly
from gcd_train.recipe import LiveStage
from gcd_train.training.loop import Progress, StepLoss, Task
from gcd_train.training.monitor import write_sheet

_CLASS_POWER = -0.25
_EDGE, _EDGE_WEIGHT, _THIN_WEIGHT = 0.05, 2.0, 12.0
_OFFSET, _CLASS, _MOVES = 0.5, 0.7, 0.2
_PIXEL_SHARE = 0.2
"""How many draws of a pixel a frame's loss is computed from: the fine head is what costs time at full size."""
THIN = ("person", "pole", "cyclist", "object")
"""Small things, which are drawn more often."""
_MEASURED_FRAMES, _JUMP = (3, 10), 0.15


class DepthTask(Task):
    """Trains a DepthNet on single frames."""

    def __init__(
        self,
        net: DepthNet,
        config: LiveConfig,
        clips: TrainingClips,
        held_out: Sequence[Path],
        stage: LiveStage,
        seed: int,
    ) -> None:
        super().__init__(net)
        self._config, self._device = config, next(net.parameters()).device
        self._net, self._held_out, self._small_share = net, held_out, stage.small_share
        self._batches = [FrameBatches(clips, stage.batch, seed + part * PART_SEED) for part in range(stage.parts)]
        self._class_weights = class_weights(clips.paths, config, _CLASS_POWER).to(self._device)
        self._thin = torch.tensor([entry.name in THIN for entry in config.classes], device=self._device)

    @property
    def class_weights(self) -> Tensor:
        """How much a pixel of each class counts, by how often it is drawn and by its weight: [K]."""
        return self._class_weights * (1 + _THIN_WEIGHT * self._thin)

    def step_loss(self, progress: Progress) -> StepLoss:
        """Of one batch of frames."""
        pictures, ground, random = self._batches[progress.part].batch(progress.updates)
        if progress.share < self._small_share:
            pictures, ground = halved(pictures), ground[:, ::2, ::2]
        self._net.train()
        inputs = depth_inputs(pictures.video, pictures.rays, ground)
        log = pictures.metres.log()[:, None]  # edges and thin things are drawn more often
        edge = ((F.max_pool2d(log, 3, 1, 1) + F.max_pool2d(-log, 3, 1, 1))[:, 0] > 2 * _EDGE).float()
        weights = 1 + _EDGE_WEIGHT * edge + _THIN_WEIGHT * self._thin[pictures.labels].float()  # [N, H, W]
        count, generator = int(weights[0].numel() * _PIXEL_SHARE), generator_on(self._device, random)
        pixels = torch.multinomial(weights.flatten(1), count, True, generator=generator)
        sweeps = pictures.sweeps(self._config.depth)
        with autocast(self._device):
            output = self.network(inputs, sweeps, pixels)
        parts = self.losses(output, pictures, pixels)
        total = parts["bin"] + _OFFSET * parts["offset"] + _CLASS * parts["class"] + _MOVES * parts["moves"]
        return StepLoss(total=total, parts=parts, frames=len(pictures.lenses))

    def losses(self, output: DepthOutput, pictures: Pictures, pixels: Tensor) -> dict[str, Tensor]:
        """Cross-entropy of the bin, distance of the offset, cross-entropies of class and motion, at some pixels."""
        config = self._config.depth

        def at(values: Tensor) -> Tensor:
            return values.flatten(1).gather(1, pixels)[..., None]  # [N, M, 1]

        metres, labels = at(pictures.metres), at(pictures.labels)
        sky = metres >= config.farthest_m
        place = (metres.log() - first_bin(config)) / bin_width(config)
        nearest = place.round().clamp(0, config.bins - 2).long()
        label = torch.where(sky, config.bins - 1, nearest)
        bin_loss = F.cross_entropy(output.logits, label)
        # the neighbours' offsets count where the peak is read
        beside = torch.arange(-1, 2, device=self._device).view(1, 3, 1, 1)
        around = (nearest[:, None] + beside).clamp(0, config.bins - 2)
        wanted = (place[:, None] - around).clamp(-1.45, 1.45)
        distance = (output.offsets(around) - wanted).abs() * torch.tensor([0.5, 2.0, 0.5]).to(wanted).view(1, 3, 1, 1)
        offset = (distance.sum(dim=1) * ~sky).mean()
        classes = F.cross_entropy(output.classes, labels, self._class_weights)
        moves = F.binary_cross_entropy_with_logits(output.moves, at(pictures.moves))
        return {"bin": bin_loss, "offset": offset, "class": classes, "moves": moves}

    def measure(self, picture: Path) -> dict[str, float]:
        """Of held-out clips, see `measure_depth`."""
        self._net.eval()
        return measure_depth(self._net, self._config, self._held_out, picture)


@torch.no_grad()
def measure_depth(
    net: DepthNet, config: LiveConfig, paths: Sequence[Path], sheet: Path | None = None
) -> dict[str, float]:
    """Errors of depth, edges and classes on the source frames of held-out clips.

    mean_relative, median_relative: of depth nearer than the farthest bin. thin_within_10: share of person and pole
    pixels within 10 %. edge_f1: depth edges within one pixel. miou: of classes that occur.
    """
    errors, thin, rows = list[Tensor](), list[Tensor](), list[list[Tensor]]()
    edges, count = torch.zeros(3), len(config.classes)
    confusion = torch.zeros(count, count, dtype=torch.int64)
    is_thin = torch.tensor([entry.name in ("person", "pole") for entry in config.classes])
    cpu, device = torch.device("cpu"), next(net.parameters()).device
    for path, frame in product(paths, _MEASURED_FRAMES):
        truth = frame_of(path, frame)
        inputs = depth_inputs(truth.video, truth.rays, truth.ground())
        output = on(cpu, net(inputs.to(device), truth.sweeps(config.depth).to(device)))
        metres, true = read_depth(output, config.depth).metres, truth.metres
        near = true < config.depth.farthest_m
        relative = (metres.clamp(max=SKY_M) - true).abs() / true
        errors.append(relative[near].clamp(max=2.0))
        thin.append(relative[is_thin[truth.labels] & near])
        edges += edge_matches(metres, true)
        classes = output.classes.argmax(1)
        confusion += confusion_matrix(classes, truth.labels, count)
        if frame == _MEASURED_FRAMES[0]:
            colours = palette(config.classes)[classes[0]].permute(2, 0, 1) / 127.5 - 1
            rows.append([truth.video[0], _shaded(true[0]), _shaded(metres[0]), colours])
    together, small = torch.cat(errors), torch.cat(thin)
    if sheet is not None:
        write_sheet(sheet, evenly(rows, 8))
    return {
        "mean_relative": float(together.mean()),
        "median_relative": float(together.median()),
        "thin_within_10": float((small < 0.1).float().mean()) if len(small) else float("nan"),
        "edge_f1": float(2 * edges[0] / (edges[1] + edges[2]).clamp(min=1)),
        **class_figures(confusion, config.classes, (8, 10, 11, 7, 16)),
    }


def _shaded(metres: Tensor) -> Tensor:
    """Near is bright: [H, W] metres -> picture [3, H, W] in [-1, 1]."""
    return (1 - (metres.clamp(0.3, 200) / 0.3).log() / 3.25).clamp(-1, 1).expand(3, -1, -1)


def edge_matches(metres: Tensor, true: Tensor) -> Tensor:
    """Matched and all edges, for F1 with a pixel's slack: (matched, edges of `metres`, edges of `true`).

    An edge is a pixel from which depth jumps by more than 15 % to the right or down.
    """
    slack: list[Tensor] = []
    edges: list[Tensor] = []
    for log in (metres.log(), true.log()):
        right, down = (F.pad(log.diff(dim=d).abs() > _JUMP, pad) for d, pad in ((-1, (0, 1)), (-2, (0, 0, 0, 1))))
        edges.append(right | down)
        slack.append(F.max_pool2d(edges[-1][:, None].float(), 3, 1, 1)[:, 0] > 0)
    matched = ((edges[0] & slack[1]).sum() + (edges[1] & slack[0]).sum()) / 2
    return torch.stack([matched, edges[0].sum(), edges[1].sum()]).float()
