"""Where the source camera goes from frame to frame: by odometry, or by the static points that two frames share.

    corners of the last frame + its depth --optical flow--> tracks --RANSAC, least squares--> world_from_camera

A track keeps its place in the world as long as it is followed, so the pose hangs on points placed many frames ago and
drifts less than a sum of steps. Every sighting's depth improves that place. OpenCV is imported where it is used.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gcd_model.errors import PoseError
from gcd_model.geometry import Intrinsics, require_rigid
from gcd_model.live.config import SKY_M
from gcd_model.live.pnp import BEHIND_M, OUTLIER, Array, Tracks, inverse, likeliest_pose, projected, unprojected

_LONGEST_STEP_M, _LARGEST_TURN_DEG = 5.0, 45.0
"""Between two frames; beyond, the odometry jumps or the points mislead."""
_CORNERS, _CORNER_QUALITY, _CORNER_GAP_PX, _BORDER_PX = 250, 0.003, 4, 2
_WINDOW_PX, _LEVELS = 7, 3
"""Of the optical flow. A larger window mixes near and far: 11 pixels double the error."""
_DARK_GREY, _CONTRAST_LIMIT, _CONTRAST_TILES = 70, 3.0, (4, 3)
"""Pictures darker than this on average get their contrast raised tile by tile."""
_THERE_AND_BACK_PX = 0.5
"""A point followed into the new frame and back again must return to its place."""
_FEWEST, _SMALLEST_SHARE = 10, 0.5
"""Of the tracks: fewer that agree are a coincidence. A wrong pose does more harm than a lost one."""
_STANDS_PX, _STANDS_SHARE = 0.15, 0.9
"""A camera stands if its motion would shift this share of the tracks by less than what optical flow gets wrong."""
_DEPTH_SHARE, _SPREADS, _SUREST = 0.04, 2.0, 0.01
"""Standard error of a depth from elsewhere, in parts of it; of the depth network's in its spreads, and at least."""
_SIGHTINGS = 8
"""A place is never surer than the mean of this many sightings: newer ones count, too."""
_OTHER_SURFACE = 0.15
"""Relative step of depth from which on a track's pixel shows something else than its point."""


NO_TRACKS = Tracks(place=np.zeros((0, 2), np.float32), point=np.zeros((0, 3)), eye=np.zeros((0, 3)), share=np.zeros(0))


class Motion(NamedTuple):
    """Where the camera of a frame is.

    world_from_camera: float64 [4, 4]; the world is the camera of the first frame, or of the last one that was lost.
    lost: why the motion since the last frame is unknown: the world begins anew here, and what was placed in the old one
        must be forgotten. None where it is known.
    """

    world_from_camera: Tensor
    lost: str | None = None


class _Frame(NamedTuple):
    """grey: u8 [H, W]. depth: [H, W] metres. share: [H, W], its standard error in parts of it. usable: u8 [H, W], 1
    where something static has a depth."""

    grey: Array
    lens: Intrinsics
    odometry: Array | None
    depth: Array
    share: Array
    usable: Array


class _LostError(Exception): ...


class EgoMotion:
    """Follows one source camera; the first frame is where the world begins."""

    def __init__(self) -> None:
        self._last: _Frame | None = None
        self._begin_world()

    def _begin_world(self) -> None:
        self._pose, self._step, self._tracks = np.eye(4), np.eye(4), NO_TRACKS

    def follow(self, picture: Tensor, lens: Intrinsics, odometry: Tensor | None = None) -> Motion:
        """The motion from the last frame that was settled to this one.

        Args:
            picture: float32 [3, H, W] in [-1, 1].
            odometry: float64 [4, 4], world_from_camera in a world of its own; only differences count. Two frames in a
                row must have it, else the pictures decide.
        """
        grey = torch.tensordot(torch.tensor([0.299, 0.587, 0.114]), picture.cpu().float(), dims=1) * 127.5 + 127.5
        stated = None if odometry is None else odometry.cpu().numpy()
        self._new, lost = (grey.round().clamp(0, 255).to(torch.uint8).numpy(), lens, stated), None
        try:
            if self._last is not None:
                self._advance(self._last, *self._new)
        except _LostError as error:
            self._begin_world()
            lost = str(error)
        return Motion(torch.from_numpy(self._pose.copy()), lost)

    def settle(self, depth: Tensor, static: Tensor, spread: Tensor | None = None) -> None:
        """What the frame shows that was just followed: the next one's motion hangs on it.

        Args:
            depth: [H, W] metres, 1000 for the sky; 0 or not finite: a hole. static: bool [H, W], what does not move.
            spread: [H, W], standard deviation of log-depth; None for depth from elsewhere.
        """
        depth = depth.cpu()
        inner = torch.zeros(depth.shape, dtype=torch.uint8)
        inside = (slice(_BORDER_PX, -_BORDER_PX),) * 2
        inner[inside] = (static.cpu() & depth.isfinite() & (depth > 0))[inside].to(torch.uint8)
        share = depth_share(depth, spread)
        self._last = frame = _Frame(*self._new, depth=depth.double().numpy(), share=share, usable=inner.numpy())
        if len(self._tracks):
            column, row = np.rint(self._tracks.place).astype(int).T
            self._tracks = _placed_better(self._tracks, frame, self._pose).rows(frame.usable[row, column] > 0)

    def _advance(self, last: _Frame, grey: Array, lens: Intrinsics, odometry: Array | None) -> None:
        """The pose, the last step and the tracks of this frame. Raises _LostError."""
        if last.odometry is not None and odometry is not None:
            step = inverse(last.odometry) @ odometry
            _require_plausible(step, "the odometry")
            pose, tracks = self._pose @ step, NO_TRACKS
        else:
            pose, tracks = _followed(last, grey, lens, self._tracks, self._pose, self._pose @ self._step)
            step = inverse(self._pose) @ pose
            _require_plausible(step, "the picture")
        self._pose, self._step, self._tracks = pose, step, tracks


def depth_share(depth: Tensor, spread: Tensor | None) -> Array:
    """The standard error of each depth, in parts of it, float64; both as `EgoMotion.settle` takes them."""
    share = torch.full_like(depth, _DEPTH_SHARE) if spread is None else (spread * _SPREADS).clamp(min=_SUREST)
    return share.cpu().double().numpy()


def require_motion(before: Tensor | None, after: Tensor) -> Tensor:
    """The odometry of a frame, float64 [4, 4], once it is known to be a pose that a camera can have after `before`.

    before: of the frame before, from here; None for the first. Raises PoseError.
    """
    after = require_rigid(after, "the odometry")
    if before is not None:
        try:
            _require_plausible(inverse(before.numpy()) @ after.numpy(), "the odometry")
        except _LostError as error:
            raise PoseError(str(error)) from error
    return after


def _require_plausible(step: Array, what: str) -> None:
    metres = float(np.linalg.norm(step[:3, 3]))
    degrees = math.degrees(math.acos(min(max((float(np.trace(step[:3, :3])) - 1) / 2, -1.0), 1.0)))
    if not (metres <= _LONGEST_STEP_M and degrees <= _LARGEST_TURN_DEG):
        raise _LostError(
            f"{what} jumps by {metres:.2f} m and {degrees:.0f} degrees between two frames; "
            f"at most {_LONGEST_STEP_M:g} m and {_LARGEST_TURN_DEG:g} degrees are a motion (were some left out?)"
        )


def _followed(
    last: _Frame, grey: Array, lens: Intrinsics, tracks: Tracks, pose: Array, guess: Array
) -> tuple[Array, Tracks]:
    """world_from_camera of the frame, and the tracks that agree with it; of the frame itself no depth is asked.

    pose: of the last frame. guess: of this one, had the camera gone on as before.
    """
    pictures = _contrasted(last.grey, grey)
    tracks = _with_new_corners(tracks, last, pictures[0], pose)
    seen = _seen_again(tracks, pictures, lens, pose, guess) if len(tracks) else tracks
    if len(seen) < _FEWEST:
        raise _LostError(f"only {len(seen)} of {len(tracks)} static corners are seen again; {_FEWEST} are needed")
    here, errors = likeliest_pose(seen, lens, pose, guess)
    agree = errors < OUTLIER
    needed = max(_FEWEST, math.ceil(_SMALLEST_SHARE * len(seen)))
    if agree.sum() < needed:
        raise _LostError(f"only {agree.sum()} of {len(seen)} static corners agree on a motion; {needed} are needed")
    seen = seen.rows(agree)
    shift = np.linalg.norm(projected(seen.point, here, lens)[1] - projected(seen.point, pose, lens)[1], axis=1)
    if np.quantile(shift, _STANDS_SHARE) < _STANDS_PX:
        here = pose
    return here, seen


def _contrasted(*pictures: Array) -> list[Array]:
    import cv2

    if pictures[0].mean() >= _DARK_GREY:
        return list(pictures)
    equalizer = cv2.createCLAHE(_CONTRAST_LIMIT, _CONTRAST_TILES)
    return [equalizer.apply(picture).astype(np.uint8) for picture in pictures]


def _with_new_corners(tracks: Tracks, frame: _Frame, grey: Array, pose: Array) -> Tracks:
    """And corners of the frame where there is no track yet."""
    import cv2

    free = frame.usable.copy()
    for column, row in np.rint(tracks.place).astype(int).tolist():
        cv2.circle(free, (column, row), _CORNER_GAP_PX - 1, 0, -1)
    room = _CORNERS - len(tracks)
    corners = cv2.goodFeaturesToTrack(grey, room, _CORNER_QUALITY, _CORNER_GAP_PX, mask=free) if room > 0 else None
    if corners is None:
        return tracks
    place = corners[:, 0]
    column, row = place.astype(int).T  # corners lie on whole pixels
    point = unprojected(place, frame.depth[row, column], frame.lens, pose)
    return Tracks(
        place=np.concatenate([tracks.place, place]),
        point=np.concatenate([tracks.point, point]),
        eye=np.concatenate([tracks.eye, np.broadcast_to(pose[:3, 3], point.shape)]),
        share=np.concatenate([tracks.share, frame.share[row, column]]),
    )


def _seen_again(tracks: Tracks, pictures: list[Array], lens: Intrinsics, pose: Array, guess: Array) -> Tracks:
    """Those that optical flow finds in the second picture, and from there in the first again."""
    ahead, after = projected(tracks.point, guess, lens)
    shift = np.where(ahead[:, 2:] > BEHIND_M, after - projected(tracks.point, pose, lens)[1], 0.0)
    shift = shift.clip(-lens.width, lens.width).astype(np.float32)
    there, found = _flow(pictures[0], pictures[1], tracks.place, tracks.place + shift)
    back, returned = _flow(pictures[1], pictures[0], there, there - shift)
    inside = ((there > -0.5) & (there < [lens.width - 0.5, lens.height - 0.5])).all(1)
    good = found & returned & inside & (np.abs(back - tracks.place).max(1) < _THERE_AND_BACK_PX)
    return replace(tracks, place=there).rows(good)


def _flow(one: Array, other: Array, place: Array, near: Array) -> tuple[Array, Array]:
    """Where the other picture shows these places, searched from `near` on, and whether it does: [N, 2], bool [N]."""
    import cv2

    window = (_WINDOW_PX, _WINDOW_PX)
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    here = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, place, near.copy(), winSize=window, maxLevel=_LEVELS, criteria=until, flags=here
    )
    return there, found[:, 0] > 0


def _placed_better(tracks: Tracks, frame: _Frame, pose: Array) -> Tracks:
    """With this frame's depth as one more sighting, where it shows the same surface."""
    column, row = np.rint(tracks.place).astype(int).T
    depth = frame.depth[row, column]
    expected = (tracks.point - pose[:3, 3]) @ pose[:3, 2]
    same = (depth > 0) & (depth < SKY_M) & (np.abs(depth - expected) < _OTHER_SURFACE * expected)
    sighting = unprojected(tracks.place, np.where(same, depth, 1.0), frame.lens, pose)
    old, new = tracks.share**2, frame.share[row, column] ** 2
    gain = np.where(same, old / (old + new), 0.0)
    joined = np.where(same, np.maximum(old * new / (old + new), np.minimum(old, new / _SIGHTINGS)), old)
    return replace(
        tracks,
        point=tracks.point + gain[:, None] * (sighting - tracks.point),
        eye=tracks.eye + gain[:, None] * (pose[:3, 3] - tracks.eye),
        share=np.sqrt(joined),
    )
