import math
from collections.abc import Callable
from itertools import product

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import PoseError
from gcd_model.geometry import (
    LOOK_AT,
    Spherical,
    SphericalDelta,
    from_pose,
    invert_rigid,
    look_at,
    nearest_delta,
    relative_pose,
    require_rigid,
    to_pose,
)

AZIMUTHS_DEG = [-179.0, 0.0, 123.4]
ELEVATIONS_DEG = [-60.0, 5.0, 89.0]
SOURCE = Spherical(azimuth_deg=15.0, elevation_deg=5.0, radius_m=15.0)
CENTRE = torch.tensor(LOOK_AT, dtype=torch.float64)


def spherical(azimuth_deg: float, elevation_deg: float, radius_m: float = 12.0) -> Spherical:
    return Spherical(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def change(azimuth_deg: float = 0.0, elevation_deg: float = 0.0, radius_m: float = 0.0) -> SphericalDelta:
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def asked_change(delta: SphericalDelta) -> Tensor:
    return relative_pose(to_pose(SOURCE), to_pose(SOURCE + delta))


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), list(product(AZIMUTHS_DEG, [-90.0, *ELEVATIONS_DEG, 90.0])))
def test_spherical_survives_the_round_trip(azimuth_deg: float, elevation_deg: float) -> None:
    back = from_pose(to_pose(spherical(azimuth_deg, elevation_deg)))
    assert back.azimuth_deg == pytest.approx(azimuth_deg, abs=1e-9)
    assert back.elevation_deg == pytest.approx(elevation_deg, abs=1e-6)
    assert back.radius_m == pytest.approx(12.0, abs=1e-9)


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), list(product(AZIMUTHS_DEG, ELEVATIONS_DEG)))
def test_a_spherical_camera_stands_upright_looks_at_the_middle_and_moves_the_way_a_change_says(
    azimuth_deg: float, elevation_deg: float
) -> None:
    view = spherical(azimuth_deg, elevation_deg)
    pose = require_rigid(to_pose(view), "pose")
    centre_in_camera = invert_rigid(pose) @ torch.cat([CENTRE, CENTRE.new_ones(1)])
    assert_close(pose, look_at(pose[:3, 3], CENTRE), rtol=0, atol=1e-11)
    assert_close(centre_in_camera[:3], torch.tensor([0.0, 0.0, 12.0], dtype=torch.float64), rtol=0, atol=1e-12)

    def step(delta: SphericalDelta) -> list[float]:
        return relative_pose(pose, to_pose(view + delta))[:3, 3].tolist()

    assert step(change(azimuth_deg=0.5))[0] > 0.0
    assert step(change(elevation_deg=0.5))[1] < 0.0
    assert step(change(radius_m=-2.0)) == pytest.approx([0.0, 0.0, 2.0], abs=1e-11)


@pytest.mark.parametrize("height", [7.0, -7.0])
def test_a_camera_straight_above_or_below_takes_its_azimuth_from_its_right_axis(height: float) -> None:
    pose = to_pose(spherical(-130.0, math.copysign(90.0, height)))
    pose[:3, 3] = CENTRE + CENTRE.new_tensor([0.0, 0.0, height])
    assert from_pose(pose).azimuth_deg == pytest.approx(-130.0)


def test_adding_a_change_and_taking_the_difference_are_inverse_and_never_wrap() -> None:
    delta = change(azimuth_deg=-475.0, elevation_deg=20.0, radius_m=-3.0)
    moved = SOURCE + delta
    assert moved.azimuth_deg == -460.0
    assert moved - SOURCE == delta


@pytest.mark.parametrize(
    "delta", [change(*numbers) for numbers in product([-170.0, 0.0, 90.0], [-60.0, 84.0], [-3.0, 2.0])]
)
def test_a_spherical_change_is_found_again_with_nothing_left_over(delta: SphericalDelta) -> None:
    fit = nearest_delta(asked_change(delta), SOURCE)
    assert fit.delta.azimuth_deg == pytest.approx(delta.azimuth_deg, abs=1e-9)
    assert fit.delta.elevation_deg == pytest.approx(delta.elevation_deg, abs=1e-9)
    assert fit.delta.radius_m == pytest.approx(delta.radius_m, abs=1e-9)
    assert fit.position_error_m == pytest.approx(0.0, abs=1e-9)
    assert fit.rotation_error_deg == pytest.approx(0.0, abs=1e-6)


def test_any_position_is_met_whatever_the_camera_looks_at() -> None:
    generator = torch.Generator().manual_seed(7)
    turns, shifts = (torch.randn(20, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    for turn, shift in zip(turns, 8 * shifts, strict=True):
        asked = torch.eye(4, dtype=torch.float64)
        asked[:3, :3], asked[:3, 3] = axis_angle_to_rotation_matrix(math.pi / 2 * turn[None])[0], shift
        fit = nearest_delta(asked, SOURCE)
        modelled = relative_pose(to_pose(SOURCE), to_pose(SOURCE + fit.delta))
        assert fit.position_error_m == pytest.approx(0.0, abs=1e-9)
        assert_close(modelled[:3, 3], asked[:3, 3], rtol=0, atol=1e-9)
        assert 0.0 <= fit.rotation_error_deg <= 180.0


@pytest.mark.parametrize(("asked_deg", "found_deg"), [(170.0, 170.0), (190.0, -170.0), (-200.0, 160.0), (359.0, -1.0)])
def test_of_equivalent_azimuths_the_one_nearest_zero_is_found(asked_deg: float, found_deg: float) -> None:
    fit = nearest_delta(asked_change(change(azimuth_deg=asked_deg)), SOURCE)
    assert fit.delta.azimuth_deg == pytest.approx(found_deg, abs=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda: spherical(0.0, 90.5, 10.0),
        lambda: spherical(0.0, 0.0, 0.0),
        lambda: spherical(math.nan, 0.0, 1.0),
        lambda: SOURCE + change(elevation_deg=86.0),
        lambda: SOURCE + change(radius_m=-15.0),
        lambda: change(azimuth_deg=math.inf),
        lambda: nearest_delta(invert_rigid(to_pose(SOURCE)) @ look_at(CENTRE, CENTRE + 1), SOURCE),  # at the middle
    ],
)
def test_a_camera_that_cannot_stand_there_is_refused(make: Callable[[], object]) -> None:
    with pytest.raises(PoseError):
        make()


def test_the_recorded_pose_of_kubric_view_4() -> None:
    """Position and axes of the camera at (15 deg, 5 deg, 15 m), as the released data have it."""
    right, down, ahead, position = to_pose(SOURCE)[:3].unbind(-1)
    assert position.tolist() == pytest.approx([14.433753, 3.867512, 2.307336], abs=1e-6)
    assert right.tolist() == pytest.approx([-0.258819, 0.965926, 0.0], abs=1e-6)
    assert down.tolist() == pytest.approx([0.084186, 0.022558, -0.996195], abs=1e-6)
    assert ahead.tolist() == pytest.approx([-0.96225, -0.257834, -0.087156], abs=1e-6)
