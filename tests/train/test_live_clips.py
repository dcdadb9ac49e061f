"""Live clips: what is drawn is what the numbers say, and visibility is exact."""

from pathlib import Path

import numpy as np
import pytest
from headless import needs_egl
from hypothesis import given
from hypothesis import strategies as st
from live_clips import HEIGHT, HFOV_DEG, WIDTH, cast, looking_ahead, write_clip

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError
from gcd_train.live.clips import SKY_M, clip_paths, decode_depth, encode_depth, read_clip, tensor_of
from gcd_train.live.filming import generate_live, live_scene, visibility
from gcd_train.scenes.renderer import Rendering, stacked


@given(st.floats(0.03, 900.0))
def test_depth_survives_its_code_to_a_fiftieth_of_a_per_cent_and_no_depth_is_the_sky(metres: float) -> None:
    back, sky = decode_depth(tensor_of(encode_depth(np.array([metres, 0.0]))))
    assert abs(back / metres - 1) < 2e-4
    assert sky == SKY_M


def rendering(pose: np.ndarray) -> Rendering:
    rgb, depth, labels = cast(pose)
    nothing = np.zeros_like(labels)
    return Rendering(rgb=rgb, depth=depth.astype(np.float32), classes=labels, instances=nothing, bodies=nothing)


def states(sources: list[np.ndarray], targets: list[np.ndarray], bodies: np.ndarray | None = None) -> np.ndarray:
    cameras = {"source": np.stack(sources), "target": np.stack(targets)}
    views = stacked((0, name, rendering(p)) for name, some in cameras.items() for p in some)
    still = np.broadcast_to(np.eye(4)[:3], (len(sources), 1, 3, 4)) if bodies is None else bodies
    lenses = dict.fromkeys(views, Intrinsics.from_hfov(HFOV_DEG, WIDTH, HEIGHT))
    return visibility(views, cameras, lenses, still, SKY_M)


def test_a_camera_sees_all_of_its_own_view_and_not_what_a_box_hides() -> None:
    pose, above = looking_ahead(0.0, 1.5), looking_ahead(4.0, 8.0, 60.0)
    assert (states([pose], [pose]) == 2).all()
    seen = states([looking_ahead(0.0, 1.0, 5.0)], [above])[0]
    assert ((rendering(above).classes == 1) & (seen == 0)).any()
    assert (seen == 2).any()


def test_a_camera_that_turned_away_leaves_what_was_seen_before_unless_it_moved() -> None:
    here, away = looking_ahead(0.0, 1.5), looking_ahead(40.0, 1.5)
    both = states([here, away], [here, here])
    assert (both[0] == 2).all()
    assert (both[1][rendering(here).classes == 1] == 1).mean() > 0.9
    bodies = np.broadcast_to(np.eye(4)[:3], (2, 1, 3, 4)).copy()
    bodies[1, 0, 0, 3] = 0.5
    assert not (states([here, away], [here, here], bodies)[1] == 1).any()


def test_a_clip_is_read_as_it_was_written(tmp_path: Path) -> None:
    clip = read_clip(write_clip(tmp_path, 3), slice(4, 6))
    assert clip.name == "driving/0000003-0"
    pose = clip.poses("source")[0].numpy()
    assert len(clip.poses("source")) == 2
    assert np.abs(clip.depth("source")[0].numpy() - np.where((d := cast(pose)[1]) > 0, d, SKY_M)).max() < 0.3


def test_a_damaged_clip_and_a_folder_without_any_are_data_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        clip_paths(tmp_path)
    path = write_clip(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError):
        read_clip(path)


@needs_egl
def test_the_seed_decides_all_of_a_clip(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        there, failures = generate_live(tmp_path / folder, "driving", range(1), size=(64, 32))
        assert (there, failures) == (1, [])
    one, two = (read_clip(clip_paths(tmp_path / folder)[0]) for folder in ("one", "two"))
    assert all((one.arrays[name] == two.arrays[name]).all() for name in one.arrays)


@needs_egl
def test_most_of_the_targets_pixels_are_explained(tmp_path: Path) -> None:
    """Where a pixel counts as seen now, the source shows nearly its colour there."""
    generate_live(tmp_path, "driving", range(2), path="paper", size=(64, 32))
    for path in clip_paths(tmp_path):
        first = read_clip(path, slice(0, 1))  # the paper's path begins at the source
        assert (first.arrays["target.visibility"] == 2).all()
        assert (first.arrays["target.rgb"] == first.arrays["source.rgb"]).all()


def test_targets_keep_above_the_floor_and_differ_from_the_source() -> None:
    scene, draws = live_scene("driving", 5, "mixed")
    assert scene.frames == 14
    assert all(draw.cameras["target"].shape == (14, 4, 4) for draw in draws)
    assert all((draw.cameras["target"][:, 2, 3] > 0.3).all() for draw in draws)
