"""The driving world as a description: what holds in every scene, before anything is drawn."""

import numpy as np
import pytest
from numpy.typing import NDArray

from gcd_model.config import DRIVING_CLASSES
from gcd_model.geometry import CameraMount
from gcd_train.scenes.driving import driving_scene
from gcd_train.scenes.driving.classes import Label, coarse
from gcd_train.scenes.frozen import vertices_of

SEEDS = (0, 3, 17, 42, 1_000_000)


def test_the_first_labels_are_the_ontology() -> None:
    assert [label.name.lower() for label in Label][: len(DRIVING_CLASSES)] == [kind.name for kind in DRIVING_CLASSES]
    assert {coarse(label) for label in Label} == set(range(len(DRIVING_CLASSES)))


def test_pairs_speak_of_the_class_heads_classes() -> None:
    scene = driving_scene(6, frames=2)
    assert {part.label for part in scene.parts} <= set(range(len(DRIVING_CLASSES)))
    assert set(scene.cameras) == {"source", "target"}


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


def _vehicle(world_from_body: NDArray[np.float32]) -> NDArray[np.float64]:
    poses = np.tile(np.eye(4), (len(world_from_body), 1, 1))
    poses[:, :3] = world_from_body
    return poses
