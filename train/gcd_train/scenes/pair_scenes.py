"""The clips of one scene, drawn: the source camera stands or drives as the world has it, the target goes its path."""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import CameraMount
from gcd_train.data.paths import Draw, FrameSampling, OrbitSampling
from gcd_train.errors import RenderError
from gcd_train.scenes.description import Scene, rotations
from gcd_train.scenes.driving import driving_scene
from gcd_train.scenes.frozen import freeze
from gcd_train.scenes.pair_world import Orbit, World
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.worlds import scene_world

_ATTEMPTS = 100
_CLEAR_M = 1.0
"""A camera stays this far from the sphere about any thing; nearer, one thing would fill the picture."""


@dataclass(frozen=True, kw_only=True, slots=True)
class DrawnClip:
    """facts: of the scene. cameras: "source" and "target", world_from_camera [T, 4, 4]. orbit: None in driving."""

    seed: int
    facts: dict[str, float | str]
    hfov_deg: float
    cameras: dict[str, NDArray[np.float64]]
    views: dict[str, list[Rendering]]
    orbit: Orbit | None = None


def drawn_clips(renderer: Renderer, world: World, seeds: Sequence[int]) -> Iterator[DrawnClip]:
    """Clips by number, each scene simulated once for those of its clips that follow each other.

    Raises:
        RenderError: a scene cannot be simulated or drawn, or leaves no room for a camera.
    """
    for scene_seed, group in groupby(seeds, key=world.scene_of):
        if world.camera == "fixed":
            yield from (_fixed(renderer, world, seed) for seed in group)
        else:
            yield from _orbits(renderer, world, scene_seed, list(group))


def _fixed(renderer: Renderer, world: World, seed: int) -> DrawnClip:
    mount = CameraMount(height_m=world.options.height_m, tilt_deg=world.options.tilt_deg)
    scene = driving_scene(seed, frames=world.frames, mount=mount, edition=world.edition, move_time=world.move_time)
    return DrawnClip(
        seed=seed, facts=scene.facts, hfov_deg=scene.hfov_deg, cameras=scene.cameras, views=renderer.render(scene)
    )


def _orbits(renderer: Renderer, world: World, scene_seed: int, seeds: list[int]) -> Iterator[DrawnClip]:
    """All clips of a scene in one pass: their time steps follow each other, so it is sent to the renderer once."""
    published = scene_world(world.name)
    scene = published.make(scene_seed, published.frames)
    draws = [orbit_draw(scene, world, seed) for seed in seeds]
    numbers = np.concatenate([draw.frame_numbers for draw in draws])
    cameras = {
        "source": np.concatenate([np.tile(draw.world_from_source, (world.frames, 1, 1)) for draw in draws]),
        "target": np.concatenate([draw.world_from_target for draw in draws]),
    }
    cut = replace(freeze(scene), poses=scene.poses[numbers], focus=scene.focus[numbers], hfov_deg=world.hfov_deg)
    views: dict[str, list[Rendering]] = {name: [] for name in cameras}
    for step, name, view in renderer.views(cut, cameras):
        views[name].append(view)
        clip, frame = divmod(step, world.frames)
        if name == "target" and frame == world.frames - 1:
            steps = slice(clip * world.frames, (clip + 1) * world.frames)
            yield DrawnClip(
                seed=seeds[clip],
                facts=scene.facts,
                hfov_deg=world.hfov_deg,
                cameras={name: poses[steps] for name, poses in cameras.items()},
                views=views,
                orbit=_told(draws[clip]),
            )
            views = {name: [] for name in cameras}


def orbit_draw(scene: Scene, world: World, seed: int) -> Draw:
    """Time steps and camera path of a clip: the first one drawn that leaves the cameras clear of all things.

    Raises: RenderError if things are in the way wherever the cameras stand.
    """
    sampling = OrbitSampling(frames=FrameSampling(clip=world.frames, strides=(world.stride,)))
    scene_seed, clip = divmod(seed, world.clips_per_scene)
    salt = zlib.crc32(world.name.encode())  # else all worlds would be seen along the same paths
    for attempt in range(_ATTEMPTS):
        random = np.random.default_rng([scene_seed, clip, attempt, salt])
        draw = sampling.draw(random, scene.frames, world.fps * world.stride)
        if _clear(scene, draw):
            return draw
    raise RenderError(f"{world.name} scene {scene_seed}: no path leaves the cameras clear of all things; skip it")


def _clear(scene: Scene, draw: Draw) -> bool:
    steps = list(draw.frame_numbers)
    eyes = np.stack([np.tile(draw.world_from_source[:3, 3], (len(steps), 1)), draw.world_from_target[:, :3, 3]])
    for thing in scene.objects:
        middle = thing.positions[steps] + rotations(thing.quaternions[steps]) @ np.array(thing.middle)
        reach = np.linalg.norm(thing.size) / 2 + _CLEAR_M
        if bool((np.linalg.norm(eyes - middle, axis=-1) < reach).any()):
            return False
    return True


def _told(draw: Draw) -> Orbit:
    if draw.start is None or draw.deltas is None:
        raise RenderError("a path over the sphere has a start and changes; use OrbitSampling")
    start = (draw.start.azimuth_deg, draw.start.elevation_deg, draw.start.radius_m)
    azimuth_deg, elevation_deg, radius_m = draw.deltas[-1].tolist()
    return Orbit(start=start, change=(azimuth_deg, elevation_deg, radius_m), frame_numbers=draw.frame_numbers)
