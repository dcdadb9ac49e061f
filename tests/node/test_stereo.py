"""Depth of a stereo pair: against ray-cast scenes, and of a real one."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fakes import HEIGHT, WIDTH, live_traits
from numpy.typing import NDArray

from gcd_model import CameraMount, Intrinsics
from gcd_node.errors import ConfigError, DepthError
from gcd_node.frame import Image, LensModel
from gcd_node.image_io import write_video
from gcd_node.offline import ClipRequest, read_clip
from gcd_node.preprocess import project
from gcd_node.sources.depth import OnnxDepth, clean_depth
from gcd_node.sources.stereo import StereoDepth

BASELINE_M, DISPARITY = 0.09, 10
FILMED = LensModel(width=384, height=256, fx=300.0, fy=300.0, cx=191.5, cy=127.5)
REAL = Path(__file__).parents[2].parent / "shared" / "real" / "oak-stereo"
SIZE = (320, 192)
IDEAL = LensModel(width=320, height=192, fx=260.0, fy=260.0, cx=159.5, cy=95.5)


TEXTURE = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (512, 512, 3)).astype(np.float32), (0, 0), 1.2)
TEXTURE = ((TEXTURE - TEXTURE.mean()) * 3 + 128).clip(0, 255)
FLOOR_Y, BACK_Z, BOX = 0.7, 4.0, (-0.35, 0.35, -0.4, 0.2, 1.6)  # left, right, top, bottom, depth


def cast(centre: NDArray[np.float64], rays: NDArray[np.float64]) -> tuple[Image, NDArray[np.float64]]:
    """A floor, a wall behind and a box, as rays [H, W, 3] from a point see them: the picture and the points hit."""
    with np.errstate(divide="ignore", invalid="ignore"):
        wall, box = (BACK_Z - centre[2]) / rays[..., 2], (BOX[4] - centre[2]) / rays[..., 2]
        floor = np.where(rays[..., 1] > 0, (FLOOR_Y - centre[1]) / rays[..., 1], np.inf)
    at = centre + rays * box[..., None]
    on_box = (at[..., 0] > BOX[0]) & (at[..., 0] < BOX[1]) & (at[..., 1] > BOX[2]) & (at[..., 1] < BOX[3])
    reach = np.where(on_box, box, np.minimum(wall, floor))
    points = centre + rays * reach[..., None]
    on_floor = ~on_box & (floor < wall)
    u, v = points[..., 0] * 90, np.where(on_floor, points[..., 2], points[..., 1]) * 90 + 130 * on_box
    wrapped = [np.mod(each, 511).astype(np.float32) for each in (u, v)]
    return cv2.remap(TEXTURE, *wrapped, cv2.INTER_LINEAR).round().astype(np.uint8), points


def taken_by(lens: LensModel, world_from_camera: NDArray[np.float64]) -> Image:
    """The scene as a distorting camera takes it: each pixel's ray is searched for until it projects there."""
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1).astype(np.float64)
    aim = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    rays = aim.copy()
    off = np.inf
    while off > 1e-3:
        away = pixels - project(lens, rays.reshape(-1, 2)).reshape(rays.shape)
        rays += away / (lens.fx, lens.fy)
        off = np.abs(away).max()
    ahead = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    return cast(world_from_camera[:3, 3], ahead @ world_from_camera[:3, :3].T)[0]


def truth(camera: Intrinsics, world_from_ideal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depth along the ideal camera's axis."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    _, points = cast(world_from_ideal[:3, 3], rays @ world_from_ideal[:3, :3].T)
    return (points - world_from_ideal[:3, 3]) @ world_from_ideal[:3, 2]


def step_errors(stereo: StereoDepth, depth: NDArray[Any], exact: NDArray[Any]) -> NDArray[Any]:
    """Of the known pixels, in pixels of disparity."""
    known = depth > 0
    return np.abs(1 / depth[known] - 1 / exact[known]) * stereo.lens.fx * stereo.baseline_m


def moved(x: float = 0.0, turn: Sequence[float] = (0.0, 0.0, 0.0), y: float = 0.0, z: float = 0.0) -> NDArray[Any]:
    """A rigid transform; turn: a rotation vector, degrees."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.radians(turn))[0], (x, y, z)
    return pose


RATIONAL = (1.9, -1.1, 3e-4, -2e-4, 0.35, 2.2, -0.85, 0.2, 0.0, 0.0, 0.0, 0.0, 0.004, -0.003)
BENT: Any = {"width": 640, "height": 400, "distortion": "rational_polynomial", "coefficients": RATIONAL}
LEFT_LENS = LensModel(fx=405.0, fy=404.0, cx=316.0, cy=204.0, **BENT)
RIGHT_LENS = LensModel(fx=409.0, fy=408.0, cx=327.0, cy=197.0, **BENT)
WORLD_FROM_LEFT = moved(0.0, (2.0, -1.0, 0.5))
WORLD_FROM_RIGHT = moved(0.09, (1.2, 1.3, -0.4), y=0.002, z=-0.001)


def camera_data(lens: LensModel, step: NDArray[Any] | None, onward: int) -> dict[str, Any]:
    """As DepthAI writes it; step: from this camera's axes to those of socket `onward`, metres; None is all zeros."""
    rotation, shift = (np.zeros((3, 3)), np.zeros(3)) if step is None else (step[:3, :3], step[:3, 3] * 100)
    return {
        "cameraType": 0,
        "width": lens.width,
        "height": lens.height,
        "intrinsicMatrix": [[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]],
        "distortionCoeff": list(lens.coefficients),
        "lensPosition": 0,
        "extrinsics": {
            "rotationMatrix": rotation.tolist(),
            "translation": dict(zip("xyz", shift.tolist(), strict=True)),
            "toCameraSocket": onward,
        },
    }


def board() -> dict[str, Any]:
    """A colour camera between the two, to which both lead: DepthAI chains cameras as it likes."""
    right, colour = WORLD_FROM_RIGHT, moved(0.04)
    return {
        "boardName": "made up",
        "cameraData": [
            [0, camera_data(LEFT_LENS, None, -1)],
            [1, camera_data(LEFT_LENS, np.linalg.inv(right) @ WORLD_FROM_LEFT, 2)],
            [2, camera_data(RIGHT_LENS, np.linalg.inv(colour) @ right, 0)],
        ],
    }


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def rectified_pose() -> NDArray[np.float64]:
    """Of the ideal camera in the world, by OpenCV itself."""
    step = np.linalg.inv(WORLD_FROM_RIGHT) @ WORLD_FROM_LEFT
    turn, *_ = cv2.stereoRectify(
        LEFT_LENS.matrix, np.zeros(5), RIGHT_LENS.matrix, np.zeros(5), (640, 400), step[:3, :3], step[:3, 3:]
    )
    pose = WORLD_FROM_LEFT.copy()
    pose[:3, :3] = WORLD_FROM_LEFT[:3, :3] @ turn.T
    return pose


@pytest.fixture(scope="module")
def pair() -> tuple[Image, Image]:
    return taken_by(LEFT_LENS, WORLD_FROM_LEFT), taken_by(RIGHT_LENS, WORLD_FROM_RIGHT)


@pytest.mark.parametrize("shrink", [1, 2])
def test_an_unrectified_pair_gives_depth_by_its_calibration(
    tmp_path: Path, pair: tuple[Image, Image], shrink: int
) -> None:
    path = written(tmp_path / "calib.json", board())
    stereo = StereoDepth.from_depthai(path, size=SIZE)
    small = (640 // shrink, 400 // shrink)
    left, depth = stereo(*(cv2.resize(each, small, interpolation=cv2.INTER_AREA) for each in pair))
    exact = truth(stereo.lens, rectified_pose())
    errors = step_errors(stereo, depth, exact)
    assert stereo.baseline_m == pytest.approx(0.09003, abs=1e-4)
    assert left.shape == (192, 320, 3)
    assert np.mean(depth > 0) > 0.7
    assert np.median(errors) < 0.25 / shrink
    assert np.mean(errors < 1.0) > 0.95


@pytest.mark.parametrize("axis", [0, 2], ids=["tilted", "rolled"])
def test_the_calibration_of_another_device_is_noticed(tmp_path: Path, pair: tuple[Image, Image], axis: int) -> None:
    off = moved(turn=[2.0 * (axis == each) for each in range(3)])
    content = board()
    step = off @ np.linalg.inv(WORLD_FROM_RIGHT) @ WORLD_FROM_LEFT
    content["cameraData"][1][1] = camera_data(LEFT_LENS, step, 2)
    stereo = StereoDepth.from_depthai(written(tmp_path / "calib.json", content), size=SIZE)
    for _ in range(2):
        with pytest.raises(DepthError):
            stereo(*pair)


WRONG: dict[str, Any] = {
    "toCameraSocket": -1,
    "rotationMatrix": [[0.0] * 3] * 3,
    "translation": {"x": 9.0, "y": 0.0, "z": 0.0},
    "intrinsicMatrix": [[405.0, 0, 9999.0], [0, 405, 200], [0, 0, 1]],
    "cameraType": 7,
    "width": "wide",
}


@pytest.mark.parametrize("key", [*WRONG, "none"])
def test_a_calibration_of_no_such_pair_is_refused_with_one_line(tmp_path: Path, key: str) -> None:
    content = board() if key in WRONG else {"cameraData": []}
    if key in WRONG:
        left = content["cameraData"][1][1]
        (left if key in left else left["extrinsics"])[key] = WRONG[key]
    path = written(tmp_path / "calib.json", content)
    with pytest.raises(ConfigError) as raised:
        StereoDepth.from_depthai(path, size=SIZE)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_pictures_the_calibration_is_not_for_are_refused_and_the_next_ones_taken() -> None:
    stereo = StereoDepth((IDEAL, IDEAL), moved(-0.05), size=SIZE)
    left, right = (taken_by(IDEAL, moved(x)) for x in (0.0, 0.05))
    for wrong in ((right, left), (left, right[:, :256])):  # swapped, and of another size
        with pytest.raises(DepthError):
            stereo(*wrong)
    assert stereo(left, right)[1].shape == (192, 320)


@pytest.mark.skipif(not REAL.is_dir(), reason="needs the OAK's pair in ../shared/real/oak-stereo")
def test_a_real_unrectified_pair_shows_a_floor_and_a_head_at_their_distance() -> None:
    pictures = []
    for side in ("left", "right"):
        capture = cv2.VideoCapture(str(REAL / f"{side}.mp4"))
        capture.set(cv2.CAP_PROP_POS_FRAMES, 510)
        read, picture = capture.read()
        assert read
        pictures.append(picture)
    stereo = StereoDepth.from_depthai(REAL / "calib.json", size=(384, 256))
    _, depth = stereo(*pictures)
    assert stereo.baseline_m == pytest.approx(0.0738, abs=1e-4)
    assert np.mean(depth > 0) > 0.8
    floor, head = depth[96:168, 36:144], depth[72:96, 186:210]
    assert np.median(floor[floor > 0]) == pytest.approx(2.7, abs=0.15)
    assert np.median(head[head > 0]) == pytest.approx(1.0, abs=0.1)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """left.mkv, right.mkv and calib.json of a camera before a wall."""
    folder = tmp_path_factory.mktemp("pair")
    wall = np.random.default_rng(1).integers(0, 256, (256, 384 + DISPARITY, 3)).astype(np.float32)
    wall = cv2.normalize(cv2.GaussianBlur(wall, (0, 0), 2.0), np.empty(0), 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    write_video(folder / "left.mkv", [np.ascontiguousarray(wall[:, :384])] * 14, 10.0)
    write_video(folder / "right.mkv", [np.ascontiguousarray(wall[:, DISPARITY:])] * 14, 10.0)
    left, right = camera_data(FILMED, moved(-BASELINE_M), 2), camera_data(FILMED, moved(), -1)
    written(folder / "calib.json", {"boardName": "made up", "cameraData": [[1, left], [2, right]]})
    return folder


@pytest.mark.parametrize("rectified", [False, True])
def test_a_stereo_pair_gives_its_rectified_left_picture_with_lens_and_depth(films: Path, rectified: bool) -> None:
    request = ClipRequest(depth=films / "right.mkv", calibration=films / "calib.json", rectified=rectified)
    clip = read_clip(films / "left.mkv", request, live_traits())
    depth, lens = clip.depth, clip.lens
    assert (lens.width, lens.height) == (WIDTH, HEIGHT)
    known = depth[depth > 0]
    assert len(known) > 0.6 * depth.numel()
    assert float(known.median()) == pytest.approx(FILMED.fx * BASELINE_M / DISPARITY, rel=0.06)


# Depth from elsewhere: as somebody measured it, or of a network of the user's, against planes.


MOUNT = CameraMount(height_m=1.4, tilt_deg=8.0, hfov_deg=80.0)


def network(
    path: Path,
    takes: Sequence[Any] = (1, 3, "high", "wide"),
    gives: Sequence[Any] = (1, "high", "wide"),
    *,
    channels: Sequence[int] = (1,),
    outputs: int = 1,
) -> Path:
    """An ONNX file whose depth is the mean of the colours: whatever a picture says. channels: the axes that the mean
    is of."""
    onnx = pytest.importorskip("onnx", reason="needs the extra `onnx`")
    pytest.importorskip("onnxruntime", reason="needs the extra `onnx`")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    keep, axes = int(len(gives) == 4), onnx.numpy_helper.from_array(np.array(channels, np.int64), "axes")
    names = [f"depth{i}" for i in range(outputs)]
    graph = helper.make_graph(
        [helper.make_node("ReduceMean", ["picture", "axes"], [name], keepdims=keep) for name in names],
        "depth",
        [helper.make_tensor_value_info("picture", kind, takes)],
        [helper.make_tensor_value_info(name, kind, gives) for name in names],
        [axes],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9), path)
    return path


def ground_inverse(width: int = 240, height: int = 160) -> NDArray[np.float64]:
    """1 / m of the ground below `MOUNT`, [H, W]; 0 above the horizon."""
    focal, tilt = width / 2 / math.tan(math.radians(40)), math.radians(8)
    v = (np.arange(height) + 0.5 - height / 2) / focal
    rows = (v * math.cos(tilt) + math.sin(tilt)) / 1.4
    return np.repeat(np.maximum(rows, 0)[:, None], width, axis=1)


def grey(values: NDArray[np.float64]) -> Image:
    """A picture that `network` turns into these values, 0 to 1."""
    return np.repeat(np.rint(values * 255).astype(np.uint8)[..., None], 3, axis=2)


def test_a_metric_network_is_taken_at_its_word(tmp_path: Path) -> None:
    white = np.mean((1 - np.array([0.485, 0.456, 0.406])) / [0.229, 0.224, 0.225])
    for gives, sides in (((1,), ("high", "wide")), ((1, 1), (70, 98))):
        path = network(tmp_path / "net.onnx", (1, 3, *sides), (*gives, *sides))
        depth = OnnxDepth(path, kind="metric")(np.full((160, 240, 3), 255, np.uint8))
        assert depth.shape == (160, 240)
        assert depth == pytest.approx(float(white), rel=1e-5)


@pytest.mark.parametrize(("a", "b"), [(1.6, -0.1), (0.9, 0.0)])
def test_the_ground_gives_relative_depth_its_scale_and_shift(tmp_path: Path, a: float, b: float) -> None:
    inverse = ground_inverse()
    inverse[60:150, 40:100] = 0.5  # somebody stands there
    y = (inverse - b) / a
    assert y.max() <= 1
    assert y.min() >= 0
    depth = OnnxDepth(network(tmp_path / "net.onnx"), kind="inverse", scale=MOUNT)(grey(y))
    near = inverse > 0.1
    assert np.mean(np.abs(depth[near] * inverse[near] - 1) < 0.03) > 0.97  # the rest are the edges of who stands there
    for tilt_deg in (-60.0, 8.0, 89.0):  # no ground that gives a scale
        mount = CameraMount(height_m=1.4, tilt_deg=tilt_deg, hfov_deg=20.0)
        with pytest.raises(DepthError):
            OnnxDepth(tmp_path / "net.onnx", kind="inverse", scale=mount)(grey(np.full((160, 240), 0.5)))


def test_what_is_no_such_network_or_lacks_a_scale_is_refused_in_a_line(tmp_path: Path) -> None:
    path = network(tmp_path / "net.onnx", (1, 3, 70, 98), (1, 70, 98))
    (tmp_path / "damaged.onnx").write_bytes(path.read_bytes()[:40])
    bad = [(tmp_path / name, "metric") for name in ("missing.onnx", "damaged.onnx")] + [(path, "inverse")]
    for name, other in (
        ("grey", {"takes": (1, 1, "high", "wide")}),
        ("colours out", {"gives": (1, 3, 1, "wide"), "channels": (2,)}),
        ("two outputs", {"outputs": 2}),
    ):
        bad.append((network(tmp_path / name, **other), "metric"))
    for file, kind in bad:
        with pytest.raises(ConfigError) as raised:
            OnnxDepth(file, kind=kind)
        assert "\n" not in str(raised.value)


def test_millimetres_become_metres_and_what_is_no_distance_a_hole_in_the_pictures_size() -> None:
    cleaned = clean_depth(np.array([[1250, 0, 65535]], np.uint16), (1, 3))
    assert cleaned == pytest.approx(np.array([[1.25, 0.0, 0.0]]))
    depth = np.array([[1.5, np.nan, np.inf], [-np.inf, -2.0, 5.0]], np.float16)
    cleaned = clean_depth(depth, (4, 6))
    assert (cleaned.dtype, cleaned.shape, set(np.unique(cleaned))) == (np.float32, (4, 6), {0.0, 1.5, 5.0})
    for wrong in (np.ones((4, 8)), np.ones((4, 6, 3)), np.ones((0, 6)), np.ones((4, 6), np.uint8)):
        with pytest.raises(DepthError) as raised:
            clean_depth(wrong if wrong.dtype == np.uint8 else wrong.astype(np.float32), (4, 6))
        assert ("\n" in str(raised.value), raised.value.exit_code) == (False, 65)
