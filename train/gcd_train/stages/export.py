"""The weight file of a run: averaged weights of all stages, in half precision, with a card."""

from gcd_model import ModelError
from gcd_model.checkpoints import load_weights, save_weights
from gcd_model.families import Family
from gcd_model.networks import Networks
from gcd_model.own_format import Card
from gcd_train.errors import RunError
from gcd_train.run_folder import RunFolder
from gcd_train.validation import Validation


def export(networks: Networks, folder: RunFolder, name: str, family: Family, validation: Validation) -> None:
    """Write `NAME.safetensors` into the run's folder, and measure what a user would load from it.

    The card's config leaves out the plane mix if these networks have none. Raises RunError.
    """
    path = folder.path / f"{name}.safetensors"
    config = networks.config
    card = Card(name=name, config=config, family=family.name, move_time=config.frames - 1, trained=True)
    try:
        save_weights(networks.cpu().half(), path, card, overwrite=True)
        loaded = load_weights(path)
    except ModelError as error:
        raise RunError(f"cannot export to {path}: {error}") from error
    values = validation.measure(loaded.networks.float(), folder.stage("export") / "samples.png")
    size = {"bytes": path.stat().st_size, "sha256_12": loaded.sha256_12}
    folder.record("export", "measured", {**size, **values})
