"""Files of both published layouts: names, numbers worked out by hand, and what other programs will find in them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from box_world import HFOV_DEG, box_scene

from gcd_model.geometry import Intrinsics, sphere_poses
from gcd_train.data import encodings, kubric4d, parallel_domain4d
from gcd_train.data.dataset4d import layout_of
from gcd_train.data.encodings import (
    FAR_M,
    NEAR_M,
    SKY_M,
    STAGE_DEPTH,
    STREET_DEPTH,
    DepthCode,
    quaternions,
    with_sky,
)
from gcd_train.data.files import SceneFiles
from gcd_train.data.kubric4d import (
    InstanceTracks,
    Kubric4DWriter,
    camera_metadata,
    project,
    segment_ids,
    view_metadata,
)
from gcd_train.data.parallel_domain4d import ParallelDomain4DWriter, calibration, ontology
from gcd_train.errors import DataError
from gcd_train.scenes.description import rotations
from gcd_train.scenes.driving.classes import ONTOLOGY, Label
from gcd_train.scenes.renderer import Rendering

LENS = Intrinsics.from_hfov(HFOV_DEG, 48, 32)


def drawing(instance: int = 9, depth: float = 10.0) -> Rendering:
    """A picture with an instance in rows 4..7 and columns 6..17, and sky in the first two rows."""
    instances = np.zeros((32, 48), np.uint8)
    instances[4:8, 6:18] = instance
    metres = np.full((32, 48), depth, np.float32)
    metres[:2] = 0
    rows, columns = np.mgrid[:32, :48]
    rgb = np.stack([7 * rows, 5 * columns, 200 - 3 * rows], -1).astype(np.uint8)
    classes = np.full((32, 48), Label.CAR, np.uint8)
    return Rendering(rgb=rgb, depth=metres, classes=classes, instances=instances, bodies=instances)


def picture(path: Path) -> Any:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


class TestNames:
    def test_kubric4d_as_published(self) -> None:
        scene = Path("data") / kubric4d.scene_name(42)
        assert str(kubric4d.metadata_path(scene, "view3")) == "data/scn00042/scn00042_p0_v3.json"
        path = kubric4d.frame_path(scene, "view15", "depth", 7)
        assert str(path) == "data/scn00042/frames_p0_v15/depth_00007.tiff"
        assert kubric4d.frame_path(scene, "view0", "rgba", 59).name == "rgba_00059.png"
        assert kubric4d.frame_path(scene, "view0", "rgba", 59, compact=True).name == "rgba_00059.webp"
        assert kubric4d.frame_path(scene, "view0", "segmentation", 0).name == "segmentation_00000.png"

    def test_parallel_domain4d_as_published(self) -> None:
        names = parallel_domain4d
        scene = Path("data") / names.scene_name(42)
        path = names.frame_path(scene, "yaw-0", "rgb", 7)
        assert str(path) == "data/scene_000042/rgb/yaw-0/000000000000000075.png"
        assert names.frame_path(scene, "camera3", "depth", 0).name == "000000000000000005.npz"
        assert names.frame_path(scene, "camera3", "depth", 0, compact=True).suffix == ".png"
        assert names.CAMERAS[:4] == ("camera0", "camera1", "camera10", "camera11")
        assert names.CAMERAS[15:] == ("camera9", "yaw-0", "yaw-60", "yaw-neg-60")
        assert len(names.CAMERAS) == 19

    @pytest.mark.parametrize("name", ["scn1", "scene_12", ".scn00001.partial", "scn00001x", "test"])
    def test_other_folders_are_no_scenes(self, name: str) -> None:
        assert layout_of(name) is None


class TestDepthCode:
    def test_the_error_is_half_a_step(self) -> None:
        metres = np.geomspace(NEAR_M, FAR_M, 4001).astype(np.float32)
        np.testing.assert_allclose(STAGE_DEPTH.table()[STAGE_DEPTH.encode(metres)], metres, rtol=5.1e-4)
        metres = metres[metres < 5000.0]
        again = STREET_DEPTH.table()[STREET_DEPTH.encode(metres)]
        np.testing.assert_array_less(np.abs(1 / again - 1 / metres), 0.00127 * (1 / metres + 1 / 20))

    @pytest.mark.parametrize(
        ("code", "metres", "last"),
        [(STAGE_DEPTH, 0.05 * np.e, 13306), (STREET_DEPTH, 20.0, 2398)],
        ids=["stage", "street"],
    )
    def test_codes_by_hand(self, code: DepthCode, metres: float, last: int) -> None:
        """Of a stage 1 + ln(e) / 0.001, of a street 1 + ln(20.05 / 0.1) / 0.0025."""
        codes = code.encode(np.array([0.0, -1.0, np.nan, 0.01, 0.05, metres, SKY_M, 1e9, np.inf], np.float32)).tolist()
        assert codes == [0, 0, 0, 1, 1, 1001 if last == 13306 else 2121, last, last, last]
        table = code.table()
        assert table[[0, 1, last, 65535]].tolist() == pytest.approx([0.0, 0.05, SKY_M, SKY_M])
        assert (np.diff(table) >= 0).all()
        assert (np.diff(table[:last]) > 0).all()

    def test_the_sky_is_far_and_nothing_in_sight_becomes_it(self) -> None:
        assert with_sky(np.array([0.0, 2.5], np.float32)).tolist() == [SKY_M, 2.5]
        metres = np.array([900.0, SKY_M], np.float32)
        assert (STREET_DEPTH.table()[STREET_DEPTH.encode(metres)] == SKY_M).tolist() == [False, True]


class TestCameraFacts:
    def test_quaternions_survive_the_round_trip(self) -> None:
        random = np.random.default_rng(0)
        wanted = random.normal(size=(500, 4))
        wanted[:4] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
        came = quaternions(rotations(wanted))
        np.testing.assert_allclose(np.abs((came * wanted).sum(-1)), 1, atol=1e-12)
        np.testing.assert_allclose(rotations(came), rotations(wanted), atol=1e-12)
        assert (came[:, 0] >= 0).all()

    def test_a_published_view_by_hand(self) -> None:
        """Azimuth 15, elevation 5, radius 15: Blender's camera has its y axis up and looks along -z."""
        pose = sphere_poses(torch.tensor([[15.0, 5.0, 15.0]], dtype=torch.float64)).numpy()
        told = camera_metadata(pose, Intrinsics.from_hfov(HFOV_DEG, 576, 384))
        np.testing.assert_allclose(told["positions"][0], [14.433753, 3.867512, 2.307336], atol=1e-6)
        axes = rotations(np.array(told["quaternions"]))[0]
        np.testing.assert_allclose(axes[:, 0], [-0.258819, 0.965926, 0], atol=1e-6)
        np.testing.assert_allclose(axes[:, 1], [-0.084186, -0.022558, 0.996195], atol=1e-6)
        np.testing.assert_allclose(axes[:, 2], [0.96225, 0.257834, 0.087156], atol=1e-6)
        np.testing.assert_allclose(np.array(told["R"])[:3, :3], axes, atol=1e-9)
        np.testing.assert_allclose(told["K"], [[1, 0, -0.5], [0, -1.5, -0.5], [0, 0, -1]], atol=1e-12)
        assert told["focal_length"] == pytest.approx(32)
        assert told["field_of_view"] == pytest.approx(0.9272952)

    def test_the_stored_matrix_projects_as_the_lens_does(self) -> None:
        pose = sphere_poses(torch.tensor([[40.0, 30.0, 12.0]], dtype=torch.float64)).numpy()
        told = camera_metadata(pose, LENS)
        at = np.array(told["K"]) @ (np.linalg.inv(np.array(told["R"])) @ [1.0, -2.0, 0.5, 1.0])[:3]
        np.testing.assert_allclose(project(np.array([[1.0, -2.0, 0.5]]), pose, LENS)[0], at[:2] / at[2], atol=1e-12)


class TestEncodings:
    def test_pillow_finds_the_ids(self, tmp_path: Path) -> None:
        image = pytest.importorskip("PIL.Image", reason="needs Pillow, which other packages bring")
        ids = np.random.default_rng(0).integers(0, 256, (7, 5)).astype(np.uint8)
        (tmp_path / "ids.png").write_bytes(encodings.indexed_png(ids, encodings.instance_palette()))
        with image.open(tmp_path / "ids.png") as opened:
            assert opened.mode == "P"
            np.testing.assert_array_equal(np.asarray(opened), ids)
        (tmp_path / "rgba.png").write_bytes(encodings.colour_png(drawing().rgb, alpha=True))
        with image.open(tmp_path / "rgba.png") as opened:
            assert opened.mode == "RGBA"
            np.testing.assert_array_equal(np.asarray(opened)[..., :3], drawing().rgb)
            assert np.asarray(opened)[..., 3].min() == 255

    @pytest.mark.parametrize("encode", [encodings.id_png, encodings.packed_id_png])
    def test_ids_are_told_by_red(self, encode: Any) -> None:
        ids = np.arange(256, dtype=np.uint8).reshape(8, 32)
        shown = cv2.imdecode(np.frombuffer(encode(ids), np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        blue, green, red = np.moveaxis(shown.astype(int), -1, 0)
        np.testing.assert_array_equal(red + 256 * green + 65536 * blue, ids)


class TestKubric4D:
    def test_metadata_has_every_published_field(self, tmp_path: Path) -> None:
        scene = box_scene(0, 2)
        folder = tmp_path / "scn00007"
        writer = Kubric4DWriter(SceneFiles(folder), scene, LENS, seed=7, fps=24.0, compact=False)
        for time in range(2):
            for camera in scene.cameras:
                writer.add(time, camera, drawing(instance=9 if time == 0 else 0))
        writer.finish()
        told = json.loads(kubric4d.metadata_path(folder, "view0").read_text())
        assert set(told) == {"scene", "camera", "instances", "dome", "random_seed", "collisions"}
        assert told["scene"]["resolution"] == [48, 32]
        assert (told["scene"]["frame_rate"], told["scene"]["num_frames"], told["random_seed"]) == (24.0, 2, 7)
        assert (told["scene"]["num_instances"], told["scene"]["num_valo_instances"]) == (2, 1)
        assert (told["scene"]["gravity"], told["scene"]["background"]) == ([0.0, 0.0, -9.81], "procedural")
        green, red = told["instances"]  # by the renderer's instance id: 4, then 9
        assert (green["asset_id"], red["asset_id"]) == ("green box", "red box")
        assert red["visibility"] == [48, 0]
        assert red["bbox_frames"] == [0]
        assert red["bboxes"] == [[4 / 32, 6 / 48, 8 / 32, 18 / 48]]
        assert (red["mass"], red["friction"], red["restitution"]) == (2.0, 0.5, 0.1)
        assert np.shape(red["bboxes_3d"]) == (2, 8, 3)
        assert np.min(red["bboxes_3d"], axis=(0, 1)).tolist() == [1.0, -2.5, 0.0]
        assert np.shape(red["positions"]) == np.shape(red["velocities"]) == (2, 3)
        assert np.shape(red["quaternions"]) == (2, 4)
        assert np.shape(red["image_positions"]) == (2, 2)
        assert "collisions" not in json.loads(kubric4d.metadata_path(folder, "view1").read_text())

    def test_physics_is_told_in_the_scenes_own_units(self) -> None:
        pytest.importorskip("mujoco", reason="needs the extra `scenes`")
        from gcd_train.scenes.drop import world
        from gcd_train.scenes.tabletop import arm

        scene = replace(box_scene(0, 2), facts={"metres_a_unit": 0.1})
        told = view_metadata(scene, scene.cameras["view0"], (), InstanceTracks(2), LENS, 24.0)["scene"]
        assert told["gravity"] == pytest.approx([0, 0, -98.1])
        assert told["step_rate"] == pytest.approx(1 / arm.STEP_S)
        assert vars(world)["_STEP_S"] == arm.STEP_S

    @pytest.mark.parametrize("instances", [(3, 3), (0,), (256,)])
    def test_objects_that_cannot_be_told_apart_are_refused(self, instances: tuple[int, ...]) -> None:
        with pytest.raises(DataError, match="distinct instance ids"):
            segment_ids(instances)

    def test_segments_are_numbered_as_the_list_of_objects(self) -> None:
        table = segment_ids((4, 9))
        assert table[[0, 4, 9, 1, 2, 3, 5, 10]].tolist() == [0, 1, 2, 3, 4, 5, 6, 10]
        assert sorted(table.tolist()) == list(range(256))
        np.testing.assert_array_equal(segment_ids(()), np.arange(256))


class TestParallelDomain4D:
    def test_what_has_no_class_is_void(self, tmp_path: Path) -> None:
        folder = tmp_path / "scene_000007"
        cars = [item for item in ONTOLOGY if item.label == Label.CAR]
        writer = ParallelDomain4DWriter(SceneFiles(folder), LENS, {"yaw-0": np.eye(4)}, cars, compact=False)
        view = drawing()
        view.classes[:5] = Label.ROAD
        writer.add(0, "yaw-0", view)
        path = parallel_domain4d.frame_path(folder, "yaw-0", "semantic_segmentation_2d", 0)
        assert np.unique(picture(path)[:5, :, 2]).tolist() == [255]
        assert np.unique(picture(path)[5:, :, 2]).tolist() == [5]

    def test_calibration_by_hand(self) -> None:
        """A camera 1.6 m ahead and 1.55 m up that looks along the vehicle's x axis."""
        pose = np.array([[0, 0, 1, 1.6], [-1, 0, 0, 0], [0, -1, 0, 1.55], [0, 0, 0, 1.0]])
        told = calibration({"yaw-0": pose, "yaw-60": pose}, LENS)
        assert told["names"] == ["yaw-0", "yaw-60"]
        assert len(told["intrinsics"]) == len(told["extrinsics"]) == 2
        assert told["intrinsics"][0]["fx"] == pytest.approx(48)
        assert (told["intrinsics"][0]["cx"], told["intrinsics"][0]["cy"]) == (24, 16)
        rotation = told["extrinsics"][0]["rotation"]
        assert [rotation[name] for name in ("qw", "qx", "qy", "qz")] == pytest.approx([0.5, -0.5, 0.5, -0.5])
        assert told["extrinsics"][0]["translation"] == {"x": 1.6, "y": 0.0, "z": 1.55}

    def test_the_ontology_lists_classes_by_their_ids(self) -> None:
        items = {item["id"]: item for item in ontology(ONTOLOGY)["items"]}
        assert items[5]["isthing"]
        assert not items[24]["isthing"]  # the road
        assert items[5]["name"] == "Car"
        assert items[5]["color"] == {"r": 0, "g": 0, "b": 142}
        assert items[255]["name"] == "Void"
        assert len(items) == len(ONTOLOGY) + 1


def test_counts_and_boxes_are_those_of_a_plain_loop() -> None:
    random = np.random.default_rng(0)
    pictures = random.integers(0, 256, (3, 20, 30)).astype(np.uint8)
    pictures[0][pictures[0] == 200] = 0
    pictures[1] %= 5
    pictures[2] = 0
    tracks = InstanceTracks(3)
    for time, ids in enumerate(pictures):
        tracks.add(time, ids)
    for time, ids in enumerate(pictures):
        for number in range(256):
            rows, columns = np.nonzero(ids == number)
            box = [rows.min(), columns.min(), rows.max() + 1, columns.max() + 1] if len(rows) else [0] * 4
            assert tracks.boxes[time, number].tolist() == box
            assert tracks.pixels[time, number] == len(rows)
