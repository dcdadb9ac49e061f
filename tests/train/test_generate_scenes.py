"""Scenes on disk: whole or not there, continued, checked; and the command that makes them."""

import os
import pickle
import re
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from box_world import box_scene, box_world, checked, odd_box_scene
from headless import drawn, needs_egl
from typer.testing import CliRunner

from gcd_train.cli.main import app
from gcd_train.data import kubric4d
from gcd_train.data.files import GEOMETRY, MANIFEST, SceneFiles, read_manifest
from gcd_train.errors import DataError, RecipeError, RenderError, RunError
from gcd_train.files import new_folder, remove_leftovers
from gcd_train.scenes import scene_writer
from gcd_train.scenes.description import Scene
from gcd_train.scenes.renderer import Renderer
from gcd_train.scenes.scene_writer import GIVE_UP_AFTER, generate_scenes, write_scene
from gcd_train.scenes.triangles import FrozenScene
from gcd_train.scenes.worlds import SCENE_WORLDS, SceneFormat

FORM = SceneFormat(width=48, height=32, frames=2, oversample=1)


def inside(root: Path) -> list[str]:
    return sorted(os.listdir(root))


class TestNewFolder:
    def test_a_scene_appears_at_the_end(self, tmp_path: Path) -> None:
        root = tmp_path / "new" / "data"
        with new_folder(root, "scn00001") as folder:
            (folder / "a").write_bytes(b"1")
            assert folder.name == "scn00001"
            assert not (root / "scn00001").exists()
            assert all(name.startswith(".") for name in inside(root))
        assert inside(root) == ["scn00001"]
        assert (root / "scn00001" / "a").read_bytes() == b"1"

    @pytest.mark.parametrize("error", [DataError, SystemExit, KeyboardInterrupt])
    def test_a_failure_leaves_nothing(self, tmp_path: Path, error: type[BaseException]) -> None:
        def broken() -> None:
            with new_folder(tmp_path, "scn00001") as folder:
                (folder / "a").write_bytes(b"1")
                raise error("broken")

        with pytest.raises(error, match="broken"):
            broken()
        assert inside(tmp_path) == []

    def test_the_first_of_two_stays(self, tmp_path: Path) -> None:
        with new_folder(tmp_path, "scn00001") as slow:
            (slow / "a").write_bytes(b"slow")
            with new_folder(tmp_path, "scn00001") as fast:
                (fast / "a").write_bytes(b"fast")
        assert inside(tmp_path) == ["scn00001"]
        assert (tmp_path / "scn00001" / "a").read_bytes() == b"fast"

    @pytest.mark.parametrize(("root", "taken"), [(".", "scn00001"), ("data", "data")])
    def test_a_file_in_the_way_is_named(self, root: str, taken: str, tmp_path: Path) -> None:
        (tmp_path / taken).write_text("notes")
        with (
            pytest.raises(RunError, match=f"{taken} (is in the way|cannot be written)"),
            new_folder(tmp_path / root, "scn00001") as folder,
        ):
            (folder / "a").write_bytes(b"1")
        assert (tmp_path / taken).read_text() == "notes"

    def test_what_others_are_making_is_no_leftover(self, tmp_path: Path) -> None:
        with new_folder(tmp_path, "scn00001") as folder:
            (folder / "a").write_bytes(b"1")
            assert remove_leftovers(tmp_path) == 0
        assert inside(tmp_path) == ["scn00001"]

    def test_what_a_killed_process_left_is_removed(self, tmp_path: Path) -> None:
        code = (
            "import os, sys; from pathlib import Path; from gcd_train.files import new_folder\n"
            "with new_folder(Path(sys.argv[1]), 'scn00001') as folder:\n"
            "    (folder / 'a').write_bytes(b'1'); os.kill(os.getpid(), 9)\n"
        )
        killed = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
        assert killed.returncode == -signal.SIGKILL
        assert len(inside(tmp_path)) == 1
        assert inside(tmp_path)[0].startswith(".scn00001.")
        assert remove_leftovers(tmp_path, "scn00002") == 0
        assert remove_leftovers(tmp_path) == 1
        assert inside(tmp_path) == []


def test_without_opengl_nothing_is_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_opengl() -> None:
        raise RenderError("no headless OpenGL")

    def simulated(seed: int, frames: int) -> Scene:
        raise AssertionError("simulated for nothing")

    monkeypatch.setattr(scene_writer, "require_drawing", no_opengl)
    with pytest.raises(RenderError, match="no headless OpenGL"):
        write_scene(tmp_path, box_world(simulated), FORM, 0)
    assert inside(tmp_path) == []


@needs_egl
class TestWriteScene:
    def test_a_scene_is_whole_and_knows_its_checksums(self, tmp_path: Path) -> None:
        made = write_scene(tmp_path, box_world(), FORM, 3)
        assert made.made
        assert made.folder == tmp_path / "scn00003"
        manifest = checked(made.folder)
        assert (manifest.world, manifest.seed, manifest.layout, manifest.frames) == ("boxes", 3, "kubric4d", 2)
        assert manifest.cameras == ("view0", "view1")
        assert manifest.facts == {"seed": 3}
        files = {path.relative_to(made.folder).as_posix() for path in made.folder.rglob("*") if path.is_file()}
        assert files == set(manifest.files) | {MANIFEST}
        assert len(files) == 2 * 2 * 3 + 2 + 2  # views, frames, layers; metadata; geometry and manifest
        assert made.size == sum((made.folder / name).stat().st_size for name in files)

    def test_pictures_are_those_of_the_renderer_and_of_the_kept_geometry(self, tmp_path: Path) -> None:
        folder, cameras = write_scene(tmp_path, box_world(), FORM, 0).folder, box_scene(0, 2).cameras
        picture = drawn(box_scene(0, 2), 48, 32)["view1"]
        with Renderer(48, 32, oversample=1) as renderer:
            again = [view for _, _, view in renderer.views(FrozenScene.load(folder / GEOMETRY), cameras)][-1]
        rgba = cv2.imread(str(kubric4d.frame_path(folder, "view1", "rgba", 1)), cv2.IMREAD_UNCHANGED)
        assert rgba is not None
        np.testing.assert_array_equal(rgba[..., 2::-1], picture.rgb[1])
        np.testing.assert_array_equal(again.rgb, picture.rgb[1])
        assert {0, 4, 9} == set(np.unique(picture.instances[1]).tolist()), "the picture shows ground, both boxes"

    def test_a_scene_that_is_there_is_kept_and_one_of_another_kind_refused(self, tmp_path: Path) -> None:
        manifest = write_scene(tmp_path, box_world(), FORM, 0).folder / MANIFEST
        before = manifest.stat().st_mtime_ns
        assert not write_scene(tmp_path, box_world(), FORM, 0).made
        assert manifest.stat().st_mtime_ns == before
        with pytest.raises(DataError, match="with compact False, wanted True; choose another folder"):
            write_scene(tmp_path, box_world(), replace(FORM, compact=True), 0)
        newer = msgspec.structs.replace(read_manifest(manifest.parent), edition=2)
        manifest.write_bytes(msgspec.json.encode(newer))
        with pytest.raises(DataError, match="edition 2, wanted 1"):
            write_scene(tmp_path, box_world(), FORM, 0)

    def test_a_folder_of_something_else_is_left_alone(self, tmp_path: Path) -> None:
        (tmp_path / "scn00000").mkdir()
        (tmp_path / "scn00000" / "mine").write_text("precious")
        with pytest.raises(DataError, match="has no gcd-manifest"):
            write_scene(tmp_path, box_world(), FORM, 0)
        assert (tmp_path / "scn00000" / "mine").read_text() == "precious"

    def test_a_file_size_limit_leaves_what_was_finished_and_nothing_half_done(self, tmp_path: Path) -> None:
        """The kernel refuses the sixth kibibyte of any file: what a quota or a full disk does, for real."""
        write_scene(tmp_path, box_world(), FORM, 1)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (5120, before[1]))
            *_, last = generate_scenes(tmp_path, box_world(), FORM, range(2))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            signal.signal(signal.SIGXFSZ, handler)
        assert (last.written, last.there, list(last.failures)) == (0, 1, [0])
        assert "File too large" in last.failures[0]
        assert re.search(r"scn00000/(frames_p0_v\d/\w+_0000\d\.\w+|geometry\.npz)", last.failures[0])
        assert inside(tmp_path) == ["scn00001"]
        checked(tmp_path / "scn00001")


@needs_egl
class TestRuns:
    def test_failures_are_counted_and_end_nothing(self, tmp_path: Path) -> None:
        *_, last = generate_scenes(tmp_path, box_world(odd_box_scene), FORM, range(4))
        assert (last.written, last.there, last.done, last.gave_up) == (2, 0, 4, False)
        assert last.failures == {1: "seed 1 is odd", 3: "seed 3 is odd"}
        assert last.exit_code == DataError.exit_code
        assert inside(tmp_path) == ["scn00000", "scn00002"]
        assert "2 written" in last.lines()[0]
        assert last.lines()[1] == "  seed 1: seed 1 is odd"

    def test_a_run_in_which_everything_fails_stops(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def full(self: SceneFiles, path: Path, data: bytes) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(SceneFiles, "write", full)
        *_, last = generate_scenes(tmp_path, box_world(), FORM, range(1000))
        assert (last.done, last.gave_up) == (GIVE_UP_AFTER, True)
        assert "gave up" in last.lines()[-1]

    def test_what_a_killed_run_left_is_removed_and_the_run_goes_on(self, tmp_path: Path) -> None:
        """What a kill leaves, and that it is not what another process is making: see TestNewFolder."""
        write_scene(tmp_path, box_world(), FORM, 0)
        half = tmp_path / ".scn00001.0123456789ab.partial"
        (half / "scn00001").mkdir(parents=True)
        (half / "lock").touch()
        *_, last = generate_scenes(tmp_path, box_world(), FORM, range(3))
        assert (last.written, last.there) == (2, 1)
        assert inside(tmp_path) == ["scn00000", "scn00001", "scn00002"]
        for name in inside(tmp_path):
            checked(tmp_path / name)


SMALL = ["--width", "48", "--height", "32", "--frames", "2", "--oversample", "1", "--workers", "1"]


@needs_egl
class TestCommand:
    def test_driving_scenes(self, tmp_path: Path) -> None:
        line = [*f"generate driving {tmp_path / 'data'} --scenes 1 --compact --first-seed 5".split(), *SMALL]
        made = CliRunner().invoke(app, line)
        assert made.exit_code == 0, made.output
        assert "1 written" in made.output
        assert inside(tmp_path / "data") == ["scene_000005"]
        manifest = checked(tmp_path / "data" / "scene_000005")
        assert len(manifest.cameras) == 19
        assert len(manifest.world_from_vehicle or ()) == 2
        again = CliRunner().invoke(app, line)
        assert again.exit_code == 0
        assert "0 written; 1 there already; 0 failed" in again.output
        other = CliRunner().invoke(app, ["generate", "driving", str(tmp_path / "data"), "--first-seed", "5", *SMALL])
        assert other.exit_code == DataError.exit_code
        assert "seed 5" in other.output
        assert "choose another folder" in other.output

    @pytest.mark.parametrize("world", ["drop", "tabletop"])
    def test_scenes_on_a_stage(self, tmp_path: Path, world: str) -> None:
        pytest.importorskip("mujoco", reason="needs the extra `scenes`")
        made = CliRunner().invoke(app, ["generate", world, str(tmp_path), "--first-seed", "7", "--compact", *SMALL])
        assert made.exit_code == 0, made.output
        manifest = checked(tmp_path / "scn00007")
        assert (manifest.world, len(manifest.cameras)) == (world, 16)
        assert manifest.facts.get("arm") == (None if world == "drop" else "primitive")
        told = msgspec.json.decode(kubric4d.metadata_path(tmp_path / "scn00007", "view4").read_bytes())
        assert len(told["instances"]) == told["scene"]["num_instances"] > 0
        assert "bboxes_3d" not in told["instances"][0]

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (["data", "--out", "data"], "give one folder"),
            ([], "give one folder"),
            (["data", "--clips", "2", "--scenes", "2"], "give one"),
            (["data", "--pairs", "--compact"], "give one"),
        ],
    )
    @pytest.mark.parametrize("world", ["driving", "drop", "tabletop"])
    def test_contradictions_are_refused(self, tmp_path: Path, world: str, options: list[str], said: str) -> None:
        options = [str(tmp_path / "data") if option == "data" else option for option in options]
        made = CliRunner().invoke(app, ["generate", world, *options])
        assert made.exit_code == RecipeError.exit_code
        assert said in made.output
        assert inside(tmp_path) == []


@pytest.mark.parametrize("name", SCENE_WORLDS)
def test_every_world_reaches_a_worker(name: str) -> None:
    assert pickle.loads(pickle.dumps(SCENE_WORLDS[name])) == SCENE_WORLDS[name]
