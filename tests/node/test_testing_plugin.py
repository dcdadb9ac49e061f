"""The pytest plugin in a robot team's project: golden runs made, kept, missed and renewed."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from runs import SOURCE, parts

import gcd_node.testing  # noqa: F401  loaded before the inner sessions, which put sys.modules back
from gcd_node.replay import compare, lockstep  # noqa: F401  the same
from gcd_node.replay.run import MANIFEST

pytest_plugins = ["pytester"]
pytestmark = pytest.mark.timeout(60)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def project(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A project with a launch file; its replays go through a made-up model."""
    whole = lockstep.replay
    monkeypatch.setattr(lockstep, "replay", lambda config, out: whole(config, out, parts=parts()))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # other plugins would be loaded anew in each session
    launch = f'[source]\n{SOURCE}\n[model]\nweights = "fake"\nsteps = 1\n[view.main]\n'
    pytester.makefile(".toml", launch=launch)
    pytester.makeini("[pytest]\n")
    return pytester


def run_test(project: pytest.Pytester, *options: str, settings: object = None, bounds: str = "") -> pytest.RunResult:
    project.makepyfile(f"""
        def test_drive(gcd_replay):
            gcd_replay("launch.toml", {settings}).assert_same_as("golden/drive"{bounds})
    """)
    return project.runpytest_inprocess("-p", "gcd_node.testing", *options)


def test_a_golden_run_is_asked_for_made_and_then_met(project: pytest.Pytester) -> None:
    result = run_test(project)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*no golden run at *golden/drive: make one with `pytest --gcd-update`*"])
    run_test(project, "--gcd-update").assert_outcomes(passed=1)
    run_test(project).assert_outcomes(passed=1)
    (moved,) = project.path.glob("test_*.py")
    moved.rename(project.mkdir("tests") / moved.name)  # paths are meant from the root of the project
    result = project.runpytest_inprocess("-p", "gcd_node.testing", "--rootdir", str(project.path), "tests")
    result.assert_outcomes(passed=1)


def test_a_run_that_differs_fails_with_causes_and_passes_if_near_enough(project: pytest.Pytester) -> None:
    run_test(project, "--gcd-update")
    result = run_test(project, settings={"model.steps": 3}, bounds=", min_psnr=45.0")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*DIFFERENT: 3 of 3 views are not within 45 dB in every frame",
            "*config model.steps: 1, 3",
            "*first divergence: window 0, view main: *42.11 dB*the same pictures*",
        ]
    )
    run_test(project, settings={"model.steps": 3}, bounds=", min_psnr=40.0").assert_outcomes(passed=1)


def test_settings_are_what_they_are_in_python(project: pytest.Pytester) -> None:
    run_test(project, "--gcd-update")
    same = {"source.kind": "synthetic", "model.guidance": [1.0, 2.0], "node_id": "4"}
    run_test(project, settings=same).assert_outcomes(passed=1)
    run_test(project, settings={"model.stepps": 4}).stdout.fnmatch_lines(["*ConfigError: *`steps`*"])


def test_an_update_makes_a_run_anew_byte_for_byte_and_removes_nothing_else(project: pytest.Pytester) -> None:
    mine = project.path / "golden" / "drive" / "mine.txt"
    mine.parent.mkdir(parents=True)
    mine.touch()
    run_test(project, "--gcd-update").stdout.fnmatch_lines(["*OutputError*no empty folder*"])
    mine.unlink()
    run_test(project, "--gcd-update").assert_outcomes(passed=1)
    inner = project.makepyfile(
        inner="""
        def test_drive(gcd_replay):
            run = gcd_replay("launch.toml")
            (run.folder / "away").symlink_to("nowhere")
            run.assert_same_as("golden/other")
    """
    )
    result = project.runpytest_inprocess("-p", "gcd_node.testing", "--gcd-update", inner)
    result.stdout.fnmatch_lines(["*OutputError*No such file*"])
    first = {path.name: path.read_bytes() for path in mine.parent.rglob("*.*")}
    run_test(project, "--gcd-update")
    assert {path.name: path.read_bytes() for path in mine.parent.rglob("*.*")} == first
    (mine.parent / MANIFEST).write_text("{")
    run_test(project).stdout.fnmatch_lines(["*DamagedRunError*"])
    run_test(project, "--gcd-update", settings={"model.steps": 2}).assert_outcomes(passed=1)
    run_test(project, settings={"model.steps": 2}).assert_outcomes(passed=1)


def test_the_plugin_brings_no_model_into_a_session_that_replays_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import sys

        def test_other(request):
            assert request.config.getoption("--gcd-update") is False
            assert not {"torch", "cv2", "zmq", "gcd_model"} & set(sys.modules)
        """
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "gcd_node.testing", "-p", "no:cacheprovider"]
    alone = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]  # which brings the plugin by itself
    assert project["entry-points"]["pytest11"] == {"gcd_node.testing": "gcd_node.testing"}
    done = subprocess.run(command, cwd=pytester.path, env=alone, capture_output=True, text=True, timeout=50)
    assert done.returncode == 0, done.stdout + done.stderr
