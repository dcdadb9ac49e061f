"""Replays of a made-up source through a made-up model, compared, and as the pytest plugin makes them."""

import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import torch
import zmq
from cameras import ramp, write_video
from fakes import HEIGHT, WIDTH, FakeSource, FakeSynthesizer, fake_config, fake_maps, painting_traits, traits
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from robot_logs import camera_info, compressed, write_bag
from rosbags.rosbag2 import Reader, StoragePlugin

import gcd_node.testing  # noqa: F401  loaded before the inner sessions, which put sys.modules back
from gcd_model import NonFiniteError, RenderOptions, SourceFeatures, Traits, Trajectory, View
from gcd_node.cli.main import run_app
from gcd_node.config import NodeConfig
from gcd_node.encoded_frames import window_seed
from gcd_node.errors import (
    ConfigError,
    DamagedRunError,
    ModelFailedError,
    OutputError,
    SourceError,
    TooShortError,
    UsageError,
)
from gcd_node.frame import Frame
from gcd_node.lifecycle import Parts
from gcd_node.replay import lockstep
from gcd_node.replay.compare import Tolerance, compare, report_text
from gcd_node.replay.lockstep import digest_of, lockstep_config, replay, replay_to_bag
from gcd_node.replay.run import MANIFEST, RunFolder, encode_manifest, keep_pixels, new_folder, open_run, pixel_digest
from gcd_node.sources import open_source
from gcd_node.stream_context import config_digest
from gcd_node.work import WindowReport

WINDOWS, FRAMES = 3, 14
SOURCE = 'kind = "synthetic"\nframes = 42'


class LevelModel(FakeSynthesizer):
    """Gives the source back, each level a whole number lower: by one for each step beyond the first, and by `lower`
    at (window, frame). `classes` moves the class numbers of a window's frame 0 in so many columns."""

    def __init__(
        self,
        made: Traits | None = None,
        lower: Mapping[tuple[int, int], int] | None = None,
        classes: Mapping[int, int] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(made or traits(), **more)
        self._lower, self._classes = lower or {}, classes or {}

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        window, steps = len(self.asked), 1 if options is None else options.steps or 1
        video = ((features.latents + 1) / 2 * 255).round() - (steps - 1)
        for (at, frame), levels in self._lower.items():
            video[frame] -= levels if at == window else 0
        views = super().render(features, trajectories, options)
        for view in views:
            if view.classes is not None:
                first = view.classes[:, 0, :, : self._classes.get(window, 0)]
                first.add_(1).remainder_(len(self.traits.classes))
        return [replace(view, samples=(video / 255)[None]) for view in views]


def nan_model(windows: set[int]) -> FakeSynthesizer:
    """NaN in these windows, in both attempts."""
    calls = iter(window for window in range(99) for _ in range(2 if window in windows else 1))

    def act(_: RenderOptions) -> None:
        if next(calls) in windows:
            raise NonFiniteError("NaN in the latents")

    return LevelModel(act=act)


def parts(model: FakeSynthesizer | None = None, source: FakeSource | None = None) -> Parts:
    chosen, played = model or LevelModel(), source or FakeSource(WINDOWS * FRAMES)
    return Parts(open_source=lambda _: played, load_model=lambda _: chosen)


def made_run(
    folder: Path, model: FakeSynthesizer | None = None, source: FakeSource | None = None, changes: Sequence[str] = ()
) -> RunFolder:
    return replay(fake_config("model.steps=1", *changes, source=SOURCE), folder, parts=parts(model, source))


def copied(run: RunFolder, folder: Path) -> Path:
    return Path(shutil.copytree(run.path, folder))


# Replays: what a run holds, that it comes out the same again, and that half a run is never taken for one.


Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """With class maps. Tests that damage it damage a copy."""
    return made_run(tmp_path_factory.mktemp("run") / "run", LevelModel(painting_traits()), FakeSource(42, fps=10.0))


def test_what_is_on_disk_is_what_the_model_drew_to_the_bit(whole: RunFolder, tmp_path: Path) -> None:
    for index, window in enumerate(whole.manifest.windows):
        view = whole.read_view(window, "main")
        levels = np.arange(20 + FRAMES * index, 20 + FRAMES * (index + 1), dtype=np.uint8)
        drawn = np.broadcast_to(levels[:, None, None, None], (FRAMES, HEIGHT, WIDTH, 3))
        assert np.array_equal(view["win"], drawn)
        assert pixel_digest(drawn) == window.views["main"]["win"] == window.input_sha256
        columns = (np.arange(FRAMES)[:, None] + np.arange(WIDTH)) % len(painting_traits().classes)
        assert np.array_equal(view["cls"], np.repeat(columns[:, None], HEIGHT, axis=1))
    live = made_run(tmp_path / "run", LevelModel(holds=("visibility", "inverse_depth")))
    maps, drawn_maps = live.read_view(live.manifest.windows[0], "main"), fake_maps()
    assert set(maps) == {"win", "vis", "depth"}
    assert np.array_equal(maps["vis"], drawn_maps["visibility"].numpy())
    assert np.array_equal(maps["depth"].view("<f2"), drawn_maps["inverse_depth"].numpy().astype("<f2"))


def test_a_manifest_tells_the_whole_story(whole: RunFolder) -> None:
    manifest = whole.manifest
    assert {f"version {name}" for name in ("gcd-node", "python", "torch", "opencv")} <= set(manifest.made_from)
    assert (manifest.made_from["weights name"], manifest.made_from["machine device"]) == ("fake", "cpu")
    assert (manifest.frames, manifest.rejected, manifest.nan_windows) == (42, {}, 0)
    second = manifest.windows[1]
    assert second.seqs == tuple(range(14, 28))
    assert (second.stamps_ns[0], second.stamps_ns[-1]) == (1_400_000_000, 2_700_000_000)
    assert second.seed == window_seed(manifest.cfg_digest, 1, 0)
    live = fake_config("model.steps=1", "source.pace=realtime", "publish.encoding=jpeg", source=SOURCE)
    again = msgspec.convert(manifest.config, NodeConfig)
    assert again == lockstep_config(live)  # and so it is the same digest, and the seeds are those of the live node
    assert config_digest(again, painting_traits()) == config_digest(live, painting_traits()) == manifest.cfg_digest
    text = encode_manifest(manifest)
    assert msgspec.json.decode(text, type=type(manifest)) == manifest
    assert len([line for line in text.splitlines() if b'{"window_id":' in line]) == WINDOWS  # for code reviews


def test_a_recording_is_named_by_the_digest_of_its_bytes_a_folder_by_names_and_contents(tmp_path: Path) -> None:
    video = write_video(tmp_path / "v.mkv", ramp(14, WIDTH, HEIGHT), 24.0)
    made = replay(fake_config(source=f'path = "{video}"'), tmp_path / "run", parts=parts(source=FakeSource(14)))
    assert made.manifest.made_from["source sha256"] == hashlib.sha256(video.read_bytes()).hexdigest()
    place, digests = tmp_path / "in", set[str]()
    place.mkdir()
    for name, content in (("b", b"2"), ("b", b"3"), ("c", b"3")):
        (place / "b").unlink(missing_ok=True)
        (place / name).write_bytes(content)
        digests.add(digest_of(place))
    assert len(digests) == 3
    with pytest.raises(SourceError):
        digest_of(tmp_path / "nowhere")


def test_windows_that_were_rejected_are_counted_and_those_with_nan_named(tmp_path: Path) -> None:
    def late(frame: Frame) -> Frame:
        """Half a second is missing after 20 frames."""
        return replace(frame, stamp_ns=frame.stamp_ns + 500_000_000 * (frame.seq >= 20))

    gap = made_run(tmp_path / "gap", source=FakeSource(42, edit=late)).manifest
    assert gap.rejected == {"WIN_GAP": 1}
    assert [window.seqs[0] for window in gap.windows] == [0, 20]
    nan = made_run(tmp_path / "nan", nan_model({1})).manifest
    assert ([window.window_id for window in nan.windows], nan.nan_windows) == ([0, 2], 1)
    assert str(window_seed(nan.cfg_digest, 1, 1)) in nan.troubles["MODEL_NAN in window 1"]


def test_a_replay_opens_no_socket_and_is_repeatable_on_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a replay opened a socket")

    def look(_: WindowReport) -> None:
        seen.append((torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark))
        (folder,) = tmp_path.iterdir()
        assert folder.suffix == ".part"  # a whole is not there before it is whole

    monkeypatch.setattr(zmq.Context, "socket", refuse)
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", True)
    seen: list[tuple[bool, bool]] = []
    settings = fake_config("control.endpoint=ipc", "publish.min_subscribers=3", source=SOURCE)
    replay(settings, tmp_path / "run", look, parts())
    assert seen == [(True, False)] * WINDOWS
    assert (torch.backends.cudnn.deterministic, torch.backends.cudnn.benchmark) == (False, True)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_cannot_be_replayed_is_refused_and_a_loop_played_once(tmp_path: Path, capsys: Capture) -> None:
    rest = '\n[model]\nweights = "fake"\n[view.main]'
    (tmp_path / "l.toml").write_text(f'[source]\nkind = "rtsp"\nurl = "rtsp://u:secret@camera/1"{rest}')
    assert run_app(["replay", str(tmp_path / "l.toml"), "--out", str(tmp_path / "run")]) == 78
    assert "secret" not in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert not lockstep_config(fake_config(source='path = "x.mkv"\nloop = true')).source.loop
    with pytest.raises(ConfigError):
        lockstep_config(fake_config())


def test_a_folder_in_use_is_refused_before_anything_is_loaded_and_an_empty_one_taken(tmp_path: Path) -> None:
    (tmp_path / "kept.txt").touch()
    (tmp_path / "file").touch()
    opened: list[object] = []
    for out in (tmp_path, tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(OutputError):
            replay(fake_config(source=SOURCE), out, opened.append, parts())
    assert opened == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "kept.txt"]
    (tmp_path / "run").mkdir()
    assert len(made_run(tmp_path / "run").manifest.windows) == WINDOWS


def test_a_replay_that_fails_leaves_nothing_and_says_what(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lost = SourceError("the disk is gone")
    for frames, fails, nan, error in (
        (9, None, set(), TooShortError),
        (20, lost, set(), SourceError),
        (42, None, {0, 1, 2}, ModelFailedError),
    ):
        with pytest.raises(error):
            made_run(tmp_path / "run", nan_model(nan), FakeSource(frames, fails=fails))
    with pytest.raises(FileNotFoundError), new_folder(tmp_path / "run"):
        (tmp_path / "drive.mp4").read_bytes()  # an input is no output

    def full(path: Path, _: Path) -> None:
        raise OSError(28, "No space left on device", path)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        made_run(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_pixels_that_do_not_fit_their_manifest_are_damage(whole: RunFolder, tmp_path: Path) -> None:
    flat = np.full((FRAMES * HEIGHT, WIDTH, 3), 7, np.uint8)
    picture = copied(whole, tmp_path / "copy") / "main" / "000001.win.png"
    damaged, whole = open_run(tmp_path / "copy"), picture.read_bytes()
    other = (cv2.imencode(".png", each)[1].tobytes() for each in (flat, flat[1:, :, 0]))
    for content in (whole[: len(whole) // 2], *other, b"no picture", None):
        picture.unlink() if content is None else picture.write_bytes(content)
        with pytest.raises(DamagedRunError):
            damaged.read_view(damaged.manifest.windows[1], "main")


def test_a_manifest_that_is_none_is_damage_and_says_where(whole: RunFolder, tmp_path: Path) -> None:
    text = encode_manifest(whole.manifest)
    for old, new, reason in (
        (b"{", b"", "no manifest of a run"),
        (b'"gcd-run/3"', b'"gcd-run/1"', "gcd-run/1"),
        (b'"nan_windows": 0', b'"nan_windows": 0, "more": 1', "more"),
        (b'"window_id":1', b'"window_id":0', "higher"),
        (b'"main":{', b'"../main":{', "views"),
        (b'"win":', b'"vis":', "digest"),
    ):
        assert old in text
        (tmp_path / MANIFEST).write_bytes(text.replace(old, new, 1))
        with pytest.raises(DamagedRunError, match=reason):
            open_run(tmp_path)


def test_what_a_strange_run_states_takes_neither_time_nor_memory(whole: RunFolder, tmp_path: Path) -> None:
    strange = copied(whole, tmp_path / "run")
    manifest = (strange / MANIFEST).read_text()
    (strange / MANIFEST).write_text(manifest.replace('"config": {', '"config": {"model": ' + '{"a":' * 20_000, 1))
    with pytest.raises(DamagedRunError):
        open_run(strange)
    with (strange / MANIFEST).open("r+b") as file:
        file.truncate(2**30)  # a sparse file
    with pytest.raises(DamagedRunError):
        open_run(strange)
    (strange / MANIFEST).write_text(manifest)
    (strange / "main" / "000000.win.png").unlink()
    os.mkfifo(strange / "main" / "000000.win.png")
    with pytest.raises(DamagedRunError):
        compare(whole, open_run(strange))


# Two runs compared: what counts as the same, how far apart they are, and what is said and shown of it.


LOOSE = Tolerance(min_psnr_db=1.0)


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return made_run(tmp_path_factory.mktemp("golden") / "run")


def lowered(folder: Path, lower: Mapping[tuple[int, int], int]) -> RunFolder:
    return made_run(folder, LevelModel(lower=lower))


def classed(folder: Path, columns: Mapping[int, int]) -> RunFolder:
    return made_run(folder, LevelModel(painting_traits(), classes=columns), FakeSource(42, fps=10.0))


def restated(whole: RunFolder, folder: Path, **changes: object) -> RunFolder:
    """A copy of a whole whose manifest says something else."""
    copied(whole, folder)
    (folder / MANIFEST).write_bytes(encode_manifest(msgspec.structs.replace(whole.manifest, **changes)))
    return open_run(folder)


def test_one_bad_frame_is_not_hidden_by_thirteen_good_ones(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, made_run(tmp_path / "again"))
    assert (comparison.facts, comparison.differences) == ({}, ())
    other = lowered(tmp_path / "run", {(1, 4): 5, (1, 9): 10})
    (view,) = compare(golden, other).differences
    assert (view.window_id, view.worst_frame, view.facts) == (1, 9, ())
    frame_db = 20 * math.log10(255 / 10)
    assert view.worst_psnr_db == pytest.approx(frame_db)
    assert view.within(Tolerance(min_psnr_db=frame_db - 0.01))
    assert not view.within(Tolerance(min_psnr_db=frame_db + 0.01))
    assert compare(other, golden).differences == (view,)


def test_class_pixels_have_a_bound_of_their_own(tmp_path: Path) -> None:
    for bounds in ({"min_psnr_db": 0.0}, {"min_psnr_db": math.nan}, {"max_class_share": 1.5}):
        with pytest.raises(UsageError):
            Tolerance(**bounds)
    (view,) = compare(classed(tmp_path / "a", {}), classed(tmp_path / "b", {1: 48})).differences
    share = 48 / 96 / FRAMES  # half of the columns, in one frame
    assert view.shares == {"class map": pytest.approx(share)}
    assert view.worst_psnr_db == math.inf
    assert not view.within(LOOSE)
    assert not view.within(Tolerance(max_class_share=0.9 * share))
    assert view.within(Tolerance(max_class_share=1.1 * share))


class MovedMaps(LevelModel):
    """Its inverse depth is so many times the usual one, and `columns` of its visibility are painted instead."""

    def __init__(self, factor: float, columns: int) -> None:
        super().__init__(holds=("visibility", "inverse_depth"))
        self._factor, self._columns = factor, columns

    def render(self, *asked: Any) -> list[View]:
        views = super().render(*asked)
        for view in views:
            view.inverse_depth.mul_(self._factor)
            view.visibility[..., : self._columns] = 0
        return views


def test_depth_and_visibility_count_like_class_pixels(tmp_path: Path) -> None:
    usual = made_run(tmp_path / "usual", MovedMaps(1.0, 0))
    near = compare(usual, made_run(tmp_path / "near", MovedMaps(1.005, 0))).differences[0]
    assert near.within(Tolerance(max_class_share=0.001))
    far = compare(usual, made_run(tmp_path / "far", MovedMaps(1.05, 24))).differences[0]
    assert far.shares["depth"] == pytest.approx(6 / 7, abs=0.01)  # the others have none
    assert far.shares["visibility"] == pytest.approx(24 / 96 * 2 / 3, abs=0.01)
    assert not far.within(Tolerance(max_class_share=0.8))
    assert "of the depth" in str(far)
    assert compare(usual, made_run(tmp_path / "plain")).differences[0].facts == ("visibility", "depth")


def test_a_window_that_only_one_run_has_fails_and_shifts_none_of_the_others(golden: RunFolder, tmp_path: Path) -> None:
    longer = made_run(tmp_path / "longer", source=FakeSource(4 * FRAMES))
    for a, b, only in ((golden, longer, "only in B"), (longer, golden, "only in A")):
        (missing,) = compare(a, b).failures(LOOSE)
        assert (missing.window_id, missing.view_id, missing.facts) == (3, "main", (only,))
    holed = compare(golden, made_run(tmp_path / "holed", nan_model({1})))
    assert [(view.window_id, view.facts) for view in holed.differences] == [(1, ("only in A",))]
    assert set(holed.facts) == {"total windows", "total nan_windows", "trouble MODEL_NAN in window 1"}


def test_other_moments_flags_and_sizes_fail_even_if_the_pixels_agree(golden: RunFolder, tmp_path: Path) -> None:
    first, *others = golden.manifest.windows
    black = np.zeros((FRAMES, 16, 24, 3), np.uint8)
    changes = {"stamps_ns": tuple(range(9, FRAMES + 9)), "seqs": tuple(range(1, FRAMES + 1)), "epoch": 4}
    for field, value in (changes | {"ood": ("fps",), "views": {"main": {"win": pixel_digest(black)}}}).items():
        changed = msgspec.structs.replace(first, **{field: value})
        other = restated(golden, tmp_path / field, windows=(changed, *others))
        if field == "views":
            keep_pixels(other.path, "main", 0, "win", black)
        (view,) = compare(golden, other).failures(LOOSE)
        assert view.facts == ("size" if field == "views" else field,)


def test_what_the_runs_were_made_from_is_named_first(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", changes=["model.steps=3", "source.resize=area", "life.nice=3"])
    made_from = other.manifest.made_from | {"weights sha256_12": "f" * 12, "version torch": "\x1b]0;mine\x07"}
    comparison = compare(golden, restated(other, tmp_path / "restated", made_from=made_from))
    assert [(name, *values) for name, values in comparison.facts.items()] == [
        ("config source.resize", "released", "area"),
        ("config model.steps", "1", "3"),
        ("weights sha256_12", "0" * 12, "f" * 12),
        ("version torch", golden.manifest.made_from["version torch"], "\\x1b]0;mine\\x07"),  # commands no terminal
    ]


def test_the_first_divergence_says_whether_input_and_seed_were_the_same(golden: RunFolder, tmp_path: Path) -> None:
    brighter = FakeSource(42, edit=lambda frame: replace(frame, image=frame.image + 1))

    def told(whole: RunFolder) -> str:
        return report_text(compare(golden, whole), LOOSE).splitlines()[-1]

    assert told(lowered(tmp_path / "same", {(2, 0): 1})).endswith("the model was given the same pictures")
    assert "other pictures already" in told(made_run(tmp_path / "input", source=brighter))
    seed = made_run(tmp_path / "seed", LevelModel(lower={(0, 0): 1}), changes=["model.cond_aug=0.01"])
    assert "same pictures and another seed" in told(seed)


def test_diff_tells_same_near_and_different(golden: RunFolder, tmp_path: Path, capsys: Capture) -> None:
    other = lowered(tmp_path / "run", {(1, 4): 5})
    damaged = copied(golden, tmp_path / "damaged")
    (damaged / MANIFEST).write_text("{")
    a, b = str(golden.path), str(other.path)
    assert run_app(["diff", a, a]) == 0
    assert run_app(["diff", a, str(damaged)]) == 65
    assert run_app(["diff", str(tmp_path / "nowhere"), b]) == 66
    capsys.readouterr()
    assert run_app(["diff", a, b]) == 1
    assert capsys.readouterr().out.startswith("DIFFERENT: 1 of 3")
    assert run_app(["diff", a, b, "--min-psnr", "30"]) == 0
    assert capsys.readouterr().out.startswith("near enough: 2 of 3")
    assert run_app(["diff", a, b, "--json"]) == 1
    plain = json.loads(capsys.readouterr().out)
    assert (plain["a"], plain["b"], plain["views"]) == (a, b, 3)
    (view,) = plain["differences"]
    assert (view["window_id"], view["view_id"], view["worst_frame"]) == (1, "main", 4)


# The pytest plugin in a robot team's project: golden runs made, kept, missed and renewed.


pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]
STEPS = {"model.steps": 3}


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


@pytest.mark.slow
def test_a_golden_run_is_asked_for_made_and_then_met_or_missed_with_causes(project: pytest.Pytester) -> None:
    result = run_test(project)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*no golden run at *golden/drive: make one with `pytest --gcd-update`*"])
    same = {"source.kind": "synthetic", "model.guidance": [1.0, 2.0], "node_id": "4"}  # what they are in Python
    for options, settings, bounds in ((["--gcd-update"], {}, ""), ([], same, ""), ([], STEPS, ", min_psnr=40.0")):
        run_test(project, *options, settings=settings, bounds=bounds).assert_outcomes(passed=1)
    result = run_test(project, settings=STEPS, bounds=", min_psnr=45.0")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*config model.steps: 1, 3", "*first divergence: window 0, view main: *42.11 dB*"])
    run_test(project, settings={"model.stepps": 4}).stdout.fnmatch_lines(["*ConfigError: *`steps`*"])
    run_test(project)
    (moved,) = project.path.glob("test_*.py")
    moved.rename(project.mkdir("tests") / moved.name)  # paths are meant from the root of the project
    result = project.runpytest_inprocess("-p", "gcd_node.testing", "--rootdir", str(project.path), "tests")
    result.assert_outcomes(passed=1)


@pytest.mark.slow
def test_an_update_makes_a_run_anew_byte_for_byte_and_removes_nothing_else(project: pytest.Pytester) -> None:
    mine = project.path / "golden" / "drive" / "mine.txt"
    mine.parent.mkdir(parents=True)
    mine.touch()
    run_test(project, "--gcd-update").stdout.fnmatch_lines(["*OutputError*no empty folder*"])
    mine.unlink()
    run_test(project, "--gcd-update").assert_outcomes(passed=1)
    first = {path.name: path.read_bytes() for path in mine.parent.rglob("*.*")}
    run_test(project, "--gcd-update")
    assert {path.name: path.read_bytes() for path in mine.parent.rglob("*.*")} == first
    (mine.parent / MANIFEST).write_text("{")
    run_test(project).stdout.fnmatch_lines(["*DamagedRunError*"])
    run_test(project, "--gcd-update", settings=STEPS).assert_outcomes(passed=1)
    run_test(project, settings=STEPS).assert_outcomes(passed=1)


@pytest.mark.slow
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


# ROS 2 bags: one goes in, one of its views comes out.


def test_a_bag_becomes_a_bag_of_its_views_that_fits_beside_it(tmp_path: Path) -> None:
    """Stamped by a simulation's clock, recorded by the wall's; read by rosbags and by the reference library."""
    stamps_ns = [round((5 + i / 10) * 1e9) for i in range(28)]
    said = [("/front/camera_info", camera_info(192, 128, d=()))]
    said += [
        ("/front/image_raw/compressed", compressed(*each)) for each in zip(ramp(28, 192, 128), stamps_ns, strict=True)
    ]
    log = write_bag(tmp_path / "drive", said, StoragePlugin.MCAP)
    config = fake_config("view.main={}", source=f'kind = "mcap"\npath = "{log}"')
    own = Parts(
        open_source=open_source,
        load_model=lambda _: LevelModel(painting_traits(), holds=("visibility", "inverse_depth")),
    )
    assert replay_to_bag(config, tmp_path / "views", parts=own).counts.windows == 2
    run = replay(config, tmp_path / "run", parts=own)

    with Reader(tmp_path / "views") as bag, Reader(log) as before:
        types = {each.topic.removeprefix("/view/main/"): each.msgtype.rpartition("/")[2] for each in bag.connections}
        assert types == {
            "image/compressed": "CompressedImage", "camera_info": "CameraInfo", "visibility": "Image",
            "depth": "Image", "classes": "Image", "header": "String", "/tf": "TFMessage",
        }  # fmt: skip
        told = {each.topic: list(bag.messages([each])) for each in bag.connections}
        recorded_ns = [at_ns for each, at_ns, _ in before.messages() if each.topic.endswith("compressed")]
    with (tmp_path / "views" / "views_0.mcap").open("rb") as file:
        read = [
            (channel.topic, message.log_time, value)
            for _, channel, message, value in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    assert len(read) == sum(map(len, told.values()))
    for name in ("image/compressed", "camera_info", "visibility", "depth"):
        heads = [(at_ns, value.header) for topic, at_ns, value in read if topic == f"/view/main/{name}"]
        assert [head.stamp.sec * 10**9 + head.stamp.nanosec for _, head in heads] == stamps_ns
        assert [at_ns for at_ns, _ in heads] == recorded_ns
    seen = np.concatenate([run.read_view(window, "main")["vis"] for window in run.manifest.windows])
    drawn = [np.frombuffer(value.data, np.uint8) for topic, _, value in read if topic.endswith("visibility")]
    np.testing.assert_array_equal(np.stack(drawn).reshape(seen.shape), seen)
    transform = next(value for topic, _, value in read if topic == "/tf").transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("front_optical", "main_optical")


def test_a_bag_with_two_cameras_asks_once_and_in_a_line_which(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """As a bag is that was joined with the bag of its views."""
    (shot,) = ramp(1, 192, 128)
    topics = ("/front/image_raw/compressed", "/view/main/image/compressed")
    said = [(topic, compressed(shot, i * 10**8)) for i in range(3) for topic in topics]
    log = write_bag(tmp_path / "both", [*said, ("/front/camera_info", camera_info(192, 128, d=()))], StoragePlugin.MCAP)
    launch = tmp_path / "launch.toml"
    launch.write_text(f'[source]\nkind = "mcap"\npath = "{log}"\n[view.main]\n[model]\nweights = "random:kubric90"\n')
    assert run_app(["replay", str(launch), "--bag", str(tmp_path / "views")]) == SourceError.exit_code
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "pictures on" in line]
    assert all(topic in line for topic in topics)
    assert "camera_info" not in line
    assert not (tmp_path / "views").exists()


def test_a_bag_is_whole_or_not_there_and_needs_a_free_place(tmp_path: Path) -> None:
    config = fake_config(source=SOURCE)
    with pytest.raises(ModelFailedError):
        replay_to_bag(config, tmp_path / "bag", parts=parts(nan_model(set(range(WINDOWS)))))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        replay_to_bag(config, tmp_path / "file", parts=parts())
    assert run_app(["replay", "any.toml"]) == run_app(["replay", "any.toml", "--out", "a", "--bag", "b"]) == 64
