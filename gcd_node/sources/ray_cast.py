"""The analytic street as a picture: one ray a pixel against the ground, boxes and balls. numpy only."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gcd_node.frame import Image
from gcd_node.sources.street import Ball, Box, Floats, Standpoint, Street
from gcd_node.sources.street_paint import box_colour, ground_colour

CAMERA_HEIGHT_M = 1.55
_NEAR_M = 0.3
_HAZE_M = 190.0
_CORNERS = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], np.float32)
_SUN = np.array([0.45, 0.55, 0.70], np.float32)
_HORIZON = np.array([206, 216, 226], np.float32)
_ZENITH = np.array([104, 154, 214], np.float32)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Rays:
    """All pixels' directions, scaled to advance 1 m along the view axis.

    The camera is level: x and y of a direction depend on the column alone (along, aside: [W], world x and y), z on the
    row alone (up: [H]). yaw_rad: where the camera looks. focal: pixels.
    """

    origin: tuple[float, float, float]
    yaw_rad: float
    focal: float
    along: Floats
    aside: Floats
    up: Floats

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return len(self.up), len(self.along)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Seen:
    """A thing, the pixels it can cover at most, and how far before the camera its nearest corner is."""

    thing: Box | Ball
    rows: slice
    columns: slice
    nearest_m: float


def draw_street(street: Street, time_s: float, width: int, height: int, hfov_deg: float) -> Image:
    """The street from the driving car, u8 [H, W, 3] RGB."""
    rays = _rays(street.camera(time_s), width, height, hfov_deg)
    depth = np.full((height, width), np.inf, np.float32)
    picture = _sky(rays)
    things = street.things(time_s)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray may run along a wall
        _draw_ground(picture, depth, rays, street)
        for seen in _seen(
            rays, [_shadow(thing) for thing in things if isinstance(thing, Box) and thing.look == "body"]
        ):
            _darken(picture, rays, seen)
        for seen in _seen(rays, things):
            if depth[seen.rows, seen.columns].max() >= seen.nearest_m:
                _draw(picture, depth, rays, seen)
    return _with_haze(picture, depth)


def _draw(picture: Floats, depth: Floats, rays: _Rays, seen: _Seen) -> None:
    area = seen.rows, seen.columns
    if isinstance(seen.thing, Box):
        _draw_box(picture[area], depth[area], rays, seen, seen.thing)
    else:
        _draw_ball(picture[area], depth[area], rays, seen, seen.thing)


def _rays(camera: Standpoint, width: int, height: int, hfov_deg: float) -> _Rays:
    focal = width / 2 / math.tan(math.radians(hfov_deg) / 2)
    cosine, sine = math.cos(camera.yaw_rad), math.sin(camera.yaw_rad)
    u = (np.arange(width, dtype=np.float32) + np.float32(0.5 - width / 2)) / np.float32(focal)
    v = (np.arange(height, dtype=np.float32) + np.float32(0.5 - height / 2)) / np.float32(focal)
    return _Rays(
        origin=(camera.x, camera.y, CAMERA_HEIGHT_M),
        yaw_rad=camera.yaw_rad,
        focal=focal,
        along=np.float32(cosine) + u * np.float32(sine),
        aside=np.float32(sine) - u * np.float32(cosine),
        up=-v,
    )


def _seen(rays: _Rays, things: Sequence[Box | Ball]) -> list[_Seen]:
    """What of the things may be in the picture, nearest first, so that it hides the rest."""
    if not things:
        return []
    height, width = rays.size
    sizes = [thing.size if isinstance(thing, Box) else (2 * thing.radius_m,) * 3 for thing in things]
    corners = _CORNERS * (np.array(sizes) / 2)[:, None, :]
    yaws = np.array([thing.yaw_rad if isinstance(thing, Box) else 0.0 for thing in things])
    away_x, away_y, away_z = _turned(corners, yaws[:, None]) + np.moveaxis(
        np.array([thing.centre for thing in things])[:, None, :] - np.array(rays.origin), 2, 0
    )
    cosine, sine = math.cos(rays.yaw_rad), math.sin(rays.yaw_rad)
    ahead = away_x * cosine + away_y * sine
    scale = rays.focal / np.maximum(ahead, 0.05)
    u = (away_x * sine - away_y * cosine) * scale + width / 2
    v = height / 2 - away_z * scale
    edges = [
        np.clip(np.floor(edge), 0, limit).astype(int)
        for edge, limit in ((u.min(1), width), (u.max(1) + 2, width), (v.min(1), height), (v.max(1) + 2, height))
    ]
    nearest, furthest = ahead.min(1), ahead.max(1)
    return [
        _Seen(
            thing=things[i],
            rows=slice(int(edges[2][i]), int(edges[3][i])),
            columns=slice(int(edges[0][i]), int(edges[1][i])),
            nearest_m=float(nearest[i]),
        )
        for i in np.argsort(nearest)
        if furthest[i] > _NEAR_M and edges[0][i] < edges[1][i] and edges[2][i] < edges[3][i]
    ]


def _turned(points: Floats, yaw_rad: Floats) -> Floats:
    """Points [N, 8, 3] turned left about z, coordinate first: [3, N, 8]."""
    x, y, z = np.moveaxis(points, 2, 0)
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([x * cosine - y * sine, x * sine + y * cosine, z])


def _sky(rays: _Rays) -> Floats:
    amount = np.clip(rays.up * 1.6, 0.0, 1.0)[:, None, None]
    return np.broadcast_to(_HORIZON + (_ZENITH - _HORIZON) * amount, (*rays.size, 3)).astype(np.float32)


def _draw_ground(picture: Floats, depth: Floats, rays: _Rays, street: Street) -> None:
    """Rows under the horizon; edges of lines are softened by a pixel's size on the ground."""
    top = int(np.count_nonzero(rays.up >= 0))
    distance = -np.float32(CAMERA_HEIGHT_M) / rays.up[top:, None]
    x, y = _ground_points(rays, slice(top, None), slice(None))
    left = (y - street.centre(x)) / np.sqrt(1 + street.slope(x) ** 2)
    pixel = distance / np.float32(rays.focal)
    picture[top:] = ground_colour(x, left, pixel, distance * pixel / np.float32(CAMERA_HEIGHT_M))
    depth[top:] = distance


def _ground_points(rays: _Rays, rows: slice, columns: slice) -> tuple[Floats, Floats]:
    """World x and y where the rays of rows under the horizon meet the ground."""
    distance = -np.float32(CAMERA_HEIGHT_M) / rays.up[rows, None]
    x = np.float32(rays.origin[0]) + distance * rays.along[columns]
    return x, np.float32(rays.origin[1]) + distance * rays.aside[columns]


def _shadow(body: Box) -> Box:
    """The part of the ground that a car's shadow reaches."""
    length, width, _ = body.size
    x, y, _ = body.centre
    return Box(centre=(x, y, 0.0), size=(1.4 * length, 1.56 * width, 0.0), yaw_rad=body.yaw_rad, colour=body.colour)


def _darken(picture: Floats, rays: _Rays, seen: _Seen) -> None:
    """Draws a shadow with a soft edge on the bare ground."""
    box = seen.thing
    if not isinstance(box, Box):
        return
    rows = slice(max(seen.rows.start, int(np.count_nonzero(rays.up >= 0))), seen.rows.stop)
    turn = _turn(box.yaw_rad)
    x, y = _ground_points(rays, rows, seen.columns)
    away_x, away_y = x - np.float32(box.centre[0]), y - np.float32(box.centre[1])
    along = (away_x * turn[0, 0] + away_y * turn[0, 1]) / np.float32(0.4 * box.size[0])
    across = (away_x * turn[1, 0] + away_y * turn[1, 1]) / np.float32(0.4 * box.size[1])
    radius = np.maximum(np.abs(along), np.abs(across))
    picture[rows, seen.columns] *= 1.0 - 0.55 * np.clip((1.25 - radius) * 4.0, 0.0, 1.0)[:, :, None]


def _draw_box(picture: Floats, depth: Floats, rays: _Rays, seen: _Seen, box: Box) -> None:
    """Slab test in the box's own axes; picture and depth are the part of them that the box can cover."""
    turn = _turn(box.yaw_rad)
    half = np.array(box.size, np.float32) / 2
    origin = turn @ (np.array(rays.origin) - np.array(box.centre)).astype(np.float32)
    along, aside, up = rays.along[seen.columns], rays.aside[seen.columns], rays.up[seen.rows]
    x, y = turn[0, 0] * along + turn[0, 1] * aside, turn[1, 0] * along + turn[1, 1] * aside
    enter_x, leave_x = _slab(x, origin[0], half[0])
    enter_y, leave_y = _slab(y, origin[1], half[1])
    enter_z, leave_z = _slab(up, origin[2], half[2])
    enter_side, leave_side = np.maximum(enter_x, enter_y), np.minimum(leave_x, leave_y)
    distance = np.maximum(enter_side[None, :], enter_z[:, None])
    hit = (distance < np.minimum(leave_side[None, :], leave_z[:, None])) & (distance < depth)
    rows, columns = np.nonzero(hit & (distance > _NEAR_M))
    if len(rows) == 0:
        return
    at = distance[rows, columns]
    face = np.where(enter_z[rows] > enter_side[columns], 2, np.where(enter_y[columns] > enter_x[columns], 1, 0))
    direction = np.stack([x[columns], y[columns], up[rows]], axis=1)
    outward = -np.sign(direction[np.arange(len(face)), face])
    colour = box_colour(box, face, outward, origin + at[:, None] * direction)
    light = np.float32(0.62) + np.float32(0.42) * np.clip((turn @ _SUN)[face] * outward, 0.0, 1.0)
    picture[rows, columns] = colour * light[:, None]
    depth[rows, columns] = at


def _slab(direction: Floats, origin: np.floating[Any], half: np.floating[Any]) -> tuple[Floats, Floats]:
    """Where rays enter and leave the layer between -half and half of one axis."""
    inverse = np.float32(1.0) / direction
    one, other = (-half - origin) * inverse, (half - origin) * inverse
    return np.minimum(one, other), np.maximum(one, other)


def _turn(yaw_rad: float) -> Floats:
    """box_from_world [3, 3]."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32)


def _draw_ball(picture: Floats, depth: Floats, rays: _Rays, seen: _Seen, ball: Ball) -> None:
    """Ray against sphere; picture and depth are the part of them that the ball can cover."""
    along, aside, up = rays.along[seen.columns], rays.aside[seen.columns], rays.up[seen.rows]
    away = (np.array(ball.centre) - np.array(rays.origin)).astype(np.float32)
    square = (along**2 + aside**2)[None, :] + (up**2)[:, None]
    middle = (along * away[0] + aside * away[1])[None, :] + (up * away[2])[:, None]
    inside = middle**2 - square * np.float32(float(away @ away) - ball.radius_m**2)
    distance = (middle - np.sqrt(np.maximum(inside, 0.0))) / square
    rows, columns = np.nonzero((inside > 0) & (distance > _NEAR_M) & (distance < depth))
    at = distance[rows, columns]
    direction = np.stack([along[columns], aside[columns], up[rows]], axis=1)
    normals = (at[:, None] * direction - away) / np.float32(ball.radius_m)
    leaves = 0.16 * np.sin(9 * normals + np.float32(2.0) * np.sin(8 * normals[:, ::-1])).prod(axis=1)
    light = 0.5 + 0.6 * np.clip(normals @ _SUN, 0.0, 1.0) + leaves
    picture[rows, columns] = np.array(ball.colour, np.float32) * light[:, None]
    depth[rows, columns] = at


def _with_haze(picture: Floats, depth: Floats) -> Image:
    """Far things fade towards the horizon; the sky stays."""
    clear = np.where(np.isinf(depth), np.float32(1.0), np.exp(-depth / np.float32(_HAZE_M)))[:, :, None]
    faded = _HORIZON + (picture - _HORIZON) * clear
    return np.rint(np.clip(faded, 0.0, 255.0)).astype(np.uint8)
