"""The driving world put together, seen by the nineteen cameras of ParallelDomain-4D, or by the two of a pair.

Source: Van Hoorick et al. 2024 (GCD), ParallelDomain-4D: a forward ego camera, a fixed path to a pose above and
behind the car, 10 frames per second.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gcd_model.geometry import (
    DRIVING_GOAL_POSITION,
    DRIVING_GOAL_TARGET,
    DRIVING_SOURCE_POSITION,
    DRIVING_SOURCE_TARGET,
    CameraMount,
    driving_trajectory,
    look_at,
)
from gcd_train.scenes.description import (
    Colour,
    Doubles,
    Floats,
    Light,
    Part,
    Pattern,
    Point,
    Scene,
    mixed,
    pick_by_share,
    rigid,
    towards,
    upright,
)
from gcd_train.scenes.driving.classes import Label, coarse
from gcd_train.scenes.driving.flow import Crowd, RoadUser, fill, random_drive
from gcd_train.scenes.driving.ground import PATCH_M, ground_sheets, lamp_pools
from gcd_train.scenes.driving.roads import random_street
from gcd_train.scenes.driving.roadside import Plot, furnish
from gcd_train.scenes.driving.things import DISTRICTS, block, lit_windows

HFOV_DEG = 85.0
EDITION = 2
"""Rises whenever a seed draws another world."""
_PATH_STEPS = 8
_PAVED = ("city", "business")
_MOUNT = CameraMount()
_SIDE_YAW_DEG, _SIDE_M = 60.0, 0.25
_FOCUS_AHEAD_M = 28.0
"""Shadows fall around a point that far ahead of the vehicle."""
_SKY = block((0, 0, 0), (-1600.0, 1600.0, 1600.0), (0.5, 0.6, 0.8), Label.SKY, shape="ball", pattern=Pattern.SKY)
"""A dome far away; its inside faces the cameras, hence the negative size."""
_POOLS_M = 70.0
_BEAM_STEPS = 8
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


def driving_scene(seed: int, *, frames: int = 14, mount: CameraMount = _MOUNT, move_time: int | None = None) -> Scene:
    """A scene for pairs, seen by a source and a target camera that ride on the vehicle, in the models' thirteen
    classes; the arguments decide it all.

    Args:
        seed: 0 or more.
        frames: time steps at 10 Hz.
        mount: where the source camera sits, by default where ParallelDomain-4D has it; the target path stays.
        move_time: the frame in which the target camera is at its goal, the last if left out; 0 is the direct path.
    """
    scene, users = random_world(seed, frames)
    parts = tuple(replace(part, label=coarse(part.label)) for part in scene.parts)
    sheets = tuple(replace(sheet, label=coarse(sheet.label)) for sheet in scene.sheets)
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
    district = str(layout.choice(list(DISTRICTS), p=[0.4, 0.3, 0.18, 0.12]))
    paved = district in _PAVED
    drive = random_drive(street, frames, way)
    path = driving_trajectory(frames=_PATH_STEPS, move_time=_PATH_STEPS - 1).source_from_target.numpy()
    along = rigid(drive.rows)[:, None] @ (vehicle_from_camera()["yaw-0"] @ path)[None]
    # where the rig's cameras stand, and some places on the path from the forward to the top-down one: [T, C, 3]
    cameras = np.concatenate([np.stack(list(_on_vehicle(drive.rows).values()), 1), along], 1)[..., :3, 3]
    plot = Plot(street=street, cameras=cameras.reshape(-1, 3))
    waits = drive.waits_at is not None
    furnish(plot, DISTRICTS[district], paved, weather.dark, not waits, standing)
    crowd = Crowd(street=street, drive=drive, obstacles=plot.taken, cameras=cameras)
    fill(crowd, weather.lamps, moving)
    sheets = ground_sheets(street, weather.wetness, paved, ground)
    asphalt = next(sheet.paint.colour for sheet in sheets if sheet.label == Label.ROAD)
    parts = [_SKY, *(part for thing in plot.things for part in thing)]
    if weather.dark:
        spots = [(x, y, heading) for x, y, heading, s in plot.lamps if abs(s) < _POOLS_M]
        sheets += lamp_pools(spots, asphalt, 0.9 if weather.kind == "night" else 0.3)
        parts += [part for thing in plot.things for part in lit_windows(thing, standing)]
    users, bodies = _users(crowd.users)
    parts += users
    if weather.kind == "night":
        parts += _beams(asphalt)
    scene = Scene(
        parts=tuple(parts),
        sheets=tuple(sheets),
        poses=bodies,
        focus=(drive.rows[:, :3] + _FOCUS_AHEAD_M * bodies[:, 1, :, 0].astype(np.float64)).astype(np.float32),
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
            "waits": int(waits),
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


def _on_vehicle(rows: Floats) -> dict[str, Doubles]:
    """world_from_camera [T, 4, 4] of the rig's cameras, where the vehicle is at x, y, z, yaw [T, 4]."""
    world_from_vehicle = rigid(rows)
    return {name: world_from_vehicle @ pose for name, pose in vehicle_from_camera().items()}


def vehicle_from_camera() -> dict[str, Doubles]:
    """Pose [4, 4] of every camera in the vehicle's frame (x ahead, y left, z up; the ground is z = 0), metres.

    camera0 to camera15 stand around and above the car, camera0 where the paper's path ends; yaw-0 looks ahead from
    where that path begins, yaw-60 and yaw-neg-60 stand beside it and look to the left and to the right.
    """
    poses = {"camera0": looking(DRIVING_GOAL_POSITION, DRIVING_GOAL_TARGET)}
    for number, (x, y, z, azimuth_deg, down_deg) in enumerate(_SURROUND, start=1):
        poses[f"camera{number}"] = _turned((x, y, z), azimuth_deg, down_deg)
    poses["yaw-0"] = looking(DRIVING_SOURCE_POSITION, DRIVING_SOURCE_TARGET)
    for name, side in (("yaw-60", 1.0), ("yaw-neg-60", -1.0)):
        x, y, z = DRIVING_SOURCE_POSITION
        poses[name] = _turned((x, y + side * _SIDE_M, z), side * _SIDE_YAW_DEG, 0.0)
    return poses


def _turned(position: Point, azimuth_deg: float, down_deg: float) -> Doubles:
    azimuth, down = np.radians(azimuth_deg), np.radians(down_deg)
    ahead = (np.cos(azimuth) * np.cos(down), np.sin(azimuth) * np.cos(down), -np.sin(down))
    return looking(position, np.add(position, ahead))


def looking(eye: Sequence[float] | Doubles, target: Sequence[float] | Doubles) -> Doubles:
    """world_from_camera [4, 4] of an upright camera at one point [3] that looks at another."""
    return look_at(*(torch.tensor(point, dtype=torch.float64) for point in (eye, target))).numpy()


def _beams(asphalt: Colour) -> list[Part]:
    """The light of the ego's headlights on the road ahead, as very flat bodies that ride with it."""
    parts: list[Part] = []
    for step in range(_BEAM_STEPS):
        share = (step + 1) / _BEAM_STEPS
        size = (34.0 - 20.0 * share, 6.5 - 4.0 * share, 0.001)
        colour = mixed(asphalt, 0.6 * share, (0.72, 0.7, 0.62))
        centre = (1.4 + size[0] / 2, 0.0, PATCH_M + 0.0006 * step)
        parts.append(block(centre, size, colour, Label.ROAD, shape="ball").of(instance=0, body=1))
    return parts


# weather

_SHARES = {
    "clear": 0.3, "cloudy": 0.18, "low sun": 0.12, "overcast": 0.12, "rain": 0.12, "fog": 0.06, "dusk": 0.06,
    "night": 0.04,
}  # fmt: skip
_GREY = {"overcast": (0.72, (220, 600)), "rain": (0.5, (110, 220)), "fog": (0.66, (38, 75))}
"""How bright the sky is, and between which distances half of the fog lies, metres."""
_DUSK = Light(
    sun_to=(0.0, 0.0, 1.0),
    sun=(0.16, 0.08, 0.05),
    sky=(0.2, 0.2, 0.3),
    ground=(0.08, 0.07, 0.07),
    horizon=(0.62, 0.34, 0.26),
    zenith=(0.1, 0.13, 0.27),
    fog_m=420.0,
    cloud=0.0,
    exposure=1.5,
)
_NIGHT = replace(
    _DUSK,
    sun=(0.035, 0.045, 0.07),
    sky=(0.06, 0.065, 0.095),
    ground=(0.03, 0.026, 0.022),
    horizon=(0.055, 0.05, 0.06),
    zenith=(0.008, 0.011, 0.026),
    fog_m=240.0,
    exposure=1.9,
)
_DIM = {"dusk": (_DUSK, 8.0), "night": (_NIGHT, 40.0)}
"""With the height of sun and moon, degrees."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Weather:
    """wetness: of the ground, 0..1. lamps: whether vehicles have theirs lit. dark: whether street lamps and windows
    are lit too.
    """

    kind: str
    light: Light
    wetness: float
    lamps: bool
    dark: bool


def random_weather(random: np.random.Generator) -> Weather:
    """Drawn at random; one in six is wet, one in ten dark."""
    kind = pick_by_share(random, tuple(_SHARES.items()))
    light = _light(kind, random)
    wet = {"rain": random.uniform(0.7, 1.0), "dusk": 0.3, "night": float(random.choice([0.0, 0.7]))}
    return Weather(
        kind=kind,
        light=light,
        wetness=wet.get(kind, 0.0),
        lamps=kind in ("rain", "fog", "dusk", "night") or (kind == "overcast" and random.random() < 0.4),
        dark=kind in _DIM,
    )


def _light(kind: str, random: np.random.Generator) -> Light:
    azimuth = random.uniform(0, 2 * math.pi)
    exposure = random.uniform(0.9, 1.12)
    if kind in _DIM:
        dim, height = _DIM[kind]
        return replace(dim, sun_to=towards(math.radians(height), azimuth), exposure=dim.exposure * exposure)
    if kind in _GREY:
        fog_m = {name: random.uniform(*bounds) for name, (_, bounds) in _GREY.items()}[kind]
        grey, _ = _GREY[kind]
        sky: Colour = (grey * 0.96, grey * 0.99, grey * 1.03)
        return Light(
            sun_to=towards(math.radians(random.uniform(45, 75)), azimuth),
            sun=(0.12, 0.12, 0.11),
            sky=(0.86 * grey + 0.16, 0.88 * grey + 0.16, 0.92 * grey + 0.16),
            ground=(0.3 * grey, 0.29 * grey, 0.28 * grey),
            horizon=sky,
            zenith=(0.82 * sky[0], 0.85 * sky[1], 0.9 * sky[2]),
            fog_m=float(fog_m),
            cloud=0.25 if kind == "rain" else 0.1,
            exposure=1.5 * exposure,
        )
    height, cloudy = float(random.uniform(9, 17) if kind == "low sun" else random.uniform(24, 66)), kind == "cloudy"
    low = math.exp(-height / 18.0)  # how golden the light is
    strength = 1.9 if cloudy else 2.5
    blue = random.uniform(0.6, 1.0) * (0.6 if cloudy else 1.0)
    return Light(
        sun_to=towards(math.radians(height), azimuth),
        sun=(strength, strength * (1 - 0.3 * low), strength * (0.94 - 0.55 * low)),
        sky=(0.38 - 0.06 * blue, 0.42, 0.48 + 0.06 * blue),
        ground=(0.17, 0.16, 0.14),
        horizon=(0.64 - 0.12 * blue + 0.34 * low, 0.68 - 0.04 * blue + 0.02 * low, 0.8 - 0.3 * low),
        zenith=(0.5 - 0.42 * blue, 0.56 - 0.33 * blue, 0.68 + 0.02 * blue),
        fog_m=random.uniform(320, 800),
        cloud=random.uniform(0.7, 1.0) if cloudy else random.uniform(0, 0.45),
        exposure=1.45 * exposure,
    )
