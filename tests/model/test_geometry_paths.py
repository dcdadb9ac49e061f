"""Cameras on the sphere and their paths: laws, and the numbers of the released data."""

import math
from collections.abc import Callable
from itertools import product
from typing import get_args

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    LOOK_AT,
    CameraMount,
    Interpolation,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    fitted_trajectory,
    from_pose,
    invert_rigid,
    look_at,
    motion_bucket,
    nearest_delta,
    path_progress,
    pose_trajectory,
    relative_pose,
    require_rigid,
    spherical_trajectory,
    to_pose,
)

AZIMUTHS_DEG, ELEVATIONS_DEG = [-179.0, 0.0, 123.4], [-60.0, 5.0, 89.0]
SOURCE = Spherical(azimuth_deg=15.0, elevation_deg=5.0, radius_m=15.0)
DELTA = SphericalDelta(azimuth_deg=-70.3, elevation_deg=25.1, radius_m=-2.2)
IDENTITY = torch.eye(4, dtype=torch.float64)
PACES: tuple[Interpolation, ...] = get_args(Interpolation)
SINE_14 = [0, 0.014529, 0.057272, 0.125745, 0.215968, 0.322698, 0.439732]
"""First half of the sine pace over 14 frames, as released."""


def point(xyz: tuple[float, float, float]) -> Tensor:
    return torch.tensor(xyz, dtype=torch.float64)


CENTRE = point(LOOK_AT)


def spherical(azimuth_deg: float, elevation_deg: float, radius_m: float = 12.0) -> Spherical:
    return Spherical(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def change(azimuth_deg: float = 0.0, elevation_deg: float = 0.0, radius_m: float = 0.0) -> SphericalDelta:
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def asked_change(delta: SphericalDelta) -> Tensor:
    return relative_pose(to_pose(SOURCE), to_pose(SOURCE + delta))


def gradual(delta: SphericalDelta = DELTA, interpolation: Interpolation = "linear") -> Trajectory:
    return spherical_trajectory(SOURCE, delta, frames=14, move_time=13, interpolation=interpolation)


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
    assert_close(centre_in_camera[:3], point((0.0, 0.0, 12.0)), rtol=0, atol=1e-12)

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
    "delta", [change(*numbers) for numbers in product([-170.0, 0.0, 90.0, 190.0, -200.0, 359.0], [-60.0, 84.0], [2.0])]
)
def test_a_spherical_change_is_found_again_with_nothing_left_over_and_the_azimuth_nearest_zero(
    delta: SphericalDelta,
) -> None:
    found, turned_deg = nearest_delta(asked_change(delta), SOURCE)
    assert found.azimuth_deg == pytest.approx(math.remainder(delta.azimuth_deg, 360.0), abs=1e-9)
    assert (found.elevation_deg, found.radius_m) == pytest.approx((delta.elevation_deg, delta.radius_m), abs=1e-9)
    assert turned_deg == pytest.approx(0.0, abs=1e-6)


def test_any_position_is_met_whatever_the_camera_looks_at() -> None:
    generator = torch.Generator().manual_seed(7)
    turns, shifts = (torch.randn(20, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    for turn, shift in zip(turns, 8 * shifts, strict=True):
        asked = IDENTITY.clone()
        asked[:3, :3], asked[:3, 3] = axis_angle_to_rotation_matrix(math.pi / 2 * turn[None])[0], shift
        delta, turned_deg = nearest_delta(asked, SOURCE)
        assert_close(asked_change(delta)[:3, 3], shift, rtol=0, atol=1e-9)
        assert 0.0 <= turned_deg <= 180.0


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: spherical(0.0, 90.5, 10.0), PoseError),
        (lambda: spherical(0.0, 0.0, 0.0), PoseError),
        (lambda: spherical(math.nan, 0.0, 1.0), PoseError),
        (lambda: SOURCE + change(elevation_deg=86.0), PoseError),
        (lambda: SOURCE + change(radius_m=-15.0), PoseError),
        (lambda: change(azimuth_deg=math.inf), PoseError),
        # at the middle
        (lambda: nearest_delta(invert_rigid(to_pose(SOURCE)) @ look_at(CENTRE, CENTRE + 1), SOURCE), PoseError),
        (lambda: gradual(change(elevation_deg=86.0)), PoseError),
        (lambda: path_progress(14, 14), OptionError),
        (lambda: path_progress(0, 0), OptionError),
        (lambda: pose_trajectory(torch.zeros(0, 4, 4)), ShapeError),
        (lambda: pose_trajectory(2 * IDENTITY.expand(14, 4, 4)), PoseError),
        (lambda: fitted_trajectory(torch.zeros(2, 3, 4, 4), SOURCE), ShapeError),
        (lambda: Trajectory(source_from_target=IDENTITY.expand(2, 4, 4).float()), ShapeError),
        (lambda: Trajectory(source_from_target=IDENTITY), ShapeError),
        *(
            (lambda delta=delta: Trajectory(source_from_target=IDENTITY.expand(2, 4, 4), delta=delta), ShapeError)
            for delta in (torch.zeros(3, 3).double(), torch.full((2, 3), math.nan).double(), torch.zeros(2, 3))
        ),
    ],
)
def test_a_camera_that_cannot_stand_there_or_take_that_path_is_refused(
    make: Callable[[], object], error: type[Exception]
) -> None:
    with pytest.raises(error):
        make()


def test_the_recorded_pose_of_kubric_view_4() -> None:
    """Position and axes of the camera at (15 deg, 5 deg, 15 m), as the released data have it."""
    right, down, ahead, position = to_pose(SOURCE)[:3].unbind(-1)
    assert position.tolist() == pytest.approx([14.433753, 3.867512, 2.307336], abs=1e-6)
    assert right.tolist() == pytest.approx([-0.258819, 0.965926, 0.0], abs=1e-6)
    assert down.tolist() == pytest.approx([0.084186, 0.022558, -0.996195], abs=1e-6)
    assert ahead.tolist() == pytest.approx([-0.96225, -0.257834, -0.087156], abs=1e-6)


@pytest.mark.parametrize("interpolation", PACES)
@pytest.mark.parametrize(("frames", "move_time"), [(14, 13), (14, 5), (14, 1), (2, 1)])
def test_progress_rises_from_0_and_is_exactly_1_from_move_time_on(
    frames: int, move_time: int, interpolation: Interpolation
) -> None:
    done = path_progress(frames, move_time, interpolation)
    assert (done.shape, done.dtype, done[0].item()) == ((frames,), torch.float64, 0.0)
    assert bool((done[move_time:] == 1.0).all())
    assert bool((done[: move_time + 1].diff() > 0.0).all())


def test_the_recorded_sine_pace() -> None:
    mirrored = [1 - done for done in reversed(SINE_14)]
    assert path_progress(14, 13, "sine").tolist() == pytest.approx(SINE_14 + mirrored, abs=1e-6)


@pytest.mark.parametrize("interpolation", PACES)
def test_a_gradual_path_starts_at_the_source_its_poses_are_its_changes_and_only_its_last_frame_is_at_the_goal(
    interpolation: Interpolation,
) -> None:
    trajectory = gradual(interpolation=interpolation)
    assert trajectory.delta is not None
    assert_close(trajectory.delta, path_progress(14, 13, interpolation)[:, None] * point((-70.3, 25.1, -2.2)))
    for pose, row in zip(trajectory.source_from_target, trajectory.delta.tolist(), strict=True):
        assert_close(pose, asked_change(change(*row)), rtol=0, atol=1e-12)
    assert_close(trajectory.source_from_target[0], IDENTITY, rtol=0, atol=1e-12)
    assert (trajectory.frames, trajectory.source, trajectory.goal_delta) == (14, SOURCE, DELTA)
    assert trajectory.at_goal == (False,) * 13 + (True,)


def test_a_direct_path_is_all_goal() -> None:
    trajectory = spherical_trajectory(SOURCE, DELTA, frames=14, move_time=0)
    assert trajectory.at_goal == (True,) * 14
    assert trajectory.delta is not None
    assert trajectory.delta.tolist() == [[-70.3, 25.1, -2.2]] * 14
    assert_close(trajectory.source_from_target, asked_change(DELTA).expand(14, 4, 4), rtol=0, atol=1e-12)


def test_the_driving_path_leads_from_the_forward_camera_to_above_and_behind() -> None:
    trajectory = driving_trajectory(frames=14, move_time=13)
    vehicle_from_source = look_at(point((1.6, 0.0, 1.55)), point((6.6, 0.0, 1.55)))
    vehicle_from_goal = vehicle_from_source @ trajectory.source_from_target[-1]
    target_in_goal = invert_rigid(vehicle_from_goal) @ CENTRE.new_tensor([5.6, 0.0, 1.55, 1.0])

    assert_close(trajectory.source_from_target[0], IDENTITY, rtol=0, atol=1e-12)
    assert_close(vehicle_from_goal[:3, 3], point((-8.0, 0.0, 8.0)), rtol=0, atol=1e-12)
    assert_close(target_in_goal[:3], point((0.0, 0.0, math.hypot(13.6, 6.45))), rtol=0, atol=1e-12)
    assert_close(vehicle_from_goal[:3, 0], point((0.0, -1.0, 0.0)), rtol=0, atol=1e-12)


def test_on_the_driving_path_position_and_target_move_separately_at_a_sine_pace() -> None:
    trajectory = driving_trajectory(frames=14, move_time=13)
    vehicle_from_source = CameraMount().vehicle_from_camera
    for t, done in enumerate(SINE_14):
        position = (1 - done) * point(DRIVING_SOURCE_POSITION) + done * point(DRIVING_GOAL_POSITION)
        target = (1 - done) * point(DRIVING_SOURCE_TARGET) + done * point(DRIVING_GOAL_TARGET)
        found = vehicle_from_source @ trajectory.source_from_target[t]
        assert_close(found, look_at(position, target), rtol=0, atol=1e-4)


def test_the_driving_path_stays_where_it_is_in_the_vehicles_frame_however_the_camera_is_mounted() -> None:
    trained, other = CameraMount(), CameraMount(height_m=1.1, forward_m=-0.3, left_m=0.4, tilt_deg=9.0, hfov_deg=60.0)
    published, same, moved = (
        driving_trajectory(frames=14, move_time=13, mount=mount).source_from_target for mount in (None, trained, other)
    )
    assert_close(same, published)
    assert_close(other.vehicle_from_camera @ moved, trained.vehicle_from_camera @ published)
    assert float((moved - published).abs().max()) > 0.1


def test_a_free_path_is_at_its_goal_where_its_pose_is_the_last_one() -> None:
    asked = gradual().source_from_target[[0, 13, 7, 13, 13]]
    trajectory = pose_trajectory(asked)
    assert trajectory.at_goal == (False, True, False, True, True)
    assert trajectory.delta is trajectory.goal_delta is None
    assert_close(trajectory.source_from_target, asked, rtol=0, atol=0)


@pytest.mark.parametrize("delta", [DELTA, change(azimuth_deg=-300.0), change(azimuth_deg=725.0)])
def test_a_spherical_path_is_found_again_without_jumps(delta: SphericalDelta) -> None:
    asked = gradual(delta)
    fitted, turned_deg = fitted_trajectory(asked.source_from_target, SOURCE)
    assert asked.delta is not None
    assert fitted.delta is not None
    assert_close(fitted.delta, asked.delta, rtol=0, atol=1e-9)
    assert_close(fitted.source_from_target, asked.source_from_target, rtol=0, atol=1e-9)
    assert (fitted.source, fitted.at_goal[-1]) == (SOURCE, True)
    assert turned_deg < 1e-6


def test_a_fitted_path_holds_the_fitted_poses_and_reports_the_rest() -> None:
    asked = gradual().source_from_target.clone()
    asked[5] = asked[5] @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))  # upside down
    fitted, turned_deg = fitted_trajectory(asked, SOURCE)
    assert_close(fitted.source_from_target, gradual().source_from_target, rtol=0, atol=1e-9)
    assert turned_deg == pytest.approx(180.0)


@pytest.mark.parametrize("largest", [(90.0, 30.0), (180.0, 60.0)])
def test_the_motion_number_is_255_only_with_both_angles_at_their_largest(largest: tuple[float, float]) -> None:
    def number(azimuth: float, elevation: float) -> int:
        delta = change(azimuth * largest[0], elevation * largest[1], 2.0)
        return motion_bucket(delta, max_azimuth_deg=largest[0], max_elevation_deg=largest[1])

    assert [number(1, 1), number(1, 0), number(0, 1), number(0, 0)] == [255, 242, 81, 0]
    assert number(2, 2) == 510  # it is not clamped
    with pytest.raises(OptionError):
        motion_bucket(SphericalDelta(azimuth_deg=10.0), max_azimuth_deg=0.0, max_elevation_deg=0.0)
