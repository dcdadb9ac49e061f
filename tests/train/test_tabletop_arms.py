"""Which arm the tabletop world has: chosen on the command line, told by the manifest."""

import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from box_world import box_scene, box_world
from headless import needs_egl
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.errors import DataError, RecipeError, RenderError
from gcd_train.layouts.scene_writer import SceneFormat, write_scene
from gcd_train.scenes.description import Scene
from gcd_train.scenes.worlds import SCENE_WORLDS, tabletop_world


@pytest.fixture
def installed_panda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gcd_train.scenes.tabletop.panda.panda_arm", lambda: None)


def test_an_arm_whose_package_is_missing_is_refused_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    made = CliRunner().invoke(app, ["generate", "tabletop", str(tmp_path), "--scenes", "9", "--arm", "panda"])
    assert made.exit_code == RenderError.exit_code
    assert made.output.count("pip install gymnasium-robotics; or use the arm 'primitive'") == 1
    assert os.listdir(tmp_path) == []


def test_an_unknown_arm_is_refused(tmp_path: Path) -> None:
    made = CliRunner().invoke(app, ["generate", "tabletop", str(tmp_path), "--arm", "tentacle"])
    assert made.exit_code == RecipeError.exit_code
    assert "choose one of primitive, panda" in made.output


@pytest.mark.usefixtures("installed_panda")
def test_the_arm_that_was_chosen_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def scene(seed: int, *, frames: int, arm: str) -> Scene:
        asked.append(arm)
        return box_scene(seed, frames)

    monkeypatch.setattr("gcd_train.scenes.tabletop.tabletop_scene", scene)
    for arm in ("panda", "primitive"):
        world = pickle.loads(pickle.dumps(tabletop_world(arm)))  # as it travels to workers
        world.make(3, 2)
    SCENE_WORLDS["tabletop"].make(3, 2)
    assert asked == ["panda", "primitive", "primitive"]


@needs_egl
@pytest.mark.usefixtures("installed_panda")
def test_scenes_of_two_arms_are_not_mixed(tmp_path: Path) -> None:
    form = SceneFormat(width=48, height=32, frames=2, oversample=1)
    write_scene(tmp_path, replace(box_world(), name=tabletop_world().name), form, 0)
    with pytest.raises(DataError, match="with world tabletop, wanted tabletop-panda; choose another folder"):
        write_scene(tmp_path, replace(box_world(), name=tabletop_world("panda").name), form, 0)
