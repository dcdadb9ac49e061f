"""`compute.compile`: the same training, compiled. Slow: torch compiles each block for minutes."""

from pathlib import Path

import msgspec
import pytest
import torch
from tiny_world import Never, TinyClips, saved, tiny_recipe

from gcd_train.data.open import RunData
from gcd_train.training.checkpoint import SavedWeights
from gcd_train.training.monitor import RunFolder
from gcd_train.training.run import RunInputs, Trainer


def unet_of(path: Path, *, compiled: bool, recompute: bool = False) -> SavedWeights:
    """The U-Net's state after all updates of the tiny recipe; the stages before it are taken as they lie there."""
    recipe = tiny_recipe()
    compute = msgspec.structs.replace(recipe.compute, compile=compiled, checkpoint_activations=recompute)
    inputs = RunInputs(
        recipe=msgspec.structs.replace(recipe, compute=compute),
        data=RunData(clips=TinyClips(2), valid=TinyClips(1, seed=9)),
        folder=RunFolder(path),
        stop=Never(),
    )
    for stage in ("vae", "latents", "unet"):
        Trainer(inputs).run(stage)
    return saved(path / "unet", "unet")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_compiled_blocks_learn_what_plain_ones_do(tmp_path: Path) -> None:
    """Single frames, then whole clips; also where blocks forget and compute anew."""
    torch.set_num_threads(1)
    plain = unet_of(tmp_path / "plain", compiled=False)
    for recompute in (False, True):
        folder = tmp_path / f"compiled-{recompute}"
        folder.mkdir()
        for stage in ("vae", "latents"):
            (folder / stage).symlink_to(tmp_path / "plain" / stage)
        compiled = unet_of(folder, compiled=True, recompute=recompute)
        assert compiled.module.keys() == plain.module.keys()  # a plain run can go on with it
        for name, weight in plain.module.items():
            torch.testing.assert_close(compiled.module[name], weight, rtol=1e-3, atol=1e-4, msg=name)
