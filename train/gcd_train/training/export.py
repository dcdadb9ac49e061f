"""Held-out clips through the synthesizer that is shipped, and the weight files of a run."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gcd_model import Clip, ModelError, Traits
from gcd_model.clip import palette
from gcd_model.networks import Networks
from gcd_model.synthesizer import Synthesizer
from gcd_model.weights.adapter import Adapter
from gcd_model.weights.card import Card, Family, precision
from gcd_model.weights.load import load_weights, save_weights
from gcd_model.weights.save import write_adapter, write_published
from gcd_train.data.sample import Clips, to_network
from gcd_train.errors import RunError
from gcd_train.evaluation.metrics import NO_CLASS, mean_iou, named_confusion, psnr
from gcd_train.recipe import ExportRecipe
from gcd_train.training.monitor import RunFolder, write_sheet
from gcd_train.training.setup import copy_of

_log = logging.getLogger(__name__)
_SHOWN_CLIPS = 4
_ADAPTER = "-adapter.safetensors"


class Validation:
    """Held-out clips and how the model takes them."""

    def __init__(self, clips: Clips, family: Family, *, count: int) -> None:
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
            sample = self._clips.sample(number)
            source, target = to_network(sample.source), to_network(sample.target)
            depth = None if sample.source_depth is None else torch.from_numpy(sample.source_depth)
            clip = Clip(video=source, fps=self._clips.fps, lens=sample.lens, depth=depth)
            view = synthesizer.render(synthesizer.encode(clip), [sample.trajectory])[0]
            scores.append(psnr(view.video, (target + 1) / 2)[1:])
            rows = [source, view.video * 2 - 1, target]
            if view.classes is not None:
                truth = torch.from_numpy(np.array(sample.target_classes))
                met = named_confusion(view.classes[0, 1:], truth[1:], [kind.name for kind in self._clips.classes])
                counts = met if counts is None else counts + met
                rows += [self._painted(view.classes[0]), self._painted(truth)]
            if number < _SHOWN_CLIPS:
                shown += [[video[t] for video in rows] for t in (len(source) // 2, len(source) - 1)]
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
            move_time=config.frames - 1,  # unread: each clip brings its own path
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


def export(
    networks: Networks,
    folder: RunFolder,
    card: Card,
    recipe: ExportRecipe,
    validation: Validation,
    *,
    updates: int,
    leftovers: Callable[[], Mapping[str, Tensor]],
    adapter: Callable[[Card], Adapter] | None,
) -> None:
    """Write `NAME.safetensors` into the run's folder, and measure what a user would load from it.

    Beside it `NAME.ckpt` in the published layout where the recipe asks for it, and `NAME-adapter.safetensors` of a run
    with adapters, which are merged into the others. Files of an earlier export are replaced.

    Args:
        updates: of the U-Net, for the published layout.
        leftovers: gives weights of the file training started from that nothing here uses, for the published layout.
        adapter: of a run that trained one, by the card of base and adapter together.
    Raises:
        RunError: a file cannot be written.
    """
    networks = networks.cpu()
    path, published, apart = (folder.path / f"{card.name}{end}" for end in (".safetensors", ".ckpt", _ADAPTER))
    written = [path]
    try:
        if "gcd-ckpt" in recipe.layouts:  # in float32, while the networks are
            weights = networks.state_dict()
            write_published(published, weights, card, carried=leftovers(), updates=updates, overwrite=True)
            written.append(published)
        if adapter is not None:
            write_adapter(apart, adapter(card), overwrite=True)
            written.append(apart)
        save_weights(networks.to(precision(recipe.dtype)), path, card, overwrite=True)
        loaded = load_weights(path)
    except ModelError as error:
        raise RunError(f"cannot export to {path}: {error}") from error
    values = validation.measure(loaded.diffusion.float(), folder.stage("export") / "samples.png")
    size = {"bytes": path.stat().st_size, "sha256_12": loaded.card.origin}
    folder.record("export", "measured", {**size, **values})
    _log.info("wrote %s", ", ".join(map(str, written)))
