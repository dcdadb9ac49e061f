"""What a calibration states, from ROS files and messages, and what no camera has."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gcd_node.errors import ConfigError
from gcd_node.frame import LensModel, depthai_lens, lens_of_message, load_lens

FILE = b"""# as cameracalibrator writes it
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [433.5, 0.0, 322.25, 0.0, 432.75, 241.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.35, 0.12, 1e-05, -2.5e-04, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [400, 0, 320, 0, 0, 400, 240, 0, 0, 0, 1, 0]
"""
K = (433.5, 0.0, 322.25, 0.0, 432.75, 241.5, 0.0, 0.0, 1.0)
P = (400.0, 0.0, 320.0, 0.0, 0.0, 401.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0)
INFO: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "model": "plumb_bob",
    "d": (-0.35, 0.12, 1e-5, -2.5e-4, 0.0),
    "k": K,
    "p": P,
}
LENS = LensModel(
    width=640, height=480, fx=433.5, fy=432.75, cx=322.25, cy=241.5,
    distortion="plumb_bob", coefficients=(-0.35, 0.12, 1e-5, -2.5e-4, 0.0),
)  # fmt: skip


def lens_of(**stated: Any) -> LensModel | None:
    """What a message states."""
    roi, binning = stated.pop("roi", (0, 0, 0, 0)), stated.pop("binning", (1, 1))
    part = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True)))
    rectified, model = stated.pop("rectified", False), stated.pop("model")
    sent = SimpleNamespace(distortion_model=model, binning_x=binning[0], binning_y=binning[1], roi=part, **stated)
    return lens_of_message(sent, rectified=rectified)


# --- files -------------------------------------------------------------------------------------------------------


def read(folder: Path, content: bytes) -> LensModel:
    (folder / "camera.yaml").write_bytes(content)
    return load_lens(folder / "camera.yaml")


def test_a_ros_file_and_the_message_of_the_same_camera_say_the_same(tmp_path: Path) -> None:
    assert read(tmp_path, FILE) == lens_of(**INFO) == LENS


def test_an_old_file_without_a_distortion_model_is_a_plumb_bob(tmp_path: Path) -> None:
    for model in (b"camera_model: pinhole\n", b""):
        assert read(tmp_path, FILE.replace(b"distortion_model: plumb_bob\n", model)) == LENS


@pytest.mark.parametrize(
    ("find", "put"),
    [
        (b"image_width: 640\n", b""),
        (b"image_width: 640", b"image_width: wide"),
        (b"image_width: 640", b"image_width: -640"),
        (b"plumb_bob", b"magic"),
        (b"-0.35, 0.12, ", b""),
        (b"433.5", b"0.0"),
        (b"433.5", b".nan"),
        (b"433.5, ", b""),
        (b"322.25", b"900"),
        (b"433.5, 0.0, 322.25, 0.0, 432.75, 241.5, 0.0, 0.0, 1.0", b"0,0,0,0,0,0,0,0,0"),
        (b"camera_matrix:", b"camera_matrix: ["),
        (b"# as", b"!!python/object/apply:os.system ['true']\n# as"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(find: bytes, put: bytes, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, FILE.replace(find, put, 1))
    assert "\n" not in str(caught.value)


def test_aliases_that_multiply_and_deep_nesting_end_in_an_error(tmp_path: Path) -> None:
    laughs = b"a: &a [x, x, x, x, x, x, x, x]\n"
    for here, there in zip("bcdefghijkl", "abcdefghijk", strict=True):
        laughs += f"{here}: &{here} [{', '.join(['*' + there] * 8)}]\n".encode()
    for text in (
        laughs,
        laughs + b"image_width: *l\n",
        b"[" * 1500,
        b"- " * 1500,
        b"image_width: &x [*x]\n",
        b"\xff\xfe\0",
    ):
        with pytest.raises(ConfigError):
            read(tmp_path, text)


def test_a_camera_nobody_calibrated_has_no_lens() -> None:
    assert lens_of(**INFO | {"k": (0.0,) * 9}) is None


def test_rectified_pictures_are_described_by_the_projection_matrix() -> None:
    lens = lens_of(**INFO, rectified=True)
    assert lens == LensModel(width=640, height=480, fx=400.0, fy=401.0, cx=320.0, cy=240.0)


@pytest.mark.parametrize(
    ("model", "d", "wanted"),
    [
        ("plumb_bob", (), ("none", 0)),
        ("plumb_bob", (0.0,) * 5, ("none", 0)),
        ("", (), ("none", 0)),
        ("plumb_bob", (0.1,) * 4, ("plumb_bob", 4)),
        ("plumb_bob", (0.1,) * 8, ("rational_polynomial", 8)),
        ("rational_polynomial", (0.1,) * 8, ("rational_polynomial", 8)),
        ("rational_polynomial", (0.1,) * 14, ("rational_polynomial", 14)),
        ("equidistant", (0.1,) * 4, ("equidistant", 4)),
        ("fisheye", (0.1,) * 4, ("equidistant", 4)),
        ("fisheye", (0.0,) * 4, ("none", 0)),  # undistorted already
        ("equidistant", (), ("none", 0)),
    ],
)
def test_names_of_distortion_become_ours(model: str, d: tuple[float, ...], wanted: tuple[str, int]) -> None:
    lens = lens_of(**INFO | {"model": model, "d": d})
    assert lens is not None
    assert (lens.distortion, len(lens.coefficients)) == wanted


def test_a_fish_eye_picture_that_depthai_has_undistorted_is_not_undistorted_again() -> None:
    lens = depthai_lens([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], [], "Fisheye", (640, 480))
    assert (lens.distortion, lens.coefficients) == ("none", ())


@pytest.mark.parametrize(
    ("model", "count"), [("plumb_bob", 3), ("rational_polynomial", 5), ("equidistant", 5), ("equidistant", 3)]
)
def test_a_wrong_number_of_coefficients_is_refused(model: str, count: int) -> None:
    with pytest.raises(ConfigError):
        lens_of(**INFO | {"model": model, "d": (0.1,) * count})


def test_a_part_of_the_picture_and_joined_pixels_move_the_axis() -> None:
    lens = lens_of(**INFO | {"roi": (100, 40, 400, 300), "binning": (2, 2)})
    assert lens is not None
    assert (lens.width, lens.height, lens.fx, lens.fy) == (200, 150, 433.5 / 2, 432.75 / 2)
    assert (lens.cx, lens.cy) == ((322.25 - 100 + 0.5) / 2 - 0.5, (241.5 - 40 + 0.5) / 2 - 0.5)


def test_resizing_moves_every_point_with_the_picture() -> None:
    small = LENS.resized(320, 240)
    point = np.array([0.2, -0.1, 1.0])
    u, v = (LENS.matrix @ point)[:2] + 0.5  # from the corner of the first pixel
    assert (small.matrix @ point)[:2] + 0.5 == pytest.approx([u / 2, v / 2])
    assert small.resized(640, 480) == LENS


def test_a_picture_of_another_shape_is_refused() -> None:
    with pytest.raises(ConfigError):
        LENS.resized(640, 360)


def test_missing_and_huge_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "huge.yaml").write_bytes(FILE + b"#" * 70_000)
    for path in (tmp_path / "none.yaml", tmp_path / "huge.yaml", tmp_path):
        with pytest.raises(ConfigError):
            load_lens(path)
