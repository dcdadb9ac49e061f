"""Where two cameras stand in each other's axes, by pictures of a textured room rendered from known poses."""

from dataclasses import replace

import numpy as np
import pytest
from live_room import LENS as ROOM_LENS
from live_room import (
    one_thread,  # noqa: F401
    path,
    room,
)
from numpy.typing import NDArray
from test_live_ego_motion import HERE, LENS, filmed, pose
from torch import Tensor
from torch.testing import assert_close

from gcd_model import AlignmentError, Intrinsics, Landmarks, align, features, landmarks, load_synthesizer
from gcd_model.geometry import invert_rigid


def shown(world_from_camera: Tensor, arm_at: int | None = None) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Picture and depth, with a patch of other texture a metre away from column `arm_at` on."""
    picture, depth = filmed(world_from_camera)
    rgb = ((picture.permute(1, 2, 0).numpy() + 1) * 127.5).round().astype(np.uint8)
    metres = depth.numpy().copy()
    if arm_at is not None:
        noise = np.random.default_rng(5).integers(0, 255, (16, 4, 1), dtype=np.uint8)
        rgb[:, arm_at : arm_at + 24], metres[:, arm_at : arm_at + 24] = noise.repeat(8, 0).repeat(6, 1), 1.0
    return rgb, metres


def known(world_from_camera: Tensor, arm_at: int | None = None) -> Landmarks:
    rgb, metres = shown(world_from_camera, arm_at)
    return landmarks(rgb, LENS, metres, np.full(metres.shape, 0.02))


@pytest.mark.parametrize("arms", [(None, None), (20, 110)])
@pytest.mark.parametrize("there", [pose(), pose(0.02), pose(0.3, 0.2, 4.0), pose(-0.4, 0.0, -12.0)])
def test_the_pose_is_found_to_its_doubt_whatever_an_arm_does(
    there: Tensor, arms: tuple[int | None, int | None]
) -> None:
    here = pose(0.1, -0.1, 2.0)
    truth = invert_rigid(here) @ there
    found = align([known(here, arms[0])], [features(shown(there, arms[1])[0], LENS)])
    off = found.moved_from(truth)
    assert off.centimetres < 3.0 * off.doubt_centimetres + 0.5
    assert off.degrees < 3.0 * off.doubt_degrees + 0.1
    assert off.doubt_centimetres < 5.0  # of walls 3 to 8 m away
    assert off.doubt_degrees < 0.3
    assert off.pixels < 1.0
    move, step = found.moved_from(HERE), float(truth[:3, 3].norm())
    assert move.centimetres == pytest.approx(100 * step, abs=5.0)


@pytest.mark.parametrize("wrong", [(0.04, 0, 0), (0, 0.04, 0), (0, 0, 0.04)])
def test_the_doubt_covers_depths_that_are_wrong_together(wrong: tuple[float, float, float]) -> None:
    here, there = pose(), pose(0.5, 0.3, 3.0)
    rgb, metres = shown(here)
    across, along = np.meshgrid(np.linspace(-1, 1, LENS.width), np.linspace(-1, 1, LENS.height))
    metres *= 1 + wrong[0] + wrong[1] * across + wrong[2] * along
    found = align([landmarks(rgb, LENS, metres, np.full(metres.shape, 0.02))], [features(shown(there)[0], LENS)])
    off = found.moved_from(invert_rigid(here) @ there)
    assert off.centimetres < off.doubt_centimetres
    assert off.degrees < off.doubt_degrees


def test_pictures_of_another_size_and_lens_are_aligned_too() -> None:
    import cv2

    here, there = pose(), pose(0.2, 0.0, 3.0)
    picture = shown(there)[0][4:124, 20:180]
    lens = LENS.cropped(20, 4, 160, 120).resized(224, 168)
    large = np.asarray(cv2.resize(picture, (224, 168), interpolation=cv2.INTER_CUBIC), np.uint8)
    off = align([known(here)], [features(large, lens)]).moved_from(invert_rigid(here) @ there)
    assert off.degrees < 0.2
    assert off.centimetres < 4.0


def test_other_scenes_and_empty_pictures_are_refused() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (32, 48, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    rgb, metres = shown(pose())
    with pytest.raises(AlignmentError):
        align([known(pose())], [features(noise, LENS)])
    for picture, depth in ((np.zeros_like(rgb), metres), (rgb, np.zeros_like(metres))):
        with pytest.raises(AlignmentError):
            landmarks(picture, LENS, depth, np.full(metres.shape, 0.02))


def test_a_view_has_the_lens_and_the_size_of_its_path() -> None:
    made, clip, still = load_synthesizer("random:live").streaming(), room(1), path(frames=1)

    def rendered(lens: Intrinsics | None) -> Tensor:
        made.reset()
        [view] = made.render(made.encode(clip), [replace(still, lens=lens)])
        assert view.visibility is not None
        assert view.visibility.shape[1:] == view.video.shape[2:]
        return view.video

    assert_close(rendered(ROOM_LENS), rendered(None), atol=0, rtol=0)
    assert rendered(ROOM_LENS.cropped(12, 2, 40, 28)).shape[2:] == (28, 40)  # which no network takes as it is
