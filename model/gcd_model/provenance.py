"""Which family a checkpoint belongs to, told from its name or from numbers of the yaml beside it. Pure text work."""

import re
from dataclasses import dataclass, replace

import msgspec

from gcd_model.config import ModelConfig, SamplingConfig
from gcd_model.errors import CheckpointError
from gcd_model.families import LIVE, Family, FamilyName, family_named
from gcd_model.live.config import LiveConfig

SVD_GUIDANCE = (1.0, 2.5)
"""Guidance of the first and last frame Stable Video Diffusion was published with; GCD uses 1.0 to 1.5."""
_LONGEST_LINE = 1000


@dataclass(frozen=True, kw_only=True, slots=True)
class Provenance:
    """What is told about a checkpoint besides its weights; None where nothing is.

    move_time: frame in which the goal pose is reached. frames: T. told_by: who named the family.
    """

    family: FamilyName | None = None
    move_time: int | None = None
    frames: int | None = None
    told_by: str | None = None


_PUBLISHED: tuple[tuple[str, Provenance], ...] = (
    (r"kubric_gradual_max90", Provenance(family="kubric90", move_time=13)),
    (r"kubric_direct_max90", Provenance(family="kubric90", move_time=0)),
    (r"kubric_gradual_max180", Provenance(family="kubric180", move_time=13)),
    (r"kubric_direct_max180", Provenance(family="kubric180", move_time=0)),
    (r"pardom_gradual_rgb", Provenance(family="driving", move_time=13)),
    (r"pardom_direct_rgb", Provenance(family="driving", move_time=0)),
    (r"pardom_gradual_semantic", Provenance(family="driving-semantic", move_time=13)),
    (r"pardom_direct_semantic", Provenance(family="driving-semantic", move_time=0)),
    (r"^(svd|stable-video-diffusion-img2vid)$", Provenance(family="svd")),
    (r"^(svd_xt|stable-video-diffusion-img2vid-xt)$", Provenance(family="svd", frames=25)),
)


def told_by_name(stem: str) -> Provenance:
    """Family of a published file name without suffix, also with something added; the base models' names only whole."""
    for pattern, told in _PUBLISHED:
        if re.search(pattern + r"(?!\d)", stem.lower()):
            return replace(told, told_by="file name")
    return Provenance()


def told_by_yaml(text: str) -> Provenance:
    """Family by the numbers of a training configuration: angle ranges, move time, the driving views.

    Only `key: value` lines with numbers are looked at, lists on one line or one item a line; nothing is executed.
    """
    lines = (line.rstrip() for line in text.splitlines())  # searching takes the square of a line's length, or of a gap
    text = "\n".join(line for line in lines if 0 < len(line) <= _LONGEST_LINE)
    move_time = re.search(r"^[ \t-]*move_time\s*:\s*(\d{1,4})\s*(#.*)?$", text, re.MULTILINE)
    family = _family_of_ranges(text) or _family_of_views(text)
    return Provenance(
        family=family,
        move_time=None if move_time is None else int(move_time[1]),
        told_by=None if family is None else "yaml",
    )


def _family_of_ranges(text: str) -> FamilyName | None:
    """By the largest azimuth difference; the elevation must not speak against it."""
    azimuth, elevation = _largest_difference(text, "azimuth"), _largest_difference(text, "elevation")
    families: dict[float, tuple[FamilyName, float]] = {90.0: ("kubric90", 30.0), 180.0: ("kubric180", 60.0)}
    if azimuth not in families:
        return None
    family, expected = families[azimuth]
    return family if elevation in (None, expected) else None


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


def _family_of_views(text: str) -> FamilyName | None:
    """The driving checkpoints look from above the road; their target is colour or classes."""
    if re.search(r"pardom|parallel_?domain|ego_forward|topdown", text, re.IGNORECASE) is None:
        return None
    semantic = re.search(r"^[ \t-]*\w*modality\w*\s*:[\['\"\s]*segm", text, re.MULTILINE | re.IGNORECASE)
    return "driving" if semantic is None else "driving-semantic"


def combined(*told: Provenance) -> Provenance:
    """Each fact from the first that knows it; who names the family first is named."""
    return Provenance(
        family=next((p.family for p in told if p.family is not None), None),
        move_time=next((p.move_time for p in told if p.move_time is not None), None),
        frames=next((p.frames for p in told if p.frames is not None), None),
        told_by=next((p.told_by for p in told if p.family is not None), None),
    )


def checked_family(told: Provenance, config: ModelConfig | LiveConfig) -> Family | None:
    """The family, if it can be: steered weights need a steered family, fixed ones a fixed one, the live model its own.

    Relative poses may stand in for angles and radius.
    Raises: CheckpointError on a contradiction, OptionError for an unknown name.
    """
    if told.family is None:
        return None
    family = family_named(told.family)
    live = family is LIVE, isinstance(config, LiveConfig)
    if live[0] != live[1]:
        raise CheckpointError(
            f"family {family.name} (told by: {told.told_by}) and these weights do not belong together: one is the live "
            "model, the other is not; leave --family out"
        )
    if (family.camera == "none") != (config.camera == "none"):
        raise CheckpointError(
            f"family {family.name} (told by: {told.told_by}) wants camera control {family.camera!r}, "
            f"the weights have {config.camera!r}; name another with --family"
        )
    return family


def at_trained_size(config: ModelConfig, family: Family | None) -> ModelConfig:
    """The config of published weights with the size and guidance of their family."""
    if family is None:
        return config
    guidance = SVD_GUIDANCE if family.name == "svd" else SamplingConfig().guidance
    return msgspec.structs.replace(
        config,
        height=family.height,
        width=family.width,
        sampling=msgspec.structs.replace(config.sampling, guidance=guidance),
    )
