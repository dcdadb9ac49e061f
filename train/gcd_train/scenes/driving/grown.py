"""A grown driving world put together: streets, what stands beside them, who moves through them, light and weather."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import driving_trajectory
from gcd_train.scenes.description import Floats, Part, Point, Sheet, upright
from gcd_train.scenes.driving import night
from gcd_train.scenes.driving.classes import Label
from gcd_train.scenes.driving.flow import Crowd, Drive, RoadUser, fill, random_drive
from gcd_train.scenes.driving.ground import ground_sheets
from gcd_train.scenes.driving.rig import on_vehicle, rigid, vehicle_from_camera
from gcd_train.scenes.driving.roadside import CAMERA_ROOM_M, Plot, furnish
from gcd_train.scenes.driving.street import Street, random_street
from gcd_train.scenes.driving.surroundings import DISTRICTS
from gcd_train.scenes.driving.vehicles import sky_dome
from gcd_train.scenes.driving.weather import Weather, random_weather

EGO_BODY = 1
_EDITION = 2
_PATH_STEPS = 8
_PAVED = ("city", "business")


@dataclass(frozen=True, kw_only=True, slots=True)
class GrownWorld:
    """All that is drawn, before it is looked at.

    things: what stands, each an assembly. users: the ego first. ego: x, y, z, yaw [T, 4].
    """

    things: tuple[tuple[Part, ...], ...]
    sheets: tuple[Sheet, ...]
    users: tuple[RoadUser, ...]
    ego: Floats
    weather: Weather
    facts: dict[str, float | str]

    @property
    def parts(self) -> tuple[Part, ...]:
        """Parts of the sky, of what stands and of the road users. The ego is instance 1 and body 1; who stands still
        belongs to the world.
        """
        made = [sky_dome(), *(part for thing in self.things for part in thing)]
        body = EGO_BODY
        for instance, user in enumerate(self.users, start=1):
            if _has_body(user, instance):
                made += [part.of(instance=instance, body=body) for part in user.assembly.parts]
                body += 1
            else:
                x, y, z, yaw = (float(value) for value in user.rows[0])
                made += [part.placed(x, y, z, yaw).of(instance=instance) for part in user.assembly.parts]
        if self.weather.kind == "night":
            made += night.beams(_road_colour(self.sheets), EGO_BODY)
        return tuple(made)

    @property
    def poses(self) -> Floats:
        """[T, B, 3, 4], world_from_body."""
        still = np.zeros_like(self.ego)
        rows = [user.rows for instance, user in enumerate(self.users, start=1) if _has_body(user, instance)]
        return upright(np.stack([still, *rows], 1))


def _has_body(user: RoadUser, instance: int) -> bool:
    return instance == 1 or user.moves


def _road_colour(sheets: tuple[Sheet, ...]) -> Point:
    return next(sheet.colour for sheet in sheets if sheet.label == Label.ROAD)


def grown_world(seed: int, frames: int) -> GrownWorld:
    """The world of a seed over so many time steps at 10 Hz."""
    layout, sky, way, standing, moving, ground = (np.random.default_rng([seed, _EDITION, part]) for part in range(6))
    street, weather = random_street(layout), random_weather(sky)
    district = str(layout.choice(list(DISTRICTS), p=[0.4, 0.3, 0.18, 0.12]))
    drive = random_drive(street, frames, way)
    cameras = _camera_places(drive.rows)
    plot = Plot(street=street, cameras=cameras.reshape(-1, 3))
    furnish(plot, DISTRICTS[district], district in _PAVED, weather.dark, not drive.waits, standing)
    crowd = Crowd(street=street, drive=drive, obstacles=plot.taken, cameras=cameras, camera_room_m=CAMERA_ROOM_M)
    fill(crowd, weather.lamps, moving)
    sheets = ground_sheets(street, weather.wetness, district in _PAVED, ground)
    things = list(plot.things)
    if weather.dark:
        sheets += night.lamp_pools(plot.lamps, _road_colour(tuple(sheets)), 0.9 if weather.kind == "night" else 0.3)
        things += [tuple(shown) for thing in plot.things if (shown := night.lit_windows(thing, standing))]
    return GrownWorld(
        things=tuple(things),
        sheets=tuple(sheets),
        users=tuple(crowd.users),
        ego=drive.rows,
        weather=weather,
        facts=_facts(seed, district, street, drive, weather, len(crowd.users)),
    )


def _camera_places(ego: Floats) -> NDArray[np.float64]:
    """[T, C, 3]: where the rig's cameras stand, and some places on the path from the forward to the top-down one."""
    path = driving_trajectory(frames=_PATH_STEPS, move_time=_PATH_STEPS - 1).source_from_target.numpy()
    along = rigid(ego)[:, None] @ (vehicle_from_camera()["yaw-0"] @ path)[None]
    rig = np.stack(list(on_vehicle(ego).values()), 1)
    return np.concatenate([rig, along], 1)[..., :3, 3]


def _facts(
    seed: int, district: str, street: Street, drive: Drive, weather: Weather, users: int
) -> dict[str, float | str]:
    return {
        "seed": seed,
        "edition": _EDITION,
        "district": district,
        "weather": weather.kind,
        "lanes": street.main.lanes_left + street.main.lanes_right,
        "crossings": len(street.crossed),
        "road_users": users,
        "waits": int(drive.waits),
        "ego_m_s": round(drive.speed, 3),
    }
