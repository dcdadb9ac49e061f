import pytest

from gcd_model.errors import OptionError
from gcd_model.geometry import SphericalDelta, motion_bucket


def max90(azimuth_deg: float, elevation_deg: float, high: float = 255.0) -> int:
    delta = SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=2.0)
    return motion_bucket(delta, max_azimuth_deg=90.0, max_elevation_deg=30.0, high=high)


def max180(azimuth_deg: float, elevation_deg: float, high: float = 255.0) -> int:
    delta = SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg)
    return motion_bucket(delta, max_azimuth_deg=180.0, max_elevation_deg=60.0, high=high)


def test_the_motion_number_is_255_only_with_both_angles_at_their_largest() -> None:
    assert max90(90.0, 30.0) == max180(180.0, 60.0) == 255
    assert max90(90.0, 0.0) == max180(180.0, 0.0) == 242
    assert max90(0.0, 30.0) == max180(0.0, 60.0) == 81
    assert max90(0.0, 0.0) == 0
    assert max90(180.0, 60.0) == 510  # it is not clamped
    with pytest.raises(OptionError):
        motion_bucket(SphericalDelta(azimuth_deg=10.0), max_azimuth_deg=0.0, max_elevation_deg=0.0)


def test_the_recorded_denominators_of_the_motion_number() -> None:
    assert max90(1.0, 0.0, high=94.868e6) == pytest.approx(1e6, rel=1e-5)
    assert max180(1.0, 0.0, high=189.737e6) == pytest.approx(1e6, rel=1e-5)
    assert max90(30.0, 15.0) == 90
