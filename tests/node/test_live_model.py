"""The live model in a node: replayed to the bit, placed on the vehicle, steered to any pose."""

import math
from pathlib import Path

import pytest
import torch
from msgspec.structs import replace

from gcd_model import CameraMount, OptionError, load_synthesizer
from gcd_node.cli.main import run_app
from gcd_node.config import NodeConfig, ViewConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.frame import SourceInfo
from gcd_node.preprocess import assumed_hfov_deg
from gcd_node.replay.run import open_run
from gcd_node.sources import SourcePose
from gcd_node.stream_context import config_digest, prepare_stream
from gcd_node.verbs import SetView
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
def test_a_replay_of_the_live_model_is_the_same_twice_with_all_its_maps(tmp_path: Path) -> None:
    (tmp_path / "launch.toml").write_text(LAUNCH)
    for name in ("a", "b"):
        assert run_app(["replay", str(tmp_path / "launch.toml"), "--out", str(tmp_path / name)]) == 0
    windows = [open_run(tmp_path / name).manifest.windows for name in ("a", "b")]
    assert windows[0] == windows[1]
    assert set(windows[0][0].views["placed"]) == {"win", "cls", "vis", "depth"}
    assert [len(each.stamps_ns) for each in windows[0]] == [1] * 5  # a view of every frame


def test_views_stand_at_their_goals_and_are_placed_from_the_mount() -> None:
    placed = VirtualView("placed", config(), TRAITS, MOUNT).planned()
    assert all(placed.at_goal)
    vehicle_from_view = MOUNT.vehicle_from_camera @ placed.source_from_target[0]
    assert vehicle_from_view[:3, 3].tolist() == pytest.approx([-4.0, 3.0, 3.0])
    above = VirtualView("topdown", config(), TRAITS, MOUNT).planned()
    assert all(above.at_goal)
    assert (MOUNT.vehicle_from_camera @ above.source_from_target[0])[:3, 3].tolist() == pytest.approx([-8.0, 0.0, 8.0])


def test_a_view_takes_any_rigid_pose_as_it_is() -> None:
    rolled = (0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    as_numbers = (2.0, -1.0, 3.0, 0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # the same as position and quaternion
    for pose in (rolled, as_numbers):
        view = ViewConfig(kind="pose", pose=pose)
        planned = VirtualView("main", replace(config(), view={"main": view}), TRAITS).planned()
        wanted = torch.tensor(rolled, dtype=torch.float64)
        assert torch.allclose(planned.source_from_target[7].flatten(), wanted, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        'kind = "pose"',
        "pose = [0, 0, 1, 0, 0, 0, 1]",
        'kind = "pose"\npose = [0, 0, 1, 0, 0, 0, 1]\nradius = 2.0',
        'kind = "pose"\npose = [0, 0, 1]',
        'kind = "pose"\npose = [0, 0, 1, 0, 0, 0, 0]',
        'kind = "pose"\npose = [0, 0, nan, 0, 0, 0, 1]',
        'kind = "pose"\npose = [0, 0, 2e4, 0, 0, 0, 1]',
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


def test_places_are_for_models_that_take_any_pose_and_cameras_on_vehicles() -> None:
    sphere = replace(config().source, pose=SourcePose(radius=3.0))
    with pytest.raises(OptionError):
        VirtualView("placed", replace(config(), source=sphere), TRAITS)
    with pytest.raises(OptionError):
        VirtualView("placed", config(), load_synthesizer("random:kubric90", device="cpu").traits)


def test_set_view_takes_a_place_too() -> None:
    wanted = SetView(view="main", position_m=(0.0, 0.0, 2.0), look_at_m=(3.0, 0.0, 0.0))
    assert wanted.to_config() == ViewConfig(position_m=(0.0, 0.0, 2.0), look_at_m=(3.0, 0.0, 0.0))


def test_the_lens_is_the_stated_one_or_is_assumed_and_published() -> None:
    for hfov_deg, pose, wanted in (
        (60.0, None, 60.0),
        (None, None, 85.0),
        (None, SourcePose(radius=2.0), assumed_hfov_deg(SourcePose(radius=2.0))),
    ):
        source = replace(config().source, hfov_deg=hfov_deg, pose=pose)
        views = {"main": ViewConfig()}
        run = prepare_stream(replace(config(), source=source, view=views), TRAITS, INFO)
        assert run.intrinsics is not None
        assert run.intrinsics.hfov_deg == pytest.approx(wanted)
        assert run.ood == ()
    wide = prepare_stream(replace(config(), source=replace(config().source, hfov_deg=140.0)), TRAITS, INFO)
    assert wide.ood == ("hfov",)


def test_where_views_and_cameras_stand_is_part_of_the_configurations_name() -> None:
    digests = {
        config_digest(replace(config(), source=replace(config().source, pose=pose)), TRAITS)
        for pose in (None, SourcePose(height_m=1.0), SourcePose(height_m=2.0), SourcePose(radius=2.0))
    }
    moved = ViewConfig(position_m=(-4.0, 3.0, 3.5), look_at_m=(12.0, 0.0, 0.5))
    digests |= {config_digest(each, TRAITS) for each in (config(), replace(config(), view={"placed": moved}))}
    assert len(digests) == 6
