"""A destination that swings to and fro from window to window."""

import math
from dataclasses import dataclass, replace

from gcd_model.errors import OptionError
from gcd_model.geometry.spherical import SphericalDelta


@dataclass(frozen=True, kw_only=True, slots=True)
class Orbit:
    """A swing in azimuth about the source camera, between -amplitude and +amplitude.

    rate_deg_s: speed along `direction`; negative swings the other way.
    amplitude_deg: where it turns round, 0 or more.
    azimuth_deg: where it is now, within the amplitude.
    direction: 1 or -1, flips at each turn.
    Raises OptionError outside these.
    """

    rate_deg_s: float
    amplitude_deg: float
    azimuth_deg: float = 0.0
    direction: int = 1

    def __post_init__(self) -> None:
        if not all(math.isfinite(number) for number in (self.rate_deg_s, self.amplitude_deg, self.azimuth_deg)):
            raise OptionError(f"an orbit needs finite numbers, got {self}")
        if self.amplitude_deg < 0.0 or abs(self.azimuth_deg) > self.amplitude_deg:
            raise OptionError(
                f"an orbit's azimuth must lie within its amplitude, a number from 0 up: "
                f"got {self.azimuth_deg:g} and {self.amplitude_deg:g} degrees"
            )
        if self.direction not in (1, -1):
            raise OptionError(f"an orbit's direction must be 1 or -1, got {self.direction}")

    @property
    def delta(self) -> SphericalDelta:
        """The destination now, as a change from the source camera."""
        return SphericalDelta(azimuth_deg=self.azimuth_deg)

    def advanced(self, seconds: float) -> "Orbit":
        """The orbit some time later (earlier, if negative), reflected as often as the time asks for.

        Advancing by a and then by b is advancing by a + b, so windows may come in any rhythm.

        Raises:
            OptionError: the time is not finite.
        """
        if not math.isfinite(seconds):
            raise OptionError(f"an orbit advances by a finite time, got {seconds} s")
        if self.rate_deg_s == 0.0 or self.amplitude_deg == 0.0:
            return self
        rising = self.direction if self.rate_deg_s > 0.0 else -self.direction
        travelled_deg = _unfolded(self.azimuth_deg, rising, self.amplitude_deg) + abs(self.rate_deg_s) * seconds
        azimuth_deg, now_rising = _folded(travelled_deg, self.amplitude_deg)
        return replace(self, azimuth_deg=azimuth_deg, direction=self.direction * rising * now_rising)


def _unfolded(azimuth_deg: float, rising: int, amplitude_deg: float) -> float:
    """Distance travelled since the last turn at -amplitude: up 2 amplitudes, then down 2."""
    if rising > 0:
        return azimuth_deg + amplitude_deg
    return 2.0 * amplitude_deg + (amplitude_deg - azimuth_deg)


def _folded(travelled_deg: float, amplitude_deg: float) -> tuple[float, int]:
    """Inverse of _unfolded(): the azimuth, and 1 while it rises or -1 while it falls."""
    phase_deg = travelled_deg % (4.0 * amplitude_deg)
    if phase_deg < 2.0 * amplitude_deg:
        return phase_deg - amplitude_deg, 1
    # In this order each step rounds towards the limit, never beyond it.
    return amplitude_deg - (phase_deg - 2.0 * amplitude_deg), -1
