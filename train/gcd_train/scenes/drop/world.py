"""The drop world: one seed, one clip, as Kubric-4D makes its scenes, with things and pictures of our own.

Source: Van Hoorick et al. 2024 (GCD), Kubric-4D: 6 to 16 things that have settled and 1 to 6 that are thrown, 60 frames
at 24 per second, sixteen cameras that stand still at 15 m from the point (0, 0, 1): four at an elevation of 45 degrees,
twelve at 5.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gcd_model.geometry import sphere_poses
from gcd_train.errors import RenderError
from gcd_train.scenes.description import (
    ORBIT,
    Colour,
    Doubles,
    Light,
    Paint,
    Part,
    Pattern,
    Point,
    Scene,
    SceneObject,
    Sheet,
    Thing,
    Tracks,
    pick,
    pick_by_share,
    rotations,
    shaded,
    square,
    towards,
    with_world,
    yawed,
)
from gcd_train.scenes.drop.things import DropLabel, random_thing
from gcd_train.scenes.triangles import shape

FPS = 24.0
HFOV_DEG = math.degrees(2 * math.atan(0.5))
_RADIUS_M = 15.0
_ATTEMPTS = 12
_SIDES_M = (1.0, 2.75)
_SETTLING_S = 4.0
_LONGEST_SETTLING_S = 10.0
_STILL_M_S = 0.06
_SYRUP_HZ = 0.7
_STEP_S = 1 / 480
_TRIES = 300
_STAGE_M = 11.0
"""Settled things lie this near to the middle, or the scene is made anew."""
_WORLD_M = 30.0
_FASTEST_M_S = 25.0
_DEEPEST_M = 0.04


class UnsoundSceneError(Exception):
    """A simulation that no clip should show: something flew off, sank in or never came to rest."""


def require_sound(tracks: Tracks, deepest_m: float, settled: Sequence[int]) -> None:
    """Raises UnsoundSceneError if something is not finite, below the floor, too fast, too deep in another, or away.

    deepest_m: how far solids overlapped at most. settled: which things lay still when the clip began.
    """
    if not all(np.isfinite(a).all() for a in (tracks.positions, tracks.quaternions, tracks.velocities)):
        raise UnsoundSceneError("a position or a speed is not a number")
    level = np.linalg.norm(tracks.positions[..., :2], axis=-1)
    for wrong, reason in (
        (tracks.positions[..., 2].min() < 0, "something is below the floor"),
        (np.linalg.norm(tracks.velocities, axis=-1).max() > _FASTEST_M_S, "something exploded"),
        (deepest_m > _DEEPEST_M, f"solids overlap by {deepest_m:.3f} m"),
        (level.max() > _WORLD_M, f"something left the stage, by {level.max():.1f} m"),
        (level[0, list(settled)].max(initial=0.0) > _STAGE_M, "something settled off the stage"),
    ):
        if wrong:
            raise UnsoundSceneError(reason)


def simulate(things: Sequence[Thing], random: np.random.Generator, *, frames: int) -> tuple[Tracks, float]:
    """Let the settled things come to rest, throw the others in, and watch.

    Returns: their motion over `frames` time steps, the first being the moment of throwing; and how far solids
        overlapped at most, metres.
    Raises: UnsoundSceneError if no free place was found or something never came to rest; RenderError without MuJoCo.
    """
    mujoco, model = load_mujoco(), _compiled(things)
    data = mujoco.MjData(model)
    # what MuJoCo works on: places and attitudes; speeds, spins
    q, v = data.qpos.reshape(-1, 7), data.qvel.reshape(-1, 6)
    for i, thing in enumerate(things):  # far outside, alone, where it disturbs nothing
        q[i] = (500.0 + 20.0 * i, 500.0, thing.size[2] / 2 + 0.01, *np.eye(4)[0])

    def put(i: int, low: Point, high: Point) -> Doubles:
        """Somewhere in a box, in any attitude, where it touches nothing; its place [3]."""
        for _ in range(_TRIES):
            quaternion, place = random.normal(size=4), random.uniform(low, high)
            q[i], v[i] = (*place, *(quaternion / np.linalg.norm(quaternion))), 0.0
            mujoco.mj_forward(model, data)
            if not (model.geom_bodyid[data.contact.geom] == i + 1).any():
                return place
        raise UnsoundSceneError(f"no free place for a {things[i].name} in {_TRIES} tries")

    def run(seconds: float) -> float:
        """Let time pass. Returns how deep solids overlapped at most."""
        deepest = 0.0
        for _ in range(round(seconds / _STEP_S)):
            mujoco.mj_step(model, data)
            deepest = min(deepest, data.contact.dist.min(initial=0.0))
        if any(warning.number for warning in data.warning):  # MuJoCo starts anew after such
            raise UnsoundSceneError("the simulation diverged")
        return -float(deepest)

    settled, thrown = ([i for i, thing in enumerate(things) if thing.dynamic == flies] for flies in (False, True))
    for i in settled:
        put(i, (-7.0, -7.0, 0.0), (7.0, 7.0, 7.0))
    mass, inertia = model.body_mass[1:, None], model.body_inertia[1:]
    # air as thick as syrup saves waiting for what rolls
    model.dof_damping[:] = _SYRUP_HZ * np.concatenate([mass, mass, mass, inertia], 1).ravel()
    waited = _SETTLING_S
    run(waited)
    while np.abs(v[settled]).max(initial=0.0) > _STILL_M_S:
        if waited >= _LONGEST_SETTLING_S:
            raise UnsoundSceneError(f"something still moves after {waited:.0f} s")
        run(0.5)
        waited += 0.5
    v[:], model.dof_damping[:] = 0.0, 0.0  # they lie still, exactly
    for i in thrown:
        x, y, _ = put(i, (-5.0, -5.0, 1.0), (5.0, 5.0, 6.0))
        # Kubric's throw: anywhere, and towards the middle; the spin is about its own axes
        v[i] = (*(random.uniform((-4, -4, 0), (4, 4, 0)) - (x, y, 0.0)), *random.uniform(-2.5, 2.5, 3))
    return _watched(q, v, run, frames)


def _watched(q: Doubles, v: Doubles, run: Callable[[float], float], frames: int) -> tuple[Tracks, float]:
    """The motion from now on, and how deep solids overlapped at most."""
    deepest, places, rates = 0.0, [q.copy()], [v.copy()]
    for _ in range(1, frames):
        deepest = max(deepest, run(1 / FPS))
        places.append(q.copy())
        rates.append(v.copy())
    q, v = np.stack(places), np.stack(rates)  # [T, N, 7], [T, N, 6]
    spin = rotations(q[..., 3:]) @ v[..., 3:, None]  # MuJoCo's are in the body's frame
    tracks = Tracks(
        positions=q[..., :3], quaternions=q[..., 3:], velocities=v[..., :3], angular_velocities=spin[..., 0]
    )
    return tracks, deepest


def load_mujoco() -> Any:
    """The library, an optional dependency: only generating needs it. Raises RenderError if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise RenderError("this world needs the extra `scenes`: pip install 'gcd-node[scenes]'") from error
    return mujoco


def _compiled(things: Sequence[Thing]) -> Any:
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = _STEP_S
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **_surface(0.7, 0.3, 1.0))
    for thing in things:
        body = spec.worldbody.add_body()
        body.add_freejoint()
        volumes = np.array([math.prod(part.size) for part in thing.parts])
        side = max(thing.size)
        for part, share in zip(thing.parts, volumes / volumes.sum(), strict=True):
            body.add_geom(
                **_geometry(mujoco, spec, part),
                pos=part.centre,
                quat=yawed(np.array(part.turn), part.yaw),
                mass=thing.mass_kg * share,
                **_surface(thing.friction, thing.restitution, side),
            )
    return spec.compile()


def _surface(friction: float, restitution: float, side_m: float) -> dict[str, Any]:
    """How a geom touches: sliding, twisting and rolling friction, and a spring that gives back that much speed."""
    damping = -math.log(max(restitution, 1e-3))
    damping /= math.hypot(math.pi, damping)  # of a spring and damper that bounces so
    return {
        "condim": 6,
        "friction": [friction, 0.03 * side_m, 0.03 * side_m],
        "solref": [0.012, max(damping, 0.2)],
        "solimp": [0.95, 0.99, 0.005, 0.5, 2.0],
    }


def _geometry(mujoco: Any, spec: Any, part: Part) -> dict[str, Any]:
    """A part as MuJoCo's own solid where it has one, else as the hull of its corners."""
    kind, (x, y, z) = mujoco.mjtGeom, part.size
    is_round = math.isclose(x, y, rel_tol=1e-6)
    if part.shape == "box":
        return {"type": kind.mjGEOM_BOX, "size": [x / 2, y / 2, z / 2]}
    if part.shape == "sphere":
        return {"type": kind.mjGEOM_ELLIPSOID, "size": [x / 2, y / 2, z / 2]}
    if part.shape == "cylinder" and is_round:
        return {"type": kind.mjGEOM_CYLINDER, "size": [x / 2, z / 2, 0]}
    if part.shape == "capsule" and is_round and math.isclose(z, x, rel_tol=1e-6):  # the unit capsule is half as wide
        return {"type": kind.mjGEOM_CAPSULE, "size": [x / 4, z / 4, 0]}
    corners = np.unique(np.round(shape(part.shape)[0].reshape(-1, 3).astype(np.float64), 6), axis=0)
    mesh = spec.add_mesh(name=f"hull{len(spec.meshes)}")
    mesh.uservert = (corners * part.size).ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    return {"type": kind.mjGEOM_MESH, "meshname": mesh.name}


def drop_scene(seed: int, frames: int = 60) -> Scene:
    """A scene that depends on nothing but its arguments.

    Args:
        seed: 0 or more.
        frames: time steps at 24 Hz.
    Raises: RenderError if MuJoCo is not installed, or no attempt at this seed gave a sound simulation.
    """
    reasons: list[str] = []
    for attempt in range(_ATTEMPTS):
        random = np.random.default_rng([seed, 0xD209, attempt])
        things = _random_things(random)
        settled = [i for i, thing in enumerate(things) if not thing.dynamic]
        try:
            tracks, deepest_m = simulate(things, random, frames=frames)
            require_sound(tracks, deepest_m, settled)
            # nothing may come so near to a camera that it could stand inside or fill the view
            eyes = np.stack([poses[0, :3, 3] for poses in orbit_cameras(1).values()])
            reach = np.array([np.linalg.norm(thing.size) / 2 for thing in things]) + ORBIT.near_m
            away = np.linalg.norm(tracks.positions[:, :, None] - eyes, axis=-1).min((0, 2))  # [N]
            if (away < reach).any():
                raise UnsoundSceneError(f"a {things[int((away - reach).argmin())].name} reaches a camera")
        except UnsoundSceneError as error:
            reasons.append(str(error))
            continue
        random = np.random.default_rng([seed, 0x100C])
        surroundings, dome, floor = random_surroundings(random)
        counts = {"settled": len(settled), "thrown": len(things) - len(settled)}
        return Scene(
            parts=(dome, *(part.of(instance=i, body=i) for i, thing in enumerate(things, 1) for part in thing.parts)),
            sheets=(floor,),
            poses=with_world(rotations(tracks.quaternions), tracks.positions),
            focus=np.zeros((frames, 3), np.float32),
            cameras=orbit_cameras(frames),
            hfov_deg=HFOV_DEG,
            light=random_light(random),
            facts={"seed": seed, "attempts": attempt + 1, "surroundings": surroundings, **counts},
            objects=tuple(
                SceneObject.of(thing, tracks, i, instance=i + 1, body=i + 1, label=DropLabel.OBJECT)
                for i, thing in enumerate(things)
            ),
            extent=ORBIT,
        )
    raise RenderError(f"drop scene {seed}: no sound simulation in {_ATTEMPTS} attempts ({'; '.join(reasons)}); skip it")


def orbit_cameras(frames: int) -> dict[str, Doubles]:
    """Kubric-4D's cameras, "view0" to "view15", which stand still: world_from_camera [T, 4, 4]."""
    ring = [(90.0 * k, 45.0, _RADIUS_M) for k in range(4)] + [(15.0 + 30.0 * k, 5.0, _RADIUS_M) for k in range(12)]
    poses = sphere_poses(torch.tensor(ring, dtype=torch.float64)).numpy()
    return {f"view{i}": np.tile(pose, (frames, 1, 1)) for i, pose in enumerate(poses)}


def _random_things(random: np.random.Generator) -> list[Thing]:
    """6 to 16 that settle, then 1 to 6 that are thrown."""
    settled, thrown = int(random.integers(6, 17)), int(random.integers(1, 7))
    sides = random.uniform(*_SIDES_M, size=settled + thrown)
    return [random_thing(random, side_m=float(side), dynamic=i >= settled) for i, side in enumerate(sides)]


DOME_M = 40.0
"""Radius of the dome. The farthest that a camera at 18 m sees is 58 m, below the 64 m at which splats are weighted
differently."""
_FLOORS = {
    "planks": Paint((0.66, 0.47, 0.3), (0.42, 0.28, 0.17), Pattern.PLANKS, 0.55, 0.12),
    "pale planks": Paint((0.8, 0.7, 0.56), (0.62, 0.5, 0.37), Pattern.PLANKS, 0.7, 0.1),
    "terrazzo": Paint((0.72, 0.7, 0.66), (0.5, 0.3, 0.22), Pattern.TERRAZZO, 0.5, 0.15),
    "checker": Paint((0.82, 0.8, 0.76), (0.3, 0.33, 0.36), Pattern.CHECKER, 1.6, 0.12),
    "marble": Paint((0.83, 0.81, 0.78), (0.62, 0.6, 0.58), Pattern.MARBLE, 2.4, 0.15),
    "grass": Paint((0.4, 0.5, 0.2), (0.2, 0.3, 0.1), Pattern.CLOUDY, 0.25),
    "sand": Paint((0.8, 0.68, 0.5), (0.66, 0.53, 0.36), Pattern.CLOUDY, 0.5),
    "concrete": Paint((0.58, 0.57, 0.55), (0.46, 0.45, 0.44), Pattern.CLOUDY, 1.2),
    "asphalt": Paint((0.3, 0.3, 0.32), (0.22, 0.22, 0.23), Pattern.CLOUDY, 0.25),
    "carpet": Paint((0.52, 0.2, 0.2), (0.62, 0.48, 0.34), Pattern.STRIPES, 2.4),
    "dotted rug": Paint((0.28, 0.36, 0.5), (0.7, 0.68, 0.6), Pattern.DOTS, 1.4),
}
_BACKDROPS: dict[str, tuple[float, Pattern, tuple[str, ...]]] = {
    "hills": (0.3, Pattern.HILLS, ("grass", "sand", "concrete", "asphalt", "pale planks")),
    "houses": (0.25, Pattern.HOUSES, ("concrete", "asphalt", "checker", "grass", "terrazzo")),
    "hall": (0.25, Pattern.HALL, ("planks", "pale planks", "checker", "terrazzo", "marble", "carpet", "dotted rug")),
    "studio": (0.2, Pattern.STUDIO, ("planks", "marble", "carpet", "dotted rug", "concrete", "checker", "sand")),
}
"""What stands around: how often, how it is painted, and the floors that suit it."""
_WALLS: tuple[tuple[Colour, Colour], ...] = (
    ((0.82, 0.78, 0.7), (0.5, 0.36, 0.24)),
    ((0.62, 0.7, 0.74), (0.36, 0.42, 0.47)),
    ((0.78, 0.62, 0.5), (0.44, 0.24, 0.18)),
    ((0.6, 0.68, 0.56), (0.3, 0.36, 0.26)),
    ((0.8, 0.8, 0.82), (0.42, 0.42, 0.48)),
)
_HILLS: tuple[Colour, Colour] = ((0.42, 0.5, 0.5), (0.2, 0.3, 0.14))


def random_surroundings(random: np.random.Generator) -> tuple[str, Part, Sheet]:
    """What they are called, the dome and the floor.

    The dome has a real distance, so that every pixel of a view is a point of the world and a point cloud has no holes
    at the top; what is painted on it is seen alike from everywhere. Its inside faces the cameras, hence the negative
    side.
    """
    backdrop = pick_by_share(random, [(name, share) for name, (share, _, _) in _BACKDROPS.items()])
    _, pattern, floors = _BACKDROPS[backdrop]
    name = pick(random, floors)
    colour, accent = _HILLS if backdrop == "hills" else pick(random, _WALLS)
    side, bright, floor = 2 * DOME_M, random.uniform(0.85, 1.12), _FLOORS[name]
    dome = Part("sphere", (0, 0, 0), (-side, side, side), Paint(colour, accent, pattern), DropLabel.BACKGROUND)
    lit = replace(floor, colour=shaded(floor.colour, bright), accent=shaded(floor.accent, bright))
    return f"{name}, {backdrop}", dome, Sheet(square(DOME_M + 1.0, 0.0), lit, DropLabel.BACKGROUND)


def random_light(random: np.random.Generator) -> Light:
    """A sun at some height, warmer when low, or a bright overcast sky."""
    overcast = random.random() < 0.2
    height, round_ = random.uniform(math.radians(28), math.radians(72)), random.uniform(0, 2 * math.pi)
    warm = random.uniform(0, 1) * (1.1 - math.sin(height))
    strength = 0.55 if overcast else random.uniform(1.3, 1.9)
    fill = 0.85 if overcast else random.uniform(0.45, 0.62)
    blue = 0.15 if overcast else random.uniform(0.4, 1.0)
    return Light(
        sun_to=towards(height, round_),
        sun=(strength, strength * (1 - 0.3 * warm), strength * (0.95 - 0.6 * warm)),
        sky=(fill * (1 - 0.12 * blue), fill, fill * (1 + 0.12 * blue)),
        ground=(0.5 * fill, 0.46 * fill, 0.42 * fill),
        horizon=(0.74 + 0.12 * warm, 0.77, 0.8 - 0.1 * warm),
        zenith=(0.62 - 0.42 * blue, 0.68 - 0.32 * blue, 0.8 - 0.02 * blue),
        fog_m=random.uniform(70, 160),
        cloud=random.uniform(0.2, 0.9),
        exposure=random.uniform(1.35, 1.75),
    )
