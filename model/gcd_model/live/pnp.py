"""Where a camera is that sees points whose places are known, some of them wrongly (perspective-n-point).

OpenCV is imported where it is used.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics

Array = NDArray[Any]

_MOST = 0.75
"""Share of the tracks that agree with a pose from which on no other is tried."""
_RANSAC_PX, _RANSAC_ROUNDS = 2.0, 150
FLOW_PX = 0.25
"""Standard error of a followed place."""
_DOUBTED, OUTLIER, _HOPELESS = 1.5, 4.0, 12.0
"""In standard errors: from here on a track counts less, not at all, and not even while the pose is still rough."""
_ROUGH_STEPS, _FINE_STEPS, _SETTLED = 4, 4, 1e-5
"""Of the least squares; settled once the camera moves by no more than this, metres and radians."""
BEHIND_M = 0.05


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracks:
    """N points of the world that are followed.

    place: float32 [N, 2], where the last frame shows them, pixels as OpenCV counts them. point: [N, 3].
    eye: [N, 3], from where they were seen, on average. share: [N], standard error of its depth, in parts of it.
    """

    place: Array
    point: Array
    eye: Array
    share: Array

    def __len__(self) -> int:
        return len(self.place)

    def rows(self, index: Array) -> "Tracks":
        """Some of them: numbers, or bool [N]."""
        return Tracks(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


def likeliest_pose(tracks: Tracks, lens: Intrinsics, pose: Array, guess: Array) -> tuple[Array, Array]:
    """The pose with which most tracks agree, and by how many standard errors each differs: [N].

    Going on as before is tried first, then standing, then what RANSAC finds.
    """
    best, agreed = (guess, np.full(len(tracks), np.inf)), -1
    for start in (lambda: guess, lambda: pose, lambda: _consensus(tracks, lens, guess)):
        refined = _refined(tracks, lens, start())
        count = int((refined[1] < OUTLIER).sum())
        if count > agreed:
            best, agreed = refined, count
        if agreed > _MOST * len(tracks):
            break
    return best


def _consensus(tracks: Tracks, lens: Intrinsics, guess: Array) -> Array:
    """The pose that RANSAC finds; the guess where it finds none."""
    import cv2

    cv2.setRNGSeed(0)
    try:
        found, turn, step, _ = cv2.solvePnPRansac(
            tracks.point,
            tracks.place.astype(np.float64),
            np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]]),
            None,
            iterationsCount=_RANSAC_ROUNDS,
            reprojectionError=_RANSAC_PX,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # of points that coincide
        return guess
    usable = found and np.isfinite(turn).all() and np.isfinite(step).all()
    return inverse(rigid(turn[:, 0], step[:, 0])) if usable else guess


def _refined(tracks: Tracks, lens: Intrinsics, pose: Array) -> tuple[Array, Array]:
    """Robust least squares over all tracks: the pose, and by how many standard errors each track differs from it."""
    for number in range(_ROUGH_STEPS + _FINE_STEPS):
        limit = _HOPELESS if number < _ROUGH_STEPS else OUTLIER
        residual, slope = reprojection(tracks, lens, pose)
        distance = np.linalg.norm(residual, axis=1)
        weight = np.minimum(1.0, _DOUBTED / np.maximum(distance, 1e-9)) * (distance < limit)
        weighted = (slope * weight[:, None, None]).reshape(-1, 6)
        normal = weighted.T @ slope.reshape(-1, 6) + 1e-6 * np.eye(6)
        change = np.linalg.solve(normal, weighted.T @ residual.reshape(-1))
        pose = pose @ inverse(rigid(change[3:], change[:3]))
        if number >= _ROUGH_STEPS and np.abs(change).max() < _SETTLED:
            break
    distance = np.linalg.norm(reprojection(tracks, lens, pose)[0], axis=1)
    behind = projected(tracks.point, pose, lens)[0][:, 2] <= BEHIND_M
    return pose, np.where(behind, np.inf, distance)


def reprojection(tracks: Tracks, lens: Intrinsics, pose: Array) -> tuple[Array, Array]:
    """Residuals [N, 2] and their slopes by a step and a turn of the camera [N, 2, 6], in standard errors.

    A wrong depth moves a point along the ray on which it was seen: in that direction of the picture it counts less.
    """
    local, place = projected(tracks.point, pose, lens)
    x, y, z = local.T
    z = np.maximum(z, BEHIND_M)
    slope = np.zeros((len(z), 2, 6))  # by the step [0:3], which is the slope by the point, and by the turn [3:6]
    slope[:, 0, 0], slope[:, 0, 2] = lens.fx / z, -lens.fx * x / z**2
    slope[:, 1, 1], slope[:, 1, 2] = lens.fy / z, -lens.fy * y / z**2
    right, down, ahead = np.moveaxis(slope[:, :, :3], 2, 0)  # each [N, 2]
    x, y, z = x[:, None], y[:, None], z[:, None]
    slope[:, :, 3], slope[:, :, 4], slope[:, :, 5] = y * ahead - z * down, z * right - x * ahead, x * down - y * right
    ray = (tracks.point - tracks.eye) @ pose[:3, :3]
    blur = (slope[:, :, :3] @ ray[:, :, None])[:, :, 0] * tracks.share[:, None]
    size = np.linalg.norm(blur, axis=1)[:, None]
    along = blur / np.maximum(size, 1e-9)
    excess = (1 - FLOW_PX / np.hypot(FLOW_PX, size)) * along
    residual = tracks.place - place
    residual = residual - excess * (along * residual).sum(1, keepdims=True)
    slope = slope - excess[:, :, None] * (along[:, None] @ slope)
    return residual / FLOW_PX, slope / FLOW_PX


def unprojected(place: Array, depth: Array, lens: Intrinsics, pose: Array) -> Array:
    """Points of the world, [N, 3], from their places in a picture, [N, 2], and their depths, [N]."""
    x, y = (place[:, 0] + 0.5 - lens.cx) / lens.fx, (place[:, 1] + 0.5 - lens.cy) / lens.fy
    return np.stack([x * depth, y * depth, depth], axis=1) @ pose[:3, :3].T + pose[:3, 3]


def projected(point: Array, pose: Array, lens: Intrinsics) -> tuple[Array, Array]:
    """In the camera's axes [N, 3], and in its picture [N, 2] as OpenCV counts pixels."""
    local = (point - pose[:3, 3]) @ pose[:3, :3]
    z = np.maximum(local[:, 2], BEHIND_M)
    return local, np.stack(
        [local[:, 0] / z * lens.fx + lens.cx - 0.5, local[:, 1] / z * lens.fy + lens.cy - 0.5], axis=1
    )


def rigid(rotation: Array, translation: Array) -> Array:
    """rotation: [3], its axis times its angle."""
    import cv2

    a_from_b = np.eye(4)
    a_from_b[:3, :3], a_from_b[:3, 3] = cv2.Rodrigues(rotation)[0], translation
    return a_from_b


def inverse(a_from_b: Array) -> Array:
    """Of a rigid transform, [4, 4]."""
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = a_from_b[:3, :3].T
    b_from_a[:3, 3] = -a_from_b[:3, :3].T @ a_from_b[:3, 3]
    return b_from_a
