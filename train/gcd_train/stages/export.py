"""The weight files of a run: averaged weights of all stages, with a card."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from gcd_model import ModelError
from gcd_model.networks import Networks
from gcd_model.weights.adapter import Adapter
from gcd_model.weights.card import Card, precision
from gcd_model.weights.families import Family
from gcd_model.weights.load import load_weights, save_weights
from gcd_model.weights.save import write_adapter, write_published
from gcd_train.errors import RunError
from gcd_train.recipe import ExportRecipe
from gcd_train.run_folder import RunFolder
from gcd_train.validation import Validation

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class ExportJob:
    """What is written under which name.

    move_time: frame in which the goal pose is reached. updates: of the U-Net, for the published layout.
    leftovers: gives weights of the file training started from that nothing here uses, for the published layout.
    adapter: of a run that trained one, by the card of base and adapter together; None otherwise.
    """

    name: str
    family: Family
    move_time: int
    updates: int
    recipe: ExportRecipe
    leftovers: Callable[[], Mapping[str, Tensor]]
    adapter: Callable[[Card], Adapter] | None = None


def export(networks: Networks, folder: RunFolder, job: ExportJob, validation: Validation) -> None:
    """Write `NAME.safetensors` into the run's folder, and measure what a user would load from it.

    Beside it `NAME.ckpt` in the published layout where the recipe asks for it, and `NAME-adapter.safetensors` of a run
    with adapters, which are merged into the others. Files of an earlier export are replaced. Raises RunError.
    """
    networks, path = networks.cpu(), folder.path / f"{job.name}.safetensors"
    card = Card(name=job.name, config=networks.config, family=job.family.name, move_time=job.move_time, trained=True)
    try:
        others = _write_others(networks, folder.path, card, job)
        save_weights(networks.to(precision(job.recipe.dtype)), path, card, overwrite=True)
        loaded = load_weights(path)
    except ModelError as error:
        raise RunError(f"cannot export to {path}: {error}") from error
    values = validation.measure(loaded.diffusion.float(), folder.stage("export") / "samples.png")
    size = {"bytes": path.stat().st_size, "sha256_12": loaded.sha256_12}
    folder.record("export", "measured", {**size, **values})
    _log.info("wrote %s", ", ".join([str(path), *(str(other) for other in others)]))


def _write_others(networks: Networks, folder: Path, card: Card, job: ExportJob) -> list[Path]:
    """What is written in float32, while the networks are; returns the files."""
    written = list[Path]()
    if "gcd-ckpt" in job.recipe.layouts:
        out, weights, carried = folder / f"{job.name}.ckpt", networks.state_dict(), job.leftovers()
        write_published(out, weights, card, carried=carried, updates=job.updates, overwrite=True)
        written.append(out)
    if job.adapter is not None:
        written.append(folder / f"{job.name}-adapter.safetensors")
        write_adapter(written[-1], job.adapter(card), overwrite=True)
    return written
