"""Where the source camera stands: on a sphere or on its vehicle, and which model takes which."""

from typing import Any

import numpy as np
import pytest
from fakes import Box, FakeSource, FakeSynthesizer, live_traits, made_node, traits

from gcd_model import CameraMount, Traits
from gcd_node.config import NodeConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.preprocess import stated_mount
from gcd_node.sources import SourcePose


def config(pose: str | None = None, *, source: str = "", more: str = "") -> NodeConfig:
    text = f"""
        {more}
        [source]
        kind = "synthetic"
        pace = "lockstep"
        {source}
        {"" if pose is None else "[source.pose]"}
        {pose or ""}
        [model]
        weights = "fake"
        [view.main]
    """
    return parse_config(text.encode(), "test")


def run(settings: NodeConfig, made: Traits, source: FakeSource | None = None) -> tuple[FakeSynthesizer, Box]:
    model, box = FakeSynthesizer(made), Box()
    made_node(settings, model, source or FakeSource(14, fps=10.0), box).run()
    return model, box


def matrices(box: Box) -> np.ndarray:
    found = box.of("win")[0].header.source_from_view
    assert found is not None
    return np.array(found).reshape(-1, 4, 4)


def meta(box: Box) -> Any:
    return next(fields for topic, fields in box.notes if topic == "meta")


@pytest.mark.parametrize("pose", ["height_m = 2.4", "tilt_deg = 12.0", "left_m = 0.4\nforward_m = -1.0"])
def test_the_view_stays_where_it_is_on_the_vehicle_however_the_camera_is_mounted(pose: str) -> None:
    _, usual = run(config(), live_traits())
    model, box = run(config(pose), live_traits())
    mount = model.clips[0].mount
    assert mount is not None
    moved = mount.vehicle_from_camera.numpy() @ matrices(box)
    assert moved == pytest.approx(CameraMount().vehicle_from_camera.numpy() @ matrices(usual), abs=1e-9)
    told = meta(box)["mount"]
    assert (told["height_m"], told["assumed"]) == (mount.height_m, False)


def test_what_is_left_out_is_as_the_model_was_trained() -> None:
    assert stated_mount(SourcePose(height_m=2.0), None, live_traits()) == CameraMount(height_m=2.0)
    assert stated_mount(SourcePose(height_m=2.0), 70.0, live_traits()) == CameraMount(height_m=2.0, hfov_deg=70.0)
    assert stated_mount(SourcePose(), None, live_traits()) is None
    assert stated_mount(SourcePose(height_m=2.0), 60.0, traits()) is None


@pytest.mark.parametrize(
    ("family", "pose"), [("kubric90", "height_m = 1.5"), ("driving", "tilt_deg = 2.0"), ("driving", "radius = 15.0")]
)
def test_a_pose_in_words_the_model_does_not_know_is_refused_before_the_first_frame(family: str, pose: str) -> None:
    with pytest.raises(ConfigError):
        made_node(config(pose), FakeSynthesizer(traits(family)), FakeSource(14, fps=10.0), Box()).run()


@pytest.mark.parametrize("pose", ["radius = 15.0\nheight_m = 1.5", "height_m = 200.0", "hight_m = 1.5"])
def test_an_impossible_pose_is_refused(pose: str) -> None:
    with pytest.raises(ConfigError):
        config(pose)


def test_an_orbit_is_planned_from_where_the_camera_is_said_to_stand() -> None:
    model, box = run(config("elevation_deg = 25.0\nradius = 13.0"), traits(), FakeSource(14, fps=12.0))
    source = model.asked[0][0][0].source
    assert source is not None
    assert (source.elevation_deg, source.radius_m) == (25.0, 13.0)
    assert model.clips[0].mount is None
    assert (meta(box)["mount"], meta(box)["src_pose"]) == (None, {"el_deg": 25.0, "r": 13.0, "assumed": False})
    _, box = run(config(), traits("driving"))
    assert (meta(box)["mount"], meta(box)["src_pose"]) == (None, None)
