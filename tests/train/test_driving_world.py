"""The driving world: the rig, what holds at every time step of a drive before it is drawn, and its scenes for pairs."""

from functools import cache

import cv2
import numpy as np
import pytest
from headless import drawn, needs_egl
from numpy.typing import NDArray

from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import CameraMount, driving_trajectory
from gcd_train.scenes.description import Paint, Part, Scene
from gcd_train.scenes.driving.classes import ONTOLOGY, Label, class_ids, coarse
from gcd_train.scenes.driving.flow import FPS, Crowd, RoadUser, random_drive
from gcd_train.scenes.driving.roads import random_street
from gcd_train.scenes.driving.roadside import Plot
from gcd_train.scenes.driving.vehicles import Lamps, random_bus
from gcd_train.scenes.driving.world import (
    driving_drive,
    driving_scene,
    random_weather,
    random_world,
    vehicle_from_camera,
)
from gcd_train.scenes.drop.things import outline

SEEDS = (1, 6, 11)
FRAMES = 50
VEHICLES = (
    Label.CAR, Label.TRUCK, Label.BUS, Label.OWN_CAR, Label.MOTORCYCLIST, Label.CYCLIST, Label.MOTORCYCLE, Label.BICYCLE
)  # fmt: skip
WEATHERS = {"clear", "cloudy", "low sun", "overcast", "rain", "fog", "dusk", "night"}
PUBLISHED = {
    "Bicyclist": (64, 64, 64), "Motorcyclist": (128, 128, 128), "Pedestrian": (220, 20, 60), "Bus": (0, 60, 100),
    "Car": (0, 0, 142), "Bicycle": (119, 11, 32), "Motorcycle": (0, 0, 230), "OwnCar(EgoCar)": (128, 230, 128),
    "Truck": (0, 0, 70),
}  # fmt: skip


@cache
def drive(seed: int) -> Scene:
    return driving_drive(seed)


@cache
def road_users(seed: int) -> list[RoadUser]:
    return random_world(seed, FRAMES)[1]


def test_the_rig_has_the_cameras_and_the_two_poses_of_the_paper() -> None:
    rig = vehicle_from_camera()
    assert set(rig) == {f"camera{i}" for i in range(16)} | {"yaw-0", "yaw-60", "yaw-neg-60"}
    np.testing.assert_allclose(rig["yaw-0"][:3, 3], [1.6, 0.0, 1.55])
    np.testing.assert_allclose(rig["yaw-0"][:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    path = driving_trajectory(frames=14, move_time=13).source_from_target.numpy()
    np.testing.assert_allclose(rig["yaw-0"] @ path[-1], rig["camera0"], atol=1e-9)
    np.testing.assert_allclose(rig["camera0"][:3, 3], [-8.0, 0.0, 8.0])
    left, right = rig["yaw-60"], rig["yaw-neg-60"]
    assert left[1, 2] == pytest.approx(np.sin(np.radians(60)))
    assert right[1, 2] == pytest.approx(-np.sin(np.radians(60)))
    poses = np.stack(list(rig.values()))  # upright, rigid and apart
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (19, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-9)
    assert len({tuple(np.round(pose[:3, 2:].ravel(), 3)) for pose in poses}) == 19


@pytest.mark.parametrize("seed", SEEDS)
def test_a_drive_lasts_five_seconds_and_its_cameras_ride_on_the_vehicle(seed: int) -> None:
    scene = drive(seed)
    assert (scene.frames, FPS, scene.hfov_deg) == (50, 10.0, 85.0)
    vehicle = np.tile(np.eye(4), (50, 1, 1))
    vehicle[:, :3] = scene.poses[:, 1]
    for name, pose in vehicle_from_camera().items():
        np.testing.assert_allclose(scene.cameras[name], vehicle @ pose, atol=1e-4)


def test_a_drive_depends_on_its_seed_alone() -> None:
    first, again, other = (driving_drive(seed, frames=3) for seed in (3, 3, 0))
    assert first.parts == again.parts
    assert first.poses.tobytes() == again.poses.tobytes()
    assert first.facts != other.facts
    assert first.frames == 3


@pytest.mark.parametrize("seed", SEEDS)
def test_road_users_never_touch(seed: int) -> None:
    """Judged by OpenCV's intersection of rotated rectangles around the parts that are drawn."""
    boxes = [_boxes(user.assembly.parts, user.rows) for user in road_users(seed)]
    rows = np.array(boxes)  # [N, T, 5]: x, y, length, width, degrees
    reach = np.hypot(rows[..., 2], rows[..., 3]) / 2
    checked = 0
    for i in range(len(rows)):
        near = np.hypot(*(rows[i, :, :2] - rows[:i, :, :2]).transpose(2, 0, 1)) < reach[i] + reach[:i]
        for j, t in np.argwhere(near):
            kind, _ = cv2.rotatedRectangleIntersection(_rectangle(rows[i, t]), _rectangle(rows[j, t]))
            assert kind == cv2.INTERSECT_NONE, (i, int(j), int(t))
            checked += 1
    assert checked > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_no_camera_is_ever_inside_a_solid(seed: int) -> None:
    scene = drive(seed)
    eyes = np.stack([poses[:, :3, 3] for poses in scene.cameras.values()], 1)  # [T, C, 3]
    by_body: dict[int, list[Part]] = {}
    for part in scene.parts:
        if part.label != Label.SKY:
            by_body.setdefault(part.body, []).append(part)
    for body, parts in by_body.items():
        pose = scene.poses[:, body].astype(float)
        local = np.einsum("tij,tci->tcj", pose[:, :, :3], eyes - pose[:, None, :, 3])
        assert not _inside(parts, local.reshape(-1, 3)).any(), body


def test_nothing_is_put_where_a_camera_passes() -> None:
    street = random_street(np.random.default_rng(3))
    house = street.main.put([Part("box", (0, 0, 4), (8, 8, 8), Paint((1, 1, 1)), Label.BUILDING)], 0.0, 40.0)
    inside = np.array([house[0].centre])
    above = inside + np.array([0.0, 0.0, 6.0])
    assert not Plot(street=street, cameras=inside).put(house)
    assert Plot(street=street, cameras=above).put(house)


def test_no_vehicle_drives_through_a_camera() -> None:
    random = np.random.default_rng(3)
    street = random_street(random)
    way = random_drive(street, 5, random)
    bus = random_bus(random, Lamps(), near=False)
    rows = np.array([[t, 100.0, 0.0, 0.0] for t in range(5)], np.float32)
    for height, kept in ((2.0, False), (6.0, True)):
        cameras = np.tile([4.0, 100.0, height], (5, 1, 1))
        crowd = Crowd(street=street, drive=way, obstacles=np.zeros((0, 5)), cameras=cameras)
        assert crowd.add(bus, rows) is kept
        assert not crowd.add(bus, rows + np.array([1, 0, 0, 0], np.float32))  # there is one, or the camera still is


@pytest.mark.parametrize("seed", SEEDS)
def test_the_street_reaches_beyond_the_drive_and_houses_keep_off_it(seed: int) -> None:
    scene = drive(seed)
    corners = np.concatenate([sheet.corners for sheet in scene.sheets if sheet.label == Label.ROAD])[..., :2]
    end = scene.poses[-1, 1]
    ahead = (corners.reshape(-1, 2) - end[:2, 3]) @ end[:2, 0]
    assert ahead.max() > 120.0
    assert ahead.min() < -100.0
    for house in (part for part in scene.parts if part.label == Label.BUILDING and part.shape == "box"):
        inside = _inside([house], np.pad(corners.mean(1), ((0, 0), (0, 1)), constant_values=house.centre[2]))
        assert not inside.any(), house


def test_instances_are_the_road_users_own() -> None:
    for seed in SEEDS:
        labels: dict[int, set[int]] = {}
        for part in drive(seed).parts:
            if part.instance:
                labels.setdefault(part.instance, set()).add(part.label)
        assert set(labels) == set(range(1, len(labels) + 1))
        assert all(len(kinds) == 1 for kinds in labels.values())
        assert labels[1] == {Label.OWN_CAR}
        assert drive(seed).poses.shape[1] <= 256


def test_drives_vary_in_what_there_is() -> None:
    scenes = [driving_drive(seed, frames=1) for seed in (0, 1, 4, 6, 8)]
    facts = [scene.facts for scene in scenes]
    assert len({each["district"] for each in facts}) >= 3
    assert len({each["weather"] for each in facts}) >= 5
    assert {each["crossings"] for each in facts} >= {0, 1, 2}
    assert {each["waits"] for each in facts} == {0, 1}
    shown = {part.label for scene in scenes for part in scene.parts} | {s.label for each in scenes for s in each.sheets}
    assert shown == set(Label)


def test_every_weather_occurs_and_its_light_can_be_drawn() -> None:
    drawn = [random_weather(np.random.default_rng(seed)) for seed in range(200)]
    assert {weather.kind for weather in drawn} == WEATHERS
    for weather in drawn:
        light = weather.light
        assert np.linalg.norm(light.sun_to) == pytest.approx(1.0)
        assert light.sun_to[2] > 0
        assert light.fog_m > 30
        assert min(*light.sun, *light.sky, *light.ground, *light.horizon, *light.zenith) >= 0
        assert 0 <= weather.wetness <= 1


def test_the_ontology_names_every_label_once_in_colours_of_its_own_or_those_published() -> None:
    assert sorted(item.label for item in ONTOLOGY) == sorted(Label)
    assert [item.id for item in ONTOLOGY] == sorted({item.id for item in ONTOLOGY})
    assert len({item.name for item in ONTOLOGY}) == len(ONTOLOGY)
    colours = np.array([item.colour for item in ONTOLOGY], float)
    apart = np.abs(colours[:, None] - colours[None]).mean(-1) + 255 * np.eye(len(colours))
    assert apart.min() > 2 * 2.55  # or the training's colour masks would take one class for another

    published = {item.name: item.colour for item in ONTOLOGY if item.name in PUBLISHED}
    assert published == PUBLISHED
    labels = np.array([[Label.SKY, Label.CAR], [Label.PERSON, Label.OWN_CAR]], np.uint8)
    np.testing.assert_array_equal(class_ids(labels), [[29, 5], [22, 20]])
    assert [label.name.lower() for label in Label][: len(DRIVING_CLASSES)] == [kind.name for kind in DRIVING_CLASSES]
    assert {coarse(label) for label in Label} == set(range(len(DRIVING_CLASSES)))


def test_pairs_speak_of_the_class_heads_classes_and_their_cameras_ride_on_the_vehicle() -> None:
    scene = driving_scene(5)
    assert {part.label for part in scene.parts} <= set(range(len(DRIVING_CLASSES)))
    vehicle = np.tile(np.eye(4), (14, 1, 1))
    vehicle[:, :3] = scene.poses[:, 1]
    source, target = (np.linalg.inv(vehicle) @ scene.cameras[name] for name in ("source", "target"))
    np.testing.assert_allclose(source[:, :3, 3], np.tile([1.6, 0.0, 1.55], (14, 1)), atol=1e-5)
    np.testing.assert_allclose(source[:, :3, 2], np.tile([1.0, 0.0, 0.0], (14, 1)), atol=1e-5)
    np.testing.assert_allclose(target[0], source[0], atol=1e-5)
    np.testing.assert_allclose(target[-1, :3, 3], [-8.0, 0.0, 8.0], atol=1e-5)
    looks_at = np.array([5.6, 0.0, 1.55]) - [-8.0, 0.0, 8.0]
    np.testing.assert_allclose(target[-1, :3, 2], looks_at / np.linalg.norm(looks_at), atol=1e-5)


def test_another_mount_moves_the_source_camera_and_leaves_the_target_path() -> None:
    usual, low = driving_scene(5), driving_scene(5, mount=CameraMount(height_m=1.2, tilt_deg=4.0))
    np.testing.assert_allclose(low.cameras["target"], usual.cameras["target"], atol=1e-5)
    assert low.cameras["source"][0, 2, 3] == pytest.approx(1.2, abs=1e-5)
    assert low.cameras["source"][0, 2, 2] == pytest.approx(-np.sin(np.radians(4.0)), abs=1e-5)


def test_the_own_car_looks_the_same_in_every_scene() -> None:
    liveries = {tuple(p for p in driving_scene(seed).parts if p.label == Label.OWN_CAR) for seed in (1, 2, 3)}
    assert len(liveries) == 1


@needs_egl
def test_the_forward_camera_sees_the_road_and_the_top_down_one_its_own_car() -> None:
    scene = driving_drive(11, frames=1)
    views = drawn(scene, 96, 72)
    assert Label.OWN_CAR not in views["yaw-0"].classes
    assert {Label.ROAD, Label.SKY} <= set(np.unique(views["yaw-0"].classes).tolist())
    assert {Label.ROAD, Label.OWN_CAR} <= set(np.unique(views["camera0"].classes).tolist())
    assert all(view.depth.max() > 5.0 for view in views.values())


def _inside(parts: list[Part], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points [N, 3] of a body's frame are in its parts' boxes, [N, P]."""
    away = points[:, None] - np.array([part.centre for part in parts])
    yaw = np.array([part.yaw for part in parts])
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = away[..., 0] * cos + away[..., 1] * sin, away[..., 1] * cos - away[..., 0] * sin
    half = np.abs([part.size for part in parts]) / 2 + 0.05
    return np.all(np.abs(np.stack([x, y, away[..., 2]], -1)) < half, axis=-1)


def _boxes(parts: tuple[Part, ...], rows: NDArray[np.float32]) -> NDArray[np.float64]:
    """The rectangle around parts as drawn, at every time step [T, 5]: x, y, length, width, degrees."""
    corners = np.concatenate([outline(part)[:, :2] for part in parts])
    low, high = corners.min(0), corners.max(0)
    middle, size = (low + high) / 2, high - low
    cos, sin = np.cos(rows[:, 3]), np.sin(rows[:, 3])
    x = rows[:, 0] + cos * middle[0] - sin * middle[1]
    y = rows[:, 1] + sin * middle[0] + cos * middle[1]
    return np.stack([x, y, 0 * x + size[0], 0 * x + size[1], np.degrees(rows[:, 3])], -1).astype(float)


def _rectangle(row: NDArray[np.float64]) -> tuple[tuple[float, float], tuple[float, float], float]:
    x, y, length, width, degrees = (float(value) for value in row)
    return (x, y), (length, width), degrees
