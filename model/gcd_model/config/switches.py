"""What our small models have and the paper's does not: a class head, warps by known planes, a plane mix."""

import math
from typing import Literal

import msgspec

from gcd_model.config.networks import require_multiple
from gcd_model.errors import OptionError

WarpFrame = Literal["vehicle", "stage"]
"""What the planes of a plane warp stand about."""


class SemanticClass(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One entry of a class map's ontology; its id is its place in the list. colour: RGB, 0-255."""

    name: str
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        if not all(0 <= channel <= 255 for channel in self.colour):
            raise OptionError(f"the colour of {self.name!r} must be RGB within 0-255, got {self.colour}")


def require_ontology(what: str, classes: tuple[SemanticClass, ...]) -> None:
    """Raises OptionError unless pixels can be told apart by these classes: 2 to 256 of them, no colour twice."""
    if not 2 <= len(classes) <= 256:
        raise OptionError(f"{what} takes 2 to 256 classes, got {len(classes)}")
    if len({entry.colour for entry in classes}) < len(classes):
        raise OptionError(f"{what} must give every class a colour of its own")


class ClassHeadConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A class map beside the picture. Ours, not the paper's.

    width: hidden channels. upscale: class logits per latent along each side.
    """

    classes: tuple[SemanticClass, ...]
    width: int = 96
    upscale: int = 4
    norm_groups: int = 8

    def __post_init__(self) -> None:
        if not 2 <= len(self.classes) <= 256 or self.upscale < 1:
            raise OptionError(
                f"a class head takes 2 to 256 classes and an upscale of 1 or more, got {len(self.classes)} classes "
                f"and upscale {self.upscale}"
            )
        require_multiple("the class head", self.width, "norm_groups", self.norm_groups)


class PlaneWarpConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The source as the target camera would see it if the world were made of known planes. Ours, not the paper's.

    frame: "vehicle": walls beside the road and across it, for a camera mounted on a vehicle. "stage": upright planes
        about the point that orbiting cameras look at; they face half-way between source and target camera.
    hfov_deg: horizontal field of view of the trained source camera and of the target camera, degrees.
    position: vehicle: trained mount of the source camera, which looks level along +x, metres in the vehicle's frame.
    side_walls_m: vehicle: distances of wall pairs y = +-d. front_walls_m: of walls x = d. Both metres.
    offsets_m: stage: how far beyond the centre the upright planes stand, metres; negative is nearer to the cameras.
    """

    frame: WarpFrame = "vehicle"
    hfov_deg: float = 85.0
    position: tuple[float, float, float] = (1.6, 0.0, 1.55)
    side_walls_m: tuple[float, ...] = (5.5, 8.0, 11.0, 15.0)
    front_walls_m: tuple[float, ...] = (8.0, 12.0, 18.0, 27.0, 45.0)
    offsets_m: tuple[float, ...] = (-3.0, -1.5, 0.0, 1.5, 3.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.hfov_deg < 180.0:
            raise OptionError(f"a horizontal field of view must lie between 0 and 180 degrees, got {self.hfov_deg:g}")
        if not all(distance > 0.0 for distance in (*self.side_walls_m, *self.front_walls_m)):
            raise OptionError("walls must stand at positive distances in metres")
        if not all(map(math.isfinite, self.offsets_m)):
            raise OptionError(f"upright planes must stand at finite offsets in metres, got {self.offsets_m}")

    @property
    def distant(self) -> int:
        """Number of the warps that condition the U-Net at a quarter of the size: those that follow the ground."""
        return 1 + len(self.side_walls_m if self.frame == "vehicle" else self.offsets_m)

    @property
    def layers(self) -> int:
        """Number of warps: ground, infinity, then side wall pairs and front walls, or upright planes."""
        return 1 + self.distant + (len(self.front_walls_m) if self.frame == "vehicle" else 0)


class PlaneMixConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A small network that chooses, pixel by pixel, between warps and the decoded picture. Ours, not the paper's.

    width: hidden channels. dilations: of its residual blocks, one each.
    """

    width: int = 64
    dilations: tuple[int, ...] = (1, 2, 4, 1)
    norm_groups: int = 8

    def __post_init__(self) -> None:
        require_multiple("the plane mix", self.width, "2 * norm_groups", 2 * self.norm_groups)


def warp_channels(config: PlaneWarpConfig | None, down_factor: int) -> int:
    """Condition channels the plane warps fill on a latent grid `down_factor` times coarser than the picture.

    Source and ground warp at half size, infinity and side walls (stage: upright planes) at quarter size, all with
    pixels moved into channels, and 4 numbers of the ray; 0 without warps.
    """
    if config is None:
        return 0
    half, quarter = (down_factor // 2) ** 2, (down_factor // 4) ** 2
    return 3 * (2 * half + config.distant * quarter) + 4
