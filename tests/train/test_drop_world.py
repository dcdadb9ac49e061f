"""The drop world: what physics owes, what Kubric-4D prescribes, and what the cameras see of it."""

import math
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from headless import drawn, needs_egl

from gcd_model.geometry import Intrinsics
from gcd_train.errors import RenderError
from gcd_train.scenes.description import Part, Scene, Tracks, rotations
from gcd_train.scenes.drop import world
from gcd_train.scenes.drop.things import KINDS, DropLabel, bounds, outline, random_paint, random_thing
from gcd_train.scenes.drop.world import (
    DOME_M,
    FPS,
    HFOV_DEG,
    UnsoundSceneError,
    drop_scene,
    orbit_cameras,
    require_sound,
)
from gcd_train.scenes.triangles import CONVEX

FRAMES = 18
SEEDS = (2, 7)


@pytest.fixture(scope="module", params=SEEDS)
def scene(request: pytest.FixtureRequest) -> Scene:
    pytest.importorskip("mujoco", reason="falling things need the extra scenes")
    return drop_scene(request.param, frames=FRAMES)


def placed(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points [N, 3] of a body in the world."""
    return points @ pose[:, :3].T + pose[:, 3]


def things(scene: Scene) -> dict[int, list[Part]]:
    """The parts of each body but the world."""
    return {o.body: [part for part in scene.parts if part.body == o.body] for o in scene.objects}


def depth_inside(points: np.ndarray, part: Part, pose: np.ndarray) -> float:
    """How deep the deepest of the points is within a convex part, metres; 0 if none is inside."""
    corners = placed(outline(part), pose).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    outside = points @ normals.T - (normals * corners[:, 0]).sum(-1)  # [N, faces]
    return float(max(-outside.max(1).min(), 0.0))


def test_the_same_seed_gives_the_same_scene_and_more_frames_only_continue_it(scene: Scene) -> None:
    again = drop_scene(int(scene.facts["seed"]), frames=FRAMES + 3)
    assert again.parts == scene.parts
    assert again.light == scene.light
    np.testing.assert_array_equal(again.poses[:FRAMES], scene.poses)
    assert again.frames == FRAMES + 3


def test_nothing_is_below_the_floor(scene: Scene) -> None:
    for body, parts in things(scene).items():
        corners = np.concatenate([outline(part) for part in parts])
        lowest = min(float(placed(corners, pose)[:, 2].min()) for pose in scene.poses[:, body])
        assert lowest > -0.04, scene.objects[body - 1].name


def test_solids_do_not_reach_into_each_other(scene: Scene) -> None:
    convex = {body: [p for p in parts if p.shape in CONVEX] for body, parts in things(scene).items()}
    compared = 0
    for step in range(0, FRAMES, 4):
        poses = scene.poses[step]
        for a, own in convex.items():
            for b, parts in convex.items():
                apart = np.linalg.norm(poses[a][:, 3] - poses[b][:, 3])
                reach = sum(np.linalg.norm(scene.objects[body - 1].size) / 2 for body in (a, b))
                if a == b or not own or not parts or apart > reach:
                    continue
                points = placed(np.concatenate([outline(part) for part in own]), poses[a])
                compared += 1
                deepest = max(depth_inside(points, part, poses[b]) for part in parts)
                assert deepest < 0.05, (scene.objects[a - 1].name, scene.objects[b - 1].name, step)
    assert compared > 3


def test_what_settled_lies_still_when_the_clip_begins(scene: Scene) -> None:
    settled = [o for o in scene.objects if not o.dynamic]
    assert 6 <= len(settled) <= 16
    for thing in settled:
        assert not thing.velocities[0].any()
        assert not thing.angular_velocities[0].any()
        assert np.linalg.norm(thing.positions[1] - thing.positions[0]) < 0.02
        assert np.abs(thing.positions[0, :2]).max() < 11


def test_what_is_thrown_starts_in_the_air_and_falls_as_bodies_fall(scene: Scene) -> None:
    thrown = [o for o in scene.objects if o.dynamic]
    assert 1 <= len(thrown) <= 6
    for thing in thrown:
        assert np.abs(thing.positions[0, :2]).max() <= 5
        assert 1 <= thing.positions[0, 2] <= 6
        assert np.linalg.norm(thing.positions[9] - thing.positions[0]) > 0.1
    dt = 1 / FPS
    drops = [t.positions[1] - t.positions[0] - dt * t.velocities[0] for t in thrown]
    assert min(np.linalg.norm(d - [0, 0, -9.81 * dt**2 / 2]) for d in drops) < 0.002  # one at least hits nothing yet


def test_the_velocities_are_those_of_the_motion(scene: Scene) -> None:
    """Also a check of frames and signs: the turn from frame to frame is about the world's axes."""
    dt, checked = 1 / FPS, 0
    for thing in scene.objects:
        if not thing.dynamic:
            continue
        mean_speed = (thing.velocities[0] + thing.velocities[1]) / 2
        if np.linalg.norm(thing.positions[1] - thing.positions[0] - dt * mean_speed) > 0.002:
            continue  # it hit something in between
        turn = rotations(thing.quaternions[1]) @ rotations(thing.quaternions[0]).T
        expected, _ = cv2.Rodrigues(dt * (thing.angular_velocities[0] + thing.angular_velocities[1]) / 2)
        np.testing.assert_allclose(turn, expected, atol=0.004)
        checked += 1
    assert checked > 0


def test_objects_poses_and_parts_tell_the_same(scene: Scene) -> None:
    assert [o.instance for o in scene.objects] == list(range(1, len(scene.objects) + 1))
    assert {part.instance for part in scene.parts} == {0, *(o.instance for o in scene.objects)}
    for thing in scene.objects:
        assert {p.instance for p in scene.parts if p.body == thing.body} == {thing.instance}
        np.testing.assert_allclose(scene.poses[:, thing.body, :, :3], rotations(thing.quaternions), atol=1e-5)
        np.testing.assert_allclose(scene.poses[:, thing.body, :, 3], thing.positions, atol=1e-5)
        low, high = bounds([p for p in scene.parts if p.body == thing.body])
        np.testing.assert_allclose(high - low, thing.size, atol=1e-4)
        np.testing.assert_allclose(high + low, 0, atol=1e-4)


def test_cameras_stand_where_kubric_4d_has_them() -> None:
    cameras = orbit_cameras(3)
    assert list(cameras) == [f"view{i}" for i in range(16)]
    right, down, ahead, position = cameras["view4"][0][:3].T  # azimuth 15, elevation 5 degrees, radius 15 m
    np.testing.assert_allclose(position, (14.433753, 3.867512, 2.307336), atol=1e-6)
    np.testing.assert_allclose(right, (-0.258819, 0.965926, 0), atol=1e-6)
    np.testing.assert_allclose(down, (0.084186, 0.022558, -0.996195), atol=1e-6)
    np.testing.assert_allclose(ahead, (-0.96225, -0.257834, -0.087156), atol=1e-6)
    for i, poses in enumerate(cameras.values()):
        x, y, z = poses[0, :3, 3] - (0, 0, 1)
        assert (poses == poses[0]).all()
        azimuth, elevation = (90 * i, 45) if i < 4 else (15 + 30 * (i - 4), 5)
        assert math.degrees(math.atan2(y, x)) % 360 == pytest.approx(azimuth, abs=1e-6)
        assert math.degrees(math.asin(z / 15)) == pytest.approx(elevation, abs=1e-6)
        np.testing.assert_allclose(poses[0, :3, 2], -np.array([x, y, z]) / 15, atol=1e-9)
    assert math.tan(math.radians(HFOV_DEG / 2)) == pytest.approx(0.5)


def test_numbers_and_sizes_are_those_of_kubric_4d() -> None:
    drawn = [world._random_things(np.random.default_rng(seed)) for seed in range(28)]
    assert drawn[0] != drawn[1]
    thrown = [sum(thing.dynamic for thing in scene) for scene in drawn]
    settled = [len(scene) - n for scene, n in zip(drawn, thrown, strict=True)]
    assert (min(settled), max(settled)) == (6, 16)
    assert (min(thrown), max(thrown)) == (1, 6)
    sides = np.array([max(thing.size) for scene in drawn for thing in scene])
    assert sides.min() >= 1 - 1e-5
    assert sides.max() <= 2.75 + 1e-5
    assert sides.mean() == pytest.approx(1.875, abs=0.1)


def test_mass_grows_with_the_square_of_the_size() -> None:
    small, large = (random_thing(np.random.default_rng(5), side_m=side, dynamic=False) for side in (1.0, 2.0))
    assert large.mass_kg == pytest.approx(4 * small.mass_kg)
    many = [random_thing(np.random.default_rng(i), side_m=1.0, dynamic=False) for i in range(40)]
    assert len({thing.name for thing in many}) > 12
    assert max(t.mass_kg for t in many) > 3 * min(t.mass_kg for t in many)  # densities differ
    assert all(0 < t.friction < 1 and 0 < t.restitution < 1 for t in many)


@pytest.mark.parametrize("name", KINDS)
def test_things_are_one_piece(name: str) -> None:
    """No part floats apart: boxes around parts touch each other from the first to the last."""
    random = np.random.default_rng(3)
    made = KINDS[name](random, *(random_paint(random, 1.0) for _ in range(2)))
    assert {part.label for part in made} == {DropLabel.OBJECT}
    boxes = [(c.min(0) - 1e-3, c.max(0) + 1e-3) for c in map(outline, made)]
    joined, rest = {0}, set(range(1, len(boxes)))
    while rest:
        near = {i for i in rest for j in joined if _touch(boxes[i], boxes[j])}
        assert near, f"parts {rest} of a {name} float"
        joined, rest = joined | near, rest - near


def _touch(a: tuple, b: tuple) -> bool:
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())


def tracks(**changes: np.ndarray) -> Tracks:
    still = {"positions": np.full((3, 2, 3), 0.5), "velocities": np.zeros((3, 2, 3))}
    turns = {"quaternions": np.tile(np.eye(4)[0], (3, 2, 1)), "angular_velocities": np.zeros((3, 2, 3))}
    return Tracks(**{**still, **turns, **changes})


def moved(to: float, axis: int, step: int = 2) -> np.ndarray:
    positions = np.full((3, 2, 3), 0.5)
    positions[step, 1, axis] = to
    return positions


@pytest.mark.parametrize(
    ("fault", "deepest_m", "reason"),
    [
        ({"positions": moved(np.nan, 0)}, 0.01, "not a number"),
        ({"positions": moved(-0.2, 2)}, 0.01, "below the floor"),
        ({"positions": moved(31.0, 0)}, 0.01, "left the stage"),
        ({"positions": moved(12.0, 1, step=0)}, 0.01, "settled off the stage"),
        ({"velocities": moved(900.0, 1)}, 0.01, "exploded"),
        ({}, 0.3, "overlap by 0.300 m"),
    ],
)
def test_an_unsound_simulation_is_noticed(fault: dict, deepest_m: float, reason: str) -> None:
    require_sound(tracks(), 0.01, [0, 1])
    with pytest.raises(UnsoundSceneError, match=reason):
        require_sound(tracks(**fault), deepest_m, [0, 1])


def motion(places: np.ndarray) -> tuple[Tracks, float]:
    turns = np.tile(np.eye(4)[0], (*places.shape[:2], 1))
    return tracks(positions=places, quaternions=turns, velocities=0 * places, angular_velocities=0 * places), 0.0


def test_an_unsound_attempt_is_followed_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def first_explodes(things: list, *_: object, frames: int) -> tuple[Tracks, float]:
        calls.append(len(things))
        if len(calls) == 1:
            raise UnsoundSceneError("something exploded")
        return motion(np.ones((frames, len(things), 3)))

    monkeypatch.setattr(world, "simulate", first_explodes)
    made = drop_scene(7, frames=2)
    assert len(calls) == made.facts["attempts"] == 2
    assert (len(made.objects), made.frames) == (calls[1], 2)


@pytest.mark.parametrize("reason", ["reaches a camera", "something exploded"])
def test_a_seed_without_any_sound_attempt_says_why(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsound(things: list, *_: object, frames: int) -> tuple[Tracks, float]:
        if "exploded" in reason:
            raise UnsoundSceneError(reason)
        places = np.ones((frames, len(things), 3))
        places[1, -1] = orbit_cameras(1)["view9"][0, :3, 3] + 0.3
        return motion(places)

    monkeypatch.setattr(world, "simulate", unsound)
    with pytest.raises(RenderError, match=rf"drop scene 7: no sound simulation.*{reason}.*skip it"):
        drop_scene(7, frames=2)


def test_without_mujoco_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(RenderError, match=r"gcd-node\[scenes\]"):
        drop_scene(0)


@needs_egl
def test_every_pixel_is_a_thing_the_floor_or_the_dome_at_its_true_depth(scene: Scene) -> None:
    lens = Intrinsics.from_hfov(HFOV_DEG, 72, 48)
    columns, rows = np.meshgrid(np.arange(72) + 0.5, np.arange(48) + 0.5)
    rays = np.stack([(columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy, np.ones((48, 72))], -1)
    one = replace(scene, poses=scene.poses[:1], focus=scene.focus[:1])
    seen: set[int] = set()
    for name, view in drawn(one, 72, 48).items():
        pose = scene.cameras[name][0]
        points = (view.depth[..., None] * rays) @ pose[:3, :3].T + pose[:3, 3]
        assert (view.depth > 0).all()
        assert view.depth.max() < 64
        on_floor = np.abs(points[..., 2]) < 0.02
        on_dome = np.abs(np.linalg.norm(points, axis=-1) - DOME_M) < 0.4
        background = view.instances == 0
        np.testing.assert_array_equal(view.classes == DropLabel.BACKGROUND, background)
        assert (on_floor | on_dome)[background].all()
        for instance in set(np.unique(view.instances)) - {0}:
            thing = scene.objects[instance - 1]  # every visible instance is listed
            middle, reach = thing.positions[0], np.linalg.norm(thing.size) / 2
            assert np.linalg.norm(points[view.instances == instance] - middle, axis=-1).max() < reach + 0.02
            seen.add(int(instance))
    assert len(seen) >= len(scene.objects) - 1  # a small one may hide among others
