import math
from collections.abc import Callable

import pytest
import torch
from kornia.geometry.camera import project_points
from torch import Tensor
from torch.testing import assert_close

from gcd_model.errors import OptionError, ShapeError
from gcd_model.geometry import Intrinsics, center_crop_box

CAMERA = Intrinsics(fx=400.0, fy=390.0, cx=310.0, cy=250.0, width=640, height=480)
POINTS = torch.tensor([[0.0, 0.0, 1.0], [0.7, -0.2, 2.0], [-1.5, 1.0, 4.0], [3.0, 2.0, 9.0]], dtype=torch.float64)


def pixels(camera: Intrinsics) -> Tensor:
    return project_points(POINTS, camera.matrix.expand(len(POINTS), 3, 3))


def test_projecting_then_resizing_is_resizing_then_projecting() -> None:
    scale = torch.tensor([384 / 640, 256 / 480], dtype=torch.float64)
    assert_close(pixels(CAMERA.resized(384, 256)), pixels(CAMERA) * scale)


def test_projecting_then_cropping_is_cropping_then_projecting() -> None:
    corner = torch.tensor([30.0, 17.0], dtype=torch.float64)
    assert_close(pixels(CAMERA.cropped(30, 17, 500, 400)), pixels(CAMERA) - corner)


@pytest.mark.parametrize("hfov_deg", [20.0, 53.13, 85.0, 150.0])
def test_a_field_of_view_survives_the_round_trip(hfov_deg: float) -> None:
    camera = Intrinsics.from_hfov(hfov_deg, 384, 256)
    assert camera.hfov_deg == pytest.approx(hfov_deg)
    assert camera.fx == camera.fy
    assert (camera.cx, camera.cy) == (192.0, 128.0)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: CAMERA.cropped(-1, 0, 10, 10), ShapeError),
        (lambda: CAMERA.cropped(0, 471, 10, 10), ShapeError),
        (lambda: CAMERA.cropped(0, 0, 0, 10), ShapeError),
        (lambda: CAMERA.resized(10, 0), ShapeError),
        (lambda: Intrinsics(fx=0.0, fy=1.0, cx=1.0, cy=1.0, width=2, height=2), OptionError),
        (lambda: Intrinsics(fx=1.0, fy=math.inf, cx=1.0, cy=1.0, width=2, height=2), OptionError),
        (lambda: Intrinsics.from_hfov(180.0, 384, 256), OptionError),
        (lambda: Intrinsics.from_hfov(math.nan, 384, 256), OptionError),
        (lambda: Intrinsics.from_hfov(50.0, 0, 256), ShapeError),
        (lambda: center_crop_box(640, 480, -1.5), OptionError),
        (lambda: center_crop_box(640, 480, math.nan), OptionError),
    ],
)
def test_what_no_pinhole_camera_is_is_refused(make: Callable[[], object], error: type[Exception]) -> None:
    with pytest.raises(error):
        make()


# The crop to the trained shape


@pytest.mark.parametrize("aspect", [0.75, 1.0, 1.5, 16 / 9])
@pytest.mark.parametrize(("width", "height"), [(640, 480), (333, 777), (37, 11)])
def test_the_crop_is_the_largest_centred_part_of_that_shape(width: int, height: int, aspect: float) -> None:
    left, top, kept_width, kept_height = center_crop_box(width, height, aspect, tolerance=0.0)
    assert kept_width == width or kept_height == height
    assert abs(kept_width - min(width, height * aspect)) < 1
    assert abs(kept_height - min(height, width / aspect)) < 1
    assert abs((width - kept_width) - 2 * left) <= 1
    assert abs((height - kept_height) - 2 * top) <= 1


@pytest.mark.parametrize(
    ("width", "height", "box"),
    [
        (640, 480, (0, 27, 640, 426)),  # ParallelDomain-4D, 4:3
        (576, 384, (0, 0, 576, 384)),  # Kubric-4D, already 3:2
        (1920, 1080, (150, 0, 1620, 1080)),
        (1080, 1920, (0, 600, 1080, 720)),
    ],
)
def test_recorded_crops_to_three_by_two(width: int, height: int, box: tuple[int, int, int, int]) -> None:
    assert center_crop_box(width, height, 1.5) == box
