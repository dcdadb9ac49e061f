"""The driving world: one seed, one clip of 14 frames, as ParallelDomain-4D sets its cameras.

Source: Van Hoorick et al. 2024 (GCD), ParallelDomain-4D: a forward ego camera, a fixed path to a pose above and
behind the car, 10 frames per second.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount, driving_trajectory
from gcd_train.errors import DataError
from gcd_train.scenes.description import Colour, Floats, Light, Part, Scene, upright
from gcd_train.scenes.driving.classes import coarse
from gcd_train.scenes.driving.grown import EGO_BODY, grown_world
from gcd_train.scenes.driving.rig import rigid
from gcd_train.scenes.driving.road import Road, random_road, road_sheets
from gcd_train.scenes.driving.surroundings import DISTRICTS, surroundings
from gcd_train.scenes.driving.traffic import Traffic, random_traffic
from gcd_train.scenes.driving.vehicles import sky_dome

HFOV_DEG = 85.0
_FOCUS_AHEAD_M = 28.0


@dataclass(frozen=True, kw_only=True, slots=True)
class _Ride:
    """How a scene is seen. move_time: the frame in which the target camera is at its goal."""

    frames: int
    mount: CameraMount
    move_time: int

    def cameras(self, ego: Floats) -> dict[str, NDArray[np.float64]]:
        """world_from_camera [T, 4, 4] of the source and of the target camera; both ride on the vehicle."""
        world_from_vehicle, source = rigid(ego), self.mount.vehicle_from_camera.numpy()
        path = driving_trajectory(frames=self.frames, move_time=self.move_time, mount=self.mount)
        goal = source @ path.source_from_target.numpy()
        return {"source": world_from_vehicle @ source, "target": world_from_vehicle @ goal}


def driving_scene(
    seed: int,
    *,
    frames: int = 14,
    mount: CameraMount | None = None,
    edition: int = 1,
    move_time: int | None = None,
) -> Scene:
    """A scene that depends on nothing but its arguments.

    Args:
        seed: 0 or more.
        frames: time steps at 10 Hz.
        mount: where the source camera sits, if not where ParallelDomain-4D has it; the target path stays.
        edition: 1 for the world that the packaged model was trained in, 2 for the grown one. Both speak of the class
            head's thirteen classes.
        move_time: the frame in which the target camera is at its goal, the last if left out; 0 is the direct path.
    Raises:
        DataError: there is no such edition.
    """
    if edition not in _EDITIONS:
        raise DataError(f"the driving world has editions 1 and 2, got {edition}; leave it out for the first one")
    last = frames - 1 if move_time is None else move_time
    return _EDITIONS[edition](seed, _Ride(frames=frames, mount=mount or CameraMount(), move_time=last))


def _first_edition(seed: int, ride: _Ride) -> Scene:
    random = np.random.default_rng([seed, 0x6D])
    road = random_road(random)
    name = str(random.choice(list(DISTRICTS), p=[0.4, 0.3, 0.18, 0.12]))
    sheets = road_sheets(road, random)
    parts = [sky_dome(), *surroundings(road, DISTRICTS[name], random)]
    traffic = random_traffic(road, random)
    light = _random_light(random)
    rows = traffic.poses(road, ride.frames)
    return Scene(
        parts=(*parts, *_bodies(traffic)),
        sheets=tuple(sheets),
        poses=upright(rows),
        focus=ahead_of(rows[:, EGO_BODY]),
        cameras=ride.cameras(rows[:, EGO_BODY]),
        hfov_deg=ride.mount.hfov_deg,
        light=light,
        facts=_facts(seed, name, road, traffic),
    )


def _grown_edition(seed: int, ride: _Ride) -> Scene:
    world = grown_world(seed, ride.frames)
    return Scene(
        parts=tuple(replace(part, label=coarse(part.label)) for part in world.parts),
        sheets=tuple(replace(sheet, label=coarse(sheet.label)) for sheet in world.sheets),
        poses=world.poses,
        focus=ahead_of(world.ego),
        cameras=ride.cameras(world.ego),
        hfov_deg=ride.mount.hfov_deg,
        light=world.weather.light,
        facts=world.facts,
    )


_EDITIONS: dict[int, Callable[[int, _Ride], Scene]] = {1: _first_edition, 2: _grown_edition}


def _bodies(traffic: Traffic) -> list[Part]:
    """Parts of the ego (instance 1), of what moves and of what is parked; instances repeat beyond 255."""
    parts = [part.of(instance=1, body=EGO_BODY) for part in traffic.ego.assembly.parts]
    for index, mover in enumerate(traffic.movers):
        parts += [part.of(instance=2 + index % 254, body=EGO_BODY + 1 + index) for part in mover.assembly.parts]
    for index, row in enumerate(traffic.parked, start=len(traffic.movers)):
        parts += [part.of(instance=2 + index % 254) for part in row]
    return parts


def ahead_of(ego: Floats) -> Floats:
    """The point around which shadows fall, [T, 3], for a vehicle at x, y, z, yaw [T, 4]."""
    forward = np.stack([np.cos(ego[:, 3]), np.sin(ego[:, 3]), np.zeros(len(ego))], -1)
    return (ego[:, :3] + _FOCUS_AHEAD_M * forward).astype(np.float32)


def _random_light(random: np.random.Generator) -> Light:
    overcast = random.random() < 0.25
    height = float(random.uniform(12, 68)) * math.pi / 180
    round_ = float(random.uniform(0, 2 * math.pi))
    low = math.exp(-height / 0.35)  # how golden the light is
    strength = 0.15 if overcast else 1.9
    sun: Colour = (strength, strength * (1 - 0.25 * low), strength * (0.92 - 0.45 * low))
    blue = float(random.uniform(0.0, 1.0)) * (0.1 if overcast else 1.0)
    bright = float(random.uniform(0.55, 0.85))
    zenith: Colour = (bright * (0.7 - 0.5 * blue), bright * (0.74 - 0.36 * blue), bright * (0.8 + 0.12 * blue))
    horizon: Colour = (0.72 * bright + 0.2 * low, 0.78 * bright + 0.06 * low, 0.86 * bright)
    fill = 0.95 if overcast else 0.55
    return Light(
        sun_to=(math.cos(height) * math.cos(round_), math.cos(height) * math.sin(round_), math.sin(height)),
        sun=sun,
        sky=(fill * (0.9 - 0.12 * blue), fill * 0.92, fill * (0.94 + 0.14 * blue)),
        ground=(0.32 * fill, 0.3 * fill, 0.28 * fill),
        horizon=horizon,
        zenith=zenith,
        fog_m=float(random.uniform(160, 700)),
        cloud=0.0 if overcast else float(random.uniform(0, 0.9)),
        exposure=float(random.uniform(1.3, 2.0)),
    )


def _facts(seed: int, district: str, road: Road, traffic: Traffic) -> dict[str, float | str]:
    return {
        "seed": seed,
        "district": district,
        "lanes": road.lanes_left + road.lanes_right,
        "crossings": len(road.crossings),
        "movers": len(traffic.movers),
        "parked": len(traffic.parked),
        "ego_m_s": round(traffic.ego.speed, 3),
    }
