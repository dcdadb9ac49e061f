import math

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


def test_a_matrix_survives_the_round_trip_in_single_precision_too() -> None:
    assert Intrinsics.from_matrix(CAMERA.matrix, 640, 480) == CAMERA
    assert Intrinsics.from_matrix(CAMERA.matrix.float(), 640, 480) == CAMERA
    assert CAMERA.matrix.dtype == torch.float64


def test_a_focal_length_of_one_picture_width_is_the_field_of_view_of_kubric() -> None:
    camera = Intrinsics(fx=384.0, fy=384.0, cx=192.0, cy=128.0, width=384, height=256)
    assert camera.hfov_deg == pytest.approx(53.13, abs=0.005)
    assert camera.hfov_deg == pytest.approx(math.degrees(2 * math.atan(0.5)))
    assert Intrinsics.from_hfov(camera.hfov_deg, 384, 256).fy / 256 == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((-1, 0, 10, 10), "stay inside the 640 x 480"),
        ((0, -1, 10, 10), "stay inside"),
        ((600, 0, 41, 10), "stay inside"),
        ((0, 471, 10, 10), "stay inside"),
        ((0, 0, 0, 10), "at least 1 x 1"),
    ],
)
def test_a_crop_must_stay_inside(box: tuple[int, int, int, int], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        CAMERA.cropped(*box)


@pytest.mark.parametrize(("fx", "fy"), [(0.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, math.inf)])
def test_focal_lengths_must_be_positive_and_finite(fx: float, fy: float) -> None:
    with pytest.raises(OptionError, match=r"positive|finite"):
        Intrinsics(fx=fx, fy=fy, cx=1.0, cy=1.0, width=2, height=2)


@pytest.mark.parametrize("hfov_deg", [0.0, -10.0, 180.0, math.nan])
def test_a_field_of_view_must_be_an_angle_a_plane_can_show(hfov_deg: float) -> None:
    with pytest.raises(OptionError, match="between 0 and 180"):
        Intrinsics.from_hfov(hfov_deg, 384, 256)


def test_a_picture_has_at_least_one_pixel() -> None:
    with pytest.raises(ShapeError, match="at least 1 x 1, got 0 x 256"):
        Intrinsics.from_hfov(50.0, 0, 256)
    with pytest.raises(ShapeError, match="at least 1 x 1"):
        CAMERA.resized(10, 0)


@pytest.mark.parametrize(("row", "column", "value"), [(0, 1, 3.0), (1, 0, 3.0), (2, 0, 0.1), (2, 2, 2.0)])
def test_a_matrix_of_another_kind_of_camera_is_refused(row: int, column: int, value: float) -> None:
    matrix = CAMERA.matrix
    matrix[row, column] = value
    with pytest.raises(OptionError, match="undistort"):
        Intrinsics.from_matrix(matrix, 640, 480)


def test_a_matrix_must_be_3_by_3() -> None:
    with pytest.raises(ShapeError, match=r"\[3, 3\], got \[4, 4\]"):
        Intrinsics.from_matrix(torch.eye(4), 640, 480)


# The crop to the trained shape


@pytest.mark.parametrize("aspect", [0.75, 1.0, 1.5, 16 / 9])
@pytest.mark.parametrize(("width", "height"), [(640, 480), (576, 384), (1920, 1080), (333, 777), (37, 11)])
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


@pytest.mark.parametrize("aspect", [0.0, -1.5, float("nan"), float("inf")])
def test_an_impossible_aspect_is_refused(aspect: float) -> None:
    with pytest.raises(OptionError, match="positive number"):
        center_crop_box(640, 480, aspect)
