"""Downloaded scenes in the compact layout: alike, whole or not there, damage told in one line a scene."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_scenes4d import CAMERAS, VIEWS, write_driving, write_kubric
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.data.compact import Compaction
from gcd_train.data.encodings import DepthCode
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.errors import DataError


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("source")
    write_kubric(root / "kubric", 3, 7, frames=2)
    write_driving(root / "driving", 5, frames=2)
    return root


def packed(source: Path, out: Path, *options: str) -> tuple[int, list[str]]:
    cameras = [word for name in (VIEWS if "kubric" in source.name else CAMERAS) for word in ("--camera", name)]
    result = CliRunner().invoke(app, ["data", "compact", str(source), str(out), *cameras, *options])
    return result.exit_code, [
        line for line in result.output.splitlines() if line.startswith(("scn", "scene_", "scenes:"))
    ]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_kubric_scenes_are_read_as_before_and_packed_once(source: Path, tmp_path: Path) -> None:
    code, lines = packed(source / "kubric", tmp_path)
    assert (code, lines[-1][:16]) == (0, "scenes: 2 packed")
    each = [Kubric4D(root, cameras=VIEWS, instances=True) for root in (source / "kubric", tmp_path)]
    assert each[0].scenes == each[1].scenes
    before, after = (of.views("scn00007", 1) for of in each)
    for view, same in zip(before, after, strict=True):
        assert np.abs(view.rgb.astype(int) - same.rgb).mean() < 12
        np.testing.assert_allclose(same.depth, view.depth, rtol=6e-4)
        assert view.instances is not None
        assert same.instances is not None
        assert np.array_equal(view.instances, same.instances)
        assert np.array_equal(view.world_from_camera, same.world_from_camera)
    there = files(tmp_path)
    assert {Path(name).suffix for name in there} == {".json", ".webp", ".png"}
    assert packed(source / "kubric", tmp_path) == (0, ["scenes: 0 packed; 2 there already; 0 damaged"])
    assert files(tmp_path) == there
    code, lines = packed(tmp_path, tmp_path.with_name("kubric-twice"))
    assert (code, all("compact already" in line for line in lines[:2])) == (66, True)


def test_driving_scenes_keep_classes_and_instances_of_two_bytes(source: Path, tmp_path: Path) -> None:
    code, lines = packed(source / "driving", tmp_path)
    assert code == 0, lines
    sets = [ParallelDomain4D(root, cameras=CAMERAS, instances=True) for root in (source / "driving", tmp_path)]
    most = 0
    for view, same in zip(*(of.views("scene_000005", 1) for of in sets), strict=True):
        assert view.classes is not None
        assert view.instances is not None
        most = max(most, int(view.instances.max()))
        assert same.classes is not None
        assert same.instances is not None
        assert np.array_equal(view.classes, same.classes)
        assert np.array_equal(view.instances, same.instances)
        assert (np.abs(same.depth / view.depth - 1) <= 0.0013 * (1 + view.depth / 20)).all()
    assert most == 44 + 256


def test_a_damaged_scene_is_one_line_and_the_next_line_packs_it(source: Path, tmp_path: Path) -> None:
    kubric = tmp_path / "kubric"
    shutil.copytree(source / "kubric", kubric)
    scene = kubric / "scn00003"
    depth, colour = scene / "frames_p0_v2" / "depth_00001.tiff", scene / "frames_p0_v1" / "rgba_00000.png"
    whole = depth.read_bytes()
    depth.write_bytes(whole[:50])
    colour.unlink()
    code, lines = packed(kubric, tmp_path / "out")
    assert (code, len(lines)) == (66, 2)
    assert lines[0].startswith(f"scn00003: 1 views lack a file and 1 are damaged; download them again. First: {colour}")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["scn00007"]
    assert packed(kubric, tmp_path / "out", "--gaps")[0] == 66
    depth.write_bytes(whole)
    assert "or give --gaps" in packed(kubric, tmp_path / "out")[1][0]
    code, lines = packed(kubric, tmp_path / "out", "--gaps")
    assert (code, lines[0]) == (0, "scn00003: packed without 1 views that are missing")
    shutil.rmtree(scene / "frames_p0_v0")
    (scene / "scn00003_p0_v0.json").unlink()
    assert packed(kubric, tmp_path / "other")[1][0].startswith("scn00003: ")


def test_what_comes_out_otherwise_is_not_there(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exact = DepthCode.encode

    def farther(code: DepthCode, metres: NDArray[np.float32]) -> NDArray[np.uint16]:
        return exact(code, metres * np.float32(1.01))

    monkeypatch.setattr(DepthCode, "encode", farther)
    with pytest.raises(DataError, match="view0 at frame 0: its depth came out"):
        Compaction.of(source / "kubric", tmp_path, cameras=VIEWS)("scn00003")
    assert list(tmp_path.iterdir()) == []
