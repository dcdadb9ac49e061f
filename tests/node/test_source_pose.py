"""Where the source camera stands: on a sphere or on its vehicle, and which model takes which."""

import numpy as np
import pytest
from fakes import Box, FakeSource, FakeSynthesizer, fake_config, live_traits, run, traits

from gcd_model import CameraMount, Traits
from gcd_node.errors import ConfigError
from gcd_node.preprocess import stated_mount
from gcd_node.sources import SourcePose


def played(made: Traits, pose: str = "", fps: float = 10.0) -> tuple[FakeSynthesizer, Box]:
    model = FakeSynthesizer(made)
    changes = [f"source.pose={{{pose}}}"] if pose else []
    return model, run(fake_config(*changes), model, FakeSource(14, fps=fps))


def matrices(box: Box) -> np.ndarray:
    found = box.of("win")[0].header.source_from_view
    assert found is not None
    return np.array(found).reshape(-1, 4, 4)


@pytest.mark.parametrize("pose", ["height_m = 2.4", "tilt_deg = 12.0", "left_m = 0.4, forward_m = -1.0"])
def test_the_view_stays_where_it_is_on_the_vehicle_however_the_camera_is_mounted(pose: str) -> None:
    _, usual = played(live_traits())
    model, box = played(live_traits(), pose)
    mount = model.clips[0].mount
    assert mount is not None
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
    assert source is not None
    assert (source.elevation_deg, source.radius_m) == (25.0, 13.0)
    assert model.clips[0].mount is None
    assert (meta["mount"], meta["src_pose"]) == (None, {"el_deg": 25.0, "r": 13.0, "assumed": False})
    meta = played(traits("driving"))[1].told("meta")[0]
    assert (meta["mount"], meta["src_pose"]) == (None, None)
