"""The command line as a user meets it: real arguments in, exit code and one line out."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from media import noise
from typer.main import get_command

from gcd_node.cli.main import COMMANDS, new_app, run_app
from gcd_node.image_io import write_video

SIZE = (128, 192)  # of the small random model
KUBRIC = ["--weights", "random:kubric90"]
DRIVING = ["--weights", "random:driving"]
QUICK = ["--steps", "1"]


@pytest.fixture(autouse=True)
def _runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "runtime"))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return noise(tmp_path / "clip", *SIZE)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    frames = [np.full((2 * SIZE[0], 2 * SIZE[1], 3), 5 * i, np.uint8) for i in range(16)]
    write_video(tmp_path / "v.mkv", frames, 10.0)
    return tmp_path / "v.mkv"


def failed(arguments: list[str | Path], code: int, capsys: pytest.CaptureFixture[str]) -> str:
    """Run, expect this exit code and one line that starts with `error:`; gives the line."""
    assert run_app([str(argument) for argument in arguments]) == code
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if "weights are random" not in line]
    assert lines[-1].startswith("error: ")
    assert "Traceback" not in "".join(lines)
    return lines[-1]


def synthesize(source: Path, out: Path, *options: str | Path) -> list[str | Path]:
    return ["synthesize", source, "--out", out, *QUICK, *options]


def launch_file(folder: Path, video_path: Path, **changes: str) -> Path:
    text = f"""
        [source]
        path = "{video_path}"
        pace = "lockstep"
        allow_upscale = true
        {changes.get("source", "")}
        [model]
        weights = "{changes.get("weights", "random:driving")}"
        steps = 1
        [view.main]
        {changes.get("view", "")}
        [publish]
        data = "ipc://{folder}/data"
        status = "ipc://{folder}/status"
        end_delay_ms = 10
        {changes.get("publish", "")}
        [control]
        endpoint = "ipc://{folder}/control"
        {changes.get("more", "")}
    """
    path = folder / "launch.toml"
    path.write_text(text)
    return path


def test_synthesize_writes_frames_video_strip_and_arrays(clip: Path, tmp_path: Path) -> None:
    out, saved = tmp_path / "out", tmp_path / "run.npz"
    options = ["--azimuth-deg", "20", "--elevation-deg", "-5", "--radius", "1", "--save", saved, *KUBRIC]
    assert run_app([str(a) for a in synthesize(clip, out, *options)]) == 0
    assert len(list((out / "frames").glob("*.png"))) == 14
    assert (out / "view.mp4").stat().st_size > 1000
    assert (out / "strip.png").stat().st_size > 1000
    assert not (out / "classes.npz").exists()
    arrays = np.load(saved)
    assert arrays["latents"].shape == (14, 4, 16, 24)
    assert arrays["frames"].shape == (14, *SIZE, 3)
    assert arrays["latents"].dtype == arrays["frames"].dtype == np.float32
    assert 0.0 <= arrays["frames"].min() <= arrays["frames"].max() <= 1.0


def test_what_nobody_stated_of_the_camera_is_said(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app([str(a) for a in synthesize(clip, tmp_path / "out", *KUBRIC)]) == 0
    assert "an elevation of 5 degrees and a radius of 15" in capsys.readouterr().out
    stated = ["--source-elevation-deg", "20", "--source-radius", "15"]
    assert run_app([str(a) for a in synthesize(clip, tmp_path / "stated", *KUBRIC, *stated)]) == 0
    assert "is taken to stand" not in capsys.readouterr().out


def test_several_samples_come_with_a_picture_of_where_they_differ(clip: Path, tmp_path: Path) -> None:
    arguments = synthesize(clip, tmp_path / "out", *KUBRIC, "--samples", "2")
    assert run_app([str(a) for a in arguments]) == 0
    assert (tmp_path / "out" / "uncertainty.png").exists()
    assert len(list((tmp_path / "out" / "frames_s1").glob("*.png"))) == 14


def test_poses_near_the_sphere_are_taken(clip: Path, tmp_path: Path) -> None:
    from gcd_model import ASSUMED_SOURCE, SphericalDelta
    from gcd_model.geometry import spherical_trajectory

    path = spherical_trajectory(ASSUMED_SOURCE, SphericalDelta(azimuth_deg=20.0), frames=14, move_time=13)
    np.save(tmp_path / "poses.npy", path.source_from_target.numpy())
    saved = [tmp_path / "angles.npz", tmp_path / "poses.npz"]
    for file, options in zip(saved, (["--azimuth-deg", "20"], ["--poses", str(tmp_path / "poses.npy")]), strict=True):
        assert run_app([str(a) for a in synthesize(clip, tmp_path / "o", *KUBRIC, *options, "--save", file)]) == 0
    angles, poses = (np.load(file)["latents"] for file in saved)
    assert np.abs(angles - poses).max() < 1e-4


@pytest.mark.parametrize(
    ("options", "code", "reason"),
    [
        ([*KUBRIC, "--azimuth-deg", "91"], 64, "[-90, 90]"),
        ([*DRIVING, "--azimuth-deg", "5"], 64, "fixed view"),
        ([*KUBRIC, "--trajectory", "sideways"], 64, "gradual or direct"),
        ([*KUBRIC, "--samples", "2", "--save", "x.npz"], 64, "one sample"),
        ([*KUBRIC, "--trajectory", "direct", "--move-time", "3"], 64, "give one"),
        ([*KUBRIC, "--guidance", "nan", "1.5"], 64, "finite"),
        ([*KUBRIC, "--poses", "none.npy"], 66, "none.npy"),
        ([*KUBRIC, "--device", "abacus"], 64, "abacus"),
        (["--weights", "package:none"], 65, "none"),
        ([*KUBRIC, "--family", "driving"], 64, "family"),
    ],
)
def test_bad_options_are_one_line_with_cause_and_remedy(
    options: list[str], code: int, reason: str, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reason in failed(synthesize(clip, tmp_path / "out", *options), code, capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["missing.mp4", "junk.mp4", "empty_folder"])
def test_an_input_that_cannot_be_decoded_is_exit_66(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if name == "empty_folder":
        path.mkdir()
    elif name == "junk.mp4":
        path.write_bytes(b"this is no picture" * 100)
    assert name in failed(synthesize(path, tmp_path / "out", *DRIVING), 66, capsys)


def test_a_wrong_checkpoint_is_exit_65(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content in (("empty.ckpt", b""), ("html.ckpt", b"<html>not found</html>"), ("x.safetensors", b"\0" * 64)):
        (tmp_path / name).write_bytes(content)
        line = failed(synthesize(clip, tmp_path / "out", "--weights", tmp_path / name), 65, capsys)
        assert name in line
    assert "x.safetensors" in failed(["weights", "inspect", tmp_path / "x.safetensors"], 65, capsys)
    assert "package" in failed(["weights", "inspect", "package:none"], 65, capsys)


def test_run_publishes_and_ends_with_0(video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["run", str(launch_file(tmp_path, video))]) == 0
    told = capsys.readouterr().err
    assert "window 0" in told
    assert "noise" in told


@pytest.mark.parametrize(
    ("changes", "code", "reason"),
    [
        ({"view": "azimuth_deg = 10.0"}, 64, "fixed view"),
        ({"view": "azimut_deg = 10.0"}, 78, "azimuth_deg"),
        ({"source": "hfov_deg = -1.0"}, 78, "> 0"),
        ({"weights": "random:unheard"}, 78, "unheard"),
    ],
)
def test_a_launch_file_that_asks_for_the_impossible_is_refused(
    changes: dict[str, str], code: int, reason: str, video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reason in failed(["run", launch_file(tmp_path, video, **changes)], code, capsys)


def test_usage_errors_are_exit_64(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["synthesize"]) == 64
    assert run_app(["no-such-command"]) == 64
    assert "no-such-command" in capsys.readouterr().err


def test_every_command_has_help_and_the_program_a_version(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ([], ["run"], ["check"], ["view"], ["demo"], ["synthesize"], ["weights"], ["weights", "inspect"]):
        assert run_app([*command, "--help"]) == 0
    capsys.readouterr()
    assert run_app(["export", "--help"]) == 0
    assert "[model] weights" in " ".join(capsys.readouterr().out.split())
    assert run_app(["--version"]) == 0
    assert capsys.readouterr().out == f"gcd-node {version('gcd-node')}\n"


def test_the_list_of_commands_says_of_each_what_its_help_begins_with_and_needs_no_torch() -> None:
    whole = get_command(new_app(COMMANDS)).commands  # type: ignore[attr-defined]
    for name, (_, summary) in COMMANDS.items():
        assert " ".join(str(whole[name].help).split("\n\n")[0].split()) == summary, name
    listed = "import sys; from gcd_node.cli.main import run_app; run_app(['--help']); assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", listed], capture_output=True, text=True, timeout=60, check=True)
    assert all(name in done.stdout for name in COMMANDS)


RANDOM_DEMO = """
from gcd_node import demo
from gcd_node.cli.main import run_app
demo.WEIGHTS = "random:live"
raise SystemExit(run_app(["demo"]))
"""


def test_the_demo_ends_with_pictures_of_what_arrived_in_the_other_process(tmp_path: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", RANDOM_DEMO],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=110,
    )
    assert done.returncode == 0, done.stderr
    assert "noise" in done.stdout
    assert "Shown, from left to right: input" in " ".join(done.stdout.split())
    assert "pictures in the other process" in done.stdout
    for name in ("side_by_side.mp4", "side_by_side.png"):
        assert (tmp_path / "gcd-demo" / name).stat().st_size > 10_000
