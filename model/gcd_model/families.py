"""What a checkpoint's names and shapes cannot tell: limits, rates, motion, the fixed path.

A family is how a checkpoint was trained.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

from gcd_model.config import CameraControl
from gcd_model.errors import OptionError
from gcd_model.geometry import Interpolation, Spherical

FamilyName = Literal["kubric90", "kubric180", "driving", "driving-semantic", "manipulation", "svd", "live"]


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewLimits:
    """How far a target camera may stand from the source camera, and where at all.

    Source: Van Hoorick et al. 2024 (GCD), section 4; elevation as in the released configurations.
    """

    azimuth_deg: float
    elevation_deg: float
    radius_m: float = 3.0
    absolute_elevation_deg: tuple[float, float] = (0.0, 50.0)
    absolute_radius_m: tuple[float, float] = (12.0, 18.0)

    def allowed(self, source: Spherical | None) -> dict[str, tuple[float, float]]:
        """Intervals of the three differences; narrower when it is known where the source stands."""
        elevation, radius = (-self.elevation_deg, self.elevation_deg), (-self.radius_m, self.radius_m)
        if source is not None:
            elevation = _within(elevation, self.absolute_elevation_deg, source.elevation_deg)
            radius = _within(radius, self.absolute_radius_m, source.radius_m)
        return {
            "azimuth_deg": (-self.azimuth_deg, self.azimuth_deg),
            "elevation_deg": elevation,
            "radius_m": radius,
        }


def _within(relative: tuple[float, float], absolute: tuple[float, float], at: float) -> tuple[float, float]:
    return max(relative[0], absolute[0] - at), min(relative[1], absolute[1] - at)


@dataclass(frozen=True, kw_only=True, slots=True)
class Family:
    """How a group of checkpoints was trained.

    camera: control the checkpoints have; relative poses may stand in for angles and radius.
    rates: trained frames per second, empty if any. fps: the default label.
    hfov_deg: trained horizontal field of view. height, width: trained size in pixels.
    motion_bucket: the constant the network was told, None where the formula gives it.
    """

    name: FamilyName
    camera: CameraControl
    limits: ViewLimits | None = None
    rates: tuple[float, ...]
    fps: float
    hfov_deg: float | None
    height: int = 256
    width: int = 384
    interpolation: Interpolation = "linear"
    motion_bucket: float | None = None
    pose_units: Literal["m", "scene"] = "scene"
    output: Literal["rgb", "semantic"] = "rgb"


KUBRIC90 = Family(
    name="kubric90",
    camera="spherical",
    limits=ViewLimits(azimuth_deg=90.0, elevation_deg=30.0),
    rates=(6.0, 8.0, 12.0, 24.0),
    fps=12.0,
    hfov_deg=53.13,
)
KUBRIC180 = replace(KUBRIC90, name="kubric180", limits=ViewLimits(azimuth_deg=180.0, elevation_deg=60.0))
DRIVING = Family(
    name="driving",
    camera="none",
    rates=(5.0, 10.0),
    fps=10.0,
    hfov_deg=85.0,
    interpolation="sine",
    motion_bucket=127.0,
    pose_units="m",
)
DRIVING_SEMANTIC = replace(DRIVING, name="driving-semantic", output="semantic")
MANIPULATION = Family(
    name="manipulation",
    camera="relative_pose",
    rates=(),
    fps=10.0,
    hfov_deg=None,
    motion_bucket=127.0,
    pose_units="m",
)
"""Ours: a camera anywhere about a robot's cell, told as a rigid transform."""
SVD = Family(name="svd", camera="none", rates=(), fps=7.0, hfov_deg=None, height=576, width=1024, motion_bucket=127.0)
LIVE = Family(
    name="live",
    camera="relative_pose",
    rates=(),
    fps=10.0,
    hfov_deg=None,
    height=128,
    width=192,
    motion_bucket=127.0,
    pose_units="m",
)
"""Ours: see `gcd_model.live`; any rigid pose, any lens of LIVE_LENS_DEG."""
LIVE_LENS_DEG = (40.0, 120.0)
"""Horizontal fields of view of the live model's training."""

_ALL = (KUBRIC90, KUBRIC180, DRIVING, DRIVING_SEMANTIC, MANIPULATION, SVD, LIVE)

FAMILIES: dict[str, Family] = {family.name: family for family in _ALL}


def family_named(name: str) -> Family:
    """The family of that name. Raises OptionError for another."""
    if name not in FAMILIES:
        raise OptionError(f"no family is called {name!r}; there are {', '.join(get_args(FamilyName))}")
    return FAMILIES[name]
