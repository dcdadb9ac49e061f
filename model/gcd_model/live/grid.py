"""A metric bird's-eye grid about the vehicle, of the source camera's own points: depth and classes, never painted ones.

    SeenFrame --points over the declared ground--> this frame's cells --> memory, cells of the world --> Grid

Vehicle: x ahead, y left, z up, metres, the origin on the ground (REP 103; `base_link` of REP 105). The memory lies still
in the world; of the camera's motion it takes place and heading, so heights never drift.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount, Intrinsics
from gcd_model.live.config import LIVE_CLASSES, SKY_M
from gcd_model.live.eyes import SeenFrame
from gcd_model.live.splat import inverse_depth, relative_slopes

Array = NDArray[Any]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Of `Grid.occupancy`, as nav_msgs/OccupancyGrid has them."""
NEVER_SEEN, SEEN_BEFORE, SEEN_NOW = 0, 1, 2
"""Of `Grid.visibility`."""
_GROUND_M, _WAY_M = -0.3, (0.3, 2.0)
"""Heights over the ground: the lowest point that may be ground, and between which a point is in the way."""
_SPREAD = 0.1
"""Standard deviation of log-depth above which a pixel counts for nothing."""
_LEAST_M2 = 0.002
"""Surface in the way that occupies a cell of the memory."""
_HIT, _GROUND, _MOST = 1.0, 0.7, 3.0
"""A frame's votes for occupied and for free, and how far they add up."""
_FREE_S = 0.5
_PAST, _REFUTED, _REFUTE_H = 0.1, 1.0, 0.5
_LONELY = True
_MARGIN = False
_NEARER, _CONFLICT, _BYCLASS = 1.0, True, 1
_FLAT=np.isin(np.arange(256),[1,2,3,4])
_MOVABLE=np.isin(np.arange(256),[8,9,10,11])
"""Ground that was seen longer ago is no longer free: somebody may have come."""
_ACROSS = (-1 / 3, 0.0, 1 / 3)
"""Places within a pixel, from its middle, at which what is in the way is looked up: a wall seen sideways has no gaps."""
_OWN_CAR = [entry.name for entry in LIVE_CLASSES].index("own_car")
_CELL = np.dtype([("stamp", "f8"), ("votes", "f4"), ("height", "f4"), ("label", "u1"), ("moves", "?")], align=True)
_NOTHING = np.array((-np.inf, 0, 0, 0, False), _CELL)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grid:
    """Cells about the vehicle, [H, W]: rows along y, columns along x, the first cell has the least of both.

    occupancy: int8; OCCUPIED: surface 0.3 to 2 m over the ground, FREE: the ground was seen all over the cell within
        half a second, under nothing, and no such surface; else UNKNOWN. visibility: uint8.
    classes: uint8, of what was seen last. height_m: float32, of the highest point that was seen, in the way or ground.
    age_ms: uint16, since anything was seen. All are 0 in cells that were never seen.
    """

    occupancy: Array
    visibility: Array
    classes: Array
    height_m: Array
    age_ms: Array


class GridMapper:
    """Makes grids of a camera's frames, one after the other; the state is what earlier ones saw."""

    def __init__(
        self, mount: CameraMount, *, extent_m: tuple[float, float, float, float], cell_m: float, seconds: float
    ) -> None:
        """extent_m: x from, x to, y from, y to on the vehicle, whole cells. seconds: of the memory, which holds nothing
        that moves."""
        x0, x1, y0, y1 = extent_m
        self._vehicle_from_camera = mount.vehicle_from_camera.numpy()
        self._seconds, self._half_m = seconds, cell_m / 2  # cells of the memory are half as large: it turns
        self._shape = round((y1 - y0) / cell_m), round((x1 - x0) / cell_m)
        self._reach_m = math.hypot(max(-x0, x1), max(-y0, y1))
        self._side = 2 * math.ceil(self._reach_m / self._half_m) + 2
        y, x = ((np.arange(2 * n) + 0.5) * self._half_m + low for n, low in zip(self._shape, (y0, x0), strict=True))
        self._middles = np.stack(np.meshgrid(x, y)).reshape(2, -1)
        self._reset()

    def _reset(self) -> None:
        self._corner = np.zeros(2, np.int64)  # of the memory, x and y in its cells from the world's origin
        self._memory = np.full((self._side, self._side), _NOTHING)

    def update(self, frame: SeenFrame, stamp_s: float) -> Grid:
        """Take in a frame; what is known after it. stamp_s: when it was taken, on any even clock."""
        if frame.begins:
            self._reset()
        vehicle = self._vehicle_from_camera
        place = vehicle @ frame.world_from_source.numpy() @ np.linalg.inv(vehicle)
        heading = math.atan2(place[1, 0], place[0, 0])
        cos, sin = math.cos(heading), math.sin(heading)
        self._turn, self._move = np.array([[cos, -sin], [sin, cos]]), place[:2, 3:]
        self._follow()
        gone = self._memory["moves"] | (stamp_s - self._memory["stamp"] > self._seconds + 1e-6)
        self._memory[gone] = _NOTHING
        self._add(_Picture.of(frame, vehicle), stamp_s)
        return self._grid(stamp_s)

    def _follow(self) -> None:
        """The memory's square stays about the vehicle; what leaves it is forgotten."""
        corner = np.floor(self._move[:, 0] / self._half_m).astype(np.int64) - self._side // 2
        for axis, step in ((1, int(corner[0] - self._corner[0])), (0, int(corner[1] - self._corner[1]))):
            if step:
                self._memory = np.roll(self._memory, -step, axis)
                lines = np.arange(self._side)
                self._memory[(slice(None),) * axis + ((lines + step < 0) | (lines + step >= self._side),)] = _NOTHING
        self._corner = corner

    def _numbers(self, points: Array) -> Array:
        """Numbers of the memory's cells at points [2 or 3, N] on the vehicle; -1 outside."""
        at = np.floor((self._turn @ points[:2] + self._move) / self._half_m).astype(np.int64) - self._corner[:, None]
        inside = ((at >= 0) & (at < self._side)).all(axis=0)
        return np.where(inside, at[1] * self._side + at[0], -1)

    def _add(self, picture: "_Picture", stamp_s: float) -> None:
        memory, size = self._memory.reshape(-1), self._side**2
        pixel, height, cell = self._seen(picture, *picture.in_the_way())
        hits = np.bincount(cell, picture.area_m2[pixel] / len(_ACROSS), minlength=size) >= _LEAST_M2
        self._refute(picture)
        kept = hits[cell]
        pixel, height, cell = pixel[kept], height[kept], cell[kept]
        memory["votes"][hits] = np.minimum(memory["votes"][hits] + _HIT, _MOST)
        memory["height"][hits] = -np.inf
        np.maximum.at(memory["height"], cell, height)
        memory["moves"][cell[picture.moves[pixel]]] = True
        memory["label"][cell] = picture.labels[pixel]
        memory["stamp"][hits] = stamp_s
        pixel, height, cell = self._seen(picture, *picture.ground(self._reach_m, self._half_m))
        kept = ~hits[cell]
        pixel, height, cell = pixel[kept], height[kept], cell[kept]
        memory["height"][cell], memory["label"][cell], memory["stamp"][cell] = height, picture.labels[pixel], stamp_s
        ground = np.bincount(cell, minlength=size) > 0
        memory["votes"][ground] = np.maximum(memory["votes"][ground] - _GROUND, -_MOST)

    def _refute(self, picture: "_Picture") -> None:
        """What the camera sees past is not there: in its column of the picture nothing in the way is so near."""
        memory = self._memory.reshape(-1)
        taken = np.flatnonzero(memory["votes"] > 0)
        at = np.stack([taken % self._side, taken // self._side]) + self._corner[:, None] + 0.5
        on = self._turn.T @ (at * self._half_m - self._move)
        camera = np.linalg.inv(picture.vehicle_from_camera)
        x, _, z = camera[:3, :2] @ on + camera[:3, 2:3] * _REFUTE_H + camera[:3, 3:]
        u = picture.lens.fx * x / np.maximum(z, 0.1) + picture.lens.cx
        inside = (z > 2.5) & (u >= 0) & (u < picture.lens.width)
        nearest = picture.nearest()
        past = inside & (z < nearest[np.where(inside, u, 0).astype(int)] * (1 - _PAST))
        memory["votes"][taken[past]] -= _REFUTED
        gone = taken[past][memory["votes"][taken[past]] <= 0]
        memory["votes"][gone] = 0

    def _seen(self, picture: "_Picture", pixel: Array, right: Array, down: Array) -> tuple[Array, Array, Array]:
        """Pixel, height and cell of the places that lie in the memory. Args: as `_Picture.points`."""
        points = picture.points(pixel, right, down)
        cell = self._numbers(points)
        inside = cell >= 0
        return pixel[inside], points[2, inside], cell[inside]

    def _grid(self, stamp_s: float) -> Grid:
        """Each cell of four of the memory: one that is occupied will do, and all must be free."""
        height, width = self._shape
        numbers = self._numbers(self._middles)
        cells = self._memory.reshape(-1)[numbers]
        cells = cells.reshape(height, 2, width, 2).swapaxes(1, 2).reshape(height, width, 4)
        age_s, taken = stamp_s - cells["stamp"], cells["votes"] > 0
        occupied, free = taken.any(axis=-1), ((cells["votes"] < 0) & (age_s <= _FREE_S + 1e-6)).all(axis=-1)
        if _MARGIN:
            t = np.pad(self._memory["votes"] > 0, 1)
            t = t[:-2] | t[1:-1] | t[2:]
            t = t[:, :-2] | t[:, 1:-1] | t[:, 2:]
            free &= ~t.reshape(-1)[numbers].reshape(height, 2, width, 2).any(axis=(1, 3))
        seen = np.isfinite(age_s).any(axis=-1)
        newest = np.where(taken | ~occupied[..., None], age_s, np.inf).argmin(axis=-1)[..., None]
        youngest_s = np.where(seen, age_s.min(axis=-1), 0.0)
        return Grid(
            occupancy=np.select([occupied, free], [OCCUPIED, FREE], UNKNOWN).astype(np.int8),
            visibility=np.where(seen, np.where(youngest_s == 0, SEEN_NOW, SEEN_BEFORE), NEVER_SEEN).astype(np.uint8),
            classes=np.take_along_axis(cells["label"], newest, axis=-1)[..., 0],
            height_m=np.where(seen, np.where(np.isfinite(age_s), cells["height"], -np.inf).max(axis=-1), 0.0),
            age_ms=np.rint(1000 * youngest_s).clip(0, 65535).astype(np.uint16),
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Picture:
    """A frame's pixels in rows, [H*W] each. slopes: [2, H*W], see `relative_slopes`. heights: over the ground; NaN
    where nothing is known, or not surely. moves: bool."""

    lens: Intrinsics
    vehicle_from_camera: Array
    rays: Array
    metres: Array
    slopes: Array
    heights: Array
    labels: Array
    moves: Array

    @staticmethod
    def of(frame: SeenFrame, vehicle_from_camera: Array) -> "_Picture":
        seen, rays = frame.geometry, frame.lens.rays().flatten(1).numpy()
        inverse = inverse_depth(seen.metres.cpu())
        metres = np.divide(1, inverse.numpy().ravel(), out=np.full(rays.shape[1], np.inf), where=inverse.numpy().ravel() > 0)
        labels = seen.labels.cpu().numpy().ravel()
        if seen.spread is not None:
            metres = np.where(_FLAT[labels], metres, metres * _NEARER)
        sure = (metres < SKY_M / 2) & (labels != _OWN_CAR)
        if seen.spread is not None:
            sure &= seen.spread.cpu().numpy().ravel() < _SPREAD
        slopes = relative_slopes(inverse)
        if _LONELY:
            sure &= ~_alone(inverse.numpy(), slopes.numpy()).ravel()
        up = vehicle_from_camera[2]
        heights = up[3] + np.where(sure, metres, np.nan) * (up[0] * rays[0] + up[1] * rays[1] + up[2])
        if _CONFLICT and seen.spread is not None:
            heights[(heights > _WAY_M[0]) & _FLAT[labels]] = np.nan
        return _Picture(
            lens=frame.lens,
            vehicle_from_camera=vehicle_from_camera,
            rays=rays,
            metres=metres,
            slopes=slopes.flatten(1).numpy(),
            heights=heights,
            labels=labels,
            moves=~seen.static.cpu().numpy().ravel() if _BYCLASS==0 else _MOVABLE[labels] if _BYCLASS==1 else (_MOVABLE[labels] & ~seen.static.cpu().numpy().ravel()),
        )

    @property
    def area_m2(self) -> Array:
        """Of each pixel's surface, as if it faced the camera."""
        return self.metres**2 / (self.lens.fx * self.lens.fy)

    def points(self, pixel: Array, right: Array, down: Array) -> Array:
        """On the vehicle, [3, N]: places beside the middles of pixels, so many pixels right and down, on their
        surfaces."""
        z = self.metres[pixel] / (1 + right * self.slopes[0, pixel] + down * self.slopes[1, pixel])
        x, y = self.rays[0, pixel] + right / self.lens.fx, self.rays[1, pixel] + down / self.lens.fy
        return self.vehicle_from_camera[:3, :3] @ np.stack([x * z, y * z, z]) + self.vehicle_from_camera[:3, 3:]

    def in_the_way(self) -> tuple[Array, Array, Array]:
        """Places on what is in the way; see `points`."""
        pixel = np.flatnonzero((self.heights > _WAY_M[0]) & (self.heights < _WAY_M[1]))
        right = np.repeat(_ACROSS, len(pixel))
        return np.tile(pixel, len(_ACROSS)), right, np.zeros_like(right)

    def nearest(self) -> Array:
        """Depth of the nearest thing in the way in each column, [W]."""
        in_way = (self.heights > _WAY_M[0]) & (self.heights < _WAY_M[1])
        return np.where(in_way, self.metres, np.inf).reshape(self.lens.height, -1).min(axis=0)

    def ground(self, reach_m: float, step_m: float) -> tuple[Array, Array, Array]:
        """Places on ground that is seen under nothing, up to so far away and about so far apart; see `points`."""
        lens = self.lens
        in_way = (self.heights > _WAY_M[0]) & (self.heights < _WAY_M[1])
        nearest = np.minimum.accumulate(np.where(in_way, self.metres, np.inf).reshape(lens.height, -1)).ravel()
        ground = (self.heights > _GROUND_M) & (self.heights <= _WAY_M[0]) & (self.metres < nearest)
        far = np.arange(step_m / 2, reach_m, 0.8 * step_m)  # along the vehicle's axis, at height 0
        camera_from_vehicle = np.linalg.inv(self.vehicle_from_camera)
        _, y, z = camera_from_vehicle[:3, :1] * far + camera_from_vehicle[:3, 3:]
        v = lens.fy * (y / z)[z > 0] + lens.cy
        v = v[(v > 0) & (v < lens.height)]
        count = max(1, math.ceil(reach_m / lens.fx / (0.8 * step_m)))  # places across a pixel
        u = (np.arange(lens.width * count) + 0.5) / count
        pixel = (v.astype(int)[:, None] * lens.width + u.astype(int)).ravel()
        right, down = np.tile(u % 1 - 0.5, len(v)), np.repeat(v % 1 - 0.5, len(u))
        kept = ground[pixel]
        return pixel[kept], right[kept], down[kept]


def _alone(inverse: Array, slopes: Array) -> Array:
    """Pixels that lie on no surface with a neighbour, along a row or a column: edges that a network has smoothed."""
    alone = np.zeros(inverse.shape, bool)
    for axis, slope in ((1, slopes[0]), (0, slopes[1])):
        step = np.abs(np.diff(inverse, axis=axis))
        pad = [(0, 0), (0, 0)]
        before, after = (np.pad(step, [side if i == axis else (0, 0) for i in (0, 1)], constant_values=np.inf) for side in ((1, 0), (0, 1)))
        alone |= (slope == 0) & (np.minimum(before, after) > 1e-3 * inverse)
    return alone
