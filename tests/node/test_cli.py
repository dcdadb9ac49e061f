"""The command line as a user meets it: real arguments in, exit code and one line out."""

import json
import math
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cameras import environment, noise
from fakes import HEIGHT, WIDTH, FakeSynthesizer, live_traits, traits, write_tiny
from typer.main import get_command

from gcd_model import CameraMount, Clip, OptionError, SphericalDelta
from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import spherical_trajectory
from gcd_model.traits import ASSUMED_SOURCE
from gcd_node.cli import offline as cli_offline
from gcd_node.cli.bench import Arrival, view_figures
from gcd_node.cli.main import COMMANDS, new_app, run_app
from gcd_node.errors import NodeError, TooShortError, UsageError
from gcd_node.image_io import write_png, write_video
from gcd_node.offline import ClipRequest, read_clip

SIZE = (128, 192)  # of the small random model
TINY = "tiny"  # weights of a model that draws class maps
Capture = pytest.CaptureFixture[str]
KUBRIC, DRIVING, LIVE = "random:kubric90", "random:driving", "random:live"


@pytest.fixture(autouse=True)
def _runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "runtime"))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return noise(tmp_path / "clip", HEIGHT, WIDTH)


def synthesize(source: Path, weights: Path | str, out: Path, *options: str | Path) -> int:
    arguments = ["synthesize", source, "--weights", weights, "--out", out, "--steps", "1", *options]
    return run_app([str(argument) for argument in arguments])


def last_error(capsys: Capture) -> str:
    """The one line that was said."""
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if "weights are random" not in line]
    assert lines[-1].startswith("error: ")
    assert "Traceback" not in "".join(lines)
    return lines[-1]


# One clip.


def test_synthesize_writes_all_it_drew_says_what_nobody_stated_and_takes_poses_near_the_sphere(
    clip: Path, tmp_path: Path, capsys: Capture
) -> None:
    path = spherical_trajectory(ASSUMED_SOURCE, SphericalDelta(azimuth_deg=20.0), frames=14, move_time=13)
    np.save(tmp_path / "poses.npy", path.source_from_target.numpy())
    size, latents = ["--height", str(HEIGHT), "--width", str(WIDTH)], []
    stated = ["--azimuth-deg", "20", "--source-elevation-deg", "5", "--source-radius", "15"]
    for name, options in (("angles", stated), ("poses", ["--poses", str(tmp_path / "poses.npy")])):
        out = tmp_path / name
        assert synthesize(clip, KUBRIC, out, *options, *size) == 0
        assert ("an elevation of 5 degrees and a radius of 15" in capsys.readouterr().out) == (options is not stated)
        assert len(list((out / "frames").glob("*.png"))) == 14
        assert min((out / file).stat().st_size for file in ("view.mp4", "strip.png")) > 1000
        arrays = np.load(out / "view.npz")
        assert set(arrays) == {"latents"}
        latents.append(arrays["latents"])
    assert (latents[0].shape, latents[0].dtype) == ((1, 14, 4, HEIGHT // 8, WIDTH // 8), np.float32)
    assert np.abs(latents[0] - latents[1]).max() < 1e-4


def test_synthesize_writes_class_maps_and_where_samples_differ(clip: Path, tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert synthesize(clip, tiny, out, "--samples", "2") == 0
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


def test_the_mount_reaches_clip_and_path_with_the_field_of_view_that_is_left_of_a_cropped_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = FakeSynthesizer(live_traits())
    monkeypatch.setattr(cli_offline, "load_synthesizer", lambda *_, **__: model)
    write_video(tmp_path / "wide.mkv", [np.zeros((2 * WIDTH, 4 * WIDTH, 3), np.uint8)] * 14, 10.0)
    assumed, stated = (
        2 * math.degrees(math.atan(0.75 * math.tan(math.radians(each)))) for each in (42.5, 45)
    )  # 2:1 became 3:2
    for options, mount in (
        ([], None),
        (["--mount-height", "2.5", "--mount-tilt", "10"], CameraMount(hfov_deg=assumed, height_m=2.5, tilt_deg=10.0)),
        (["--hfov-deg", "90", "--mount-height", "2"], CameraMount(hfov_deg=stated, height_m=2.0)),
    ):
        assert synthesize(tmp_path / "wide.mkv", "fake", tmp_path / f"{len(model.clips)}", *options) == 0
        assert model.clips[-1].mount == mount
        wanted = model.traits.plan_view(mount=mount).source_from_target
        assert torch.equal(model.asked[-1][0][0].source_from_target, wanted)


@pytest.mark.parametrize(
    ("weights", "options", "code", "reason"),
    [
        (KUBRIC, ["--azimuth-deg", "91"], 64, "[-90, 90]"),
        (DRIVING, ["--azimuth-deg", "5"], 64, ""),
        (KUBRIC, ["--poses", "p.npy", "--move-time", "3"], 64, ""),
        (KUBRIC, ["--poses", "none.npy"], 66, "none.npy"),
        (KUBRIC, ["--device", "abacus"], 64, "abacus"),
        ("empty.ckpt", [], 65, "empty.ckpt"),
        ("html.ckpt", [], 65, "html.ckpt"),
        ("zeros.safetensors", [], 65, "zeros.safetensors"),
        (KUBRIC, ["--mount-height", "1.5"], 64, ""),
        (DRIVING, ["--mount-tilt", "3"], 64, ""),
        (TINY, ["--source-radius", "15", "--mount-left", "0"], 64, ""),
        (LIVE, ["--hfov-deg", "180"], 64, ""),
    ],
)
def test_bad_options_are_one_line_with_cause_and_remedy(
    weights: str, options: list[str], code: int, reason: str, tiny: Path, tmp_path: Path, capsys: Capture
) -> None:
    contents = {"empty.ckpt": b"", "html.ckpt": b"<html>not found</html>", "zeros.safetensors": bytes(64)}
    if weights in contents:
        (tmp_path / weights).write_bytes(contents[weights])
    clip = noise(tmp_path / "clip", *((HEIGHT, WIDTH) if weights in (TINY, LIVE) else SIZE))
    chosen = tiny if weights == TINY else tmp_path / weights if weights in contents else weights
    assert synthesize(clip, chosen, tmp_path / "out", *options) == code
    assert reason in last_error(capsys)
    (tmp_path / "junk.mp4").write_bytes(b"this is no picture" * 100)
    (tmp_path / "empty_folder").mkdir()
    for name in ("missing.mp4", "junk.mp4", "empty_folder") if code == 66 else ():
        assert synthesize(tmp_path / name, DRIVING, tmp_path / "out") == 66
        assert name in last_error(capsys)
    assert not (tmp_path / "out").exists()
    if code == 65:
        assert run_app(["weights", "inspect", str(chosen)]) == 65


# The program.


def test_every_command_has_the_help_of_the_list_which_needs_no_torch(capsys: Capture) -> None:
    whole = get_command(new_app(COMMANDS)).commands  # type: ignore[attr-defined]
    for name, (_, summary) in COMMANDS.items():
        assert " ".join(str(whole[name].help).split("\n\n")[0].split()) == summary, name
        assert run_app([name, "--help"]) == 0
    for arguments in (["synthesize"], ["view", "ipc", "--kind", "cls", "--hatch"], ["no-such-command"]):
        assert run_app(arguments) == 64
    capsys.readouterr()
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


@pytest.mark.slow
def test_the_demo_ends_with_pictures_of_what_arrived_in_the_other_process(tmp_path: Path) -> None:
    command = [sys.executable, "-c", RANDOM_DEMO]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=110)
    assert done.returncode == 0, done.stderr
    for name in ("side_by_side.mp4", "side_by_side.png"):
        assert (tmp_path / "gcd-demo" / name).stat().st_size > 10_000


# The bench counts right and reads a real node; how fast this machine is, no test says.


def arrivals(*views: tuple[int, int, range]) -> list[Arrival]:
    """Of (arrival in ms, age in ms, sequence numbers)."""
    return [Arrival(at_ns=at_ms * 1_000_000, age_ms=age_ms, seqs=tuple(seqs)) for at_ms, age_ms, seqs in views]


def named(views: dict[str, list[Arrival]], *names: str) -> list[float]:
    figures = {name.partition(".")[2]: value for name, value in view_figures(views).items()}
    return [figures[name] for name in names]


def test_a_frame_is_answered_once_every_view_has_it_and_a_lost_window_misses_as_many() -> None:
    windows = arrivals((1000, 500, range(14)), (2400, 700, range(14, 28)), (5200, 600, range(42, 56)))
    names = ("NUM_FRAMES_SENT", "NUM_MISSED_FRAMES", "MEAN_FRAME_RATE", "P95_LATENCY", "MAX_JITTER")
    assert named({"top": windows}, *names) == pytest.approx([56, 14, 28 / 4.2, 700, 1400])
    top = arrivals(*((100 * seq, 80, range(seq, seq + 1)) for seq in range(10)))
    side = arrivals(*((100 * seq + 50, 120, range(seq, seq + 1)) for seq in range(1, 10) if seq != 5))
    counted = named({"top": top, "side": side}, "NUM_FRAMES_SENT", "NUM_MISSED_FRAMES", "NUM_VIEWS", "MAX_LATENCY")
    assert counted == [9, 1, 18, 120]
    with pytest.raises(NodeError, match="--seconds"):
        view_figures({"top": top, "side": side[:2]})


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_real_node_is_measured_under_the_published_names(tmp_path: Path) -> None:
    launch = tmp_path / "launch.toml"
    launch.write_text(f'[source]\nkind = "synthetic"\n[model]\nweights = "{write_tiny(tmp_path)}"\n[view.top]\n')
    out = tmp_path / "bench.json"
    options = ["--set", "model.threads=1", "--seconds", "12", "--json", str(out)]
    assert run_app(["bench", str(launch), "--rate", "50", *options]) == 0
    figures = json.loads(out.read_text())
    assert figures["metadata"]["BenchmarkMetadata.INPUT_DATA_PATH"] == "synthetic"
    for run in (figures, figures["50.0fps"]):
        assert run["BasicPerformanceMetrics.NUM_FRAMES_SENT"] >= 42
        assert run["BasicPerformanceMetrics.MEAN_FRAME_RATE"] > 0
        assert 0 < run["GcdNodeMetrics.P50_LATENCY"] <= run["BasicPerformanceMetrics.MAX_LATENCY"]
        assert run["BasicPerformanceMetrics.MEAN_JITTER"] >= 0
        assert 0 <= run["ResourceMetrics.MEAN_OVERALL_CPU_UTILIZATION"] <= 100
        assert run["GcdNodeMetrics.PEAK_MEMORY"] > 100
        assert run["GcdNodeMetrics.FIRST_VIEW"] > 0
    assert figures["BasicPerformanceMetrics.NUM_MISSED_FRAMES"] == 0  # in lockstep
    for source, code in (('kind = "v4l2"', 64), ('path = "none.mp4"', 70)):
        launch.write_text(f'[source]\n{source}\n[model]\nweights = "random:kubric90"\n[view.top]\n')
        assert run_app(["bench", str(launch)]) == code


# Clips from files.


def numbered(count: int, height: int = 2 * HEIGHT, width: int = 2 * WIDTH) -> list[np.ndarray]:
    return [np.full((height, width, 3), 10 * i % 250, np.uint8) for i in range(count)]


@pytest.fixture
def video(tmp_path: Path) -> Path:
    write_video(tmp_path / "v.mkv", numbered(24), 24.0)
    return tmp_path / "v.mkv"


def read(path: Path, family: str = "kubric90", **request: object) -> Clip:
    return read_clip(path, ClipRequest(**request), traits(family))  # type: ignore[arg-type]


def levels(clip: Clip) -> list[int]:
    return [round((float(frame[0, 0, 0]) + 1) * 127.5) for frame in clip.video]


def test_a_video_goes_to_the_size_and_the_range_of_the_model(video: Path, caplog: pytest.LogCaptureFixture) -> None:
    clip = read(video)
    assert clip.video.shape == (14, 3, HEIGHT, WIDTH)
    assert levels(clip) == [10 * i for i in range(14)]
    assert clip.video[1].unique().tolist() == pytest.approx([10 / 127.5 - 1])
    assert (clip.fps, read(video, fps=7.5).fps) == (24.0, 7.5)  # the label is what the user says
    assert read(video, "driving").fps == 24.0  # and a foreign rate is kept and said
    assert "24 frames per second" in caplog.text
    assert read(video, height=2 * HEIGHT, width=2 * WIDTH).video.shape == (14, 3, 2 * HEIGHT, 2 * WIDTH)
    for size, error in (({"height": HEIGHT + 1, "width": WIDTH}, OptionError), ({"height": HEIGHT}, UsageError)):
        with pytest.raises(error):
            read(video, **size)


def test_start_and_stride_count_frames_of_the_input_and_too_few_is_an_error_with_the_count(video: Path) -> None:
    assert levels(read(video, start=5)) == [10 * i for i in range(5, 19)]
    for options, found in (({"stride": 2}, 12), ({"start": 500}, 0)):
        with pytest.raises(TooShortError, match=f"n={found}"):
            read(video, **options)
    write_video(video, numbered(41), 24.0)
    clip = read(video, start=1, stride=3)
    assert (levels(clip), clip.fps) == ([10 * i % 250 for i in range(1, 41, 3)], 8.0)
    write_png(video.parent / "s.png", numbered(5)[4])  # a still is repeated, a folder read in order
    still = read(video.parent / "s.png")
    assert (levels(still), still.fps) == ([40] * 14, 12.0)
    for index, picture in enumerate(numbered(15)):
        write_png(video.parent / "folder" / f"{index}.png", picture)
    assert levels(read(video.parent / "folder", start=1)) == [10 * i for i in range(1, 15)]
