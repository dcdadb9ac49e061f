"""The command line as a user meets it: real arguments in, exit code and one line out."""

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from fakes import HEIGHT, WIDTH, FakeSynthesizer, live_traits, write_tiny
from media import environment, noise
from typer.main import get_command

from gcd_model import ASSUMED_SOURCE, CameraMount, SphericalDelta
from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import spherical_trajectory
from gcd_node.cli import offline as cli_offline
from gcd_node.cli.main import COMMANDS, new_app, run_app
from gcd_node.image_io import write_video

SIZE = (128, 192)  # of the small random model
TINY = "tiny"  # weights of a model that draws class maps
KUBRIC, DRIVING, LIVE = "random:kubric90", "random:driving", "random:live"


@pytest.fixture(autouse=True)
def _runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "runtime"))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return noise(tmp_path / "clip", *SIZE)


@pytest.fixture
def small_clip(tmp_path: Path) -> Path:
    return noise(tmp_path / "small", HEIGHT, WIDTH)


def synthesize(source: Path, weights: Path | str, out: Path, *options: str | Path) -> int:
    arguments = ["synthesize", source, "--weights", weights, "--out", out, "--steps", "1", *options]
    return run_app([str(argument) for argument in arguments])


def last_error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that was said."""
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if "weights are random" not in line]
    assert lines[-1].startswith("error: ")
    assert "Traceback" not in "".join(lines)
    return lines[-1]


# One clip.


def test_synthesize_writes_frames_video_strip_and_arrays_and_says_what_nobody_stated(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    options = ["--azimuth-deg", "20", "--elevation-deg", "-5", "--radius", "1"]
    assert synthesize(clip, KUBRIC, out, *options) == 0
    assert "an elevation of 5 degrees and a radius of 15" in capsys.readouterr().out
    assert len(list((out / "frames").glob("*.png"))) == 14
    assert (out / "view.mp4").stat().st_size > 1000
    assert (out / "strip.png").stat().st_size > 1000
    arrays = np.load(out / "view.npz")
    assert set(arrays) == {"latents"}
    assert (arrays["latents"].shape, arrays["latents"].dtype) == ((1, 14, 4, 16, 24), np.float32)


def test_poses_near_the_sphere_are_taken(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = spherical_trajectory(ASSUMED_SOURCE, SphericalDelta(azimuth_deg=20.0), frames=14, move_time=13)
    np.save(tmp_path / "poses.npy", path.source_from_target.numpy())
    outs = [tmp_path / "angles", tmp_path / "poses"]
    stated = ["--azimuth-deg", "20", "--source-elevation-deg", "5", "--source-radius", "15"]
    for out, options in zip(outs, (stated, ["--poses", str(tmp_path / "poses.npy")]), strict=True):
        assert synthesize(clip, KUBRIC, out, *options) == 0
        assert ("is taken to stand" in capsys.readouterr().out) == (options is not stated)
    angles, poses = (np.load(out / "view.npz")["latents"] for out in outs)
    assert np.abs(angles - poses).max() < 1e-4


def test_synthesize_writes_the_class_map_with_its_meaning_and_where_samples_differ(
    small_clip: Path, tiny: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert synthesize(small_clip, tiny, out, "--samples", "2") == 0
    assert len(list((out / "frames_s1").glob("*.png"))) == 14
    arrays = np.load(out / "view.npz")
    assert arrays["std"].shape == (14, HEIGHT, WIDTH)
    assert arrays["classes"].shape == (2, 14, HEIGHT, WIDTH)
    assert arrays["classes"].dtype == np.uint8
    assert arrays["classes"].max() < len(DRIVING_CLASSES)
    assert arrays["class_ids"].tolist() == list(range(13))
    assert arrays["class_names"].tolist() == [each.name for each in DRIVING_CLASSES]
    assert [tuple(colour) for colour in arrays["class_colours"].tolist()] == [each.colour for each in DRIVING_CLASSES]
    strip = cv2.cvtColor(cv2.imread(str(out / "strip.png")), cv2.COLOR_BGR2RGB)
    third = strip[2 * (HEIGHT + 4) : 2 * (HEIGHT + 4) + HEIGHT, :WIDTH]
    assert np.array_equal(third, arrays["class_colours"][arrays["classes"][0, 0]])
    assert len(strip) > 3 * HEIGHT + 8  # the legend below


@pytest.mark.parametrize(
    ("options", "mount"),
    [
        ([], None),
        (["--mount-height", "2.5", "--mount-tilt", "10"], CameraMount(height_m=2.5, tilt_deg=10.0)),
        (["--hfov-deg", "100", "--mount-height", "2"], CameraMount(hfov_deg=100.0, height_m=2.0)),
    ],
)
def test_the_mount_reaches_clip_and_path(
    options: list[str], mount: CameraMount | None, small_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = FakeSynthesizer(live_traits())
    monkeypatch.setattr(cli_offline, "load_synthesizer", lambda *_, **__: model)
    assert synthesize(small_clip, "fake", tmp_path / "out", *options) == 0
    assert model.clips[0].mount == mount
    wanted = model.traits.plan_view(mount=mount).source_from_target
    assert torch.equal(model.asked[0][0][0].source_from_target, wanted)


def test_a_video_is_cropped_and_its_field_of_view_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "wide.mkv", [np.zeros((2 * WIDTH, 4 * WIDTH, 3), np.uint8)] * 14, 10.0)
    model = FakeSynthesizer(live_traits())
    monkeypatch.setattr(cli_offline, "load_synthesizer", lambda *_, **__: model)
    assert synthesize(tmp_path / "wide.mkv", "fake", tmp_path / "out", "--hfov-deg", "90", "--mount-height", "2") == 0
    mount = model.clips[0].mount
    assert mount is not None
    assert mount.hfov_deg == pytest.approx(2 * np.degrees(np.arctan(0.75)))  # 2:1 became 3:2


@pytest.mark.parametrize(
    ("weights", "options", "code", "reason"),
    [
        (KUBRIC, ["--azimuth-deg", "91"], 64, "[-90, 90]"),
        (DRIVING, ["--azimuth-deg", "5"], 64, "fixed view"),
        (KUBRIC, ["--samples", "0"], 64, "samples"),
        (KUBRIC, ["--poses", "p.npy", "--move-time", "3"], 64, "whole path"),
        (KUBRIC, ["--guidance", "nan", "1.5"], 64, "finite"),
        (KUBRIC, ["--poses", "none.npy"], 66, "none.npy"),
        (KUBRIC, ["--device", "abacus"], 64, "abacus"),
        ("package:none", [], 65, "none"),
        (KUBRIC, ["--family", "driving"], 64, "family"),
        (KUBRIC, ["--mount-height", "1.5"], 64, ""),
        (DRIVING, ["--mount-tilt", "3"], 64, ""),
        (TINY, ["--source-radius", "15", "--mount-left", "0"], 64, ""),
        (LIVE, ["--mount-height", "nan"], 64, ""),
        (LIVE, ["--hfov-deg", "180"], 64, ""),
    ],
)
def test_bad_options_are_one_line_with_cause_and_remedy(
    weights: str,
    options: list[str],
    code: int,
    reason: str,
    clip: Path,
    small_clip: Path,
    tiny: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source, chosen = (small_clip if weights in (TINY, LIVE) else clip), (tiny if weights == TINY else weights)
    assert synthesize(source, chosen, tmp_path / "out", *options) == code
    assert reason in last_error(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["missing.mp4", "junk.mp4", "empty_folder"])
def test_an_input_that_cannot_be_decoded_is_exit_66(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty_folder").mkdir()
    (tmp_path / "junk.mp4").write_bytes(b"this is no picture" * 100)
    assert synthesize(tmp_path / name, DRIVING, tmp_path / "out") == 66
    assert name in last_error(capsys)


def test_a_wrong_checkpoint_is_exit_65(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, content in (("empty.ckpt", b""), ("html.ckpt", b"<html>not found</html>"), ("x.safetensors", b"\0" * 64)):
        (tmp_path / name).write_bytes(content)
        assert synthesize(clip, tmp_path / name, tmp_path / "out") == 65
        assert name in last_error(capsys)
    for file, reason in ((str(tmp_path / "x.safetensors"), "x.safetensors"), ("package:none", "package")):
        assert run_app(["weights", "inspect", file]) == 65
        assert reason in last_error(capsys)


# A node.


def launch_file(folder: Path, weights: Path | str, size: tuple[int, int] = SIZE, **changes: str) -> Path:
    """Of a video of 28 pictures."""
    frames = [np.full((2 * size[0], 2 * size[1], 3), 5 * i, np.uint8) for i in range(28)]
    write_video(folder / "v.mkv", frames, 10.0)
    (folder / "launch.toml").write_text(f"""
        [source]
        path = "{folder}/v.mkv"
        pace = "lockstep"
        {changes.get("source", "")}
        [model]
        weights = "{weights}"
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
    """)
    return folder / "launch.toml"


def test_run_publishes_and_ends_with_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["run", str(launch_file(tmp_path, DRIVING))]) == 0
    told = capsys.readouterr().err
    assert "windows rendered" in told
    assert "noise" in told


def test_view_saves_windows_and_class_maps_of_a_running_node(tiny: Path, tmp_path: Path) -> None:
    settings = launch_file(tmp_path, tiny, (HEIGHT, WIDTH), publish="min_subscribers = 1")
    node = subprocess.Popen([sys.executable, "-m", "gcd_node", "run", str(settings)], stderr=subprocess.DEVNULL)
    try:
        saving = ["--kind", "all", "--save", str(tmp_path / "s"), "--timeout", "60"]
        assert run_app(["view", f"ipc://{tmp_path}/data", "--view", "main", *saving]) == 0
        assert node.wait(30) == 0
    finally:
        node.kill()
    saved = tmp_path / "s" / "main"
    assert len(list(saved.glob("*.png"))) == len(list((saved / "cls").glob("*_*.png"))) == 28
    assert [np.load(path).shape for path in sorted((saved / "cls").glob("*.npy"))] == [(14, HEIGHT, WIDTH)] * 2
    assert (saved / "cls" / "legend.png").exists()


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
    changes: dict[str, str], code: int, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_app(["run", str(launch_file(tmp_path, **{"weights": DRIVING, **changes}))]) == code  # type: ignore[arg-type]
    assert reason in last_error(capsys)


# The program.


def test_usage_errors_are_exit_64(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["synthesize"], ["view", "ipc", "--kind", "cls", "--hatch"], ["no-such-command"]):
        assert run_app(arguments) == 64
    assert "no-such-command" in capsys.readouterr().err


def test_every_command_has_the_help_that_the_list_says_and_the_list_needs_no_torch(
    capsys: pytest.CaptureFixture[str],
) -> None:
    whole = get_command(new_app(COMMANDS)).commands  # type: ignore[attr-defined]
    for name, (_, summary) in COMMANDS.items():
        assert " ".join(str(whole[name].help).split("\n\n")[0].split()) == summary, name
        assert run_app([name, "--help"]) == 0
    capsys.readouterr()
    assert run_app(["export", "--help"]) == 0
    assert "[model] weights" in " ".join(capsys.readouterr().out.split())
    assert run_app(["--version"]) == 0
    assert capsys.readouterr().out == f"gcd-node {version('gcd-node')}\n"
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
    command = [sys.executable, "-c", RANDOM_DEMO]
    threads = environment() | {"OMP_NUM_THREADS": "2"}
    done = subprocess.run(command, cwd=tmp_path, env=threads, capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    assert "noise" in done.stdout
    assert "Shown, from left to right: input" in " ".join(done.stdout.split())
    assert "pictures in the other process" in done.stdout
    for name in ("side_by_side.mp4", "side_by_side.png"):
        assert (tmp_path / "gcd-demo" / name).stat().st_size > 10_000
