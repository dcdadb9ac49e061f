"""How good the networks are on held-out clips, through the synthesizer that is shipped."""

from pathlib import Path

import torch
from torch import Tensor

from gcd_model import Clip, Family, Synthesizer, Traits
from gcd_model.colours import palette
from gcd_model.networks import Networks
from gcd_train.data.sample import ClipSource, to_network
from gcd_train.evaluation.metrics import NO_CLASS, mean_iou, named_confusion, psnr
from gcd_train.model_setup import copy_of
from gcd_train.pictures import write_sheet

_SHOWN_CLIPS = 4


class Validation:
    """Held-out clips and how the model takes them."""

    def __init__(self, clips: ClipSource, family: Family, *, count: int) -> None:
        self._clips, self._family = clips, family
        self._count = min(count, len(clips))

    def measure(self, networks: Networks, picture: Path) -> dict[str, float]:
        """PSNR over frames 2 to T and of the last, mean IoU of the class map at picture size; writes a sample sheet.

        One row shows source, view, target and, of a model that paints classes, predicted and true class map of a frame.
        """
        synthesizer = self._synthesizer(networks)
        scores: list[Tensor] = []
        counts: Tensor | None = None
        shown: list[list[Tensor]] = []
        for number in range(self._count):
            source, target = (to_network(side) for side in self._clips.rgb(number))
            clip = Clip(video=source, fps=self._clips.fps)
            view = synthesizer.render(synthesizer.encode(clip), [self._clips.trajectory(number)])[0]
            scores.append(psnr(view.video, (target + 1) / 2)[1:])
            rows = [source, view.video * 2 - 1, target]
            if view.classes is not None:
                truth = torch.from_numpy(self._clips.target_classes(number).copy())
                met = named_confusion(view.classes[0, 1:], truth[1:], [kind.name for kind in self._clips.classes])
                counts = met if counts is None else counts + met
                rows += [self._painted(view.classes[0]), self._painted(truth)]
            if number < _SHOWN_CLIPS:
                shown += _excerpt(rows)
        write_sheet(picture, shown)
        table = torch.stack(scores)  # [clips, T - 1]
        values = {"psnr": float(table.mean()), "psnr_last": float(table[:, -1].mean())}
        return values if counts is None else {**values, "miou_full": mean_iou(counts)}

    def _synthesizer(self, networks: Networks) -> Synthesizer:
        """A copy of the networks behind the door that users take."""
        copy = copy_of(networks)
        config = copy.config
        device = networks.unet.stem.weight.device
        traits = Traits(
            name="validation",
            config=config,
            family=self._family,
            move_time=config.frames - 1,
            sha256_12="0" * 12,
            precision="float32",
            device=str(device),
        )
        return Synthesizer(copy.to(device), traits)

    def _painted(self, ids: Tensor) -> Tensor:
        """Class ids [T, H, W] as pictures [T, 3, H, W] in [-1, 1], black where no class is."""
        named = palette(tuple(self._clips.classes)).float() / 127.5 - 1
        colours = torch.cat([named, torch.full((NO_CLASS + 1 - len(named), 3), -1.0)])
        return colours[ids.long().cpu()].permute(0, 3, 1, 2)


def _excerpt(rows: list[Tensor]) -> list[list[Tensor]]:
    frames = rows[0].shape[0]
    return [[video[t] for video in rows] for t in (frames // 2, frames - 1)]
