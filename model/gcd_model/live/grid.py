"""A metric bird's-eye grid about the vehicle, of the source camera's own points: depth and classes, never painted ones.

    SeenFrame --points over the declared ground--> this frame's cells --> memory, cells of the world --> Grid

Vehicle: x ahead, y left, z up, metres, the origin on the ground (REP 103; base_link of REP 105). The memory lies still
in the world; of the camera's motion it takes place and heading, so heights never drift. The constants were chosen on
training drives (docs/log/grid.md).
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
_LOWEST_M, _WAY_M = -0.3, (0.3, 2.0)
"""Heights over the ground: of the lowest point that counts, and between which one is in the way; below it is ground."""
_SPREAD = 0.2
"""Standard deviation of log-depth from which on a pixel counts for nothing."""
_LEAST_M2 = 0.002
"""Surface in the way that occupies a cell of the memory."""
_VOTES = 3.0
"""A frame votes by 1 for occupied or for free; they add up to no more than this."""
_PAST, _PAST_HEIGHT_M, _PAST_M = 0.1, 0.5, 2.5
"""What the camera sees past by this share of the distance, at this height and farther away than that, is not there."""
_FREE_S = 0.2
"""Ground that was seen longer ago is no longer free: somebody may have come."""
_ACROSS = (-1 / 3, 0.0, 1 / 3)
"""Places across a pixel at which what is in the way is looked up: a wall seen sideways has no gaps."""
_DENSE = 0.8
"""Ground is looked up at places so far apart, in cells of the memory."""
_IN_FRONT = 0.06
"""Ground so little nearer, as a share of its distance, than what a network's depth has above it, may lie under that."""
_NEVER = math.inf
_CELL = np.dtype([("stamp", "f8"), ("votes", "f4"), ("height", "f4"), ("label", "u1"), ("moves", "?")], align=True)
_NOTHING = np.array((-_NEVER, 0, 0, 0, False), _CELL)


def _classes(*names: str) -> Array:
    """Whether a class is one of these, by id."""
    return np.array([entry.name in names for entry in LIVE_CLASSES])


_OWN_CAR = _classes("own_car")
_FLAT = _classes("road", "lane_marking", "pavement", "terrain")
_TRAFFIC = _classes("car", "truck", "cyclist", "person")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grid:
    """Cells about the vehicle, [H, W]: rows along y, columns along x, the first cell has the least of both.

    occupancy: int8; OCCUPIED: surface 0.3 to 2 m over the ground was seen in it. FREE: its ground was seen all over
        within the last 0.2 s, under nothing, and no such surface within half a cell. Else UNKNOWN.
    visibility: uint8. classes: uint8, of what was seen last. height_m: float32, of the highest point that was seen.
    age_ms: uint16, since anything was seen. All but the occupancy are 0 in cells that were never seen.
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
        """extent_m: x from, x to, y from, y to on the vehicle, whole cells. seconds: of the memory, which holds no
        traffic that moves."""
        x0, x1, y0, y1 = extent_m
        self._vehicle_from_camera = mount.vehicle_from_camera.numpy()
        self._seconds, self._half_m = seconds, cell_m / 2  # cells of the memory are half as large: the vehicle turns
        self._shape = round((y1 - y0) / cell_m), round((x1 - x0) / cell_m)
        self._reach_m = math.hypot(max(-x0, x1), max(-y0, y1))
        self._side = 2 * math.ceil(self._reach_m / self._half_m) + 4
        y, x = ((np.arange(2 * n) + 0.5) * self._half_m + low for n, low in zip(self._shape, (y0, x0), strict=True))
        self._middles = np.stack(np.meshgrid(x, y)).reshape(2, -1)
        self._reset()

    def _reset(self) -> None:
        self._corner = np.zeros((2, 1), np.int64)  # of the memory, x and y in its cells from the world's origin
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
        picture = _Picture.of(frame, vehicle)
        self._refute(picture)
        self._add(picture, stamp_s)
        return self._grid(stamp_s)

    def _follow(self) -> None:
        """The memory's square stays about the vehicle; what leaves it is forgotten."""
        corner, lines = np.floor(self._move / self._half_m).astype(np.int64) - self._side // 2, np.arange(self._side)
        for axis, step in zip((1, 0), (corner - self._corner).ravel(), strict=True):
            if step:
                self._memory = np.roll(self._memory, -step, axis)
                new = (lines + step < 0) | (lines + step >= self._side)
                self._memory[(slice(None), new) if axis else new] = _NOTHING
        self._corner = corner

    def _numbers(self, points: Array) -> Array:
        """Numbers of the memory's cells at points [2 or 3, N] on the vehicle; -1 outside."""
        x, y = np.floor((self._turn @ points[:2] + self._move) / self._half_m).astype(np.int64) - self._corner
        inside = (x >= 0) & (x < self._side) & (y >= 0) & (y < self._side)
        return np.where(inside, y * self._side + x, -1)

    def _refute(self, picture: "_Picture") -> None:
        """One vote against what the camera sees past: in its column of the picture nothing in the way is so near."""
        memory, lens = self._memory.reshape(-1), picture.lens
        taken = np.flatnonzero(memory["votes"] > 0)
        at = np.stack([taken % self._side, taken // self._side]) + self._corner + 0.5
        on_vehicle = self._turn.T @ (at * self._half_m - self._move)
        x, _, z = picture.on_camera(np.vstack([on_vehicle, np.full(len(taken), _PAST_HEIGHT_M)]))
        u = lens.fx * x / np.maximum(z, _PAST_M) + lens.cx
        inside = (z > _PAST_M) & (u >= 0) & (u < lens.width)
        nearest = picture.way_m.min(axis=0)[np.where(inside, u, 0).astype(int)]
        past = taken[inside & (z < nearest * (1 - _PAST))]
        memory["votes"][past] = np.maximum(memory["votes"][past] - 1, 0)

    def _add(self, picture: "_Picture", stamp_s: float) -> None:
        memory, size = self._memory.reshape(-1), self._side**2
        pixel, height, cell = self._looked_up(picture, *picture.in_the_way())
        hit = np.bincount(cell, picture.area_m2[pixel] / len(_ACROSS), minlength=size) >= _LEAST_M2
        kept = hit[cell]
        pixel, height, cell = pixel[kept], height[kept], cell[kept]
        memory["height"][hit] = -np.inf
        np.maximum.at(memory["height"], cell, height)
        memory["label"][cell] = picture.labels[pixel]
        memory["moves"][cell[picture.moves[pixel]]] = True
        ground_pixel, height, cell = self._looked_up(picture, *picture.ground(self._reach_m, _DENSE * self._half_m))
        kept = ~hit[cell]
        pixel, height, cell = ground_pixel[kept], height[kept], cell[kept]
        memory["height"][cell], memory["label"][cell] = height, picture.labels[pixel]
        ground = np.bincount(cell, minlength=size) > 0
        for seen, vote in ((hit, 1), (ground, -1)):
            memory["stamp"][seen] = stamp_s
            memory["votes"][seen] = (memory["votes"][seen] + vote).clip(-_VOTES, _VOTES)

    def _looked_up(self, picture: "_Picture", pixel: Array, right: Array, down: Array) -> tuple[Array, Array, Array]:
        """Pixel, height and cell of places that lie in the memory. Args: as `_Picture.points`."""
        points = picture.points(pixel, right, down)
        cell = self._numbers(points)
        inside = cell >= 0
        return pixel[inside], points[2, inside], cell[inside]

    def _grid(self, stamp_s: float) -> Grid:
        """Each cell of four of the memory: one that is occupied will do, all and those beside them must be free."""
        height, width = self._shape
        numbers = self._numbers(self._middles)
        cells = self._memory.reshape(-1)[numbers].reshape(height, 2, width, 2)
        cells = cells.swapaxes(1, 2).reshape(height, width, 4)
        age_s, taken = stamp_s - cells["stamp"], cells["votes"] > 0
        occupied, free = taken.any(axis=-1), ((cells["votes"] < 0) & (age_s <= _FREE_S + 1e-6)).all(axis=-1)
        beside = np.pad(self._memory["votes"] > 0, 1)
        beside = beside[:-2] | beside[1:-1] | beside[2:]
        beside = (beside[:, :-2] | beside[:, 1:-1] | beside[:, 2:]).ravel()[numbers]
        free &= ~beside.reshape(height, 2, width, 2).any(axis=(1, 3))
        newest = np.where(taken | ~taken.any(axis=-1, keepdims=True), age_s, np.inf).argmin(axis=-1, keepdims=True)
        youngest_s, seen = age_s.min(axis=-1), np.isfinite(age_s).any(axis=-1)
        heights = np.where(np.isfinite(age_s), cells["height"], -np.inf).max(axis=-1)
        return Grid(
            occupancy=np.select([occupied, free], [OCCUPIED, FREE], UNKNOWN).astype(np.int8),
            visibility=np.select([youngest_s == 0, seen], [SEEN_NOW, SEEN_BEFORE], NEVER_SEEN).astype(np.uint8),
            classes=np.take_along_axis(cells["label"], newest, axis=-1)[..., 0],
            height_m=np.where(seen, heights, 0).astype(np.float32),
            age_ms=np.rint(1000 * np.where(seen, youngest_s, 0)).clip(0, 65535).astype(np.uint16),
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Picture:
    """A frame's pixels, row by row in one axis, [N].

    rays: [2, N], see `Intrinsics.rays`. slopes: [2, N], see `relative_slopes`. height: over the ground, NaN where
    nothing is known surely. way_m: [H, W], depth of what is in the way, elsewhere infinite. in_front: see _IN_FRONT.
    """

    lens: Intrinsics
    vehicle_from_camera: Array
    rays: Array
    metres: Array
    slopes: Array
    height: Array
    way_m: Array
    labels: Array
    moves: Array
    in_front: float

    @staticmethod
    def of(frame: SeenFrame, vehicle_from_camera: Array) -> "_Picture":
        seen, lens, rays = frame.geometry, frame.lens, frame.lens.rays().flatten(1).numpy()
        inverse = inverse_depth(seen.metres.cpu())
        slopes, labels = relative_slopes(inverse), seen.labels.cpu().numpy().ravel()
        sure = ~_alone(inverse.numpy(), slopes.numpy()).ravel() & ~_OWN_CAR[labels]
        if seen.spread is not None:
            sure &= seen.spread.cpu().numpy().ravel() < _SPREAD
        inverse = inverse.numpy().ravel()
        metres = np.divide(1, inverse, out=np.full_like(inverse, np.inf), where=sure & (inverse > 2 / SKY_M))
        up = vehicle_from_camera[2]
        height = up[3] + np.where(np.isfinite(metres), metres, np.nan) * (up[:2] @ rays + up[2])
        height[(height < _LOWEST_M) | (height > _WAY_M[1]) | ((height > _WAY_M[0]) & _FLAT[labels])] = np.nan
        return _Picture(
            lens=lens,
            vehicle_from_camera=vehicle_from_camera,
            rays=rays,
            metres=metres,
            slopes=slopes.flatten(1).numpy(),
            height=height,
            way_m=np.where(height > _WAY_M[0], metres, np.inf).reshape(lens.height, lens.width),
            labels=labels,
            moves=_TRAFFIC[labels] & ~seen.static.cpu().numpy().ravel(),
            in_front=0 if seen.spread is None else _IN_FRONT,  # measured depth is taken as it is
        )

    @property
    def area_m2(self) -> Array:
        """Of each pixel's surface, as if it faced the camera."""
        return self.metres**2 / (self.lens.fx * self.lens.fy)

    def on_camera(self, points: Array) -> Array:
        """Points [3, N] on the vehicle in the camera's axes."""
        return self.vehicle_from_camera[:3, :3].T @ (points - self.vehicle_from_camera[:3, 3:])

    def points(self, pixel: Array, right: Array, down: Array) -> Array:
        """On the vehicle, [3, N]: places beside the middles of pixels, so many pixels right and down, on the surfaces
        that they show."""
        z = self.metres[pixel] / (1 + right * self.slopes[0, pixel] + down * self.slopes[1, pixel])
        x, y = self.rays[0, pixel] + right / self.lens.fx, self.rays[1, pixel] + down / self.lens.fy
        return self.vehicle_from_camera[:3, :3] @ np.stack([x * z, y * z, z]) + self.vehicle_from_camera[:3, 3:]

    def in_the_way(self) -> tuple[Array, Array, Array]:
        """Places on what is in the way; see `points`."""
        pixel = np.flatnonzero(np.isfinite(self.way_m))
        right = np.repeat(_ACROSS, len(pixel))
        return np.tile(pixel, len(_ACROSS)), right, np.zeros_like(right)

    def ground(self, reach_m: float, step_m: float) -> tuple[Array, Array, Array]:
        """Places on ground that is seen under nothing, so far away and about so far apart; see `points`."""
        lens, above_m = self.lens, np.minimum.accumulate(self.way_m).ravel()
        ground = (self.height <= _WAY_M[0]) & (self.metres < above_m * (1 - self.in_front))
        far = np.arange(step_m, reach_m, step_m)  # along the vehicle's axis, where the ground should be
        _, y, z = self.on_camera(np.stack([far, 0 * far, 0 * far]))
        v = lens.fy * y[z > 0] / z[z > 0] + lens.cy
        v = v[(v > 0) & (v < lens.height)]
        count = math.ceil(reach_m / lens.fx / step_m)  # places across a pixel
        u = (np.arange(lens.width * count) + 0.5) / count
        pixel = (v.astype(int)[:, None] * lens.width + u.astype(int)).ravel()
        right, down = np.tile(u % 1 - 0.5, len(v)), np.repeat(v % 1 - 0.5, len(u))
        kept = ground[pixel]
        return pixel[kept], right[kept], down[kept]


def _alone(inverse: Array, slopes: Array) -> Array:
    """bool [H, W]: pixels on no surface with a neighbour, along a row or a column; such are edges that a network has
    smoothed, between two surfaces."""
    found = np.zeros(inverse.shape, bool)
    for axis, slope in ((1, slopes[0]), (0, slopes[1])):
        step = np.abs(np.diff(inverse, axis=axis))
        sides = [(0, 0), (0, 0)]
        sides[axis] = (1, 1)
        step = np.pad(step, sides, constant_values=np.inf)
        nearest = np.minimum(np.delete(step, 0, axis), np.delete(step, -1, axis))
        found |= (slope == 0) & (nearest > 1e-3 * inverse)
    return found
