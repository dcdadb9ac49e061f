"""Training pairs out of scenes in the published layouts: what they show, and what happens to bad data."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scenes4d import (
    BOX,
    CAMERAS,
    COLOURS,
    DRIVING_LENS,
    GROUND,
    KUBRIC_LENS,
    SKY,
    VIEWS,
    draw,
    driving_pose,
    edit_json,
    write_driving,
    write_kubric,
)
from torch.utils.data import DataLoader

from gcd_model.geometry import SphericalDelta, to_pose
from gcd_train.data.dataset4d import VOID
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import DRIVING, MAX90, Control, FrameSampling, generator
from gcd_train.data.pictures import PictureOptions, ViewPairs, trained_lens, trained_picture
from gcd_train.data.sample import Sample, collate
from gcd_train.data.visibility import render_lens
from gcd_train.errors import DataError, RenderError

SIZE = (48, 32)
FRAMES = 6
CLIP = FrameSampling(clip=4)
ORBIT, PATH = replace(MAX90, frames=CLIP), replace(DRIVING, frames=CLIP)


@pytest.fixture(scope="module")
def driving_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_driving(tmp_path_factory.mktemp("driving"), 4, 9, frames=FRAMES).parent


@pytest.fixture
def two_scenes(driving_root: Path, tmp_path: Path) -> Path:
    """Scenes 4 and 9, which a test may damage."""
    shutil.copytree(driving_root, tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture(scope="module")
def kubric(tmp_path_factory: pytest.TempPathFactory) -> Kubric4D:
    return Kubric4D(write_kubric(tmp_path_factory.mktemp("kubric"), 3, frames=FRAMES).parent, cameras=VIEWS)


def driving_pairs(root: Path, repeats: int = 400, **options: object) -> ViewPairs:
    dataset, made = ParallelDomain4D(root, cameras=CAMERAS), PictureOptions(size=SIZE, **options)  # pyright: ignore
    return ViewPairs(dataset, PATH, 5, made, repeats=repeats)


def similar(one: np.ndarray, other: np.ndarray) -> float:
    """PSNR in dB."""
    return float(-10 * np.log10(np.mean((one.astype(float) - other) ** 2) / 255**2))


def test_a_kubric_pair_shows_the_scene_from_the_drawn_cameras(kubric: Kubric4D) -> None:
    sample = ViewPairs(kubric, ORBIT, 1, PictureOptions(size=SIZE)).sample(8)
    assert sample.source.shape == sample.target.shape == (4, 32, 48, 3)
    assert sample.start is not None
    assert sample.deltas is not None
    lens = render_lens(KUBRIC_LENS, *SIZE)
    for step in (1, 3):
        target = sample.start + SphericalDelta(
            azimuth_deg=float(sample.deltas[step, 0]),
            elevation_deg=float(sample.deltas[step, 1]),
            radius_m=float(sample.deltas[step, 2]),
        )
        time = sample.frame_numbers[step]
        source_truth = draw(to_pose(sample.start).numpy(), lens, time=time).rgb
        target_truth = draw(to_pose(target).numpy(), lens, time=time).rgb
        other_truth = draw(to_pose(target + SphericalDelta(azimuth_deg=45.0)).numpy(), lens, time=time).rgb
        assert similar(sample.source[step], source_truth) > 15  # what lies far away no camera sees sharply
        assert similar(sample.target[step], target_truth) > 15
        assert similar(sample.target[step], target_truth) > similar(sample.target[step], other_truth) + 2


def test_a_driving_source_is_the_cameras_own_picture(driving_root: Path) -> None:
    sample = driving_pairs(driving_root).sample(0)
    own = draw(driving_pose("yaw-0"), DRIVING_LENS, time=sample.frame_numbers[2], box_x=9.0).rgb
    np.testing.assert_array_equal(sample.source[2], trained_picture(own, *SIZE))
    np.testing.assert_allclose(sample.source_from_target[0], np.eye(4), atol=1e-6)
    assert sample.start is None
    assert sample.deltas is None


def test_the_trained_lens_is_that_of_the_trained_picture() -> None:
    pose = driving_pose("yaw-0")
    large = DRIVING_LENS.resized(480, 360)
    made = trained_picture(draw(pose, large, box_x=9.0).rgb, 96, 64)
    wanted = draw(pose, trained_lens(large, 96, 64), box_x=9.0).rgb
    np.testing.assert_array_equal(made, wanted)  # five times smaller: a pixel's middle is a pixel's middle


def test_classes_come_as_colours_and_as_ids(driving_root: Path) -> None:
    painted = driving_pairs(driving_root, modality="classes", class_ids=True).sample(1)
    coloured = driving_pairs(driving_root, class_ids=True).sample(1)
    assert painted.target_classes is not None
    assert coloured.target_classes is not None
    np.testing.assert_array_equal(painted.target_classes, coloured.target_classes)
    np.testing.assert_array_equal(painted.source, coloured.source)
    assert {BOX, GROUND} <= set(np.unique(painted.target_classes).tolist()) <= set(COLOURS)
    inside = painted.target_classes == GROUND
    assert np.abs(painted.target[inside].astype(int) - COLOURS[GROUND]).mean() < 12
    assert similar(painted.target, coloured.target) < 25
    truth = draw(driving_pose("yaw-0"), render_lens(DRIVING_LENS, *SIZE), box_x=9.0).ids
    assert np.mean(painted.target_classes[0] == truth) > 0.9


def test_no_edge_is_of_a_third_class_whose_colour_lies_between_and_holes_are_of_none(two_scenes: Path) -> None:
    between = [(one + other) // 2 for one, other in zip(COLOURS[BOX], COLOURS[GROUND], strict=True)]
    rider = {"id": 7, "name": "Rider", "color": dict(zip("rgb", between, strict=True))}
    for path in two_scenes.glob("*/ontology/*.json"):
        edit_json(path, lambda told: told["items"].insert(0, rider))
    ids = driving_pairs(two_scenes, class_ids=True).sample(1).target_classes
    assert ids is not None
    assert set(np.unique(ids).tolist()) == {BOX, GROUND, SKY, VOID}


def test_what_the_source_saw_is_all_at_first_and_less_later(kubric: Kubric4D, driving_root: Path) -> None:
    orbit = ViewPairs(kubric, ORBIT, 1, PictureOptions(size=SIZE, visible=True)).sample(8).visible
    path = driving_pairs(driving_root, visible=True).sample(8).visible
    assert orbit is not None
    assert path is not None
    assert orbit.shape == path.shape == (4, 32, 48)
    assert orbit[0].mean() > 0.8  # not where no camera looked
    assert path[0].mean() > 0.99
    assert 0.3 < orbit[-1].mean() < 1.0
    assert 0.3 < path[-1].mean() < 0.7


def test_workers_of_a_loader_give_what_one_process_gives(driving_root: Path) -> None:
    pairs = driving_pairs(driving_root, repeats=2)
    alone = [pairs.sample(index) for index in range(4)]
    loaded = list(DataLoader(pairs, batch_size=2, num_workers=2, collate_fn=collate))
    assert [[sample.scene for sample in batch.samples] for batch in loaded] == [["scene_000004", "scene_000009"]] * 2
    together = torch.cat([batch.target for batch in loaded])
    np.testing.assert_array_equal(together, np.stack([sample.target for sample in alone]))
    np.testing.assert_array_equal(loaded[0].samples[1].source_from_target, alone[1].source_from_target)
    assert loaded[0].samples[0].deltas is None


def cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def delete_scene(path: Path) -> None:
    shutil.rmtree(path.parents[2])


def no_depth(path: Path) -> None:
    path = path.parents[2] / "depth" / path.parent.name / f"{path.stem}.npz"
    np.savez(path, data=np.full((36, 48), np.nan, np.float32))


@pytest.mark.parametrize(
    ("damage", "match"),
    [
        (cut_off, "is damaged"),
        (Path.unlink, "is missing"),
        (delete_scene, "is missing|holds no JSON"),
        (no_depth, "NaN or negative"),
    ],
)
def test_a_bad_sample_is_replaced_counted_and_named(
    two_scenes: Path, damage: Callable[[Path], None], match: str
) -> None:
    pairs = driving_pairs(two_scenes)
    numbers = PATH.draw(generator(5, 0), FRAMES, 10.0).frame_numbers
    path = two_scenes / "scene_000004" / "rgb" / "camera0" / f"{10 * numbers[0] + 5:018d}.png"
    damage(path)
    sample = pairs.sample(0)
    assert isinstance(sample, Sample)
    assert len(sample.skipped) >= 1
    assert {skipped.scene for skipped in sample.skipped} == {"scene_000004"}
    assert pairs.skips.total == len(sample.skipped)
    first = sample.skipped[0]
    assert first.file.startswith(str(two_scenes / "scene_000004"))
    assert any(word in first.reason for word in match.split("|"))
    np.testing.assert_array_equal(pairs.sample(0).target, sample.target)  # the replacement is drawn, not chanced upon


def test_a_set_in_which_nothing_can_be_read_ends_with_the_last_faults(two_scenes: Path) -> None:
    pairs = driving_pairs(two_scenes)
    for path in two_scenes.glob("*/rgb/yaw-0/*.png"):
        cut_off(path)
    with pytest.raises(DataError, match=r"101 samples in a row cannot be read, the last: scene_00000\d: .*is damaged"):
        pairs.sample(0)
    assert pairs.skips.total == 101


def test_what_is_wrong_with_the_machine_is_not_blamed_on_the_data(
    driving_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cannot(*_: object) -> None:
        raise RenderError("no headless OpenGL")

    pairs = driving_pairs(driving_root)
    monkeypatch.setattr(pairs.dataset, "views", cannot)
    with pytest.raises(RenderError, match="no headless OpenGL"):
        pairs.sample(0)
    assert pairs.skips.total == 0


def test_a_control_is_followed_and_not_replaced(two_scenes: Path) -> None:
    pairs = driving_pairs(two_scenes)
    control = Control(name="sample_00", frame_start=1, frame_skip=1)
    assert pairs.controlled("scene_000009", control).frame_numbers == (1, 2, 3, 4)
    shutil.rmtree(two_scenes / "scene_000009" / "depth")
    with pytest.raises(DataError, match=r"depth/.*is missing"):
        pairs.controlled("scene_000009", control)


def test_classes_of_a_set_without_any_are_refused(kubric: Kubric4D) -> None:
    with pytest.raises(DataError, match="Kubric-4D has instances only"):
        ViewPairs(kubric, ORBIT, 0, PictureOptions(size=SIZE, modality="classes"))


def test_a_scene_without_its_class_layer_is_left_out(two_scenes: Path) -> None:
    shutil.rmtree(two_scenes / "scene_000004" / "semantic_segmentation_2d")
    sample = driving_pairs(two_scenes, modality="classes").sample(0)
    assert sample.scene == "scene_000009"
    assert "lacks its layer semantic_segmentation_2d" in sample.skipped[0].reason


def test_a_short_scene_is_left_out_by_name(two_scenes: Path) -> None:
    for path in (two_scenes / "scene_000004" / "rgb" / "yaw-0").iterdir():
        if int(path.stem) > 30:
            path.unlink()
    sample = driving_pairs(two_scenes).sample(0)
    assert sample.scene == "scene_000009"
    assert "is too short" in sample.skipped[0].reason
    assert sample.skipped[0].file == str(two_scenes / "scene_000004")
