"""Crop, resize and intrinsics from the camera's picture to the network's."""

import cv2
import numpy as np
import pytest

from gcd_model import Intrinsics, center_crop_box
from gcd_node.errors import ConfigError
from gcd_node.preprocess import Fit, to_clip_tensor


def noise(width: int, height: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def test_the_released_fit_is_a_centre_crop_and_a_bilinear_resize() -> None:
    image = noise(640, 480)
    left, top, wide, high = center_crop_box(640, 480, 384 / 256)
    wanted = cv2.resize(image[top : top + high, left : left + wide], (384, 256), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_array_equal(Fit(width=384, height=256).image(image), wanted)


def test_area_averages_where_bilinear_aliases() -> None:
    checks = (np.indices((512, 768)).sum(axis=0) % 2 * 255).astype(np.uint8)
    image = np.repeat(checks[:, :, None], 3, axis=2)
    area = Fit(width=192, height=128, resize="area").image(image)
    assert np.abs(area.astype(float) - 127.5).max() <= 1


@pytest.mark.parametrize(("width", "height"), [(320, 240), (1000, 200), (383, 256)])
def test_too_small_a_picture_is_refused_unless_it_may_be_enlarged(width: int, height: int) -> None:
    with pytest.raises(ConfigError):
        Fit(width=384, height=256).image(noise(width, height))
    assert Fit(width=384, height=256, allow_upscale=True).image(noise(width, height)).shape == (256, 384, 3)


@pytest.mark.parametrize(("width", "height"), [(640, 480), (1280, 720), (576, 384)])
def test_a_marked_point_lands_where_the_fitted_intrinsics_project_it(width: int, height: int) -> None:
    source = Intrinsics.from_hfov(85.0, width, height)
    fit = Fit(width=192, height=128, resize="area")
    fitted = fit.intrinsics(source)
    u, v = round(width * 0.6), round(height * 0.4)
    image = np.zeros((height, width, 3), np.uint8)
    image[v - 4 : v + 4, u - 4 : u + 4] = 255
    rows, columns = np.nonzero(fit.image(image)[:, :, 0] > 64)
    seen = columns.mean() + 0.5, rows.mean() + 0.5
    x, y = (u - source.cx) / source.fx, (v - source.cy) / source.fy
    assert seen == pytest.approx((fitted.fx * x + fitted.cx, fitted.fy * y + fitted.cy), abs=0.75)


def test_the_clip_spans_minus_one_to_one() -> None:
    images = np.zeros((2, 4, 5, 3), np.uint8)
    images[1, 2, 3] = (255, 51, 0)
    clip = to_clip_tensor(images)
    assert (clip.shape, clip.dtype, clip.flags.c_contiguous) == ((2, 3, 4, 5), np.float32, True)
    np.testing.assert_allclose(clip[1, :, 2, 3], [1.0, -0.6, -1.0], atol=1e-6)
    assert clip[0].max() == -1.0
