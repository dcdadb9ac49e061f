"""What names and shapes cannot tell of a checkpoint: its family, which is how it was trained, and what our files say.

A family has limits, rates, motion, the fixed path. Published files tell it by their name or the yaml beside them.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Self, get_args

import msgspec
import torch

from gcd_model.config import CameraControl, ModelConfig
from gcd_model.errors import CheckpointError, FileError, OptionError
from gcd_model.geometry import Interpolation, Spherical
from gcd_model.live.config import LiveConfig
from gcd_model.small_files import decode_json

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

    move_time: frame in which the goal pose is reached. frames: T. head_width: channels of an attention head of the
    U-Net; or heads: their number, one for all levels or one each. image_heads: attention heads of the image tower.
    latent_scale: see `VAEConfig.scale`. Raises OptionError for numbers that cannot be.
    """

    family: Family | None = None
    move_time: int | None = None
    frames: int | None = None
    head_width: int | None = None
    heads: int | tuple[int, ...] | None = None
    image_heads: int | None = None
    latent_scale: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("head_width", 1), ("image_heads", 1), ("frames", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise OptionError(f"{name} must be at least {least}, got {value}")

    def over(self, *others: Self) -> Self:
        """Each fact from the first that knows it, this one before the others."""
        every = [{name: getattr(each, name) for name in self.__slots__} for each in (self, *others)]
        return replace(self, **{n: next((each[n] for each in every if each[n] is not None), None) for n in every[0]})


_GCD = re.compile(r"(?:kubric_(gradual|direct)_(max90|max180)|pardom_(gradual|direct)_(rgb|semantic))(?!\d)")
_GCD_FAMILIES = {"max90": KUBRIC90, "max180": KUBRIC180, "rgb": DRIVING, "semantic": DRIVING_SEMANTIC}
_ANGLE_FAMILIES: dict[tuple[float | None, float | None], Family] = {
    (90.0, 30.0): KUBRIC90,
    (90.0, None): KUBRIC90,
    (180.0, 60.0): KUBRIC180,
    (180.0, None): KUBRIC180,
}
_SVD = re.compile(r"svd(_xt)?|stable-video-diffusion-img2vid(-xt)?")


def told_by_name(stem: str) -> Hints:
    """Family of a published file name without suffix, also with something added; the base models' names only whole."""
    if found := _GCD.search(stem.lower()):
        pace, kind = filter(None, found.groups())
        return Hints(family=_GCD_FAMILIES[kind], move_time=13 if pace == "gradual" else 0)
    if found := _SVD.fullmatch(stem.lower()):
        return Hints(family=SVD, frames=25 if any(found.groups()) else None)
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
        family = DRIVING if semantic is None else DRIVING_SEMANTIC  # both look from above the road
    return Hints(family=family, move_time=None if move_time is None else int(move_time[1]))


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


def require_family(family: Family, config: ModelConfig | LiveConfig) -> None:
    """Raises CheckpointError if weights cannot be of that family: steered ones have a steered family, fixed ones a
    fixed one, the live model its own. Relative poses may stand in for angles and radius."""
    if (family is LIVE) != isinstance(config, LiveConfig):
        raise CheckpointError(
            f"family {family.name} and these weights do not belong together: one is the live model, the other is not; "
            "leave --family out"
        )
    if (family.camera == "none") != (config.camera == "none"):
        raise CheckpointError(
            f"family {family.name} wants camera control {family.camera!r}, the weights have {config.camera!r}; name "
            "another with --family"
        )


# --- what our files say about themselves ------------------------------------------------------------------------------


Layout = Literal["gcd-ckpt", "sgm-safetensors", "diffusers", "gcd-node"]
"""Lightning checkpoint of GCD; `svd.safetensors` and its like; diffusers folder; our own format."""

FORMAT = "1"
CONFIG_KEY, ADAPTER_KEY = "gcd.config", "gcd.adapter"
"""Metadata that our weight files have, and those of adapters alone."""
NOTES = "gcd_node"
"""Where in the hyper-parameters of a `.ckpt` our card stands."""
_PACKED = "gcd"
"""The one entry of a safetensors file that holds all of ours, as JSON: the library writes several in an order of the
moment, and the same weights must be the same bytes. Files of before have them apart."""
NO_DIFFUSION = "is the live model, which has no U-Net and no VAE: this is for diffusion models"
_SCALE_KEY = "gcd.uncertainty_scale"

PRECISIONS: dict[str, torch.dtype] = {
    "float32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}
"""What --dtype takes."""

FULL_PRECISION = ("decoder",)
"""Networks that compute in float32 whatever --dtype says: what they make is looked at."""


def packed(metadata: Mapping[str, str]) -> dict[str, str]:
    """Metadata as our files hold it."""
    return {_PACKED: msgspec.json.encode(metadata).decode()}


def unpacked(metadata: Mapping[str, str]) -> dict[str, str]:
    """The inverse of `packed`. Raises CheckpointError if it is damaged."""
    try:
        return {**metadata, **decode_json(metadata.get(_PACKED, "{}"), dict[str, str])}
    except FileError as error:
        raise CheckpointError(f"its metadata {error}; convert the weights again") from error


def precision(name: str) -> torch.dtype:
    """The dtype of that name. Raises OptionError for another."""
    if name not in PRECISIONS:
        raise OptionError(f"dtype must be one of {', '.join(PRECISIONS)}, got {name!r}")
    return PRECISIONS[name]


@dataclass(frozen=True, kw_only=True, slots=True)
class Card:
    """What our files say about themselves besides the weights.

    family: None if nobody could tell; then no limits are checked.
    move_time: frame in which the goal pose is reached; 0 for a direct checkpoint.
    trained: False for random weights, whose pictures are noise.
    origin: digest of the file this one was converted from, or "".
    uncertainty_scale: the deviation over samples times this covers the truth as often as it says, as was measured on
        held-out clips; a positive number, None where nobody did.
    """

    name: str
    config: ModelConfig | LiveConfig
    family: Family | None
    move_time: int
    trained: bool = True
    origin: str = ""
    uncertainty_scale: float | None = None

    def __post_init__(self) -> None:
        scale = self.uncertainty_scale
        if scale is not None and not 0 < scale < math.inf:
            raise OptionError(f"the uncertainty scale must be a positive number, got {scale:g}; measure it again")
        if not 0 <= self.move_time < self.config.frames:
            raise OptionError(f"move_time must be one of the {self.config.frames} frames, got {self.move_time}")

    @property
    def live(self) -> bool:
        """Whether it is the live model, which needs to know the lens and takes a mount, depth and odometry."""
        return isinstance(self.config, LiveConfig)

    @property
    def diffusion(self) -> ModelConfig:
        """The config of a diffusion model. Raises CheckpointError for the live model's."""
        if isinstance(self.config, LiveConfig):
            raise CheckpointError(f"{self.name or 'it'} {NO_DIFFUSION}")
        return self.config

    def to_metadata(self) -> dict[str, str]:
        """As safetensors metadata: text to text."""
        scale = self.uncertainty_scale
        return {
            "gcd.format": FORMAT,
            CONFIG_KEY: msgspec.json.encode(self.config).decode(),
            "gcd.name": self.name,
            "gcd.family": "" if self.family is None else self.family.name,
            "gcd.move_time": str(self.move_time),
            "gcd.trained": "true" if self.trained else "false",
            "gcd.origin": self.origin,
            **({} if scale is None else {_SCALE_KEY: repr(scale)}),
        }

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """Raises CheckpointError for another format or a damaged config."""
        if metadata.get("gcd.format", FORMAT) != FORMAT:
            raise CheckpointError(
                f"its format is {metadata['gcd.format']!r}, this version reads {FORMAT!r}; install a newer gcd-node"
            )
        try:
            config, family = metadata[CONFIG_KEY], metadata.get("gcd.family")
            live = decode_json(config, dict[str, object]).get("kind") == "live"
            return cls(
                name=metadata.get("gcd.name", ""),
                config=decode_json(config, LiveConfig if live else ModelConfig),
                family=family_named(family) if family else None,
                move_time=int(metadata["gcd.move_time"]),
                trained=metadata.get("gcd.trained", "true") != "false",
                origin=metadata.get("gcd.origin", ""),
                uncertainty_scale=None if _SCALE_KEY not in metadata else float(metadata[_SCALE_KEY]),
            )
        except (KeyError, ValueError, ArithmeticError) as error:
            raise CheckpointError(f"its metadata cannot be used ({error}); convert the weights again") from error
