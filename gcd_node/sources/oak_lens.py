"""An OAK's factory calibration as a LensModel."""

import logging
from collections.abc import Sequence

from gcd_node.errors import ConfigError
from gcd_node.optics.calibration import Distortion, LensModel

_LOG = logging.getLogger(__name__)
_LENSES_DIFFER = 0.02
_RATIONAL_FULL, _RATIONAL, _FISHEYE = 14, 8, 4


def to_lens(
    matrix: Sequence[Sequence[float]], coefficients: Sequence[float], model: str, size: tuple[int, int]
) -> LensModel | None:
    """A lens as DepthAI describes it.

    Args:
        matrix: 3 x 3 intrinsics, pixels.
        coefficients: 14 of OpenCV's rational model with prism and tilt, or 4 of its fisheye model; 0 is no distortion.
        model: DepthAI's name of it, "Perspective" or "Fisheye".
        size: width and height the matrix is for.
    Returns:
        None, and says so in the log, for another model or numbers that no camera has.
    """
    if (known := _distortion(model, coefficients)) is None:
        _LOG.warning("an OAK's lens is of model %s, which is not known here; it counts as uncalibrated", model)
        return None
    (fx, _, cx), (_, fy, cy), _ = matrix
    width, height = size
    try:
        return LensModel(
            width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=known[0], coefficients=known[1]
        )
    except ConfigError as error:
        _LOG.warning("an OAK's calibration makes no sense, it counts as uncalibrated: %s", error)
        return None


def _distortion(model: str, coefficients: Sequence[float]) -> tuple[Distortion, tuple[float, ...]] | None:
    """Our name of a model, and as many coefficients as it has; DepthAI pads them with zeros, or leaves zeros out."""
    if model not in ("Perspective", "Fisheye"):
        return None
    if not any(coefficients):
        return "none", ()
    full = (*coefficients, *[0.0] * _RATIONAL_FULL)[:_RATIONAL_FULL]
    if model == "Fisheye":
        return "equidistant", full[:_FISHEYE]
    return "rational_polynomial", full if any(full[_RATIONAL:]) else full[:_RATIONAL]


def better_lens(own: LensModel | None, stored: LensModel | None) -> LensModel | None:
    """What a picture itself says, which knows what the sensor's mode cuts off; else what the memory says."""
    if own is None:
        return stored
    if stored is not None and abs(own.fx / stored.fx - 1) > _LENSES_DIFFER:
        _LOG.warning(
            "the OAK's focal length is %.1f pixels by its pictures, %.1f by its memory: the sensor's mode cuts edges "
            "off; the former is used",
            own.fx,
            stored.fx,
        )
    return own
