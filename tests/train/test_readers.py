"""Reading Kubric-4D and ParallelDomain-4D in their published layouts."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scenes4d import (
    BOX,
    CAMERAS,
    DRIVING_LENS,
    GROUND,
    KUBRIC_LENS,
    SKY,
    VIEWS,
    copy_scene,
    draw,
    driving_pose,
    edit_json,
    kubric_poses,
    ontology,
    palette_png,
    write_driving,
    write_kubric,
    write_png,
)

from gcd_model.geometry import Intrinsics
from gcd_train.data.dataset4d import VOID, Ontology, OntologyItem, read_ontology
from gcd_train.data.encodings import STAGE_DEPTH, read_ids, read_palette_indices
from gcd_train.data.files import FileFault
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.errors import DataError


@pytest.fixture(scope="module")
def kubric_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kubric")
    write_kubric(root, 7, frames=2)
    write_kubric(root, 2801, views=1, frames=1)  # a gap in the numbers
    return root


@pytest.fixture(scope="module")
def driving_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("driving")
    write_driving(root, 4, frames=2)
    write_driving(root, 2143, frames=2, spelling=1)
    return root


@pytest.fixture
def kubric(kubric_root: Path, tmp_path: Path) -> Path:
    """A scene that a test may damage."""
    return copy_scene(kubric_root / "scn00007", tmp_path / "scn00007")


@pytest.fixture
def driving(driving_root: Path, tmp_path: Path) -> Path:
    """A scene that a test may damage."""
    return copy_scene(driving_root / "scene_000004", tmp_path / "scene_000004")


def open_kubric(root: Path, **options: bool) -> Kubric4D:
    return Kubric4D(root, cameras=VIEWS, **options)


def open_driving(root: Path, **options: bool) -> ParallelDomain4D:
    return ParallelDomain4D(root, cameras=CAMERAS, **options)


def test_kubric_views_are_what_was_drawn(kubric_root: Path) -> None:
    views = open_kubric(kubric_root, instances=True).views("scn00007", 1)
    for view, pose in zip(views, kubric_poses(), strict=True):
        drawn = draw(pose, KUBRIC_LENS, time=1)
        np.testing.assert_array_equal(view.rgb, drawn.rgb)
        near = drawn.depth < 30_000
        np.testing.assert_allclose(view.depth[near], drawn.depth[near], rtol=2e-6)
        np.testing.assert_allclose(view.world_from_camera, pose, atol=1e-6)
        assert view.instances is not None
        np.testing.assert_array_equal(view.instances > 0, drawn.ids == BOX)
        assert view.classes is None


def test_driving_views_are_what_was_drawn(driving_root: Path) -> None:
    views = open_driving(driving_root, instances=True).views("scene_000004", 1)
    for view, camera in zip(views, CAMERAS, strict=True):
        drawn = draw(driving_pose(camera), DRIVING_LENS, time=1, box_x=9.0)
        np.testing.assert_array_equal(view.rgb, drawn.rgb)
        np.testing.assert_array_equal(view.depth, drawn.depth)
        assert view.classes is not None
        assert view.instances is not None
        np.testing.assert_array_equal(view.classes, drawn.ids)
        np.testing.assert_array_equal(view.instances, np.where(drawn.ids == BOX, 300, 0))
        np.testing.assert_allclose(view.world_from_camera, driving_pose(camera), atol=1e-6)


def test_both_spellings_of_a_calibration_say_the_same(driving_root: Path) -> None:
    dataset = open_driving(driving_root)
    for camera in CAMERAS:
        np.testing.assert_array_equal(dataset.pose("scene_000004", camera), dataset.pose("scene_002143", camera))
    lens = dataset.lens("scene_002143")
    assert lens == Intrinsics(fx=lens.fx, fy=lens.fx, cx=24.0, cy=18.0, width=48, height=36)
    assert lens.hfov_deg == pytest.approx(85.0)


def test_layers_that_were_not_downloaded_are_none(kubric: Path, driving: Path) -> None:
    for path in kubric.glob("*/segmentation_*"):
        path.unlink()
    shutil.rmtree(driving / "semantic_segmentation_2d")
    assert open_kubric(kubric.parent, instances=True).views("scn00007", 0)[0].instances is None
    assert open_driving(driving.parent).views("scene_000004", 0)[0].classes is None


def test_compact_files_are_read_where_the_published_ones_are_not(driving: Path) -> None:
    drawn = draw(driving_pose("yaw-0"), DRIVING_LENS, box_x=9.0)
    colour, depth = (driving / layer / "yaw-0" / "000000000000000005" for layer in ("rgb", "depth"))
    colour.with_suffix(".png").unlink()
    depth.with_suffix(".npz").unlink()
    assert cv2.imwrite(str(colour.with_suffix(".webp")), drawn.rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 90])
    assert cv2.imwrite(str(depth.with_suffix(".png")), STAGE_DEPTH.encode(drawn.depth))
    view = open_driving(driving.parent).views("scene_000004", 0, ["yaw-0"])[0]
    np.testing.assert_allclose(view.depth, drawn.depth, rtol=6e-4)
    assert np.abs(view.rgb.astype(int) - drawn.rgb).mean() < 15


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_palette_and_grey_pictures_give_their_indices(tmp_path: Path, bits: int) -> None:
    ids = np.random.default_rng(bits).integers(0, 2**bits, (9, 13), dtype=np.uint8)
    colours = [(number * 7 % 256, number * 13 % 256, 99) for number in range(2**bits)]
    for palette in (colours, []):
        (tmp_path / "a.png").write_bytes(palette_png(ids, palette, bits))
        np.testing.assert_array_equal(read_palette_indices(tmp_path / "a.png"), ids)


def test_ids_count_red_then_green_then_blue(tmp_path: Path) -> None:
    write_png(tmp_path / "ids.png", np.array([[[1, 0, 0], [0, 1, 0], [3, 2, 1]]], np.uint8))
    np.testing.assert_array_equal(read_ids(tmp_path / "ids.png"), [[1, 256, 3 + 512 + 65536]])


def kubric_file(name: str) -> str:
    return f"frames_p0_v2/{name}_00001.{'tiff' if name == 'depth' else 'png'}"


def driving_file(layer: str) -> str:
    return f"{layer}/yaw-60/000000000000000015.{'npz' if layer == 'depth' else 'png'}"


def expect_fault(scene: Path, path: str, match: str) -> None:
    opened = open_kubric if scene.name.startswith("scn0") else open_driving
    dataset = opened(scene.parent, instances=True)
    with pytest.raises(FileFault, match=match) as caught:
        dataset.views(scene.name, 1)
    assert caught.value.path == scene / path
    assert str(scene / path) in str(caught.value)


@pytest.mark.parametrize("layer", ["rgb", "depth", "semantic_segmentation_2d", "instance_segmentation_2d"])
@pytest.mark.parametrize("share", [None, 0.0, 0.5, 0.95])
def test_a_missing_or_cut_off_file_is_named(driving: Path, kubric: Path, layer: str, share: float | None) -> None:
    names = {"rgb": "rgba", "depth": "depth", "instance_segmentation_2d": "segmentation"}
    kubric_layer = kubric_file(names.get(layer, "depth"))
    for path in (driving / driving_file(layer), kubric / kubric_layer):
        content = path.read_bytes()
        path.unlink()
        if share is not None:
            path.write_bytes(content[: int(share * len(content))])
    said = "is missing" if share is None else "is empty" if share == 0 else "damaged"
    expect_fault(driving, driving_file(layer), said)
    expect_fault(kubric, kubric_layer, said)


@pytest.mark.parametrize(
    ("value", "pixels", "said"),
    [
        (np.nan, 3, "3 of 1728"),
        (-1.0, 3, "3 of 1728"),
        (np.inf, None, "beyond 30000 m"),
        (0.0, None, "no depth above 0"),
    ],
)
def test_depth_that_is_none_is_named(driving: Path, value: float, pixels: int | None, said: str) -> None:
    depth = np.full((36, 48), 5.0, np.float32)
    depth.flat[:pixels] = value
    np.savez(driving / driving_file("depth"), data=depth)
    expect_fault(driving, driving_file("depth"), said)


def test_a_missing_view_is_named(kubric: Path, driving: Path) -> None:
    shutil.rmtree(kubric / "frames_p0_v3")
    expect_fault(kubric, "frames_p0_v3/rgba_00001.png", "is missing")
    (kubric / "scn00007_p0_v1.json").unlink()
    expect_fault(kubric, "scn00007_p0_v1.json", "is missing")
    shutil.rmtree(driving / "rgb" / "camera0")
    expect_fault(driving, "rgb/camera0/000000000000000015.png", "is missing")
    shutil.rmtree(driving / "rgb" / "yaw-0")
    expect_fault(driving, "rgb/yaw-0", "is missing")


def test_mixed_sizes_are_named(kubric: Path, driving: Path) -> None:
    write_png(driving / driving_file("rgb"), np.zeros((30, 40, 3), np.uint8))
    expect_fault(driving, driving_file("rgb"), "40 x 30 where .* 48 x 36: sizes are mixed")
    write_png(kubric / kubric_file("rgba"), np.zeros((30, 40, 3), np.uint8), alpha=True)
    expect_fault(kubric, kubric_file("rgba"), "40 x 30 where .* 48 x 32: sizes are mixed")
    edit_json(kubric / "scn00007_p0_v2.json", lambda told: told["scene"].update(resolution=[96, 64]))
    expect_fault(kubric, "scn00007_p0_v2.json", "96 x 64 pixels, .* sizes are mixed")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda told: told.pop("camera"), "is damaged or lacks"),
        (lambda told: told["camera"].update(K="none"), "is damaged or lacks"),
        (lambda told: told["camera"].update(quaternions=[[0.0, 0.0, 0.0, 0.0]] * 2), "length 1"),
        (lambda told: told["camera"].update(positions=[[0.0, 0.0, 0.0]]), "in 1 frames of 2"),
        (lambda told: told["scene"].update(resolution=[0, 0]), "is damaged or lacks"),
    ],
)
def test_damaged_kubric_metadata_is_named(kubric: Path, change: Callable[[Any], object], match: str) -> None:
    edit_json(kubric / "scn00007_p0_v1.json", change)
    expect_fault(kubric, "scn00007_p0_v1.json", match)


TWICE = json.dumps({"items": 2 * ontology()["items"]}).encode()


@pytest.mark.parametrize("content", [b"", b"{", b'{"scene": {}}', b"\xff\xfe", b"null", TWICE])
def test_json_that_is_none_is_named(kubric: Path, driving: Path, content: bytes) -> None:
    (kubric / "scn00007_p0_v1.json").write_bytes(content)
    expect_fault(kubric, "scn00007_p0_v1.json", "is empty|is damaged")
    dataset = open_driving(driving.parent)
    (driving / "ontology" / "d4e5f6.json").write_bytes(content)
    with pytest.raises(FileFault, match=r"d4e5f6\.json is (empty|no ontology|no usable ontology)"):
        dataset.views("scene_000004", 0)
    (driving / "calibration" / "a1b2c3.json").write_bytes(content)
    with pytest.raises(FileFault, match=r"a1b2c3\.json is (empty|no calibration)"):
        dataset.views("scene_000004", 0)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda told: told["names"].__setitem__(3, "other"), "lacks 1 of 3 cameras, first: camera0"),
        (lambda told: told["names"].pop(), "differ in length"),
        (lambda told: told["extrinsics"][1].pop("rotation"), "without rotation or orientation"),
        (lambda told: told["extrinsics"][1]["rotation"].pop("qw"), "without a number for qw or w"),
        (lambda told: told["extrinsics"][1]["rotation"].update(qw=9.0), "length 1"),
        (lambda told: told["extrinsics"].__setitem__(1, None), "without rotation"),
        (lambda told: told["intrinsics"][1].update(fx=0.0), "impossible lens"),
        (lambda told: told["intrinsics"][1].update(cx=320.0), "resized"),
        (lambda told: told["intrinsics"].__setitem__(1, None), "without a number for fx"),
    ],
)
def test_a_damaged_calibration_is_named(driving: Path, change: Callable[[Any], object], match: str) -> None:
    edit_json(driving / "calibration" / "a1b2c3.json", change)
    expect_fault(driving, "calibration/a1b2c3.json", match)


def test_a_scene_with_another_ontology_is_refused(driving_root: Path, tmp_path: Path) -> None:
    shutil.copytree(driving_root, tmp_path / "set")
    path = tmp_path / "set" / "scene_002143" / "ontology" / "d4e5f6.json"
    edit_json(path, lambda told: told["items"][0].update(name="Moon"))
    dataset = open_driving(tmp_path / "set")
    with pytest.raises(FileFault, match=r"wrong ontology: it differs from the first scene's by Moon, Road"):
        dataset.views("scene_002143", 0)
    assert len(dataset.views("scene_000004", 0)) == 3


def test_the_instance_layer_in_the_place_of_the_class_layer_is_noticed(driving: Path) -> None:
    shutil.rmtree(driving / "semantic_segmentation_2d")
    shutil.copytree(driving / "instance_segmentation_2d", driving / "semantic_segmentation_2d")
    dataset = open_driving(driving.parent)
    with pytest.raises(FileFault, match="holds id 300, beyond 255: is it another layer"):
        dataset.views("scene_000004", 0)


def test_a_frame_beyond_the_end_is_refused(kubric_root: Path, driving_root: Path) -> None:
    with pytest.raises(FileFault, match="tells of 2 frames, wanted frame 2"):
        open_kubric(kubric_root).views("scn00007", 2)
    with pytest.raises(FileFault, match="is missing"):
        open_driving(driving_root).views("scene_000004", 2)


@pytest.mark.parametrize("kind", [Kubric4D, ParallelDomain4D])
def test_a_folder_without_scenes_is_refused(tmp_path: Path, kind: type[Kubric4D | ParallelDomain4D]) -> None:
    with pytest.raises(DataError, match="holds no"):
        kind(tmp_path)
    with pytest.raises(DataError, match="cannot be read"):
        kind(tmp_path / "nowhere")


@pytest.mark.parametrize("layer", ["rgb", "depth", "semantic_segmentation_2d", "kubric depth", "kubric segmentation"])
def test_whatever_a_file_holds_it_is_read_or_named(driving: Path, kubric: Path, layer: str) -> None:
    if layer.startswith("kubric"):
        path = kubric / kubric_file(layer.split()[1])
        dataset, scene = open_kubric(kubric.parent, instances=True), "scn00007"
    else:
        path = driving / driving_file(layer)
        dataset, scene = open_driving(driving.parent), "scene_000004"
    camera = "view2" if layer.startswith("kubric") else "yaw-60"
    whole, rng = path.read_bytes(), np.random.default_rng(len(layer))
    named: list[Path] = []
    for _ in range(40):
        content = bytearray(whole)
        for _ in range(int(rng.integers(1, 5))):
            content[int(rng.integers(len(content)))] = int(rng.integers(256))
        path.write_bytes(content)
        try:
            (view,) = dataset.views(scene, 1, [camera])
        except FileFault as fault:
            named.append(fault.path)
        else:
            assert view.rgb.shape[:2] == view.depth.shape
    assert set(named) == {path}


def test_classes_that_share_a_colour_are_reported(driving: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = driving / "ontology" / "d4e5f6.json"
    edit_json(path, lambda told: told["items"][1].update(color=told["items"][0]["color"]))
    dataset = open_driving(driving.parent)
    assert dataset.ontology is not None
    assert dataset.ontology.duplicates == ((5, 24),)
    assert "classes of one colour are merged in decoding: Car (5), Road (24)" in caplog.text


def test_far_depth_is_cut_as_published(driving: Path) -> None:
    path = driving / "depth" / "yaw-0" / "000000000000000005.npz"
    np.savez(path, data=np.where(draw(driving_pose("yaw-0"), DRIVING_LENS).ids == SKY, np.inf, 7.0).astype("f4"))
    assert float(open_driving(driving.parent).views("scene_000004", 0, ["yaw-0"])[0].depth.max()) == 30_000.0


# class palettes: there and back, duplicates, what is refused

COLOUR = st.tuples(*[st.integers(0, 255)] * 3)


def made(colours: dict[int, tuple[int, int, int]]) -> Ontology:
    return Ontology(tuple(OntologyItem(id=i, name=f"class {i}", colour=colour) for i, colour in colours.items()))


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.integers(0, 255), COLOUR, min_size=1, max_size=60))
def test_ids_survive_colouring_but_for_those_that_share_a_colour(colours: dict[int, tuple[int, int, int]]) -> None:
    known = made(colours)
    ids = np.array(sorted(colours), np.uint8)
    np.testing.assert_array_equal(known.decode(known.encode(ids)), known.merge(ids))
    apart = [i for i in ids.tolist() if not any(i in group for group in known.duplicates)]
    np.testing.assert_array_equal(known.merge(np.array(apart, np.uint8)), apart)


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.integers(0, 255), COLOUR, min_size=1, max_size=20), st.lists(COLOUR, min_size=1, max_size=9))
def test_decoding_finds_the_nearest_colour(
    colours: dict[int, tuple[int, int, int]], asked: list[tuple[int, int, int]]
) -> None:
    known = made(colours)
    found = known.decode(np.array(asked, np.uint8))
    for colour, number in zip(asked, found.tolist(), strict=True):
        distances = {i: sum((a - b) ** 2 for a, b in zip(colour, c, strict=True)) for i, c in colours.items()}
        assert number == min(distances, key=lambda i: (distances[i], i))


def test_unlisted_ids_are_black_and_without_a_place() -> None:
    known = made({5: (10, 20, 30), 9: (1, 1, 1)})
    assert known.encode(np.array([6], np.uint8)).tolist() == [[0, 0, 0]]
    assert known.places[[5, 9, 6]].tolist() == [0, 1, VOID]
    assert [kind.name for kind in known.classes] == ["class 5", "class 9"]


@pytest.mark.parametrize(
    "items",
    [
        (),
        (OntologyItem(id=1, name="a", colour=(0, 0, 0)), OntologyItem(id=1, name="b", colour=(1, 0, 0))),
        (OntologyItem(id=1, name="a", colour=(0, 0, 256)),),
    ],
)
def test_an_impossible_ontology_is_refused(items: tuple[OntologyItem, ...]) -> None:
    with pytest.raises(DataError):
        Ontology(items)


def test_an_ontology_is_read_from_the_scene(tmp_path: Path) -> None:
    (tmp_path / "aa.json").write_text('{"other": 1}')
    (tmp_path / "bb.json").write_text(json.dumps(ontology()))
    assert [item.id for item in read_ontology(tmp_path).items] == [BOX, GROUND, SKY, 255]
    (tmp_path / "bb.json").unlink()
    with pytest.raises(FileFault, match=r"aa\.json is no ontology"):
        read_ontology(tmp_path)
