"""What is measured beside the live model: the best homography, errors that nobody declares, other ways to paint.

    python tools/live_variants.py --heldout DIR --training DIR --sets orbit --methods live,live-mean --out DIR

The options of `python -m gcd_train.live.measure`, and its report.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.layers import zeroed
from gcd_model.live.config import SKY_M
from gcd_model.live.eyes import Eyes, FrameGeometry
from gcd_model.networks import LiveNetworks
from gcd_train.evaluation.predictors import pixel_rays, to_pixels
from gcd_train.live.clips import Array, LiveClip
from gcd_train.live.figures import NOW, MethodViews
from gcd_train.live.measure import LiveModel, Method, main

_FEWEST_PAIRS, _MOST_PAIRS = 8, 3000
_RANSAC_PX = 1.5
_ECC_ROUNDS, _ECC_STEP = 40, 1e-5


@dataclass(frozen=True, kw_only=True, slots=True)
class BestHomography:
    """The source's picture under the best plane-to-plane map, frame by frame: of three the one nearest to the truth.

    Candidates: least squares and RANSAC on exact correspondences of pixels that are seen now, and ECC on the pictures.
    """

    name: str = "homography"

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        metres, seen = clip.depth("target"), torch.from_numpy(clip.arrays["target.visibility"] == NOW)
        video, classes = [], []
        for t, move in enumerate(invert_rigid(clip.poses("source")) @ clip.poses("target")):
            source, target = (clip.arrays[f"{name}.rgb"][t] for name in ("source", "target"))
            places = _correspondences(metres[t], seen[t], move, clip.lens("target"), clip.lens("source"))
            shown = [(_warped(source, each, cv2.INTER_LINEAR), each) for each in _candidates(*places, source, target)]
            best, chosen = min(shown, key=lambda each: float(np.square(each[0].astype(np.float64) - target).mean()))
            video.append(best)
            classes.append(_warped(clip.arrays["source.labels"][t], chosen, cv2.INTER_NEAREST))
        pictures = torch.from_numpy(np.stack(video)).permute(0, 3, 1, 2).float() / 255
        return MethodViews(video=pictures, classes=torch.from_numpy(np.stack(classes)))


def _correspondences(
    metres: Tensor, seen: Tensor, source_from_target: Tensor, lens: Intrinsics, own: Intrinsics
) -> tuple[Array, Array]:
    """Where pixels are in the target and in the source, [N, 2] each, as OpenCV counts pixels; evenly chosen.

    metres: [H, W], of the target. seen: bool [H, W], the pixels to take. lens, own: of target and source.
    """
    v, u = (each[:: max(len(each) // _MOST_PAIRS, 1)] for each in seen.nonzero(as_tuple=True))
    points = pixel_rays(lens)[v, u] * metres[v, u, None].double()
    there = to_pixels(points @ source_from_target[:3, :3].T + source_from_target[:3, 3], own) - 0.5
    return torch.stack([u, v], dim=1).double().numpy(), there.numpy()


def _candidates(here: Array, there: Array, source: Array, target: Array) -> list[Array]:
    """Maps from target to source pixels."""
    made: list[Array | None] = []
    if len(here) >= _FEWEST_PAIRS:
        made = [cv2.findHomography(here, there, method, _RANSAC_PX)[0] for method in (0, cv2.RANSAC)]
    kept = [each for each in made if each is not None] or [np.eye(3)]
    template, moved = (cv2.cvtColor(np.ascontiguousarray(each), cv2.COLOR_RGB2GRAY) for each in (target, source))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ECC_ROUNDS, _ECC_STEP)
    try:
        found = cv2.findTransformECC(template, moved, kept[0].astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria)[1]
    except cv2.error:  # it does not converge where the pictures have little in common
        return kept
    return [*kept, np.asarray(found)]


def _warped(picture: Array, source_from_target: Array, interpolation: int) -> Array:
    height, width = picture.shape[:2]
    flags, move = interpolation | cv2.WARP_INVERSE_MAP, source_from_target.astype(np.float64)
    return np.asarray(cv2.warpPerspective(picture, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


class Misjudging(Eyes):
    """Eyes whose depth is off by a factor."""

    def __init__(self, networks: LiveNetworks, scale: float) -> None:
        super().__init__(networks)
        self._scale = scale

    def look(self, *args: Any, **kwargs: Any) -> FrameGeometry:
        geometry = super().look(*args, **kwargs)
        metres = geometry.metres
        return replace(geometry, metres=torch.where(metres < SKY_M, metres * self._scale, metres))


def variants(live: LiveModel) -> Sequence[Method]:
    """The homography, and the live model with what may be wrong, with several steps, its mean, or that made crisp."""
    mean, crisp = deepcopy(live.networks), deepcopy(live.networks)
    mean.paint.first_step = partial(mean.paint.first_step, detail=False)
    zeroed(crisp.paint.detail.out)
    return [
        BestHomography(),
        replace(live, name="live-depth-0.9", eyes=partial(Misjudging, scale=0.9)),
        replace(live, name="live-depth-1.1", eyes=partial(Misjudging, scale=1.1)),
        replace(live, name="live-floor-20cm", floor_higher_m=0.2),
        replace(live, name="live-floor-2deg", floor_tilt_deg=2.0),
        replace(live, name="live-2-steps", steps=2),
        replace(live, name="live-4-steps", steps=4),
        replace(live, name="live-mean", networks=mean),
        replace(live, name="live-crisp", networks=crisp),
    ]


if __name__ == "__main__":
    main(more=variants)
