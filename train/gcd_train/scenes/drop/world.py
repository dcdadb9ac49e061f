"""The drop world: one seed, one clip, as Kubric-4D makes its scenes, with things and pictures of our own.

Source: Van Hoorick et al. 2024 (GCD), Kubric-4D: 6 to 16 things that have settled and 1 to 6 that are thrown, 60 frames
at 24 per second, sixteen cameras that stand still at 15 m from the point (0, 0, 1): four at an elevation of 45 degrees,
twelve at 5.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model.geometry import sphere_poses
from gcd_train.errors import DataError, RenderError
from gcd_train.scenes.description import ORBIT, Floats, Part, Scene, SceneObject, rotations
from gcd_train.scenes.drop.looks import DropLabel, random_light, random_surroundings
from gcd_train.scenes.drop.things import Thing, random_thing, turned
from gcd_train.scenes.primitives import shape

Doubles = NDArray[np.float64]
SETTLING_S = 4.0
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


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracks:
    """The motion of N things in T time steps.

    positions, velocities, angular_velocities: [T, N, 3] in the world; metres, metres a second, radians a second.
    quaternions: [T, N, 4], w, x, y, z, world_from_thing. deepest_m: how far solids overlapped at most.
    """

    positions: Doubles
    quaternions: Doubles
    velocities: Doubles
    angular_velocities: Doubles
    deepest_m: float

    def require_sound(self, settled: Sequence[int]) -> None:
        """Raises UnsoundSceneError if something is not finite, below the floor, too fast, too deep in another, or away.

        settled: which things lay still when the clip began.
        """
        if not all(np.isfinite(a).all() for a in (self.positions, self.quaternions, self.velocities)):
            raise UnsoundSceneError("a position or a speed is not a number")
        level = np.linalg.norm(self.positions[..., :2], axis=-1)
        for wrong, reason in (
            (self.positions[..., 2].min() < 0, "something is below the floor"),
            (np.linalg.norm(self.velocities, axis=-1).max() > _FASTEST_M_S, "something exploded"),
            (self.deepest_m > _DEEPEST_M, f"solids overlap by {self.deepest_m:.3f} m"),
            (level.max() > _WORLD_M, f"something left the stage, by {level.max():.1f} m"),
            (level[0, list(settled)].max(initial=0.0) > _STAGE_M, "something settled off the stage"),
        ):
            if wrong:
                raise UnsoundSceneError(reason)


def simulate(things: Sequence[Thing], random: np.random.Generator, *, frames: int, fps: float) -> Tracks:
    """Let the settled things come to rest, throw the others in, and watch.

    Returns: where they are at `frames` time steps; the first is the moment of throwing.
    Raises: UnsoundSceneError if no free place was found or something never came to rest; RenderError without MuJoCo.
    """
    stage = _Stage(things)
    settled = [i for i, thing in enumerate(things) if not thing.dynamic]
    for i in range(len(things)):
        stage.park(i)
    for i in settled:
        stage.put(i, random, (-7.0, -7.0, 0.0), (7.0, 7.0, 7.0))
    stage.settle(settled)
    for i, thing in enumerate(things):
        if thing.dynamic:
            place = stage.put(i, random, (-5.0, -5.0, 1.0), (5.0, 5.0, 6.0))
            pull = np.array([place[0], place[1], 0.0])  # Kubric's throw: anywhere, and towards the middle
            stage.throw(i, random.uniform((-4, -4, 0), (4, 4, 0)) - pull, random.uniform(-2.5, 2.5, 3))
    return stage.watch(frames, fps)


class _Stage:
    """A floor and things on it; the only owner of MuJoCo's state."""

    def __init__(self, things: Sequence[Thing]) -> None:
        self._mujoco = _mujoco()
        self._things = things
        self._model: Any = _compiled(self._mujoco, things)
        self._data: Any = self._mujoco.MjData(self._model)

    def park(self, i: int) -> None:
        """Far outside, alone, where it disturbs nobody."""
        self._place(i, np.array([500.0 + 20.0 * i, 500.0, self._things[i].size[2] / 2 + 0.01]), np.eye(4)[0])

    def put(self, i: int, random: np.random.Generator, low: Sequence[float], high: Sequence[float]) -> Doubles:
        """Somewhere in a box, in any attitude, where it touches nothing; its place [3]."""
        for _ in range(_TRIES):
            quaternion = random.normal(size=4)
            place = random.uniform(low, high)
            self._place(i, place, quaternion / np.linalg.norm(quaternion))
            self._mujoco.mj_forward(self._model, self._data)
            if not self._touches(i):
                return place
        raise UnsoundSceneError(f"no free place for a {self._things[i].name} in {_TRIES} tries")

    def settle(self, which: Sequence[int]) -> None:
        """Until all of them lie still, which is then made exact. Air as thick as syrup saves waiting for what rolls."""
        mass, inertia = self._model.body_mass[1:, None], self._model.body_inertia[1:]
        self._model.dof_damping[:] = _SYRUP_HZ * np.concatenate([mass, mass, mass, inertia], 1).ravel()
        self._run(SETTLING_S)
        rows = [6 * i + k for i in which for k in range(6)]
        waited = SETTLING_S
        while np.abs(self._data.qvel[rows]).max(initial=0.0) > _STILL_M_S:
            if waited >= _LONGEST_SETTLING_S:
                raise UnsoundSceneError(f"something still moves after {waited:.0f} s")
            self._run(0.5)
            waited += 0.5
        self._data.qvel[:] = 0.0
        self._model.dof_damping[:] = 0.0

    def throw(self, i: int, velocity: Doubles, spin: Doubles) -> None:
        """Give it a velocity, metres a second, and a spin about its own axes, radians a second."""
        self._data.qvel[6 * i : 6 * i + 6] = np.concatenate([velocity, spin])

    def watch(self, frames: int, fps: float) -> Tracks:
        """Its states at the frames' times, beginning now."""
        states, deepest = [self._state()], 0.0
        for _ in range(frames - 1):
            deepest = max(deepest, self._run(1 / fps))
            states.append(self._state())
        q, v = (np.stack(rows) for rows in zip(*states, strict=True))  # [T, N, 7], [T, N, 6]
        return Tracks(
            positions=q[..., :3],
            quaternions=q[..., 3:],
            velocities=v[..., :3],
            angular_velocities=(rotations(q[..., 3:]) @ v[..., 3:, None])[..., 0],  # MuJoCo's are in the body's frame
            deepest_m=deepest,
        )

    def _run(self, seconds: float) -> float:
        """Let time pass. Returns how deep solids overlapped at most. Raises UnsoundSceneError if it diverged."""
        deepest = 0.0
        for _ in range(round(seconds / _STEP_S)):
            self._mujoco.mj_step(self._model, self._data)
            deepest = min(deepest, self._data.contact.dist.min(initial=0.0))
        if any(warning.number for warning in self._data.warning):  # MuJoCo starts anew after such
            raise UnsoundSceneError("the simulation diverged")
        return -float(deepest)

    def _place(self, i: int, place: Doubles, quaternion: Doubles) -> None:
        self._data.qpos[7 * i : 7 * i + 7] = np.concatenate([place, quaternion])
        self._data.qvel[6 * i : 6 * i + 6] = 0.0

    def _touches(self, i: int) -> bool:
        contact = self._data.contact
        return bool((self._model.geom_bodyid[contact.geom] == i + 1).any())

    def _state(self) -> tuple[Doubles, Doubles]:
        return self._data.qpos.reshape(-1, 7).copy(), self._data.qvel.reshape(-1, 6).copy()


def _mujoco() -> Any:
    try:
        import mujoco  # an optional dependency: only generating needs it
    except ImportError as error:
        raise RenderError("falling things need the extra `scenes`: pip install 'gcd-node[scenes]'") from error
    return mujoco


def _compiled(mujoco: Any, things: Sequence[Thing]) -> Any:
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
                quat=turned(part),
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


FPS = 24.0
HFOV_DEG = math.degrees(2 * math.atan(0.5))
RADIUS_M = 15.0
_ATTEMPTS = 12
_SIDES_M = (1.0, 2.75)


def drop_scene(seed: int, *, frames: int = 60) -> Scene:
    """A scene that depends on nothing but its arguments.

    Args:
        seed: 0 or more.
        frames: time steps at 24 Hz.
    Raises:
        DataError: no frame is asked for.
        RenderError: MuJoCo is not installed, or no attempt at this seed gave a sound simulation.
    """
    if frames < 1:
        raise DataError(f"a clip has at least one frame, got {frames}; ask for 1 or more")
    reasons: list[str] = []
    for attempt in range(_ATTEMPTS):
        random = np.random.default_rng([seed, 0xD209, attempt])
        things = _random_things(random)
        settled = [i for i, thing in enumerate(things) if not thing.dynamic]
        try:
            tracks = simulate(things, random, frames=frames, fps=FPS)
            tracks.require_sound(settled)
            _require_free_cameras(things, tracks)
        except UnsoundSceneError as error:
            reasons.append(str(error))
            continue
        return _scene(things, tracks, np.random.default_rng([seed, 0x100C]), {"seed": seed, "attempts": attempt + 1})
    raise RenderError(f"drop scene {seed}: no sound simulation in {_ATTEMPTS} attempts ({'; '.join(reasons)}); skip it")


def orbit_cameras(frames: int) -> dict[str, NDArray[np.float64]]:
    """Kubric-4D's cameras, "view0" to "view15", which stand still: world_from_camera [T, 4, 4]."""
    ring = [(90.0 * k, 45.0, RADIUS_M) for k in range(4)] + [(15.0 + 30.0 * k, 5.0, RADIUS_M) for k in range(12)]
    poses = sphere_poses(torch.tensor(ring, dtype=torch.float64)).numpy()
    return {f"view{i}": np.tile(pose, (frames, 1, 1)) for i, pose in enumerate(poses)}


def _random_things(random: np.random.Generator) -> list[Thing]:
    """6 to 16 that settle, then 1 to 6 that are thrown."""
    settled, thrown = int(random.integers(6, 17)), int(random.integers(1, 7))
    sides = random.uniform(*_SIDES_M, size=settled + thrown)
    return [random_thing(random, side_m=float(side), dynamic=i >= settled) for i, side in enumerate(sides)]


def _require_free_cameras(things: list[Thing], tracks: Tracks) -> None:
    """Raises UnsoundSceneError if something comes so near to a camera that it could stand inside or fill the view."""
    cameras = np.stack([poses[0, :3, 3] for poses in orbit_cameras(1).values()])
    reach = np.array([np.linalg.norm(thing.size) / 2 for thing in things]) + ORBIT.near_m
    away = np.linalg.norm(tracks.positions[:, :, None] - cameras, axis=-1).min((0, 2))  # [N]
    if (away < reach).any():
        raise UnsoundSceneError(f"a {things[int((away - reach).argmin())].name} reaches a camera")


def _scene(things: list[Thing], tracks: Tracks, random: np.random.Generator, facts: dict[str, float | str]) -> Scene:
    frames = len(tracks.positions)
    surroundings, dome, floor = random_surroundings(random)
    thrown = sum(thing.dynamic for thing in things)
    return Scene(
        parts=(dome, *_parts(things)),
        sheets=(floor,),
        poses=_poses(tracks),
        focus=np.zeros((frames, 3), np.float32),
        cameras=orbit_cameras(frames),
        hfov_deg=HFOV_DEG,
        light=random_light(random),
        facts={**facts, "surroundings": surroundings, "settled": len(things) - thrown, "thrown": thrown},
        objects=tuple(_object(thing, i, tracks) for i, thing in enumerate(things)),
        extent=ORBIT,
    )


def _parts(things: list[Thing]) -> list[Part]:
    """Thing i is instance and body i + 1."""
    return [part.of(instance=i + 1, body=i + 1) for i, thing in enumerate(things) for part in thing.parts]


def _poses(tracks: Tracks) -> Floats:
    """World_from_body [T, 1 + N, 3, 4]; body 0 is the world itself."""
    moving = np.concatenate([rotations(tracks.quaternions), tracks.positions[..., None]], -1)
    still = np.broadcast_to(np.eye(4)[:3], (len(moving), 1, 3, 4))
    return np.concatenate([still, moving], 1).astype(np.float32)


def _object(thing: Thing, i: int, tracks: Tracks) -> SceneObject:
    return SceneObject(
        name=thing.name,
        instance=i + 1,
        body=i + 1,
        label=DropLabel.OBJECT,
        size=thing.size,
        dynamic=thing.dynamic,
        mass_kg=thing.mass_kg,
        friction=thing.friction,
        restitution=thing.restitution,
        positions=tracks.positions[:, i],
        quaternions=tracks.quaternions[:, i],
        velocities=tracks.velocities[:, i],
        angular_velocities=tracks.angular_velocities[:, i],
    )
