"""The live model in a node: replayed to the bit, placed on the vehicle, steered to any pose."""

import math
import os
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import Box, FakeSource, FakeSynthesizer, fake_config, live_traits, run, traits
from msgspec.structs import replace as struct_replace

from gcd_model import (
    CameraMount,
    DeviceMemoryError,
    NonFiniteError,
    OptionError,
    RenderOptions,
    SourceFeatures,
    Traits,
    Trajectory,
    View,
    load_synthesizer,
)
from gcd_node.cli.main import run_app
from gcd_node.config import ModelSection, NodeConfig, parse_config
from gcd_node.errors import ConfigError, ModelFailedError
from gcd_node.frame import Frame, SourceInfo
from gcd_node.lifecycle import Parts
from gcd_node.node import Node
from gcd_node.preprocess import assumed_hfov_deg, stated_mount
from gcd_node.replay.run import open_run
from gcd_node.sources import SourcePose
from gcd_node.stream_context import prepare_stream
from gcd_node.verbs import SetView
from gcd_node.view_config import ViewConfig
from gcd_node.views import VirtualView

LAUNCH = """
[source]
kind = "synthetic"
frames = 5
pace = "lockstep"
hfov_deg = 85.0
[source.pose]
height_m = 1.2
tilt_deg = 10.0
[model]
weights = "random:live"
threads = 1
[view.topdown]
[view.placed]
position_m = [-4.0, 3.0, 3.0]
look_at_m = [12.0, 0.0, 0.5]
"""
TRAITS = load_synthesizer("random:live", device="cpu").traits
MOUNT = CameraMount(height_m=1.2, tilt_deg=10.0)
INFO = SourceInfo(kind="file", id="a.mp4", width=384, height=256, fps_nominal=10.0, clock="stream")


def config(more: str = "") -> NodeConfig:
    return parse_config((LAUNCH + more).encode(), "test")


@pytest.mark.timeout(300)
def test_a_replay_of_the_live_model_is_the_same_twice_with_all_its_maps_whatever_the_pace(tmp_path: Path) -> None:
    (tmp_path / "launch.toml").write_text(LAUNCH + '[publish]\nencoding = "jpeg"\n')
    for name, pace in (("a", "realtime"), ("b", "lockstep")):
        where = ["--out", str(tmp_path / name), "--set", f"source.pace={pace}"]
        assert run_app(["replay", str(tmp_path / "launch.toml"), *where]) == 0
    assert run_app(["diff", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    first, second = (open_run(tmp_path / name).manifest for name in ("a", "b"))
    assert first == second
    assert set(first.windows[0].views["placed"]) == {"win", "cls", "vis", "depth"}
    assert [len(each.stamps_ns) for each in first.windows] == [1] * 5  # a view of every frame


def test_views_stand_at_their_goals_and_are_placed_from_the_mount_by_models_that_take_any_pose() -> None:
    for name, wanted in (("placed", [-4.0, 3.0, 3.0]), ("topdown", [-8.0, 0.0, 8.0])):
        planned = VirtualView(name, config(), TRAITS, MOUNT).planned()
        assert all(planned.at_goal)
        vehicle_from_view = MOUNT.vehicle_from_camera @ planned.source_from_target[0]
        assert vehicle_from_view[:3, 3].tolist() == pytest.approx(wanted)
    place = SetView(view="main", position_m=(0.0, 0.0, 2.0), look_at_m=(3.0, 0.0, 0.0))
    assert place.to_config() == ViewConfig(position_m=(0.0, 0.0, 2.0), look_at_m=(3.0, 0.0, 0.0))
    sphere = struct_replace(config(), source=struct_replace(config().source, pose=SourcePose(radius=3.0)))
    for settings, made in ((sphere, TRAITS), (config(), traits())):
        with pytest.raises(OptionError):
            VirtualView("placed", settings, made)


def test_a_view_takes_any_rigid_pose_as_it_is() -> None:
    rolled = (0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    as_numbers = (2.0, -1.0, 3.0, 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # the same as position and quaternion
    for pose in (rolled, as_numbers):
        view = ViewConfig(kind="pose", pose=pose)
        planned = VirtualView("main", struct_replace(config(), view={"main": view}), TRAITS).planned()
        wanted = torch.tensor(rolled, dtype=torch.float64)
        assert torch.allclose(planned.source_from_target[7].flatten(), wanted, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        'kind = "pose"',
        "pose = [0, 0, 1, 0, 0, 0, 1]",
        'kind = "pose"\npose = [0, 0, 1, 0, 0, 0, 1]\nradius = 2.0',
        *(f'kind = "pose"\npose = {pose}' for pose in ("[0, 0, 1]", "[0, 0, 1, 0, 0, 0, 0]")),
        *(f'kind = "pose"\npose = [0, 0, {z}, 0, 0, 0, 1]' for z in ("nan", "2e4")),
        "position_m = [0, 0, 1]",
        "look_at_m = [0, 0, 1]",
        "position_m = [0, 1]\nlook_at_m = [0, 0, 1]",
        "position_m = [0, 0, 1]\nlook_at_m = [1, 0, 1]\nazimuth_deg = 3.0",
        'position_m = [0, 0, 1]\nlook_at_m = [1, 0, 1]\nkind = "orbit"\nrate_deg_s = 1\namplitude_deg = 5',
    ],
)
def test_what_is_no_pose_or_place_or_two_goals_is_refused(wrong: str) -> None:
    with pytest.raises(ConfigError):
        config(f"[view.wrong]\n{wrong}\n")


def test_the_lens_is_the_stated_one_or_is_assumed_and_published() -> None:
    for hfov_deg, pose, wanted in (
        (60.0, None, 60.0),
        (None, None, 85.0),
        (None, SourcePose(radius=2.0), assumed_hfov_deg(SourcePose(radius=2.0))),
    ):
        source = struct_replace(config().source, hfov_deg=hfov_deg, pose=pose)
        views = {"main": ViewConfig()}
        run = prepare_stream(struct_replace(config(), source=source, view=views), TRAITS, INFO)
        assert run.intrinsics.hfov_deg == pytest.approx(wanted)
        assert run.ood == ()
    wide = prepare_stream(
        struct_replace(config(), source=struct_replace(config().source, hfov_deg=140.0)), TRAITS, INFO
    )
    assert wide.ood == ("hfov",)


# Where the source camera stands: on a sphere or on its vehicle, and which model takes which.


def played(made: Traits, pose: str = "", fps: float = 10.0) -> tuple[FakeSynthesizer, Box]:
    model = FakeSynthesizer(made)
    changes = [f"source.pose={{{pose}}}"] if pose else []
    return model, run(fake_config(*changes), model, FakeSource(14, fps=fps))


def matrices(box: Box) -> np.ndarray:
    found = box.of("win")[0].header.source_from_view
    return np.array(found).reshape(-1, 4, 4)


@pytest.mark.parametrize("pose", ["height_m = 2.4", "tilt_deg = 12.0", "left_m = 0.4, forward_m = -1.0"])
def test_the_view_stays_where_it_is_on_the_vehicle_however_the_camera_is_mounted(pose: str) -> None:
    _, usual = played(live_traits())
    model, box = played(live_traits(), pose)
    mount = model.clips[0].mount
    moved = mount.vehicle_from_camera.numpy() @ matrices(box)
    assert moved == pytest.approx(CameraMount().vehicle_from_camera.numpy() @ matrices(usual), abs=1e-9)
    told = box.told("meta")[0]["mount"]
    assert (told["height_m"], told["assumed"]) == (mount.height_m, False)


def test_what_is_left_out_is_as_the_model_was_trained() -> None:
    assert stated_mount(SourcePose(height_m=2.0), None, live_traits()) == CameraMount(height_m=2.0)
    assert stated_mount(SourcePose(height_m=2.0), 70.0, live_traits()) == CameraMount(height_m=2.0, hfov_deg=70.0)
    assert stated_mount(SourcePose(), None, live_traits()) is None
    assert stated_mount(SourcePose(height_m=2.0), 60.0, traits()) is None


@pytest.mark.parametrize(
    ("made", "pose"),
    [
        (traits(), "height_m = 1.5"),
        (traits("driving"), "tilt_deg = 2.0"),
        (traits("driving"), "radius = 15.0"),
        (live_traits(), "radius = 15.0, height_m = 1.5"),
        (live_traits(), "height_m = 200.0"),
    ],
)
def test_a_pose_that_cannot_be_or_in_words_the_model_does_not_know_is_refused(made: Traits, pose: str) -> None:
    with pytest.raises(ConfigError):
        played(made, pose)


def test_an_orbit_is_planned_from_where_the_camera_is_said_to_stand() -> None:
    model, box = played(traits(), "elevation_deg = 25.0, radius = 13.0", fps=12.0)
    source, meta = model.asked[0][0][0].source, box.told("meta")[0]
    assert (source.elevation_deg, source.radius_m) == (25.0, 13.0)
    assert model.clips[0].mount is None
    assert (meta["mount"], meta["src_pose"]) == (None, {"el_deg": 25.0, "r": 13.0, "assumed": False})
    meta = played(traits("driving"))[1].told("meta")[0]
    assert (meta["mount"], meta["src_pose"]) == (None, None)


# Models that work frame by frame: a view of every frame, nothing remembered across a break of the source, and three
# threads beside a live one.


class Streaming(FakeSynthesizer):
    """Notes after how many frames it was told to forget."""

    def __init__(self, act: object = None) -> None:
        super().__init__(replace(traits(), config=struct_replace(traits().config, frames=1), move_time=0), act)  # type: ignore[arg-type]
        self.resets: list[int] = []

    def streaming(self) -> "Streaming":
        return self

    def reset(self) -> None:
        self.resets.append(len(self.asked))

    def see(self, features: SourceFeatures) -> Any:
        return (features,)

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        return seen

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        return self.render(placed[0], trajectories, options)


class Stepping(FakeSource):
    """Its clock jumps by an hour before frame 10."""

    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            yield frame if frame.seq < 10 else replace(frame, stamp_ns=frame.stamp_ns + 3600 * 10**9)


def test_every_frame_gives_a_view_and_a_break_of_the_source_is_a_beginning() -> None:
    model = Streaming()
    box = run(fake_config(), model, Stepping(20))
    assert box.seqs() == box.ids() == list(range(20))
    assert model.resets == [0, 10]


def failing_once(after: int) -> Streaming:
    """With NaN, once it has drawn so many."""
    failing = iter([True])

    def act(_: RenderOptions) -> None:
        if len(model.asked) > after and next(failing, False):
            raise NonFiniteError("for once")

    model = Streaming(act)
    return model


def test_a_frame_that_is_rendered_again_is_the_first_one_then() -> None:
    model = failing_once(4)
    assert run(fake_config(), model, FakeSource(8)).seqs() == list(range(8))
    assert model.resets == [0, 5]


class SideBySide(Streaming):
    """Paints frame 3 only while it and those after it are so many `at_once` in work, and no more. Notes the threads."""

    def __init__(self, at_once: int) -> None:
        super().__init__()
        self.threads = {name: set[str]() for name in ("see", "place", "paint")}
        self._at_once, self._all, self._more, self.met = at_once, threading.Event(), threading.Event(), False

    def _note(self, step: str) -> None:
        self.threads[step].add(threading.current_thread().name)

    def see(self, features: SourceFeatures) -> Any:
        self._note("see")
        if len(self.clips) == 4 + self._at_once:
            self._all.set()
        if len(self.clips) > 4 + self._at_once:
            self._more.set()
        return super().see(features)

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        self._note("place")
        return super().place(seen, trajectories)

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        self._note("paint")
        if len(self.asked) == 4:
            self.met = self._all.wait(10) and not self._more.wait(0.2)
        return super().paint(placed, trajectories, options)


def live(model: Streaming, frames: int = 12) -> Box:
    """Beside a live source, 20 frames a second."""
    return run(fake_config("source.pace=realtime"), model, FakeSource(frames, period_s=0.05))


@pytest.fixture(autouse=True)
def cores(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> int:
    count = getattr(request, "param", 4)
    monkeypatch.setattr(os, "sched_getaffinity", {0: range(count)}.__getitem__)
    return count


@pytest.mark.parametrize("cores", [2, 4], indirect=True)
def test_beside_a_live_source_three_frames_are_in_work_at_once_and_on_two_cores_two(cores: int) -> None:
    model = SideBySide(min(cores, 3))
    seqs = live(model).seqs()
    assert model.met
    assert model.threads == {"see": {"model"}, "place": {"placer"}, "paint": {"painter"}}
    assert seqs == sorted(set(seqs))
    assert seqs[-1] == 11
    assert not {"painter", "placer"} & {thread.name for thread in threading.enumerate()}


def test_what_fails_in_the_painter_is_done_again_or_ends_the_node() -> None:
    model = failing_once(5)
    assert live(model).seqs()[-1] == 11
    assert len(model.resets) == 2

    def broken(_: RenderOptions) -> None:
        if len(model.asked) > 5:
            raise ValueError("broken")

    model = Streaming(broken)
    with pytest.raises(ModelFailedError, match="broken"):
        live(model, 1000)


class Remembering(Streaming):
    """Frame 2 fails in the painter while frame 3 is placed and frame 4 seen. Notes frames that do not go on where the
    one before ended, in place and paint: every `reset` begins another world."""

    def __init__(self, error: Exception) -> None:
        super().__init__()
        self._world, self._fourth, self._failing = 0, threading.Event(), iter([error])
        self._at = {"see": 0, "place": 0, "paint": 0}
        self.strays: list[tuple[str, int]] = []

    def reset(self) -> None:
        super().reset()
        self._world += 1

    def see(self, features: SourceFeatures) -> Any:
        if len(self.clips) == 6:
            self._fourth.set()
        begins, self._at["see"] = self._world != self._at["see"], self._world
        return features, self._world, begins

    def _follow(self, step: str, world: int, begins: bool) -> None:
        if not begins and world != self._at[step]:
            self.strays.append((step, world))
        self._at[step] = world

    def place(self, seen: Any, trajectories: Sequence[Trajectory]) -> Any:
        self._follow("place", *seen[1:])
        return seen

    def paint(
        self, placed: Any, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        self._follow("paint", *placed[1:])
        if len(self.asked) == 3 and self._fourth.wait(10):
            for error in self._failing:
                raise error
        return self.render(placed[0], trajectories, options)


@pytest.mark.parametrize("error", [NonFiniteError("for once"), DeviceMemoryError("for once")])
def test_frames_that_were_in_work_when_the_memory_began_anew_are_left_out(error: Exception) -> None:
    model = Remembering(error)
    seqs = live(model).seqs()
    assert (seqs[:4], seqs[-1], model.strays) == ([0, 1, 2, 5], 11, [])


def test_a_model_that_is_loaded_in_half_precision_is_loaded_once_and_is_not_hung_meanwhile() -> None:
    loaded: list[str | None] = []

    def load(section: ModelSection) -> Streaming:
        loaded.append(section.dtype)
        time.sleep(0.6 if section.dtype else 0.0)
        model = Streaming(lambda _: None if section.dtype or len(model.asked) < 4 else full())
        model.traits = replace(model.traits, device="cuda:0", precision=section.dtype or "float32")
        return model

    def full() -> None:
        raise DeviceMemoryError("full")

    config, box, source = fake_config("source.pace=realtime", "life.hang_s=0.3"), Box(), FakeSource(30, period_s=0.05)
    Node(config, Parts(open_source=lambda _: source, load_model=load), box).run()
    assert loaded == [None, "bfloat16"]
    assert [fields["code"] for fields in box.told("event")] == ["GPU_OOM", "SRC_ENDED"]
    assert box.of("win")[-1].header.model.precision == "bfloat16"
