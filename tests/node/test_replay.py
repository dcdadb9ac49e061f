"""Replays: what a run holds, that it comes out the same again, and that half a run is never taken for one."""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
import zmq
from fakes import HEIGHT, WIDTH, FakeSource, FakeSynthesizer, fake_maps, painting_traits, traits
from media import ramp, write_video
from runs import FRAMES, WINDOWS, LevelModel, copied, launch, made_run, nan_model, parts

from gcd_node.cli.main import run_app
from gcd_node.config import parse_config
from gcd_node.config_dump import config_digest
from gcd_node.encoded_frames import window_seed
from gcd_node.errors import (
    ConfigError,
    DamagedRunError,
    ModelFailedError,
    NodeError,
    OutputError,
    SourceError,
    TooShortError,
)
from gcd_node.frame import Frame
from gcd_node.inference import WindowReport
from gcd_node.replay.lockstep import digest_of, lockstep_config, replay
from gcd_node.replay.run import (
    MANIFEST,
    PixelReader,
    PixelWriter,
    RunFolder,
    check_pixels,
    encode_manifest,
    new_folder,
    open_run,
    parse_manifest,
    pixel_digest,
    read_windows,
)

pytestmark = pytest.mark.timeout(60)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """With class maps. Tests that damage it damage a copy."""
    return made_run(tmp_path_factory.mktemp("run") / "run", LevelModel(painting_traits()), FakeSource(42, fps=10.0))


def hashes(folder: Path) -> list[dict[str, str]]:
    windows = open_run(folder).manifest.windows
    return [{view_id: view.sha256["win"] for view_id, view in window.views.items()} for window in windows]


# Laws.


@pytest.mark.timeout(110)
def test_a_real_model_replayed_twice_gives_the_same_hashes_whatever_the_pace(tmp_path: Path) -> None:
    text = '[source]\nkind = "synthetic"\nframes = 14\npace = "realtime"\n'
    text += '[model]\nweights = "random:driving"\nsteps = 1\nthreads = 1\n[view.main]\n[publish]\nencoding = "jpeg"\n'
    (tmp_path / "launch.toml").write_text(text)
    order = ["replay", str(tmp_path / "launch.toml"), "--out"]
    assert run_app([*order, str(tmp_path / "a")]) == 0
    assert run_app([*order, str(tmp_path / "b"), "--set", "source.pace=lockstep"]) == 0
    assert hashes(tmp_path / "a") == hashes(tmp_path / "b")
    assert run_app(["diff", str(tmp_path / "a"), str(tmp_path / "b")]) == 0


def test_what_is_on_disk_is_what_the_model_drew(run: RunFolder) -> None:
    for index, window in enumerate(read_windows(run)):
        levels = [20 + seq % 200 for seq in range(FRAMES * index, FRAMES * (index + 1))]
        wanted = np.repeat(np.array(levels, np.uint8), HEIGHT * WIDTH * 3).reshape(FRAMES, HEIGHT, WIDTH, 3)
        assert np.array_equal(window.views["main"]["win"], wanted)
        assert pixel_digest(wanted) == window.entry.views["main"].sha256["win"] == window.entry.input_sha256
        columns = (np.arange(FRAMES)[:, None] + np.arange(WIDTH)) % len(run.manifest.classes)
        assert np.array_equal(window.views["main"]["cls"], np.repeat(columns[:, None], HEIGHT, axis=1))


def test_visibility_and_depth_are_on_disk_to_the_bit(tmp_path: Path) -> None:
    model = LevelModel(traits(), holds=("visibility", "inverse_depth"))
    made = made_run(tmp_path / "run", model)
    for window in read_windows(made):
        maps, wanted = window.views["main"], fake_maps()
        assert np.array_equal(maps["vis"], wanted["visibility"].numpy())
        assert np.array_equal(maps["depth"].view("<f2"), wanted["inverse_depth"].numpy().astype("<f2"))
        assert set(window.entry.views["main"].sha256) == {"win", "vis", "depth"}


def test_noise_of_every_level_survives_the_disk(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (3, 16, 24, 3), np.uint8)
    for pixels in (noise, noise[..., 0]):
        writer = PixelWriter(tmp_path / "noise.mkv", height=16, width=24, fps=10.0)
        writer.write(pixels)
        writer.close()
        reader = PixelReader(tmp_path / "noise.mkv", shape=(3, 16, 24), grey=pixels.ndim == 3)
        assert np.array_equal(reader.read(0, pixel_digest(pixels)), pixels)
        reader.require_end()
        reader.close()


def test_a_manifest_survives_the_round_trip(run: RunFolder) -> None:
    text = encode_manifest(run.manifest)
    assert parse_manifest(text, "test") == run.manifest
    assert len([line for line in text.splitlines() if b'{"window_id":' in line]) == WINDOWS


# What a run holds.


def test_a_manifest_tells_the_whole_story(run: RunFolder) -> None:
    manifest = run.manifest
    assert {f"version {name}" for name in ("gcd-node", "python", "torch", "opencv")} <= set(manifest.made_from)
    assert manifest.made_from["weights name"] == "fake"
    assert manifest.made_from["machine device"] == "cpu"
    assert manifest.totals == msgspec.structs.replace(manifest.totals, frames=42, windows=3, rejected={}, nan_windows=0)
    assert (manifest.size.frames, manifest.size.height, manifest.size.width) == (FRAMES, HEIGHT, WIDTH)
    second = manifest.windows[1]
    assert second.seqs == tuple(range(14, 28))
    assert second.stamps[0] == (1, 400_000_000)
    assert second.stamps[-1] == (2, 700_000_000)
    view = second.views["main"]
    assert (view.seed, view.steps, view.nan_frames) == (window_seed(manifest.cfg_digest, 1, 0), 1, 0)
    assert view.ood == ()


def test_the_configuration_in_a_manifest_is_a_launch_file_of_the_same_digest(run: RunFolder) -> None:
    again = parse_config(run.manifest.config.encode(), "manifest")
    assert again == lockstep_config(launch())
    assert (
        config_digest(again, painting_traits()) == config_digest(launch(), painting_traits()) == run.manifest.cfg_digest
    )


def test_seeds_are_those_of_the_live_node() -> None:
    live = launch(["source.pace=realtime", "publish.encoding=jpeg", "life.idle_s=5", "control.endpoint=ipc"])
    assert config_digest(lockstep_config(live), traits()) == config_digest(live, traits())


def test_a_file_is_named_by_the_digest_of_its_bytes(tmp_path: Path) -> None:
    video = write_video(tmp_path / "v.mkv", ramp(14, WIDTH, HEIGHT), 24.0)
    settings = parse_config(f'[source]\npath = "{video}"\n[model]\nweights="fake"\n[view.main]'.encode(), "test")
    run = replay(settings, tmp_path / "run", parts=parts(source=FakeSource(14)))
    assert run.manifest.made_from["source sha256"] == hashlib.sha256(video.read_bytes()).hexdigest()


def test_a_folder_is_named_by_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "a").write_bytes(b"1")
    (tmp_path / "in" / "b").write_bytes(b"2")
    digests = [digest_of(tmp_path)]
    (tmp_path / "in" / "b").write_bytes(b"3")
    digests.append(digest_of(tmp_path))
    (tmp_path / "in" / "b").rename(tmp_path / "in" / "c")
    digests.append(digest_of(tmp_path))
    assert len(set(digests)) == 3
    with pytest.raises(SourceError, match="nowhere"):
        digest_of(tmp_path / "nowhere")


class Gap(FakeSource):
    """Half a second is missing after 20 frames."""

    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            late_ns = 500_000_000 if frame.seq >= 20 else 0
            yield Frame(image=frame.image.copy(), stamp_ns=frame.stamp_ns + late_ns, seq=frame.seq)


def test_windows_that_were_rejected_are_counted_with_their_reason(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", source=Gap(42))
    assert run.manifest.totals.rejected == {"WIN_GAP": 1}
    assert [window.seqs[0] for window in run.manifest.windows] == [0, 20]


def test_a_window_with_nan_is_missing_and_named(tmp_path: Path) -> None:
    manifest = made_run(tmp_path / "run", nan_model({1})).manifest
    assert [window.window_id for window in manifest.windows] == [0, 2]
    assert manifest.totals.nan_windows == 1
    (trouble,) = manifest.troubles
    assert (trouble.code, trouble.window_id) == ("MODEL_NAN", 1)
    assert str(window_seed(manifest.cfg_digest, 1, 1)) in trouble.detail


def test_every_view_has_its_own_pixels(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", changes=["view.second.azimuth_deg=5.0"])
    assert run.manifest.views == ("main", "second")
    assert sorted(path.name for path in run.path.iterdir()) == ["main.mkv", MANIFEST, "second.mkv"]
    check_pixels(run)


# How a run comes to be.


def test_no_socket_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a replay opened a socket")

    monkeypatch.setattr(zmq.Context, "socket", refuse)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "runtime"))
    run = made_run(tmp_path / "run", changes=["control.endpoint=ipc", "publish.min_subscribers=3"])
    assert len(run.manifest.windows) == WINDOWS
    assert not (tmp_path / "runtime").exists()


def test_a_gpu_is_held_to_repeatable_convolutions_for_the_time_of_a_replay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", True)
    seen: list[tuple[bool, bool]] = []

    def look(_: WindowReport) -> None:
        seen.append((torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark))

    replay(launch(), tmp_path / "run", look, parts())
    assert seen == [(True, False)] * WINDOWS
    assert (torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark) == (False, True)


@pytest.mark.parametrize(
    "source",
    ['kind = "oak"', 'kind = "v4l2"\ndevice = "0"', 'kind = "rtsp"\nurl = "rtsp://user:secret@camera/1"'],
)
def test_a_live_camera_is_refused(source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "l.toml").write_text(f'[source]\n{source}\n[model]\nweights = "random:driving"\n[view.main]')
    assert run_app(["replay", str(tmp_path / "l.toml"), "--out", str(tmp_path / "run")]) == 78
    told = capsys.readouterr().err
    assert "record it first" in told
    assert "secret" not in told
    assert not (tmp_path / "run").exists()


def test_a_drive_without_an_end_is_refused() -> None:
    endless = parse_config(b'[source]\nkind = "synthetic"\n[model]\nweights = "fake"\n[view.main]', "test")
    with pytest.raises(ConfigError, match="frames"):
        lockstep_config(endless)


def test_a_recording_that_loops_is_played_once() -> None:
    text = b'[source]\npath = "x.mkv"\nloop = true\n[model]\nweights = "fake"\n[view.main]'
    looping = parse_config(text, "test")
    assert not lockstep_config(looping).source.loop


def test_a_folder_in_use_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").touch()
    (tmp_path / "file").touch()
    opened: list[object] = []
    watched = parts()
    for out in (tmp_path, tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(OutputError, match=r"name another folder|name a folder"):
            replay(launch(), out, opened.append, watched)
    assert opened == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "kept.txt"]


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    assert len(made_run(tmp_path / "run").manifest.windows) == WINDOWS


def test_a_run_is_not_there_before_it_is_whole(tmp_path: Path) -> None:
    seen: list[list[str]] = []

    def look(_: WindowReport) -> None:
        seen.append([path.name for path in tmp_path.iterdir()])

    replay(launch(), tmp_path / "run", look, parts())
    assert len(seen) == WINDOWS
    assert all(len(names) == 1 and names[0].endswith(".part") for names in seen)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_was_cut_short_is_no_run(tmp_path: Path) -> None:
    with new_folder(tmp_path / "run") as part:
        (part / "main.mkv").touch()
        with pytest.raises(DamagedRunError, match="did not finish"):
            open_run(part)


def short() -> FakeSource:
    return FakeSource(9)


def broken() -> FakeSource:
    source = FakeSource(20)
    source.fails = SourceError("the disk is gone")
    return source


@pytest.mark.parametrize(
    ("model", "source", "error"),
    [
        (None, short, TooShortError),
        (None, broken, SourceError),
        (lambda: nan_model({0, 1, 2}), None, ModelFailedError),
        (lambda: nan_model({0, 1}), lambda: FakeSource(28), ModelFailedError),
    ],
)
def test_a_replay_that_fails_leaves_nothing(
    model: Callable[[], FakeSynthesizer] | None,
    source: Callable[[], FakeSource] | None,
    error: type[NodeError],
    tmp_path: Path,
) -> None:
    with pytest.raises(error):
        made_run(tmp_path / "run", model and model(), source and source())
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_loses_pixels_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = PixelWriter.write
    monkeypatch.setattr(PixelWriter, "write", lambda self, pixels: whole(self, pixels[:-1]))
    with pytest.raises(OutputError, match="is there space"):
        made_run(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


# Damaged runs.


def truncated(folder: Path) -> None:
    whole = (folder / "main.mkv").read_bytes()
    (folder / "main.mkv").write_bytes(whole[: len(whole) // 2])


def repainted(folder: Path) -> None:
    with_other_pixels = np.full((WINDOWS * FRAMES, HEIGHT, WIDTH, 3), 7, np.uint8)
    writer = PixelWriter(folder / "main.mkv", height=HEIGHT, width=WIDTH, fps=24.0)
    writer.write(with_other_pixels)
    writer.close()


def longer(folder: Path) -> None:
    table = json.loads((folder / MANIFEST).read_text())
    table["windows"].pop()
    (folder / MANIFEST).write_text(json.dumps(table))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (truncated, "shorter than|cannot be opened"),
        (repainted, "SHA-256"),
        (longer, "more frames"),
        (lambda folder: (folder / "main.mkv").unlink(), "missing"),
        (lambda folder: (folder / "main.classes.mkv").unlink(), "missing"),
        (lambda folder: (folder / "main.mkv").write_bytes(b"no video"), "cannot be opened"),
    ],
)
def test_pixels_that_do_not_fit_their_manifest_are_damage(
    damage: Callable[[Path], None], reason: str, run: RunFolder, tmp_path: Path
) -> None:
    folder = copied(run, tmp_path / "copy")
    damage(folder)
    with pytest.raises(DamagedRunError, match=reason):
        check_pixels(open_run(folder))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (b"{", b"", "no manifest of a run"),
        (b'"gcd-run/2"', b'"gcd-run/1"', "gcd-run/1"),
        (b'"format"', b'"forma"', "format"),
        (b'"fps": 10.0', b'"fps": "x"', "fps"),
        (b'"fps": 10.0', b'"fps": 10.0, "more": 1', "more"),
        (b'"frames": 14', b'"frames": 13', "13 stamps"),
        (b'"window_id":1', b'"window_id":0', "higher"),
        (b'"main":{', b'"../main":{', "views"),
        (b'"seqs":[0,', b'"seqs":[', "13 seqs"),
    ],
)
def test_a_manifest_that_is_none_is_damage_and_says_where(
    old: bytes, new: bytes, reason: str, run: RunFolder, tmp_path: Path
) -> None:
    text = encode_manifest(run.manifest)
    assert old in text
    (tmp_path / MANIFEST).write_bytes(text.replace(old, new, 1))
    with pytest.raises(DamagedRunError, match=reason):
        open_run(tmp_path)


def test_a_run_that_is_not_there_is_another_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such folder"):
        open_run(tmp_path / "nowhere")
