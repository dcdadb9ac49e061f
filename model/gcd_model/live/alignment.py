"""Where one camera stands in the axes of another, by pictures that both took of one scene and the depth of one of them.

features of pictures with depth (landmarks) + features of others --matches, RANSAC, least squares--> Alignment

Neither camera moves between its pictures. What does, such as an arm, disagrees with the rest and is left out. OpenCV is
imported where it is used.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from gcd_model.errors import AlignmentError
from gcd_model.geometry import Intrinsics
from gcd_model.live.config import SKY_M
from gcd_model.live.ego_motion import depth_share
from gcd_model.live.eyes import SeenFrame
from gcd_model.live.pnp import (
    FLOW_PX,
    OUTLIER,
    Array,
    Tracks,
    inverse,
    likeliest_pose,
    projected,
    reprojection,
    unprojected,
)

_FEATURES, _CONTRAST = 1500, 0.01
_RATIO = 0.8
"""A match's descriptor is nearer than the second best by this. Source: Lowe 2004, section 7.1."""
_EDGE = 1.1
"""Depths around a landmark differ by less than this factor: at an edge nobody knows on which side it lies."""
_FEWEST, _LEAST_SHARE = 12, 0.25
"""Of the matches, that agree with a pose: fewer are a coincidence."""
_TOGETHER = 2.0
"""Of the standard error of depths: by how much they may be wrong together."""
_MOST_DEG, _MOST_SHARE = 1.5, 0.02
"""Doubt about an angle, and about a place in parts of the distance to the landmarks, beyond which a pose is none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Features:
    """What of a picture can be told again from elsewhere.

    place: float32 [N, 2], pixels as OpenCV counts them. descriptor: float32 [N, 128]. lens: of the picture.
    """

    place: Array
    descriptor: Array
    lens: Intrinsics


@dataclass(frozen=True, kw_only=True, slots=True)
class Landmarks:
    """Features whose points are known, in the axes of the camera that saw them.

    tracks: N of them. descriptor: float32 [N, 128]. lens: of the picture.
    """

    tracks: Tracks
    descriptor: Array
    lens: Intrinsics

    @property
    def features(self) -> Features:
        """The same without their points."""
        return Features(place=self.tracks.place, descriptor=self.descriptor, lens=self.lens)


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraMove:
    """How far a camera stands from where it was expected, each with its standard error.

    pixels: the shift of the landmarks in its picture, root of the mean square.
    """

    pixels: float
    degrees: float
    centimetres: float
    doubt_pixels: float
    doubt_degrees: float
    doubt_centimetres: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Alignment:
    """The camera of the features in the axes of that of the landmarks.

    pose: float64 [4, 4], metres. matches: pairs of a landmark and a feature. inliers: those that agree with the pose.
    covariance: float64 [6, 6], of a step and a turn in the camera's own axes, metres and radians. lens: its own.
    """

    pose: Tensor
    matches: int
    inliers: Tracks
    covariance: Array
    lens: Intrinsics

    def moved_from(self, expected: Tensor) -> CameraMove:
        """How far the camera stands from the pose `expected`, [4, 4]."""
        here, there, seen = self.pose.numpy(), expected.numpy(), self.inliers
        step = inverse(there) @ here
        shift = projected(seen.point, here, self.lens)[1] - projected(seen.point, there, self.lens)[1]
        slope = FLOW_PX * reprojection(replace(seen, share=np.zeros(len(seen))), self.lens, here)[1]  # pixels
        blur = np.einsum("nij,jk,nik->n", slope, self.covariance, slope)
        variance = np.diag(self.covariance)
        return CameraMove(
            pixels=math.sqrt((shift**2).sum(axis=1).mean()),
            degrees=math.degrees(math.acos(min(max((float(np.trace(step[:3, :3])) - 1) / 2, -1.0), 1.0))),
            centimetres=100 * float(np.linalg.norm(step[:3, 3])),
            doubt_pixels=math.sqrt(blur.mean()),
            doubt_degrees=math.degrees(math.sqrt(variance[3:].sum())),
            doubt_centimetres=100 * math.sqrt(variance[:3].sum()),
        )

    def preference(self, expected: Tensor) -> float:
        """The share of inliers that lie nearer to where this pose has them than to where `expected`, [4, 4], has them:
        about a half by chance, whatever a few of them pull the pose to; 1 for a camera that moved."""
        seen = self.inliers
        here, there = (
            np.linalg.norm(seen.place - projected(seen.point, pose.numpy(), self.lens)[1], axis=1)
            for pose in (self.pose, expected)
        )
        return float((here < there).mean())


def features(picture: Array, lens: Intrinsics) -> Features:
    """Of a picture u8 [H, W, 3], RGB. Raises AlignmentError: there are next to none."""
    place, descriptor = _described(picture)
    return Features(place=place, descriptor=descriptor, lens=lens)


def landmarks(
    picture: Array, lens: Intrinsics, depth: Array, share: Array, depth_lens: Intrinsics | None = None
) -> Landmarks:
    """Of a picture with depth.

    Args:
        picture: u8 [H, W, 3], RGB. depth: [h, w] metres, 0 or not finite: none, also for what moves. share: [h, w], its
            standard error, in parts of it. depth_lens: of the depth, if that has another size; from the same place.
    Raises: AlignmentError: there are next to none.
    """
    import cv2

    place, descriptor = _described(picture)
    depth_lens = depth_lens or lens
    ray = (place + 0.5 - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    there = (ray * (depth_lens.fx, depth_lens.fy) + (depth_lens.cx, depth_lens.cy) - 0.5).astype(np.float32)
    column, row = np.rint(there).astype(int).clip(0, (depth_lens.width - 1, depth_lens.height - 1)).T
    known = np.isfinite(depth) & (depth > 0) & (depth < SKY_M)
    inverse_depth = np.where(known, 1 / np.where(known, depth, 1), 0).astype(np.float32)  # linear on planes
    far, near = (change(inverse_depth, np.ones((3, 3)))[row, column] for change in (cv2.erode, cv2.dilate))
    good = (far > 0) & (near < _EDGE * far)
    if good.sum() < _FEWEST:
        raise AlignmentError(f"only {good.sum()} corners of the picture have a depth; {_FEWEST} are needed")
    across, along = there[good].T[..., None]
    inverse_m = cv2.remap(inverse_depth, across, along, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    point = unprojected(place[good], 1 / inverse_m[:, 0].astype(float), lens, np.eye(4))
    tracks = Tracks(place=place[good], point=point, eye=np.zeros_like(point), share=share[row, column][good])
    return Landmarks(tracks=tracks, descriptor=descriptor[good], lens=lens)


def landmarks_of(frame: SeenFrame, picture: Array | None = None, lens: Intrinsics | None = None) -> Landmarks:
    """Of what stands still in a frame that the live model has looked at.

    picture: u8 [H, W, 3], the same one, finer than the model takes it; with its lens.
    Raises: AlignmentError as `landmarks`.
    """
    seen = frame.geometry
    if picture is None or lens is None:
        levels = ((frame.picture.cpu() + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        picture, lens = levels.permute(1, 2, 0).numpy(), frame.lens
    depth = torch.where(seen.static, seen.metres, 0.0).cpu().numpy()
    return landmarks(picture, lens, depth, depth_share(seen.metres, seen.spread), frame.lens)


def align(known: Sequence[Landmarks], seen: Sequence[Features]) -> Alignment:
    """Where the camera of the features stands in the axes of that of the landmarks.

    Args:
        known, seen: of one or several pictures each, taken where they stand.
    Raises: AlignmentError: they show different scenes, or too little that both cameras see.
    """
    pairs = [_matched(each, other) for each in known for other in seen]
    if (common := sum(map(len, pairs))) < _FEWEST:
        raise AlignmentError(f"the pictures have {common} corners in common; {_FEWEST} are needed")
    tracks = Tracks(**{f.name: np.concatenate([getattr(each, f.name) for each in pairs]) for f in fields(Tracks)})
    # residuals count in the coarser picture's pixels: there corners are placed no better
    lens, finer = seen[0].lens, max(1.0, seen[0].lens.fx / known[0].lens.fx)
    coarse = lens.resized(max(1, round(lens.width / finer)), max(1, round(lens.height / finer)))
    scale = np.array([coarse.width / lens.width, coarse.height / lens.height])
    tracks = replace(tracks, place=((tracks.place + 0.5) * scale - 0.5).astype(np.float32))
    pose, errors = likeliest_pose(tracks, coarse, np.eye(4), np.eye(4))
    agree = errors < OUTLIER
    needed = max(_FEWEST, math.ceil(_LEAST_SHARE * len(tracks)))
    if agree.sum() < needed:
        raise AlignmentError(
            f"only {agree.sum()} of {len(tracks)} common corners agree on a pose; {needed} are needed: do both show "
            "one scene, and are both lenses stated right?"
        )
    inliers = tracks.rows(agree)
    covariance = _covariance(inliers, coarse, pose, len(pairs))
    _require_sure(inliers, pose, covariance)
    inliers = replace(inliers, place=(inliers.place + 0.5) / scale - 0.5)
    return Alignment(
        pose=torch.from_numpy(pose), matches=len(tracks), inliers=inliers, covariance=covariance, lens=lens
    )


def _described(picture: Array) -> tuple[Array, Array]:
    import cv2

    finder = cv2.SIFT.create(nfeatures=_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    corners, descriptor = finder.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
    if len(corners) < _FEWEST:
        raise AlignmentError(f"the picture has {len(corners)} corners; {_FEWEST} are needed: is it dark or blurred?")
    place = np.asarray(cv2.KeyPoint.convert(corners), np.float32)
    inside = ((place > -0.5) & (place < np.array(picture.shape[1::-1]) - 0.5)).all(axis=1)
    return place[inside], descriptor[inside]


def _matched(known: Landmarks, seen: Features) -> Tracks:
    """The landmarks that are found again, at the places where they are."""
    import cv2

    matcher = cv2.BFMatcher(cv2.NORM_L2)
    there = matcher.knnMatch(known.descriptor, seen.descriptor, k=2)
    back = {each.queryIdx: each.trainIdx for each in matcher.match(seen.descriptor, known.descriptor)}
    good = [
        (best.queryIdx, best.trainIdx)
        for best, second in there
        if best.distance < _RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    index, place = np.array(good, int).reshape(-1, 2).T
    return replace(known.tracks.rows(index), place=seen.place[place])


def _covariance(inliers: Tracks, lens: Intrinsics, pose: Array, pairs: int) -> Array:
    """Of a step and a turn. pairs: of pictures, which show the same corners and so err alike.

    All depths may also be wrong together: by the same share, or by one that grows across the picture or down it.
    """
    residual, slope = reprojection(inliers, lens, pose)
    flat = slope.reshape(-1, 6)
    spread = max(1.0, (residual**2).sum() / (residual.size - 6))
    inverse_normal = np.linalg.inv(flat.T @ flat + 1e-6 * np.eye(6))
    covariance = pairs * spread * inverse_normal
    ray = (inliers.point - inliers.eye) @ pose[:3, :3] * inliers.share[:, None]
    shift = np.einsum("nij,nj->ni", slope[:, :, :3], ray)  # of the picture, where a depth is wrong by its share
    across, along = 2 * ((inliers.place + 0.5) / (lens.width, lens.height) - 0.5).T
    for mode in (np.ones(len(inliers)), across, along):
        moved = _TOGETHER * inverse_normal @ np.einsum("nij,ni,n->j", slope, shift, mode)
        covariance += np.outer(moved, moved)
    return covariance


def _require_sure(inliers: Tracks, pose: Array, covariance: Array) -> None:
    variance, far_m = np.diag(covariance), np.median(np.linalg.norm(inliers.point - pose[:3, 3], axis=1))
    doubt_deg, doubt_m = math.degrees(math.sqrt(variance[3:].sum())), math.sqrt(variance[:3].sum())
    if doubt_deg > _MOST_DEG or doubt_m > _MOST_SHARE * far_m:
        raise AlignmentError(
            f"the pictures leave a doubt of {doubt_deg:.1f} degrees and {100 * doubt_m:.0f} cm: they share too little, "
            "or a lens is stated wrong"
        )
