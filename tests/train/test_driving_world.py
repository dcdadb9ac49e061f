"""The driving world as a description: what holds in every scene, before anything is drawn."""

import hashlib

import numpy as np
import pytest
from numpy.typing import NDArray

from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError
from gcd_train.scenes.driving import driving_scene
from gcd_train.scenes.driving.classes import Label, coarse
from gcd_train.scenes.driving.first_edition import random_road
from gcd_train.scenes.driving.first_traffic import Mover, random_traffic
from gcd_train.scenes.frozen import vertices_of

RECORDED = (
    (0, 27812, "6960525f2ffb0f58",
     [2179.029, 2327.635, 604.094, 3902.3, -3259.073, 6584.038],
     [341.9526, 373.2458, 283.8358, 365.3796, 97.8339, 374.6077]),
    (7, 10424, "850ef6f07fbe968e",
     [4687.296, 5471.023, 3177.261, 7145.402, -3099.449, 6224.581],
     [256.945, 302.4125, 209.0505, 384.0737, 166.2042, 353.6325]),
    (1_000_003, 14150, "a06fc2edf1bef3de",
     [15275.757, 13695.986, -713.529, -115.705, -3464.022, 7814.753],
     [379.3549, 421.5749, 339.1933, 498.1867, 224.4229, 466.8507]),
)  # fmt: skip
SEEDS = (0, 3, 17, 42, 1_000_000)


def test_the_first_labels_are_the_ontology() -> None:
    assert [label.name.lower() for label in Label][: len(DRIVING_CLASSES)] == [kind.name for kind in DRIVING_CLASSES]
    assert {coarse(label) for label in Label} == set(range(len(DRIVING_CLASSES)))


@pytest.mark.parametrize(("seed", "triangles", "painted", "structure", "motion"), RECORDED)
def test_the_first_edition_is_the_world_of_the_packaged_model(
    seed: int, triangles: int, painted: str, structure: list[float], motion: list[float]
) -> None:
    """Recorded before the world grew: how much there is, its paint exactly, and where it stands and how it moves, by
    the cosines of all vertices (and of the poses' rows) along six fixed directions, which no vertex leaves unseen.
    """
    scene = driving_scene(seed)
    vertices = vertices_of(scene)
    paint = np.concatenate([vertices["colour"], vertices["tags"]], 1)
    assert len(vertices) == 3 * triangles
    assert hashlib.sha256(paint[np.lexsort(paint.T)].tobytes()).hexdigest()[:16] == painted
    waves = np.random.default_rng(0).normal(0, 1, (6, 3))
    found = np.cos(vertices["position"].astype(float) @ waves.T).sum(0)
    np.testing.assert_allclose(found, structure, atol=0.05)
    rows = scene.poses.astype(float).reshape(-1, 4) @ np.pad(waves, ((0, 0), (0, 1)), constant_values=0.7).T
    np.testing.assert_allclose(np.cos(rows).sum(0), motion, atol=0.01)


def test_the_second_edition_speaks_of_the_same_classes() -> None:
    scene = driving_scene(6, frames=2, edition=2)
    assert {part.label for part in scene.parts} <= set(range(len(DRIVING_CLASSES)))
    assert set(scene.cameras) == {"source", "target"}
    assert scene.facts["edition"] == 2


def test_an_unknown_edition_is_named() -> None:
    with pytest.raises(DataError, match="editions 1 and 2, got 3"):
        driving_scene(0, edition=3)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_scene_depends_on_its_seed_alone(seed: int) -> None:
    first, again = (vertices_of(driving_scene(seed)).tobytes() for _ in range(2))
    assert first == again
    assert first != vertices_of(driving_scene(seed + 1)).tobytes()


def test_cameras_are_those_of_parallel_domain_and_ride_on_the_vehicle() -> None:
    scene = driving_scene(5)
    vehicle = _vehicle(scene.poses[:, 1])
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


@pytest.mark.parametrize("seed", range(12))
def test_vehicles_never_overlap(seed: int) -> None:
    random = np.random.default_rng(seed)
    road = random_road(random)
    traffic = random_traffic(road, random)
    vehicles = [m for m in traffic.movers if m.assembly.length > 2.5]
    assert all(m.assembly.width < road.lane_m for m in vehicles)
    for seconds in (0.0, 0.7, 1.3):
        spans = [_span(m, seconds) for m in (traffic.ego, *vehicles)]
        for i, (rear, front, lateral) in enumerate(spans):
            same_lane = [s for s in spans[:i] if abs(s[2] - lateral) < road.lane_m / 2]
            assert all(front < other_rear or other_front < rear for other_rear, other_front, _ in same_lane)


def test_scenes_vary_in_layout_and_all_classes_occur() -> None:
    scenes = [driving_scene(seed) for seed in range(30)]
    assert len({scene.facts["district"] for scene in scenes}) >= 3
    assert len({scene.facts["lanes"] for scene in scenes}) >= 3
    assert {scene.facts["crossings"] for scene in scenes} >= {0, 1, 2}
    shown = {part.label for scene in scenes for part in scene.parts} | {
        s.label for scene in scenes for s in scene.sheets
    }
    assert shown == set(range(len(DRIVING_CLASSES)))


def test_the_own_car_looks_the_same_in_every_scene() -> None:
    liveries = {tuple(p for p in driving_scene(seed).parts if p.label == Label.OWN_CAR) for seed in (1, 2, 3)}
    assert len(liveries) == 1


def _span(mover: Mover, seconds: float) -> tuple[float, float, float]:
    middle, half = mover.start_m + mover.speed * seconds, mover.assembly.length / 2
    return middle - half, middle + half, mover.lateral_m


def _vehicle(world_from_body: NDArray[np.float32]) -> NDArray[np.float64]:
    poses = np.tile(np.eye(4), (len(world_from_body), 1, 1))
    poses[:, :3] = world_from_body
    return poses
