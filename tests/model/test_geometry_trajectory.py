import math
from collections.abc import Callable
from typing import get_args

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import OptionError, PoseError, ShapeError
from gcd_model.geometry import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    CameraMount,
    Interpolation,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    fitted_trajectory,
    invert_rigid,
    look_at,
    motion_bucket,
    path_progress,
    pose_trajectory,
    relative_pose,
    spherical_trajectory,
    to_pose,
)

SOURCE = Spherical(azimuth_deg=15.0, elevation_deg=5.0, radius_m=15.0)
DELTA = SphericalDelta(azimuth_deg=-70.3, elevation_deg=25.1, radius_m=-2.2)
IDENTITY = torch.eye(4, dtype=torch.float64)
PACES: tuple[Interpolation, ...] = get_args(Interpolation)
SINE_14 = [0, 0.014529, 0.057272, 0.125745, 0.215968, 0.322698, 0.439732]
"""First half of the sine pace over 14 frames, as released."""


def point(xyz: tuple[float, float, float]) -> Tensor:
    return torch.tensor(xyz, dtype=torch.float64)


def gradual(delta: SphericalDelta = DELTA, interpolation: Interpolation = "linear") -> Trajectory:
    return spherical_trajectory(SOURCE, delta, frames=14, move_time=13, interpolation=interpolation)


def deltas_of(trajectory: Trajectory) -> list[SphericalDelta]:
    assert trajectory.delta is not None
    return [
        SphericalDelta(azimuth_deg=azimuth, elevation_deg=elevation, radius_m=radius)
        for azimuth, elevation, radius in trajectory.delta.tolist()
    ]


# The pace


@pytest.mark.parametrize("interpolation", PACES)
@pytest.mark.parametrize(("frames", "move_time"), [(14, 13), (14, 5), (14, 1), (2, 1), (7, 6)])
def test_progress_rises_from_0_and_is_exactly_1_from_move_time_on(
    frames: int, move_time: int, interpolation: Interpolation
) -> None:
    done = path_progress(frames, move_time, interpolation)
    assert done.shape == (frames,)
    assert done.dtype == torch.float64
    assert done[0].item() == 0.0
    assert bool((done[move_time:] == 1.0).all())
    assert bool((done[: move_time + 1].diff() > 0.0).all())


def test_the_recorded_sine_pace() -> None:
    mirrored = [1 - done for done in reversed(SINE_14)]
    assert path_progress(14, 13, "sine").tolist() == pytest.approx(SINE_14 + mirrored, abs=1e-6)


# Paths over the sphere


@pytest.mark.parametrize("interpolation", PACES)
def test_poses_and_deltas_of_a_spherical_path_say_the_same(interpolation: Interpolation) -> None:
    trajectory = gradual(interpolation=interpolation)
    for pose, delta in zip(trajectory.source_from_target, deltas_of(trajectory), strict=True):
        assert_close(pose, relative_pose(to_pose(SOURCE), to_pose(SOURCE + delta)), rtol=0, atol=1e-12)


def test_a_gradual_path_starts_at_the_source_and_only_its_last_frame_is_at_the_goal() -> None:
    trajectory = gradual()
    assert trajectory.frames == 14
    assert trajectory.source == SOURCE
    assert trajectory.at_goal == (False,) * 13 + (True,)
    assert_close(trajectory.source_from_target[0], IDENTITY, rtol=0, atol=1e-12)
    assert deltas_of(trajectory)[0] == SphericalDelta()


def test_a_direct_path_is_all_goal() -> None:
    trajectory = spherical_trajectory(SOURCE, DELTA, frames=14, move_time=0)
    goal = relative_pose(to_pose(SOURCE), to_pose(SOURCE + DELTA))
    assert trajectory.at_goal == (True,) * 14
    assert deltas_of(trajectory) == [DELTA] * 14
    assert_close(trajectory.source_from_target, goal.expand(14, 4, 4), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: gradual(SphericalDelta(elevation_deg=86.0)), PoseError),
        (lambda: path_progress(14, 14), OptionError),
        (lambda: path_progress(0, 0), OptionError),
        (lambda: pose_trajectory(torch.zeros(0, 4, 4)), ShapeError),
        (lambda: pose_trajectory(2 * IDENTITY.expand(14, 4, 4)), PoseError),
        (lambda: fitted_trajectory(torch.zeros(2, 3, 4, 4), SOURCE), ShapeError),
    ],
)
def test_a_path_that_no_camera_can_take_is_refused(make: Callable[[], object], error: type[Exception]) -> None:
    with pytest.raises(error):
        make()


# The driving path


def test_the_driving_path_leads_from_the_forward_camera_to_above_and_behind() -> None:
    trajectory = driving_trajectory(frames=14, move_time=13)
    vehicle_from_source = look_at(point((1.6, 0.0, 1.55)), point((6.6, 0.0, 1.55)))
    vehicle_from_goal = vehicle_from_source @ trajectory.source_from_target[-1]
    target_in_goal = invert_rigid(vehicle_from_goal) @ point((5.6, 0.0, 1.55)).new_tensor([5.6, 0.0, 1.55, 1.0])

    assert_close(trajectory.source_from_target[0], IDENTITY, rtol=0, atol=1e-12)
    assert_close(vehicle_from_goal[:3, 3], point((-8.0, 0.0, 8.0)), rtol=0, atol=1e-12)
    assert_close(target_in_goal[:3], point((0.0, 0.0, math.hypot(13.6, 6.45))), rtol=0, atol=1e-12)
    assert_close(vehicle_from_goal[:3, 0], point((0.0, -1.0, 0.0)), rtol=0, atol=1e-12)


def test_on_the_driving_path_position_and_target_move_separately_at_a_sine_pace() -> None:
    trajectory = driving_trajectory(frames=14, move_time=13)
    vehicle_from_source = CameraMount().vehicle_from_camera
    for t, done in enumerate(SINE_14):
        vehicle_from_camera = vehicle_from_source @ trajectory.source_from_target[t]
        position = (1 - done) * point(DRIVING_SOURCE_POSITION) + done * point(DRIVING_GOAL_POSITION)
        target = (1 - done) * point(DRIVING_SOURCE_TARGET) + done * point(DRIVING_GOAL_TARGET)
        assert_close(vehicle_from_camera, look_at(position, target), rtol=0, atol=1e-4)


def test_the_driving_path_stays_where_it_is_in_the_vehicles_frame_however_the_camera_is_mounted() -> None:
    trained, other = CameraMount(), CameraMount(height_m=1.1, forward_m=-0.3, left_m=0.4, tilt_deg=9.0, hfov_deg=60.0)
    published = driving_trajectory(frames=14, move_time=13).source_from_target
    assert_close(driving_trajectory(frames=14, move_time=13, mount=trained).source_from_target, published)
    moved = driving_trajectory(frames=14, move_time=13, mount=other).source_from_target
    assert_close(other.vehicle_from_camera @ moved, trained.vehicle_from_camera @ published)
    assert float((moved - published).abs().max()) > 0.1


# Free paths


def test_a_free_path_is_at_its_goal_where_its_pose_is_the_last_one() -> None:
    asked = gradual().source_from_target[[0, 13, 7, 13, 13]]
    trajectory = pose_trajectory(asked)
    assert trajectory.at_goal == (False, True, False, True, True)
    assert trajectory.delta is None
    assert_close(trajectory.source_from_target, asked, rtol=0, atol=0)


@pytest.mark.parametrize("delta", [DELTA, SphericalDelta(azimuth_deg=-300.0), SphericalDelta(azimuth_deg=725.0)])
def test_a_spherical_path_is_found_again_without_jumps(delta: SphericalDelta) -> None:
    asked = gradual(delta)
    fitted, fits = fitted_trajectory(asked.source_from_target, SOURCE)
    assert asked.delta is not None
    assert fitted.delta is not None
    assert_close(fitted.delta, asked.delta, rtol=0, atol=1e-9)
    assert_close(fitted.source_from_target, asked.source_from_target, rtol=0, atol=1e-9)
    assert fitted.source == SOURCE
    assert fitted.at_goal[-1]
    assert [fit.delta for fit in fits] == deltas_of(fitted)
    assert max(fit.rotation_error_deg for fit in fits) < 1e-6
    assert max(fit.position_error_m for fit in fits) < 1e-9


def test_a_fitted_path_holds_the_fitted_poses_and_reports_the_rest() -> None:
    asked = gradual().source_from_target.clone()
    asked[5] = asked[5] @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))  # upside down
    fitted, fits = fitted_trajectory(asked, SOURCE)
    assert_close(fitted.source_from_target, gradual().source_from_target, rtol=0, atol=1e-9)
    assert [round(fit.rotation_error_deg, 3) for fit in fits] == [0.0] * 5 + [180.0] + [0.0] * 8


# The type itself


@pytest.mark.parametrize(
    ("poses", "delta", "flags", "error"),
    [
        (IDENTITY.expand(2, 4, 4), None, 3, ShapeError),
        (IDENTITY.expand(2, 4, 4), torch.zeros(3, 3).double(), 2, ShapeError),
        (IDENTITY.expand(2, 4, 4), torch.full((2, 3), math.nan).double(), 2, ShapeError),
        (IDENTITY.expand(2, 4, 4).float(), None, 2, ShapeError),
        (IDENTITY, None, 4, ShapeError),
        (torch.zeros(2, 4, 4).double(), None, 2, PoseError),
    ],
)
def test_a_trajectory_checks_itself(poses: Tensor, delta: Tensor | None, flags: int, error: type[Exception]) -> None:
    with pytest.raises(error):
        Trajectory(source_from_target=poses, delta=delta, at_goal=(True,) * flags, source=None)


def test_the_motion_number_is_255_only_with_both_angles_at_their_largest() -> None:
    for largest in ((90.0, 30.0), (180.0, 60.0)):

        def number(azimuth: float, elevation: float, largest: tuple[float, float] = largest) -> int:
            delta = SphericalDelta(azimuth_deg=azimuth * largest[0], elevation_deg=elevation * largest[1], radius_m=2.0)
            return motion_bucket(delta, max_azimuth_deg=largest[0], max_elevation_deg=largest[1])

        assert [number(1, 1), number(1, 0), number(0, 1), number(0, 0)] == [255, 242, 81, 0]
        assert number(2, 2) == 510  # it is not clamped
    with pytest.raises(OptionError):
        motion_bucket(SphericalDelta(azimuth_deg=10.0), max_azimuth_deg=0.0, max_elevation_deg=0.0)
