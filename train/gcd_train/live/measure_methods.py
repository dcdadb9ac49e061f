"""Everything that is measured beside the live model, and the live model itself: a clip in, its target views out."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.layers import zeroed
from gcd_model.live.config import SKY_M, LiveConfig
from gcd_model.live.depth_net import pixel_rays
from gcd_model.live.eyes import Eyes, Floor, FrameGeometry
from gcd_model.live.paint_net import filled, seen_of
from gcd_model.live.painter import COVERED, LiveView
from gcd_model.live.splat import splat, unproject
from gcd_model.live.synthesizer import LiveSynthesizer
from gcd_model.loading import load_synthesizer
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError
from gcd_train.live.batches import Pictures, pictures_of
from gcd_train.live.clips import LiveClip, evenly, read_clip
from gcd_train.live.measure_figures import NEVER, NOW, MethodViews
from gcd_train.live.store import training_paths

Array = NDArray[Any]
_SAMPLE = 60
"""Training clips that the fill of holes is read off."""
_FEWEST_PAIRS, _MOST_PAIRS = 8, 3000
_RANSAC_PX = 1.5
_ECC_ROUNDS, _ECC_STEP = 40, 1e-5


class Method(Protocol):
    """Shows a clip as its target camera would have seen it."""

    @property
    def name(self) -> str: ...
    def views(self, clip: LiveClip) -> MethodViews:
        """All frames of it."""
        ...


@lru_cache
def commonest_class(training: Path, world: str) -> int:
    """Of target pixels of a world's training clips. Raises DataError if there are none."""
    paths = [path for path in training_paths(training) if path.parent.name == world]
    if not paths:
        raise DataError(f"{training} holds no training clips of {world!r}; holes are filled as they are on average")
    counts = np.zeros(256)
    for path in evenly(paths, _SAMPLE):
        labels = read_clip(path, slice(6, 7), ["target.labels"]).arrays["target.labels"]
        counts += np.bincount(labels.ravel(), minlength=256)
    return int(counts.argmax())


def _lens(clip: LiveClip, camera: str) -> Intrinsics:
    height, width = clip.arrays[f"{camera}.labels"].shape[1:]
    return Intrinsics.from_hfov(clip.hfov_deg(camera), width, height)


def _poses(clip: LiveClip, camera: str) -> Tensor:
    return torch.from_numpy(clip.arrays[f"{camera}.pose"])


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactSplat:
    """This frame's pixels by their exact depth, as surfels; holes have the colours around and the commonest class."""

    training: Path
    classes: int = len(LiveConfig().classes)
    name: str = "splat"

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        source, lens = pictures_of(clip, "source"), _lens(clip, "target")
        poses, targets = _poses(clip, "source"), _poses(clip, "target")
        rays, nothing = pixel_rays(lens), torch.zeros(lens.height, lens.width)
        video, votes, coverage = [], [], []
        for t, own in enumerate(source.lenses):
            labels = source.labels[t].to(torch.uint8)
            surfels = unproject(source.metres[t], source.video[t], labels, own, poses[t], 1.0)
            made = splat(surfels, targets[t], lens, self.classes, 1.0)
            video.append((filled(seen_of(made, None, rays, nothing, torch.zeros(12)))[0].clamp(-1, 1) + 1) / 2)
            votes.append(made.votes.max(dim=0).indices)
            coverage.append(made.coverage)
        covered, label = torch.stack(coverage), commonest_class(self.training, str(clip.facts["world"]))
        return MethodViews(
            video=torch.stack(video),
            classes=torch.where(covered > 0, torch.stack(votes), label).to(torch.uint8),
            visibility=torch.where(covered >= COVERED, NOW, NEVER).to(torch.uint8),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class BestHomography:
    """The source's picture under the best plane-to-plane map, frame by frame: of three the one nearest to the truth.

    Candidates: least squares and RANSAC on exact correspondences of pixels that are seen now, and ECC on the pictures.
    """

    name: str = "homography"

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        lens, own = _lens(clip, "target"), _lens(clip, "source")
        source_from_target = (invert_rigid(_poses(clip, "source")) @ _poses(clip, "target")).numpy()
        metres, seen = clip.depth("target"), clip.arrays["target.visibility"] == NOW
        video, classes = [], []
        for t, move in enumerate(source_from_target):
            pictures = clip.arrays["source.rgb"][t], clip.arrays["target.rgb"][t]
            places = correspondences(metres[t], seen[t], move, lens, own)
            best = _best(_candidates(*places, *pictures), *pictures)
            video.append(_warped(pictures[0], best, cv2.INTER_LINEAR))
            classes.append(_warped(clip.arrays["source.labels"][t], best, cv2.INTER_NEAREST))
        shown = torch.from_numpy(np.stack(video)).permute(0, 3, 1, 2).float() / 255
        return MethodViews(video=shown, classes=torch.from_numpy(np.stack(classes)))


def correspondences(
    metres: Array, seen: Array, source_from_target: Array, lens: Intrinsics, own: Intrinsics
) -> tuple[Array, Array]:
    """Where pixels are in the target and in the source, [N, 2] each, as OpenCV counts pixels; evenly chosen.

    metres: [H, W], of the target. seen: bool [H, W], the pixels to take. lens, own: of target and source.
    """
    v, u = np.nonzero(seen)
    chosen = slice(None, None, max(len(u) // _MOST_PAIRS, 1))
    u, v = u[chosen], v[chosen]
    rays = np.stack([(u + 0.5 - lens.cx) / lens.fx, (v + 0.5 - lens.cy) / lens.fy, np.ones(len(u))], axis=1)
    points = (rays * metres[v, u, None]) @ source_from_target[:3, :3].T + source_from_target[:3, 3]
    there = points[:, :2] / points[:, 2:] * (own.fx, own.fy) + (own.cx - 0.5, own.cy - 0.5)
    return np.stack([u, v], axis=1).astype(np.float64), there


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


def _best(candidates: Sequence[Array], source: Array, target: Array) -> Array:
    errors = [
        np.square(_warped(source, each, cv2.INTER_LINEAR).astype(np.float64) - target).mean() for each in candidates
    ]
    return candidates[int(np.argmin(errors))]


def _warped(picture: Array, source_from_target: Array, interpolation: int) -> Array:
    height, width = picture.shape[:2]
    flags = interpolation | cv2.WARP_INVERSE_MAP
    made = cv2.warpPerspective(
        picture, source_from_target.astype(np.float64), (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(made)


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveModel:
    """The live model, frame by frame as a node runs it.

    depth_scale, floor_higher_m, floor_tilt_deg: errors that nobody declares.
    """

    networks: LiveNetworks
    name: str = "live"
    depth_scale: float = 1.0
    floor_higher_m: float = 0.0
    floor_tilt_deg: float = 0.0
    steps: int | None = None

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        view = LiveView(self.networks, steps=self.steps)
        view.eyes = _Misjudging(self.networks, self.depth_scale)
        source, lens = pictures_of(clip, "source"), _lens(clip, "target")
        source_from_target = invert_rigid(_poses(clip, "source")) @ _poses(clip, "target")
        frames = []
        for t, own in enumerate(source.lenses):
            made = view.step(
                source.video[t],
                [source_from_target[t]],
                lens=own,
                floor=self._floor(source, t),
                target_lens=lens,
            )
            frames.append(made.views[0])
        return MethodViews(
            video=torch.stack([(frame.picture.clamp(-1, 1) + 1) / 2 for frame in frames]),
            classes=torch.stack([frame.classes for frame in frames]),
            visibility=torch.stack([frame.visibility for frame in frames]),
            log_variance=torch.stack([frame.log_variance for frame in frames]),
        )

    def _floor(self, source: Pictures, t: int) -> Floor:
        tilt = torch.tensor(np.radians(self.floor_tilt_deg)).float()
        x, y, z = source.ups[t]
        up = torch.stack([x, y * tilt.cos() - z * tilt.sin(), y * tilt.sin() + z * tilt.cos()])
        return Floor(up=up, height_m=float(source.heights_m[t]) + self.floor_higher_m)


class _Misjudging(Eyes):
    """Eyes whose depth is off by a factor."""

    def __init__(self, networks: LiveNetworks, scale: float) -> None:
        super().__init__(networks)
        self._scale = scale

    def look(self, *args: Any, **kwargs: Any) -> FrameGeometry:
        geometry = super().look(*args, **kwargs)
        metres = geometry.metres
        return replace(geometry, metres=torch.where(metres < SKY_M, metres * self._scale, metres))


def live_model(weights: str, *, device: str = "auto") -> LiveSynthesizer:
    """A live model. Raises DataError for weights of another."""
    loaded = load_synthesizer(weights, device=device)
    if not isinstance(loaded, LiveSynthesizer):
        raise DataError(f"{weights} is no live model; give the weights of one")
    return loaded


def live_methods(networks: LiveNetworks) -> dict[str, LiveModel]:
    """The live model as it ships, with what may be wrong, and painting in several steps, the mean, or it made crisp."""
    plain, mean, crisp = LiveModel(networks=networks), deepcopy(networks), deepcopy(networks)
    mean.paint.first_step = partial(mean.paint.first_step, detail=False)
    zeroed(crisp.paint.detail.out)
    made = [
        plain,
        replace(plain, name="live-depth-0.9", depth_scale=0.9),
        replace(plain, name="live-depth-1.1", depth_scale=1.1),
        replace(plain, name="live-floor-20cm", floor_higher_m=0.2),
        replace(plain, name="live-floor-2deg", floor_tilt_deg=2.0),
        replace(plain, name="live-2-steps", steps=2),
        replace(plain, name="live-4-steps", steps=4),
        replace(plain, name="live-mean", networks=mean),
        replace(plain, name="live-crisp", networks=crisp),
    ]
    return {each.name: each for each in made}
