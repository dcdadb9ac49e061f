"""Every family of shipped recipe trains at its small scale, shrunk further, on tiny scenes in the layout it names."""

import json
from pathlib import Path

import pytest
from box_world import STAGE
from headless import needs_egl
from tiny_scenes4d import CAMERAS, VIEWS, write_driving, write_kubric
from tiny_world import ran

from gcd_model import load_synthesizer
from gcd_train.recipe_files import load_recipe, packaged_recipes
from gcd_train.scenes.scene_writer import write_scene
from gcd_train.scenes.worlds import SceneFormat

TINY: dict[str, object] = {
    "model.frames": 3,
    "model.height": 16,
    "model.width": 16,
    "model.unet.width": 16,
    "model.unet.multipliers": [1, 2],
    "model.unet.attention": [False, True],
    "model.unet.head_width": 16,
    "model.vae.width": 8,
    "model.vae.multipliers": [1, 1],
    "data.frames.strides": [1, 2],
    "data.repeats": 3,
    "vae.budget.updates": 2,
    "vae.pool": 1,
    "vae.clips": 1,
    "vae.crop": 16,
    "vae.frames": 2,
    "unet.budget.updates": 2,
    "unet.clip_batch": 1,
    "unet.batch": 2,
    "log.log_s": 1e-6,
}
KUBRIC: dict[str, object] = {"data.cameras": VIEWS}
DRIVING: dict[str, object] = {"data.cameras": CAMERAS}


@pytest.fixture(scope="module")
def kubric(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_kubric(tmp_path_factory.mktemp("kubric"), 0, 1, frames=7).parent


@pytest.fixture(scope="module")
def driving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_driving(tmp_path_factory.mktemp("driving"), 0, 1, frames=7).parent


def trained(recipe: str, data: Path, out: Path, changes: dict[str, object]) -> list[dict[str, float]]:
    """Run `gcd-train train --small`; the lines of its metrics about the U-Net."""
    told = [f"--set={key}={json.dumps(value)}" for key, value in (TINY | changes).items()]
    code, said = ran("train", f"package:{recipe}", f"--data={data}", f"--out={out}", "--small", *told)
    assert code == 0, said
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["stage"] == "unet"]


def require_learned(lines: list[dict[str, float]]) -> None:
    """Two updates with a finite loss and a measured wait, and a measurement through the synthesizer."""
    losses = [line for line in lines if "loss" in line]
    assert losses[-1]["updates"] == 2
    assert all(line["loss"] > 0 and line["wait_s"] >= 0 for line in losses)
    assert any("psnr" in line for line in lines)


_PUBLISHED = [name for name in packaged_recipes() if name.startswith(("kubric-", "pardom-"))]
_QUICK = "kubric-direct-max180"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != _QUICK)) for name in _PUBLISHED]
)
def test_the_published_recipes_train(name: str, kubric: Path, driving: Path, tmp_path: Path) -> None:
    """Each for two updates, the ones from scratch and those of painted classes too."""
    orbit = name.startswith("kubric-")
    data, changes = (kubric, KUBRIC) if orbit else (driving, DRIVING)
    require_learned(trained(name, data, tmp_path, changes))
    traits = load_synthesizer(tmp_path / f"{name}-small.safetensors").traits
    camera, goal = "spherical" if orbit else "none", 2 if "gradual" in name else 0
    assert (traits.config.camera, traits.move_time) == (camera, goal)
    assert traits.family is not None
    assert traits.family.name == load_recipe(f"package:{name}").model.family


@pytest.mark.slow
@needs_egl
def test_tabletop_trains_on_exact_pictures(tmp_path: Path) -> None:
    """Scenes as our writers make them, drawn with OpenGL: the model is steered by relative poses."""
    form = SceneFormat(width=48, height=32, frames=7, oversample=1)
    for seed in (0, 1):
        write_scene(tmp_path / "data", STAGE, form, seed)
    require_learned(trained("tabletop", tmp_path / "data", tmp_path / "run", {}))
    traits = load_synthesizer(tmp_path / "run" / "tabletop-small.safetensors").traits
    assert traits.config.camera == "relative_pose"


@pytest.mark.slow
def test_lerobot_trains_on_pairs_of_cameras(tmp_path: Path) -> None:
    """A data set of three calibrated cameras, written and read as LeRobot's."""
    from test_lerobot import _write  # pyright: ignore[reportPrivateUsage]  (is skipped without the extra)

    folder = _write(tmp_path / "data", 0, 1, 2)
    require_learned(trained("lerobot", folder, tmp_path / "run", {"data.held_out": 1}))
    traits = load_synthesizer(tmp_path / "run" / "lerobot-small.safetensors").traits
    assert traits.config.camera == "relative_pose"
    assert traits.family is not None
    assert traits.family.name == "manipulation"


def test_the_small_scale_keeps_the_objective() -> None:
    for name in packaged_recipes():
        if not name.startswith(("kubric-", "pardom-", "tabletop", "lerobot")):
            continue
        large, small = load_recipe(f"package:{name}").unet, load_recipe(f"package:{name}", small=True).unet
        for part in ("noise", "dropout", "dropout_per", "dropout_joint", "augmentation", "fps", "motion_bucket"):
            assert getattr(small, part) == getattr(large, part), (name, part)
        for part in ("focal", "focal_fraction", "focal_blend", "class_weights", "weight_limit"):
            assert getattr(small.loss, part) == getattr(large.loss, part), (name, part)
        assert (small.source, small.optimiser.kind, small.ema) == (large.source, large.optimiser.kind, large.ema)
