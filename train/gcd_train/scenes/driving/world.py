"""The driving world put together, seen by the nineteen cameras of ParallelDomain-4D, or by the two of a pair.

Source: Van Hoorick et al. 2024 (GCD), ParallelDomain-4D: a forward ego camera, a fixed path to a pose above and
behind the car, 10 frames per second.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    CameraMount,
    driving_trajectory,
    look_at,
)
from gcd_train.scenes.description import Floats, Part, Point, Scene, upright
from gcd_train.scenes.driving.classes import Label, coarse
from gcd_train.scenes.driving.flow import Crowd, RoadUser, fill, random_drive
from gcd_train.scenes.driving.ground import ground_sheets
from gcd_train.scenes.driving.roads import Doubles, random_street
from gcd_train.scenes.driving.roadside import CAMERA_ROOM_M, Plot, furnish
from gcd_train.scenes.driving.things import DISTRICTS, random_district, sky_dome
from gcd_train.scenes.driving.weather import beams, lamp_pools, lit_windows, random_weather, shadow_focus

HFOV_DEG = 85.0
EDITION = 2
"""Rises whenever a seed draws another world."""
_PATH_STEPS = 8
_PAVED = ("city", "business")
_SIDE_YAW_DEG, _SIDE_M = 60.0, 0.25
_SURROUND: tuple[tuple[float, float, float, float, float], ...] = (
    (-4.0, 0.0, 4.6, 0.0, 42.0),
    (2.0, 3.5, 4.6, -45.0, 42.0),
    (-4.0, 0.0, 4.6, 0.0, 12.0),
    (2.0, 0.0, 4.6, -45.0, 42.0),
    (-10.0, -3.5, 10.0, 0.0, 12.0),
    (-4.0, 3.5, 4.6, 0.0, 12.0),
    (2.0, 0.0, 4.6, -135.0, 42.0),
    (2.0, 0.0, 4.6, 0.0, 12.0),
    (-10.0, 3.5, 7.0, 0.0, 12.0),
    (2.0, 0.0, 4.6, 135.0, 12.0),
    (2.0, 3.5, 4.6, -135.0, 12.0),
    (14.0, 0.0, 4.6, 180.0, 12.0),
    (2.0, -3.5, 7.0, 90.0, 42.0),
    (-4.0, 3.5, 4.6, -90.0, 12.0),
    (8.0, 0.0, 4.6, 0.0, 12.0),
)
"""camera1 to camera15: x, y, z in metres, to which side (0 ahead, 90 left) and how far down they look, degrees.

Picked one after the other from 720 candidates: the first nine as those that see most of what the path from the forward
to the top-down pose sees and no camera before them does, the others likewise for views around the car. Over six drives
the rig sees 99.9 % of what the path sees within 150 m, and 98 % of what is seen around the car.
"""


def driving_drive(seed: int, frames: int = 50) -> Scene:
    """One drive. Its cameras are named as the data set names them (see `vehicle_from_camera`).

    Args:
        seed: 0 or more; it and the number of frames decide all that is drawn.
        frames: time steps at 10 Hz; the world's origin lies amid the way that the vehicle goes meanwhile.
    """
    scene, users = random_world(seed, frames)
    return replace(scene, cameras=_on_vehicle(users[0].rows))


def driving_scene(
    seed: int, *, frames: int = 14, mount: CameraMount | None = None, move_time: int | None = None
) -> Scene:
    """A scene for pairs, seen by a source and a target camera that ride on the vehicle, in the class head's thirteen
    classes; the arguments decide it all.

    Args:
        seed: 0 or more.
        frames: time steps at 10 Hz.
        mount: where the source camera sits, if not where ParallelDomain-4D has it; the target path stays.
        move_time: the frame in which the target camera is at its goal, the last if left out; 0 is the direct path.
    """
    scene, users = random_world(seed, frames)
    parts = tuple(replace(part, label=coarse(part.label)) for part in scene.parts)
    sheets = tuple(replace(sheet, label=coarse(sheet.label)) for sheet in scene.sheets)
    mount = mount or CameraMount()
    world_from_vehicle, source = rigid(users[0].rows), mount.vehicle_from_camera.numpy()
    path = driving_trajectory(frames=frames, move_time=frames - 1 if move_time is None else move_time, mount=mount)
    goal = source @ path.source_from_target.numpy()
    cameras = {"source": world_from_vehicle @ source, "target": world_from_vehicle @ goal}
    return replace(scene, parts=parts, sheets=sheets, cameras=cameras, hfov_deg=mount.hfov_deg)


def random_world(seed: int, frames: int) -> tuple[Scene, list[RoadUser]]:
    """The world of a seed over so many time steps at 10 Hz, without cameras, and its road users, the ego first.

    The ego is instance 1 and body 1; a road user that stands still belongs to the world.
    """
    layout, sky, way, standing, moving, ground = (np.random.default_rng([seed, EDITION, part]) for part in range(6))
    street, weather = random_street(layout), random_weather(sky)
    district = random_district(layout)
    paved = district in _PAVED
    drive = random_drive(street, frames, way)
    cameras = _camera_places(drive.rows)
    plot = Plot(street=street, cameras=cameras.reshape(-1, 3))
    furnish(plot, DISTRICTS[district], paved, weather.dark, not drive.waits, standing)
    crowd = Crowd(street=street, drive=drive, obstacles=plot.taken, cameras=cameras, camera_room_m=CAMERA_ROOM_M)
    fill(crowd, weather.lamps, moving)
    sheets = ground_sheets(street, weather.wetness, paved, ground)
    asphalt = next(sheet.paint.colour for sheet in sheets if sheet.label == Label.ROAD)
    parts = [sky_dome(), *(part for thing in plot.things for part in thing)]
    if weather.dark:
        sheets += lamp_pools(plot.lamps, asphalt, 0.9 if weather.kind == "night" else 0.3)
        parts += [part for thing in plot.things for part in lit_windows(thing, standing)]
    users, bodies = _users(crowd.users)
    parts += users
    if weather.kind == "night":
        parts += beams(asphalt, body=1)
    scene = Scene(
        parts=tuple(parts),
        sheets=tuple(sheets),
        poses=bodies,
        focus=shadow_focus(drive.rows),
        cameras={},
        hfov_deg=HFOV_DEG,
        light=weather.light,
        facts={
            "seed": seed,
            "edition": EDITION,
            "district": district,
            "weather": weather.kind,
            "lanes": street.main.lanes_left + street.main.lanes_right,
            "crossings": len(street.crossed),
            "road_users": len(crowd.users),
            "waits": int(drive.waits),
            "ego_m_s": round(drive.speed, 3),
        },
    )
    return scene, crowd.users


def _users(users: list[RoadUser]) -> tuple[list[Part], Floats]:
    """Parts of the road users, and world_from_body [T, B, 3, 4] of those with a body of their own."""
    parts: list[Part] = []
    rows = [np.zeros_like(users[0].rows)]
    for instance, user in enumerate(users, start=1):
        if instance == 1 or user.moves:
            parts += [part.of(instance=instance, body=len(rows)) for part in user.assembly.parts]
            rows.append(user.rows)
        else:
            x, y, z, yaw = (float(value) for value in user.rows[0])
            parts += [part.placed(x, y, z, yaw).of(instance=instance) for part in user.assembly.parts]
    return parts, upright(np.stack(rows, 1))


def _camera_places(ego: Floats) -> Doubles:
    """[T, C, 3]: where the rig's cameras stand, and some places on the path from the forward to the top-down one."""
    path = driving_trajectory(frames=_PATH_STEPS, move_time=_PATH_STEPS - 1).source_from_target.numpy()
    along = rigid(ego)[:, None] @ (vehicle_from_camera()["yaw-0"] @ path)[None]
    return np.concatenate([np.stack(list(_on_vehicle(ego).values()), 1), along], 1)[..., :3, 3]


def _on_vehicle(rows: Floats) -> dict[str, Doubles]:
    """world_from_camera [T, 4, 4] of the rig's cameras, where the vehicle is at x, y, z, yaw [T, 4]."""
    world_from_vehicle = rigid(rows)
    return {name: world_from_vehicle @ pose for name, pose in vehicle_from_camera().items()}


def vehicle_from_camera() -> dict[str, Doubles]:
    """Pose [4, 4] of every camera in the vehicle's frame (x ahead, y left, z up; the ground is z = 0), metres.

    camera0 to camera15 stand around and above the car, camera0 where the paper's path ends; yaw-0 looks ahead from
    where that path begins, yaw-60 and yaw-neg-60 stand beside it and look to the left and to the right.
    """
    poses = {"camera0": _looking(DRIVING_GOAL_POSITION, DRIVING_GOAL_TARGET)}
    for number, (x, y, z, azimuth_deg, down_deg) in enumerate(_SURROUND, start=1):
        poses[f"camera{number}"] = _turned((x, y, z), azimuth_deg, down_deg)
    poses["yaw-0"] = _looking(DRIVING_SOURCE_POSITION, DRIVING_SOURCE_TARGET)
    for name, side in (("yaw-60", 1.0), ("yaw-neg-60", -1.0)):
        x, y, z = DRIVING_SOURCE_POSITION
        poses[name] = _turned((x, y + side * _SIDE_M, z), side * _SIDE_YAW_DEG, 0.0)
    return poses


def rigid(rows: NDArray[Any]) -> Doubles:
    """x, y, z, yaw [T, 4] as rigid transforms [T, 4, 4]."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = upright(rows)
    return poses


def _turned(position: Point, azimuth_deg: float, down_deg: float) -> Doubles:
    azimuth, down = np.radians(azimuth_deg), np.radians(down_deg)
    ahead = (np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down))
    x, y, z = (float(at + step) for at, step in zip(position, ahead, strict=True))
    return _looking(position, (x, y, z))


def _looking(position: Point, target: Point) -> Doubles:
    return look_at(torch.tensor(position, dtype=torch.float64), torch.tensor(target, dtype=torch.float64)).numpy()
