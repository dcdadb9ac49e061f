"""Canonical views: their camera, how their pose is found, and how a source camera that was moved is noticed."""

import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from fakes import Box, FakeSource, live_traits, run, traits
from numpy.typing import NDArray
from textured_room import HERE, LENS, moved, seen, shot

import gcd_node.drift
from gcd_client.control import Code
from gcd_model import Intrinsics, OptionError, align, features, landmarks_of, load_synthesizer
from gcd_node.canonical import Reference, load_reference, load_references
from gcd_node.cli.calibrate import doubt_lens
from gcd_node.cli.main import run_app
from gcd_node.commands import NodeCommands
from gcd_node.config import NodeConfig, parse_config
from gcd_node.drift import DriftDetector
from gcd_node.errors import ConfigError
from gcd_node.health import Health
from gcd_node.image_io import write_png
from gcd_node.status import Announcer
from gcd_node.verbs import AlignView, Command, RequestError, SetPose, SetView
from gcd_node.view_config import CalibratedView, pose_matrix
from gcd_node.views import LiveConfig, VirtualView

LAUNCH = """
[source]
kind = "synthetic"
hfov_deg = 60.0
[model]
weights = "random:live"
threads = 1
[view.policy]
kind = "canonical"
reference = "{folder}/reference.png"
hfov_deg = 60.0
"""
STANDS = "pose = [0, 0, 0, 0, 0, 0, 1]\n"
THERE = moved(0.06, 0.02, 4.0)
"""Where the policy's camera stood."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_png(tmp_path / "reference.png", shot(THERE, arm=120)[0])
    return tmp_path


def config(folder: Path, more: str = STANDS) -> NodeConfig:
    return parse_config(LAUNCH.format(folder=folder) + more, "test")


@pytest.mark.parametrize(
    "wrong",
    [
        '[view.a]\nkind = "canonical"',
        '[view.a]\nkind = "canonical"\nreference = "a.png"',
        '[view.a]\nkind = "canonical"\nreference = "a.png"\nhfov_deg = 60.0\ncalibration = "a.yaml"',
        '[view.a]\nkind = "canonical"\nreference = "a.png"\nhfov_deg = 60.0\nazimuth_deg = 3.0',
        '[view.a]\nreference = "a.png"',
        "[view.a]\nrealign = true",
        'pose = "missing.toml"',
        'pose = "{folder}/reference.png"',
        "pose = [0, 0, 0]",
    ],
)
def test_what_names_no_camera_is_refused(folder: Path, wrong: str) -> None:
    with pytest.raises(ConfigError):
        config(folder, wrong.replace("{folder}", str(folder)))


def test_the_pose_comes_from_the_file_that_calibrate_view_wrote(folder: Path) -> None:
    numbers = tuple(THERE.flatten().tolist())
    doubts = dict.fromkeys(
        ("pixels", "degrees", "centimetres", "doubt_pixels", "doubt_degrees", "doubt_centimetres"), 0.5
    )
    (folder / "p.toml").write_text(CalibratedView(pose=numbers, inliers=12, matches=20, **doubts).to_toml())
    assert config(folder, f'pose = "{folder}/p.toml"').view["policy"].pose == numbers


@pytest.mark.parametrize("change", ["size = [1920, 1280]", 'calibration = "no.yaml"', "folder", "dark"])
def test_a_reference_that_says_something_else_is_refused_in_a_line(folder: Path, change: str) -> None:
    text = LAUNCH.format(folder=folder) + STANDS
    if change == "folder":  # of pictures of two sizes
        write_png(folder / "small.png", np.zeros((64, 96, 3), np.uint8))
        text = text.replace("/reference.png", "")
    elif change == "dark":
        write_png(folder / "reference.png", np.zeros((64, 96, 3), np.uint8))
    elif change.startswith("calibration"):
        text = text.replace("hfov_deg = 60.0\npose", f"{change}\npose")
    else:
        text += change
    with pytest.raises(ConfigError) as error:
        load_references(parse_config(text, "test"))
    assert "\n" not in str(error.value)


def test_a_size_of_another_shape_stretches_the_view_as_a_policy_resizes_its_picture(folder: Path) -> None:
    square = load_reference(config(folder, STANDS + "size = [96, 96]").view["policy"])
    assert square.features[0].lens == LENS
    assert (square.view.fx, square.view.fy) == pytest.approx((LENS.fx / 2, LENS.fy * 0.75))


def test_a_view_in_lockstep_has_the_camera_of_its_reference_and_needs_its_pose(folder: Path) -> None:
    lockstep = LAUNCH.format(folder=folder).replace('"synthetic"', '"synthetic"\nframes = 2\npace = "lockstep"')
    model = load_synthesizer("random:live")
    box = run(parse_config(lockstep + STANDS + "size = [96, 64]\n", "test"), model, None)
    for kind in ("frm", "vis", "depth", "cls"):
        assert [message.header.shape[1:3] for message in box.of(kind, "policy")] == [(64, 96)] * len(
            box.of("frm", "policy")
        )
    matrix = box.of("frm", "policy")[0].header.intrinsics
    assert matrix is not None
    assert matrix[0] == pytest.approx(LENS.fx / 2)
    with pytest.raises(ConfigError):
        load_references(parse_config(lockstep, "test"))
    with pytest.raises(OptionError):
        VirtualView("policy", parse_config(lockstep + STANDS, "test"), traits())


@pytest.mark.parametrize("others", ["", "[view.main]\n"])
def test_a_node_draws_other_views_while_a_pose_is_looked_for(
    folder: Path, others: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gcd_node.drift, "_PERIOD_S", 0.02)
    source = FakeSource(15, fps=10.0, period_s=0.1, size=(192, 128))
    box = run(config(folder, others), load_synthesizer("random:live"), source)
    assert [event["view"] for event in box.events("UNALIGNED")] == ["policy"]
    assert box.of("frm", "policy") == []
    assert bool(box.of("frm", "main")) == bool(others)
    assert not [thread for thread in threading.enumerate() if thread.name == "drift"]


class Watched:
    """A drift detector, shown frames of the room."""

    def __init__(self, folder: Path, more: str = STANDS) -> None:
        self.live, self.box, self.changes = LiveConfig(config(folder, more)), Box(), 0
        self.health = Health()
        self.announcer = Announcer("gcd", "boot", self.box, self.health)
        references = {"policy": load_reference(self.live.config.view["policy"])}
        self.detector = DriftDetector(self.live, self.announcer, references, lambda: None)

    def cover(self) -> None:
        frame = seen(HERE)
        self.detector.check(replace(frame, picture=torch.full_like(frame.picture, -1.0)))

    def show(self, pose: NDArray[np.float64], times: int = 3, seed: int = 0) -> "Watched":
        for number in range(times):
            self.detector.check(seen(pose, arm=30 + 40 * number, seed=seed))
        return self

    @property
    def pose(self) -> NDArray[np.float64]:
        return np.array(pose_matrix(self.live.config.view["policy"].pose or ())).reshape(4, 4)

    def codes(self) -> list[Any]:
        return [event["code"] for event in self.box.told("event")]


def stated(pose: NDArray[np.float64]) -> str:
    return f"pose = {pose.flatten().tolist()}\n"


def assert_near(pose: NDArray[np.float64], wanted: NDArray[np.float64]) -> None:
    assert np.abs(pose - wanted).max() < 1e-2  # metres, and 0.6 degrees


def test_a_camera_that_stands_is_left_in_peace_and_one_that_moved_is_told_of_once(folder: Path) -> None:
    watched = Watched(folder, stated(THERE)).show(HERE, 9)
    assert watched.codes() == []
    watched.show(moved(0.01), 2)
    assert watched.codes() == []  # not yet: an arm does that, too
    watched.show(moved(0.01), 4)
    assert watched.codes() == ["CAMERA_MOVED"]
    assert watched.detector.moved == {"policy"}
    assert watched.box.told("event")[0]["centimetres"] == pytest.approx(1.0, abs=0.2)
    assert watched.health.status()["camera"]["centimetres"] == pytest.approx(1.0, abs=0.2)
    assert watched.health.status()["reasons"] == ["CAMERA_MOVED"]
    assert_near(watched.pose, THERE)  # nobody asked
    assert watched.show(HERE).detector.moved == frozenset()


@pytest.mark.parametrize("asked", [True, False])
def test_a_view_follows_a_camera_that_was_moved(folder: Path, asked: bool) -> None:
    now = moved(0.03, 0.0, 2.0)
    watched = Watched(folder, stated(THERE) + ("" if asked else "realign = true\n")).show(HERE).show(now, 4)
    if asked:
        assert watched.codes() == ["CAMERA_MOVED"]
        watched.detector.request("policy")
        watched.show(now, 1)
    assert watched.codes() == ["CAMERA_MOVED", "VIEW_ALIGNED"]
    assert watched.detector.moved == frozenset()
    assert watched.live.revision("policy") == 2
    assert [watched.detector.was_wrong("policy", rev) for rev in (1, 2)] == [True, False]  # 1 is still in work
    assert_near(watched.pose, np.linalg.inv(now) @ THERE)


def test_a_pose_that_was_left_out_is_found_and_a_stale_one_is_noticed_at_the_start(folder: Path) -> None:
    watched = Watched(folder, "").show(HERE, 2)
    assert watched.live.config.view["policy"].pose is None
    watched.show(HERE, 1)
    assert watched.codes() == ["VIEW_ALIGNED"]
    assert_near(watched.pose, THERE)
    watched = Watched(folder, stated(moved(0.0, 0.0, 10.0)) + "realign = true\n").show(HERE, 8)
    assert watched.codes() == ["CAMERA_MOVED", "VIEW_ALIGNED"]
    assert_near(watched.pose, THERE)


def test_another_scene_aligns_nothing(folder: Path) -> None:
    watched = Watched(folder, "").show(HERE, 5, seed=3)
    assert watched.codes() == ["UNALIGNED"]
    assert watched.live.config.view["policy"].pose is None
    watched.detector.request("policy")
    assert watched.show(HERE, 1, seed=4).codes() == ["UNALIGNED", "ALIGN_FAILED"]


def test_a_camera_that_was_turned_away_is_told_of_and_found_by_its_reference(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gcd_node.drift, "_UNSEEN_S", -1.0)
    watched = Watched(folder, stated(THERE)).show(HERE).show(HERE, 2, seed=5)
    assert watched.detector.moved == {"policy"}
    assert watched.codes() == ["CAMERA_MOVED"]
    watched = Watched(folder, stated(THERE)).show(HERE)
    watched.cover()
    assert watched.codes() == ["CAMERA_MOVED"]
    watched = Watched(folder, stated(moved(0.0, 0.0, 10.0) @ THERE) + "realign = true\n")
    watched.show(moved(0.0, 0.0, 10.0), seed=7)  # what it saw at the start, and never again
    watched.show(HERE, 9)
    assert watched.codes()[-1] == "VIEW_ALIGNED"
    assert_near(watched.pose, THERE)


def test_a_dark_frame_after_a_break_is_no_move(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    watched, clock = Watched(folder, stated(THERE)).show(HERE), time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: clock() + 60.0)  # a camera that was plugged in again
    watched.cover()
    assert watched.show(HERE).codes() == []


def test_a_view_that_a_command_made_another_has_not_moved(folder: Path) -> None:
    watched = Watched(folder, stated(THERE) + "[view.other]\n").show(HERE).show(moved(0.03), 4)
    watched.live.set_view("policy", watched.live.config.view["other"])
    watched.show(moved(0.03), 2)
    time.sleep(gcd_node.drift._HOLD_S)  # pyright: ignore[reportPrivateUsage]
    watched.show(moved(0.03), 1)
    assert watched.detector.moved == frozenset()
    assert watched.health.status()["reasons"] == []
    assert "camera" not in watched.health.status()


@pytest.mark.parametrize("frames", [True, False])
def test_a_request_is_answered_once_in_time_whatever_the_camera_does(
    folder: Path, frames: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gcd_node.drift, "_PERIOD_S", 0.01)
    monkeypatch.setattr(gcd_node.drift, "_ANSWER_S", 0.05)
    monkeypatch.setattr(os, "nice", lambda _: 0)
    watched = Watched(folder, "").show(HERE, seed=3)  # where no reference tells the pose
    thread = threading.Thread(target=watched.detector.run)
    watched.detector.request("policy")
    thread.start()
    while "ALIGN_FAILED" not in watched.codes():
        if frames:
            watched.detector.offer(seen(HERE, seed=3))
        time.sleep(0.01)
    watched.detector.request("policy")
    watched.detector.stop()
    thread.join(5)
    assert watched.detector.is_over
    assert watched.codes() == ["UNALIGNED", "ALIGN_FAILED", "ALIGN_FAILED"]


def test_a_canonical_view_is_aligned_and_never_set(folder: Path) -> None:
    watched = Watched(folder, stated(THERE))
    parts: Any = SimpleNamespace(traits=live_traits(), stream=SimpleNamespace(drift=watched.detector))
    unused: Any = None
    commands = NodeCommands(watched.live, watched.announcer, parts, unused, unused)
    setting = (SetView(view="policy"), SetPose(view="policy", pose=(0, 0, 0, 0, 0, 0, 1)))
    for args in setting:
        with pytest.raises(RequestError, match="align_view"):
            commands.handle(Command(verb="set_view", args=args), "operator")
    align_it = Command(verb="align_view", args=AlignView(view="policy"))
    assert commands.handle(replace(align_it, dry_run=True), "operator").code is Code.OK
    assert watched.detector._asked_s == {}
    assert commands.handle(align_it, "operator").code is Code.ACCEPTED
    assert list(watched.detector._asked_s) == ["policy"]
    assert watched.live.revision("policy") == 1
    watched.live.remove_view("policy")
    for args in setting:  # what a policy looks at does not come back as another view of that name
        with pytest.raises(RequestError, match="align_view"):
            commands.handle(Command(verb="set_view", args=args), "operator")


def test_a_command_that_came_first_is_not_overwritten(folder: Path) -> None:
    live = LiveConfig(config(folder))
    before = live.config.view["policy"]
    live.set_view("policy", config(folder, stated(THERE)).view["policy"])
    assert live.set_view("policy", before, instead_of=before) is None
    assert live.revision("policy") == 2


def test_calibrate_view_says_that_a_lens_is_wrong(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """No standard error of a pose tells."""
    known = [landmarks_of(seen(HERE))]
    for hfov_deg, wanted in ((60.0, 0), (56.0, 1), (64.0, 1)):
        lens = Intrinsics.from_hfov(hfov_deg, LENS.width, LENS.height)
        camera = Reference(features=(features(shot(THERE)[0], lens),), view=lens)
        doubt_lens(known, camera, align(known, camera.features))
        assert len(caplog.records) == wanted
        caplog.clear()


def test_calibrate_view_writes_a_pose_or_says_in_its_exit_code_why_not(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(3):
        write_png(folder / "source" / f"{number}.png", shot(HERE)[0])
    write_png(folder / "same.png", shot(HERE)[0])
    write_png(folder / "other.png", shot(HERE, seed=3)[0])
    write_png(folder / "large.png", np.asarray(cv2.resize(shot(HERE)[0], (1280, 853)), np.uint8))
    write_png(folder / "dark.png", np.zeros((128, 192, 3), np.uint8))
    launch = folder / "launch.toml"
    source = f'[source]\nkind = "folder"\npace = "lockstep"\npath = "{folder}/source"\nfps = 5.0\nhfov_deg = 60.0\n'
    (folder / "no_lens.toml").write_text(source.replace("hfov_deg = 60.0\n", "") + '[model]\nweights = "random:live"\n')
    launch.write_text(source + '[model]\nweights = "package:live-small"\nthreads = 1\n[view.main]\n')

    def code(reference: str, *more: str) -> int:
        where = ["--source", str(launch), "--out", str(folder / "found.toml"), "--set", "source.allow_upscale=true"]
        return run_app(["calibrate-view", str(folder / reference), *where, *more])

    lens = ("--hfov-deg", "60")
    assert code("same.png", *lens) == 0
    pose = np.array(config(folder, f'pose = "{folder}/found.toml"').view["policy"].pose).reshape(4, 4)
    assert np.abs(pose - np.eye(4)).max() < 1e-3  # whatever depth random weights see
    assert code("large.png", *lens) == 0  # more pixels than a view may have
    assert capsys.readouterr().err == ""
    (folder / "found.toml").unlink()
    for reference, options, wanted in (
        ("other.png", lens, 65),
        ("missing.png", lens, 78),
        ("dark.png", lens, 78),
        ("same.png", (), 64),
        ("same.png", (*lens, "--source", str(folder / "no_lens.toml")), 78),
        ("same.png", (*lens, "--set", "source.path=/missing"), 66),
        ("same.png", (*lens, "--set", "model.weights=random:kubric90"), 78),
    ):
        assert code(reference, *options) == wanted
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (folder / "found.toml").exists()
