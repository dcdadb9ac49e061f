"""The tabletop world: what holds in every scene, and that grasps hold by friction alone."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from headless import drawn, needs_egl

from gcd_train.errors import RenderError
from gcd_train.scenes.tabletop.arm import FINGERS, build_model, random_setting
from gcd_train.scenes.tabletop.scene import Episode, tabletop_episode, tabletop_scene
from gcd_train.scenes.tabletop.simulation import Simulation
from gcd_train.scenes.tabletop.things import TabletopClass
from gcd_train.scenes.triangles import vertices_of

pytest.importorskip("mujoco", reason="needs the extra `scenes`: pip install 'gcd-node[scenes]'")

LONG = 88
"""Frames: over three seconds, a whole pick and place."""


@cache
def episode(seed: int, frames: int = 2) -> Episode:
    return tabletop_episode(seed, frames=frames, skipped_s=0.0)


def test_a_scene_depends_on_its_seed_alone() -> None:
    first, again = (tabletop_scene(4, frames=2) for _ in range(2))
    assert vertices_of(first).tobytes() == vertices_of(again).tobytes()
    np.testing.assert_array_equal(first.poses, again.poses)
    other = episode(5).scene
    assert vertices_of(first).tobytes() != vertices_of(other).tobytes()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_things_and_clutter_lie_on_the_table_and_links_are_within_the_picture(seed: int) -> None:
    scene = episode(seed).scene
    kinds = {label: [thing for thing in scene.objects if thing.label == label] for label in TabletopClass}
    things, clutter = kinds[TabletopClass.OBJECT], kinds[TabletopClass.CLUTTER]
    arm, gripper = kinds[TabletopClass.ROBOT_ARM], kinds[TabletopClass.GRIPPER]
    assert 5 <= len(things) <= 12
    assert 2 <= len(clutter) <= 5
    assert all(thing.positions[0, 2] > -1.2 for thing in (*things, *clutter))  # the table's surface, decimetres
    assert all(thing.dynamic != (thing.label == TabletopClass.CLUTTER) for thing in scene.objects)
    assert len(arm) == 6
    assert {thing.name.split("/")[0] for thing in arm} == {"robot_arm"}
    assert {thing.name for thing in gripper} == {f"gripper/{part}" for part in ("palm", "left_finger", "right_finger")}
    centre = [0.0, 0.0, 1.0]
    assert max(np.linalg.norm(link.positions - centre, axis=1).max() for link in (*arm, *gripper)) < 11.0


def test_what_is_told_of_an_object_is_what_is_drawn_of_it() -> None:
    scene = episode(1, LONG).scene
    assert [thing.instance for thing in scene.objects] == list(range(1, len(scene.objects) + 1))
    drawn = {(part.instance, part.label, part.body) for part in scene.parts if part.instance}
    assert drawn == {(thing.instance, thing.label, thing.body) for thing in scene.objects}
    for thing in (thing for thing in scene.objects if thing.dynamic):  # the others' parts are in the table's frame
        np.testing.assert_allclose(scene.poses[:, thing.body, :, 3], thing.positions, atol=1e-4)
        centres = np.array([part.centre for part in scene.parts if part.instance == thing.instance])
        assert (np.abs(centres - thing.middle) < np.array(thing.size) / 2 + 1e-6).all(), thing.name
    moved = max(scene.objects, key=lambda thing: float(np.ptp(thing.positions, axis=0).sum()))
    by_difference = np.gradient(moved.positions, 1 / 24, axis=0)[2:-2]
    np.testing.assert_allclose(by_difference, moved.velocities[2:-2], atol=0.15 * np.abs(moved.velocities).max())


def test_no_camera_of_the_bounds_stands_in_a_wall() -> None:
    walls = [part for part in episode(0).scene.parts if part.label == TabletopClass.WALL]
    inner = min(max(abs(part.centre[0]), abs(part.centre[1])) - min(part.size[:2]) for part in walls)
    assert inner > 18.0 + 2.0  # cameras are at most 18 away


@pytest.mark.parametrize("seed", [1, 2])
def test_a_grasped_thing_is_lifted_follows_the_gripper_and_stays_where_it_is_put(seed: int) -> None:
    done = episode(seed, LONG)
    grasp = done.motion.grasps[0]
    assert grasp.held
    thing = done.scene.objects[grasp.thing]
    steps = np.array(done.motion.steps)
    first_carry = int(np.flatnonzero(steps == "carry")[0])
    first_open = int(np.flatnonzero(steps[first_carry:] == "open")[0]) + first_carry
    carried = np.flatnonzero(steps[:first_open] == "carry")
    tips = [part for part in done.scene.objects if "finger" in part.name]
    between = (tips[0].positions + tips[1].positions) / 2
    rest = thing.positions[0, 2]
    assert (thing.positions[carried, 2] > rest + 0.5).all()  # five centimetres above the table
    apart = np.linalg.norm(thing.positions[carried] - between[carried], axis=1)
    assert np.ptp(apart) < 0.3  # it follows
    assert np.linalg.norm(np.ptp(thing.positions[carried, :2], axis=0)) > 0.8  # and it went somewhere
    after = np.flatnonzero(steps[first_open:] == "retreat") + first_open
    placed = thing.positions[[row for row in after if row - after[0] < 6]]
    assert len(placed) > 2
    assert np.linalg.norm(placed[-1] - placed[0]) < 0.05
    assert abs(placed[-1, 2] - rest) < 0.15


def at_work() -> tuple[Any, Simulation]:
    random = np.random.default_rng(3)
    setting = random_setting(random)
    model = build_model(setting)
    return model, Simulation(model, setting.things, random, 0.9)


def test_nothing_is_welded_an_arm_without_grip_lifts_nothing() -> None:
    model, simulation = at_work()
    assert model.neq == 1  # the two fingers move alike; nothing else is tied to anything
    model.actuator_forcerange[[model.actuator(name).id for name in FINGERS]] = [-1e-3, 1e-3]
    motion = simulation.run(72, 0.0)
    assert motion.grasps
    assert not any(grasp.held for grasp in motion.grasps)


def test_physics_that_diverges_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it runs
    model, simulation = at_work()
    model.opt.gravity[2] = np.nan
    with pytest.raises(RenderError, match="became unstable"):
        simulation.run(2, 0.0)


def test_clips_begin_at_different_points_of_the_work() -> None:
    begun = [tabletop_scene(seed, frames=2).facts["steps"] for seed in (1, 3, 7)]
    assert len(set(begun)) >= 2


@needs_egl
def test_arm_and_gripper_and_things_are_seen() -> None:
    scene = episode(0).scene
    cameras = {name: scene.cameras[name][:1] for name in ("view0", "view4", "view9")}
    short = replace(scene, poses=scene.poses[:1], focus=scene.focus[:1], cameras=cameras)
    views = drawn(short, 96, 64).values()
    seen = set(np.unique(np.stack([view.classes for view in views])).tolist())
    wanted = set(TabletopClass) - {TabletopClass.SKY}
    assert seen >= wanted
    assert len(np.unique(np.stack([view.instances for view in views]))) > 10
    assert all((view.depth[view.classes != TabletopClass.SKY] > 0).all() for view in views)
