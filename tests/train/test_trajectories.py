"""The paper's sampling of frames and camera paths: its laws, then its numbers."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcd_model.geometry import Spherical
from gcd_train.data.paths import (
    DRIVING,
    DRIVING_FRAMES,
    KUBRIC_FRAMES,
    MAX90,
    MAX180,
    Control,
    Draw,
    DrivingSampling,
    FrameSampling,
    OrbitSampling,
    generator,
)
from gcd_train.errors import DataError, RecipeError

SEEDS = st.integers(0, 2**31)
LAWS = settings(max_examples=25, deadline=None)


def drawn(sampling: OrbitSampling | DrivingSampling, seed: int, index: int = 0) -> Draw:
    orbit = isinstance(sampling, OrbitSampling)
    return sampling.draw(generator(seed, index), 60 if orbit else 50, 24.0 if orbit else 10.0)


def goal_of(draw: Draw) -> tuple[float, float, float]:
    assert draw.start is not None
    assert draw.deltas is not None
    azimuth, elevation, radius = draw.deltas[-1].tolist()
    return draw.start.azimuth_deg + azimuth, draw.start.elevation_deg + elevation, draw.start.radius_m + radius


@LAWS
@given(SEEDS, st.sampled_from([MAX90, MAX180]))
def test_source_and_goal_stay_within_the_published_bounds(seed: int, sampling: OrbitSampling) -> None:
    draw = drawn(sampling, seed)
    assert draw.start is not None
    assert draw.deltas is not None
    _, elevation, radius = goal_of(draw)
    assert 0 <= draw.start.azimuth_deg < 360
    assert -1e-9 <= draw.start.elevation_deg <= 50 + 1e-9
    assert -1e-9 <= elevation <= 50 + 1e-9
    assert 12 <= draw.start.radius_m <= 18
    assert 12 - 1e-9 <= radius <= 18 + 1e-9
    change = np.abs(draw.deltas[-1])
    assert (change <= [sampling.max_azimuth_deg, sampling.max_elevation_deg, 3 + 1e-9]).all()


@LAWS
@given(SEEDS, st.sampled_from([MAX90, MAX180, DRIVING]))
def test_a_gradual_clip_starts_at_the_source_and_ends_at_the_goal(
    seed: int, sampling: OrbitSampling | DrivingSampling
) -> None:
    draw = drawn(sampling, seed)
    np.testing.assert_allclose(draw.world_from_target[0], draw.world_from_source, atol=1e-9)
    if draw.deltas is not None:
        np.testing.assert_array_equal(draw.deltas[0], 0.0)
        np.testing.assert_allclose(draw.deltas, draw.deltas[-1] * (np.arange(14) / 13)[:, None], atol=1e-9)


@LAWS
@given(SEEDS, st.integers(0, 13), st.sampled_from([MAX90, DRIVING]))
def test_the_goal_is_reached_at_the_move_time_and_kept(
    seed: int, move_time: int, sampling: OrbitSampling | DrivingSampling
) -> None:
    draw = drawn(replace(sampling, move_time=move_time), seed)
    apart = np.abs(draw.world_from_target - draw.world_from_target[-1]).max((1, 2))
    np.testing.assert_array_equal(apart[move_time:], 0.0)
    assert (apart[:move_time] > 0).all()


@LAWS
@given(SEEDS, st.integers(16, 80), st.sampled_from([KUBRIC_FRAMES, DRIVING_FRAMES]))
def test_frames_are_evenly_spaced_and_inside_the_scene(seed: int, frames: int, sampling: FrameSampling) -> None:
    numbers, stride = sampling.draw(generator(seed, 0), frames)
    assert len(numbers) == 14
    assert set(np.diff(numbers)) in ({stride}, {-stride})
    assert min(numbers) >= 0
    assert max(numbers) < frames - 1  # as released, the last frame is out of reach
    assert stride in sampling.strides


@LAWS
@given(SEEDS, st.integers(0, 10_000), st.permutations(range(3)))
def test_a_sample_depends_on_seed_and_index_alone(seed: int, first: int, order: list[int]) -> None:
    in_order = {index: drawn(MAX180, seed, first + index) for index in range(3)}
    for index in order:
        again = drawn(MAX180, seed, first + index)
        assert again.frame_numbers == in_order[index].frame_numbers
        np.testing.assert_array_equal(again.world_from_target, in_order[index].world_from_target)
    assert len({in_order[index].world_from_target.tobytes() for index in range(3)}) == 3


def test_source_directions_are_uniform_on_the_sphere() -> None:
    rng = generator(1, 0)
    sources = [MAX90.source(rng) for _ in range(4000)]
    share = np.sin(np.radians([source.elevation_deg for source in sources])) / math.sin(math.radians(50))
    counts, _ = np.histogram(share, bins=10, range=(0, 1))
    assert abs(counts - 400).max() < 100  # five standard deviations
    assert np.mean([source.elevation_deg < 25 for source in sources]) == pytest.approx(0.5517, abs=0.04)


def test_starts_and_strides_are_those_of_the_release() -> None:
    assert [KUBRIC_FRAMES.last_start(60, stride) for stride in (1, 2, 3, 4)] == [6, 6, 6, 6]
    assert [DRIVING_FRAMES.last_start(50, stride) for stride in (1, 2)] == [35, 22]
    draws = [KUBRIC_FRAMES.draw(generator(3, index), 60) for index in range(1500)]
    assert {stride for _, stride in draws} == {1, 2, 3, 4}
    assert {min(numbers) for numbers, _ in draws} == set(range(7))
    assert np.mean([numbers[0] > numbers[-1] for numbers, _ in draws]) == pytest.approx(0.2, abs=0.05)
    assert {drawn(MAX90, 3, index).fps for index in range(30)} == {24.0, 12.0, 8.0, 6.0}
    driving = [drawn(DRIVING, 3, index) for index in range(30)]
    assert all(draw.frame_numbers[0] < draw.frame_numbers[-1] for draw in driving)
    assert {draw.fps for draw in driving} == {10.0, 5.0}


def test_the_last_frame_can_be_reached_by_choice() -> None:
    sampling = FrameSampling(reach_last=True)
    assert sampling.draw(generator(0, 0), 14)[0] == tuple(range(14))
    with pytest.raises(DataError, match=r"clip of 14 at stride 1 wants 15 frames \(the last is left out.*\), got 14"):
        FrameSampling().draw(generator(0, 0), 14)


def test_a_reversed_clip_runs_backwards_under_the_same_camera() -> None:
    forward = replace(MAX90, frames=replace(KUBRIC_FRAMES, reverse=0.0))
    backward = replace(MAX90, frames=replace(KUBRIC_FRAMES, reverse=1.0))
    one, other = drawn(forward, 5), drawn(backward, 5)
    assert one.frame_numbers == other.frame_numbers[::-1]
    np.testing.assert_array_equal(one.world_from_target, other.world_from_target)


def test_the_driving_path_is_the_published_one() -> None:
    poses = drawn(DRIVING, 0).world_from_target
    np.testing.assert_allclose(poses[0][:3, 3], [1.6, 0.0, 1.55], atol=1e-12)
    np.testing.assert_allclose(poses[-1][:3, 3], [-8.0, 0.0, 8.0], atol=1e-12)
    np.testing.assert_allclose(poses[0][:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    done = (1.6 - poses[:, 0, 3]) / 9.6
    np.testing.assert_allclose(done[:4], [0.0, 0.014529, 0.057272, 0.125745], atol=1e-6)


def test_a_kubric_control_is_followed_whatever_the_bounds() -> None:
    start = Spherical(azimuth_deg=15.0, elevation_deg=5.0, radius_m=15.0)
    goal = Spherical(azimuth_deg=195.0, elevation_deg=70.0, radius_m=25.0)
    control = Control(name="sample_00", frame_start=3, frame_skip=4, start=start, goal=goal)
    draw = MAX90.controlled(control, 60, 24.0)
    assert draw.frame_numbers == tuple(range(3, 56, 4))
    assert (draw.fps, draw.start) == (6.0, start)
    np.testing.assert_allclose(goal_of(draw), [195.0, 70.0, 25.0])
    with pytest.raises(DataError, match="sample_00 asks for frame 55 of 50"):
        MAX90.controlled(control, 50, 24.0)


def test_a_driving_control_says_frames_only() -> None:
    control = Control(name="sample_03", frame_start=19, frame_skip=2)
    draw = DRIVING.controlled(control, 50, 10.0)
    assert (draw.frame_numbers[0], draw.frame_numbers[-1], draw.fps) == (19, 45, 5.0)
    with pytest.raises(DataError, match="sample_03 has no cameras"):
        MAX90.controlled(control, 50, 24.0)


@pytest.mark.parametrize(
    "options",
    [
        {"elevation_deg": (50.0, 0.0)},
        {"elevation_deg": (0.0, 91.0)},
        {"radius_m": (0.0, 5.0)},
    ],
)
def test_bounds_that_mean_nothing_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(RecipeError):
        OrbitSampling(**options)


def test_short_scenes_take_the_strides_that_fit() -> None:
    strides = {KUBRIC_FRAMES.draw(generator(0, index), 30)[1] for index in range(60)}
    assert strides == {1, 2}
