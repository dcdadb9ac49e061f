"""`compute.compile`: the same training, compiled. Slow: torch compiles each block for minutes."""

from pathlib import Path

import msgspec
import pytest
import torch
from tiny_world import saved, tiny_recipe, trainer

from gcd_train.training.checkpoint import SavedWeights


def unet_of(path: Path, *, compiled: bool, recompute: bool = False) -> SavedWeights:
    """The U-Net's state after all updates of the tiny recipe; the stages before it are taken as they lie there."""
    recipe = tiny_recipe()
    compute = msgspec.structs.replace(recipe.compute, compile=compiled, checkpoint_activations=recompute)
    for stage in ("vae", "latents", "unet"):
        trainer(path, msgspec.structs.replace(recipe, compute=compute)).run(stage)
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
