import math
from itertools import accumulate, product
from typing import Any

import pytest

from gcd_model.errors import OptionError
from gcd_model.geometry import Orbit

ORBITS = [
    Orbit(rate_deg_s=rate, amplitude_deg=amplitude, azimuth_deg=share * amplitude, direction=direction)
    for rate, amplitude, share, direction in product([25.0, -7.3], [45.0, 0.1], [-0.9, 0.35], [1, -1])
]


def swing_seconds(orbit: Orbit) -> float:
    return 4 * orbit.amplitude_deg / abs(orbit.rate_deg_s)


def ends_together(one: Orbit, other: Orbit) -> bool:
    """The same motion up to rounding: same place, and same way unless both are at a turn."""
    near = math.isclose(one.azimuth_deg, other.azimuth_deg, abs_tol=1e-6)
    at_turn = math.isclose(abs(one.azimuth_deg), one.amplitude_deg, abs_tol=1e-6)
    return near and (at_turn or one.direction == other.direction)


@pytest.mark.parametrize("orbit", ORBITS)
def test_the_azimuth_never_leaves_the_amplitude(orbit: Orbit) -> None:
    steps = [0.0, 0.01, 0.5, 0.583333, 3.0, 100.0, 12345.678]
    visited = list(accumulate(steps * 5, lambda place, step: place.advanced(step), initial=orbit))
    assert all(abs(place.azimuth_deg) <= orbit.amplitude_deg for place in visited)
    assert {place.amplitude_deg for place in visited} == {orbit.amplitude_deg}


@pytest.mark.parametrize("orbit", ORBITS)
@pytest.mark.parametrize(("first_s", "second_s"), [(0.13, 0.4), (2.0, 9.1), (3.3, -1.2)])
def test_two_steps_are_one_step_of_their_sum(orbit: Orbit, first_s: float, second_s: float) -> None:
    assert ends_together(orbit.advanced(first_s).advanced(second_s), orbit.advanced(first_s + second_s))


@pytest.mark.parametrize("orbit", ORBITS)
def test_a_whole_swing_leads_back_and_half_a_swing_to_the_mirror_image(orbit: Orbit) -> None:
    whole, half = orbit.advanced(swing_seconds(orbit)), orbit.advanced(swing_seconds(orbit) / 2)
    assert ends_together(whole, orbit)
    assert half.azimuth_deg == pytest.approx(-orbit.azimuth_deg, abs=1e-9)
    assert half.direction == -orbit.direction


@pytest.mark.parametrize(
    "orbit", [Orbit(rate_deg_s=0.0, amplitude_deg=20.0, azimuth_deg=5.0), Orbit(rate_deg_s=9.0, amplitude_deg=0.0)]
)
def test_an_orbit_without_rate_or_amplitude_stays(orbit: Orbit) -> None:
    assert orbit.advanced(17.0) == orbit


@pytest.mark.parametrize(
    "changes",
    [
        {"amplitude_deg": -1.0},
        {"azimuth_deg": 10.1},
        {"direction": 0},
        {"rate_deg_s": math.nan},
        {"amplitude_deg": math.inf},
    ],
)
def test_an_impossible_orbit_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        Orbit(**{"rate_deg_s": 1.0, "amplitude_deg": 10.0, **changes})


def test_an_orbit_advances_by_a_finite_time() -> None:
    with pytest.raises(OptionError):
        Orbit(rate_deg_s=1.0, amplitude_deg=1.0).advanced(math.inf)
