"""What a calibration states, from ROS files and messages, and what no camera has."""

from contextlib import nullcontext
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
D = (-0.35, 0.12, 1e-5, -2.5e-4, 0.0)
K = (433.5, 0.0, 322.25, 0.0, 432.75, 241.5, 0.0, 0.0, 1.0)
P = (400.0, 0.0, 320.0, 0.0, 0.0, 401.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0)
INFO: dict[str, Any] = {"width": 640, "height": 480, "model": "plumb_bob", "d": D, "k": K, "p": P}
SIZE: dict[str, Any] = {"width": 640, "height": 480}
LENS = LensModel(fx=433.5, fy=432.75, cx=322.25, cy=241.5, distortion="plumb_bob", coefficients=D, **SIZE)
LAUGHS = b"a: &a [x, x, x, x, x, x, x, x]\n" + b"".join(
    f"{here}: &{here} [{', '.join(['*' + there] * 8)}]\n".encode()
    for here, there in zip("bcdefghijkl", "abcdefghijk", strict=True)
)


def lens_of(**stated: Any) -> LensModel | None:
    """What a message states."""
    roi, binning = stated.pop("roi", (0, 0, 0, 0)), stated.pop("binning", (1, 1))
    part = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True)))
    rectified, model = stated.pop("rectified", False), stated.pop("model")
    sent = SimpleNamespace(distortion_model=model, binning_x=binning[0], binning_y=binning[1], roi=part, **stated)
    return lens_of_message(sent, rectified=rectified)


def read(folder: Path, content: bytes) -> LensModel:
    (folder / "camera.yaml").write_bytes(content)
    return load_lens(folder / "camera.yaml")


def test_a_ros_file_and_the_message_of_the_same_camera_say_the_same_and_an_old_file_is_a_plumb_bob(
    tmp_path: Path,
) -> None:
    assert read(tmp_path, FILE) == lens_of(**INFO) == LENS
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
        (FILE, FILE + b"#" * 70_000),
        *((FILE, text) for text in (LAUGHS, LAUGHS + b"image_width: *l\n", b"[" * 1500, b"- " * 1500)),
        *((FILE, text) for text in (b"image_width: &x [*x]\n", b"\xff\xfe\0")),
    ],
    ids=range(19),
)
def test_a_bad_file_is_refused_in_one_line(find: bytes, put: bytes, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, FILE.replace(find, put, 1))
    assert "\n" not in str(caught.value)
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(ConfigError):
            load_lens(path)


def test_rectified_pictures_are_described_by_the_projection_matrix_and_who_was_not_calibrated_by_nothing() -> None:
    assert lens_of(**INFO, rectified=True) == LensModel(fx=400.0, fy=401.0, cx=320.0, cy=240.0, **SIZE)
    assert lens_of(**INFO | {"k": (0.0,) * 9}) is None
    lens = depthai_lens([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], [], "Fisheye", (640, 480))
    assert (lens.distortion, lens.coefficients) == ("none", ())  # DepthAI has undistorted it


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
        # a wrong number of coefficients
        ("plumb_bob", (0.1,) * 3, None),
        ("rational_polynomial", (0.1,) * 5, None),
        ("equidistant", (0.1,) * 5, None),
        ("equidistant", (0.1,) * 3, None),
    ],
)
def test_names_of_distortion_become_ours(model: str, d: tuple[float, ...], wanted: tuple[str, int] | None) -> None:
    with nullcontext() if wanted else pytest.raises(ConfigError):
        lens = lens_of(**INFO | {"model": model, "d": d})
        assert lens is not None
        assert (lens.distortion, len(lens.coefficients)) == wanted


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
    with pytest.raises(ConfigError):
        LENS.resized(640, 360)
