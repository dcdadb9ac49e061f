"""A whole drive as ParallelDomain-4D records it: five seconds, nineteen cameras on the vehicle."""

from gcd_train.scenes.description import Scene
from gcd_train.scenes.driving.grown import grown_world
from gcd_train.scenes.driving.pair_scene import HFOV_DEG, ahead_of
from gcd_train.scenes.driving.rig import on_vehicle


def driving_drive(seed: int, *, frames: int = 50) -> Scene:
    """One drive through a grown world. Its cameras are named as the data set names them (see `vehicle_from_camera`).

    Args:
        seed: 0 or more; it and the number of frames decide all that is drawn.
        frames: time steps at 10 Hz; the world's origin lies amid the way that the vehicle goes meanwhile.
    """
    world = grown_world(seed, frames)
    return Scene(
        parts=world.parts,
        sheets=world.sheets,
        poses=world.poses,
        focus=ahead_of(world.ego),
        cameras=on_vehicle(world.ego),
        hfov_deg=HFOV_DEG,
        light=world.weather.light,
        facts=world.facts,
    )
