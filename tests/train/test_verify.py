"""`gcd-train verify`: which files of which scenes are not as they were written."""

from pathlib import Path

import pytest
from box_world import box_world
from headless import needs_egl
from typer.testing import CliRunner, Result

from gcd_train.cli.main import app
from gcd_train.data import kubric4d
from gcd_train.data.files import MANIFEST
from gcd_train.errors import DataError
from gcd_train.scenes.scene_writer import write_scene
from gcd_train.scenes.worlds import SceneFormat


def verified(*places: Path) -> Result:
    return CliRunner().invoke(app, ["verify", *map(str, places)])


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    """A set of two scenes, and something that is none."""
    form = SceneFormat(width=16, height=16, frames=1, oversample=1)
    for seed in (0, 1):
        write_scene(tmp_path / "data", box_world(), form, seed)
    (tmp_path / "data" / "notes").mkdir()
    return tmp_path / "data"


@needs_egl
def test_whole_scenes_are_counted(scenes: Path) -> None:
    for places in ([scenes], [scenes / "scn00000", scenes / "scn00001"]):
        told = verified(*places)
        assert (told.exit_code, told.stdout) == (0, "2 of 2 scenes are as they were written\n")


@needs_egl
def test_every_damaged_file_and_a_scene_without_a_manifest_are_named(scenes: Path) -> None:
    changed, missing = (kubric4d.frame_path(scenes / "scn00001", view, "depth", 0) for view in ("view0", "view1"))
    changed.write_bytes(changed.read_bytes()[:-1] + b"x")
    missing.unlink()
    told = verified(scenes)
    assert told.exit_code == DataError.exit_code
    lines = told.stdout.splitlines()
    assert f"{changed} is not as it was written" in lines[0]
    assert f"{missing} cannot be read (No such file or directory)" in lines[1]
    assert lines[2:] == [
        "1 of 2 scenes are as they were written; delete the others and run the line that made them again"
    ]
    assert verified(scenes / "scn00000").exit_code == 0
    (scenes / "scn00000" / MANIFEST).write_text("{")
    assert verified(scenes / "scn00000").exit_code == DataError.exit_code
    (scenes / "scn00000" / MANIFEST).unlink()
    told = verified(scenes)
    assert (told.exit_code, f"{scenes / 'scn00000'} has no {MANIFEST}" in told.stdout) == (DataError.exit_code, True)


def test_folders_without_scenes_are_refused(tmp_path: Path) -> None:
    for place, said in ((tmp_path, "holds no scene"), (tmp_path / "gone", "is no folder")):
        told = verified(place)
        assert told.exit_code == DataError.exit_code
        assert f"{place} {said}" in told.output
