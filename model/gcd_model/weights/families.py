"""What a checkpoint's names and shapes cannot tell: limits, rates, motion, the fixed path.

A family is how a checkpoint was trained.
"""

import re
from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

import msgspec

from gcd_model.config import CameraControl, ModelConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.geometry import Interpolation, Spherical
from gcd_model.live.config import LiveConfig

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
            (low, high), at = self.absolute_elevation_deg, source.elevation_deg
            elevation = max(elevation[0], low - at), min(elevation[1], high - at)
            (low, high), at = self.absolute_radius_m, source.radius_m
            radius = max(radius[0], low - at), min(radius[1], high - at)
        azimuth = (-self.azimuth_deg, self.azimuth_deg)
        return {"azimuth_deg": azimuth, "elevation_deg": elevation, "radius_m": radius}


@dataclass(frozen=True, kw_only=True, slots=True)
class Family:
    """How a group of checkpoints was trained.

    camera: control the checkpoints have; relative poses may stand in for angles and radius.
    rates: trained frames per second, empty if any. fps: the default label.
    hfov_deg: trained horizontal field of view. height, width: trained size in pixels.
    motion_bucket: the constant the network was told, None where the formula gives it. guidance: of the first and the
    last frame, as published.
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
    guidance: tuple[float, float] = (1.0, 1.5)


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
SVD = Family(
    name="svd",
    camera="none",
    rates=(),
    fps=7.0,
    hfov_deg=None,
    height=576,
    width=1024,
    motion_bucket=127.0,
    guidance=(1.0, 2.5),
)
LIVE = replace(MANIPULATION, name="live", height=128, width=192)
"""Ours: see `gcd_model.live`; any rigid pose, any lens of LIVE_LENS_DEG."""
LIVE_LENS_DEG = (40.0, 120.0)
"""Horizontal fields of view of the live model's training."""

FAMILIES: dict[str, Family] = {
    family.name: family for family in (KUBRIC90, KUBRIC180, DRIVING, DRIVING_SEMANTIC, MANIPULATION, SVD, LIVE)
}


def family_named(name: str) -> Family:
    """The family of that name. Raises OptionError for another."""
    if name not in FAMILIES:
        raise OptionError(f"no family is called {name!r}; there are {', '.join(get_args(FamilyName))}")
    return FAMILIES[name]


# --- the family of a checkpoint, by its name or the yaml beside it ---------------------------------------------------


_LONGEST_LINE = 1000


@dataclass(frozen=True, kw_only=True, slots=True)
class Hints:
    """What is told of a checkpoint besides its names and shapes; None where nobody says.

    told_by: who named the family. move_time: frame in which the goal pose is reached. frames: T.
    head_width: channels of an attention head of the U-Net; or heads: their number, one for all levels or one each.
    image_heads: attention heads of the image tower. latent_scale: see `VAEConfig.scale`.
    Raises OptionError for numbers that cannot be, and a family nobody knows.
    """

    family: str | None = None
    told_by: str | None = None
    move_time: int | None = None
    frames: int | None = None
    head_width: int | None = None
    heads: int | tuple[int, ...] | None = None
    image_heads: int | None = None
    latent_scale: float | None = None

    def __post_init__(self) -> None:
        if self.family is not None:
            family_named(self.family)
        for name, least in (("head_width", 1), ("image_heads", 1), ("frames", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise OptionError(f"{name} must be at least {least}, got {value}")

    def over(self, *others: Self) -> Self:
        """Each fact from the first that knows it, this one before the others."""
        every = [{name: getattr(each, name) for name in self.__slots__} for each in (self, *others)]
        return replace(self, **{n: next((each[n] for each in every if each[n] is not None), None) for n in every[0]})


_GCD = re.compile(r"(?:kubric_(gradual|direct)_(max90|max180)|pardom_(gradual|direct)_(rgb|semantic))(?!\d)")
_GCD_FAMILIES: dict[str, FamilyName] = {
    "max90": "kubric90",
    "max180": "kubric180",
    "rgb": "driving",
    "semantic": "driving-semantic",
}
_ANGLE_FAMILIES: dict[tuple[float | None, float | None], FamilyName] = {
    (90.0, 30.0): "kubric90",
    (90.0, None): "kubric90",
    (180.0, 60.0): "kubric180",
    (180.0, None): "kubric180",
}
_SVD = re.compile(r"svd(_xt)?|stable-video-diffusion-img2vid(-xt)?")


def told_by_name(stem: str) -> Hints:
    """Family of a published file name without suffix, also with something added; the base models' names only whole."""
    if found := _GCD.search(stem.lower()):
        pace, kind = filter(None, found.groups())
        return Hints(family=_GCD_FAMILIES[kind], move_time=13 if pace == "gradual" else 0, told_by="file name")
    if found := _SVD.fullmatch(stem.lower()):
        return Hints(family="svd", frames=25 if any(found.groups()) else None, told_by="file name")
    return Hints()


def told_by_yaml(text: str) -> Hints:
    """Family by the numbers of a training configuration: angle ranges, move time, the driving views.

    Only `key: value` lines with numbers are looked at, lists on one line or one item a line; nothing is executed.
    """
    lines = (line.rstrip() for line in text.splitlines())  # searching takes the square of a line's length, or of a gap
    text = "\n".join(line for line in lines if 0 < len(line) <= _LONGEST_LINE)
    move_time = re.search(r"^[ \t-]*move_time\s*:\s*(\d{1,4})\s*(#.*)?$", text, re.MULTILINE)
    angles = _largest_difference(text, "azimuth"), _largest_difference(text, "elevation")
    family = _ANGLE_FAMILIES.get(angles)
    if family is None and re.search(r"pardom|parallel_?domain|ego_forward|topdown", text, re.IGNORECASE):
        semantic = re.search(r"^[ \t-]*\w*modality\w*\s*:[\['\"\s]*segm", text, re.MULTILINE | re.IGNORECASE)
        family = "driving" if semantic is None else "driving-semantic"  # both look from above the road
    told_by = None if family is None else "yaml"
    return Hints(family=family, move_time=None if move_time is None else int(move_time[1]), told_by=told_by)


def _largest_difference(text: str, angle: str) -> float | None:
    """Half the width of the first range symmetric about zero under a key that names the angle."""
    number = r"(-?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)"
    inline = rf"\[\s*{number}\s*,\s*{number}\s*\]"
    block = rf"(?:#.*)?\n\s*-\s*{number}\s*\n\s*-\s*{number}\s*(?:\n|$)"
    for found in re.finditer(
        rf"^[ \t-]*[\w.]*{angle}\w*\s*:\s*(?:{inline}|{block})", text, re.MULTILINE | re.IGNORECASE
    ):
        low, high = (float(value) for value in found.groups() if value is not None)
        if low == -high and high > 0:
            return high
    return None


def require_family(told: Hints, config: ModelConfig | LiveConfig) -> None:
    """Whether the family can be: steered weights need a steered family, fixed ones a fixed one, the live model its own.

    Relative poses may stand in for angles and radius. Raises: CheckpointError on a contradiction.
    """
    if told.family is None:
        return
    family = FAMILIES[told.family]
    if (family is LIVE) != isinstance(config, LiveConfig):
        raise CheckpointError(
            f"family {family.name} (told by: {told.told_by}) and these weights do not belong together: one is the live "
            "model, the other is not; leave --family out"
        )
    if (family.camera == "none") != (config.camera == "none"):
        raise CheckpointError(
            f"family {family.name} (told by: {told.told_by}) wants camera control {family.camera!r}, "
            f"the weights have {config.camera!r}; name another with --family"
        )


def at_trained_size(config: ModelConfig, told: Hints) -> ModelConfig:
    """The config of published weights with the size and guidance of their family."""
    if told.family is None:
        return config
    family = FAMILIES[told.family]
    sampling = msgspec.structs.replace(config.sampling, guidance=family.guidance)
    return msgspec.structs.replace(config, height=family.height, width=family.width, sampling=sampling)
