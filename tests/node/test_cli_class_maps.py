"""The command line with a model that draws class maps: a tiny random one, in a real file."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from fakes import FakeSynthesizer, live_traits
from media import noise
from tiny_weights import HEIGHT, WIDTH, write_tiny

from gcd_model import CameraMount
from gcd_model.config import DRIVING_CLASSES
from gcd_node.cli import offline as cli_offline
from gcd_node.cli.main import run_app
from gcd_node.image_io import write_video


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    return noise(tmp_path / "clip", HEIGHT, WIDTH)


def synthesize(source: Path, weights: Path | str, out: Path, *options: str) -> int:
    return run_app(["synthesize", str(source), "--weights", str(weights), "--out", str(out), *options])


def test_synthesize_writes_the_class_map_as_numbers_with_their_meaning_and_shows_it(
    clip: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert synthesize(clip, weights, out, "--samples", "2") == 0
    assert "classes.npz" in capsys.readouterr().out
    arrays = np.load(out / "classes.npz")
    assert arrays["classes"].shape == (2, 14, HEIGHT, WIDTH)
    assert arrays["classes"].dtype == np.uint8
    assert arrays["classes"].max() < len(DRIVING_CLASSES)
    assert arrays["ids"].tolist() == list(range(13))
    assert arrays["names"].tolist() == [each.name for each in DRIVING_CLASSES]
    assert [tuple(colour) for colour in arrays["colours"].tolist()] == [each.colour for each in DRIVING_CLASSES]
    strip = cv2.cvtColor(cv2.imread(str(out / "strip.png")), cv2.COLOR_BGR2RGB)
    third = strip[2 * (HEIGHT + 4) : 2 * (HEIGHT + 4) + HEIGHT, :WIDTH]
    assert np.array_equal(third, arrays["colours"][arrays["classes"][0, 0]])
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
    options: list[str], mount: CameraMount | None, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = FakeSynthesizer(live_traits())
    monkeypatch.setattr(cli_offline, "load_synthesizer", lambda *_, **__: model)
    assert synthesize(clip, "fake", tmp_path / "out", *options) == 0
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
    ("model", "options"),
    [
        ("random:kubric90", ["--mount-height", "1.5"]),
        ("random:driving", ["--mount-tilt", "3"]),
        ("tiny", ["--source-radius", "15", "--mount-left", "0"]),
        ("random:live", ["--mount-height", "nan"]),
        ("random:live", ["--hfov-deg", "180"]),
    ],
)
def test_a_mount_that_cannot_be_is_one_line_and_exit_64(
    model: str, options: list[str], weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = (128, 192) if model in ("random:kubric90", "random:driving") else (HEIGHT, WIDTH)
    chosen = weights if model == "tiny" else model
    assert synthesize(noise(tmp_path / "clip", *size), chosen, tmp_path / "out", *options) == 64
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")
    assert not (tmp_path / "out").exists()


def test_view_saves_windows_and_class_maps_of_a_running_node(weights: Path, tmp_path: Path) -> None:
    video = tmp_path / "v.mkv"
    write_video(video, [np.full((2 * HEIGHT, 2 * WIDTH, 3), 5 * i, np.uint8) for i in range(28)], 10.0)
    settings = tmp_path / "launch.toml"
    settings.write_text(f"""
        [source]
        path = "{video}"
        pace = "lockstep"
        [model]
        weights = "{weights}"
        [view.main]
        [publish]
        data = "ipc://{tmp_path}/data"
        status = "ipc://{tmp_path}/status"
        end_delay_ms = 10
        min_subscribers = 1
        [control]
        endpoint = "ipc://{tmp_path}/control"
    """)
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


def test_hatching_is_for_windows_alone() -> None:
    assert run_app(["view", "ipc", "--kind", "cls", "--hatch"]) == 64
