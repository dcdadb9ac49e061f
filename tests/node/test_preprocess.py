"""From the camera's picture to the network's: crop and resize; undistortion and the cut to the model's field of view,
against formulas and against the slow, exact way."""

import math
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from cameras import calibration
from fakes import HEIGHT, WIDTH, fake_config, traits
from numpy.typing import NDArray

from gcd_model import Intrinsics, center_crop_box
from gcd_node.errors import ConfigError
from gcd_node.frame import Image, LensModel, SourceInfo, depthai_lens, lens_of_message, load_lens
from gcd_node.preprocess import Fit, Rectifier, project, to_clip_tensor, widest_camera
from gcd_node.stream_context import StreamContext, prepare_stream


def lens_of(width: int, height: int, kind: Any = "none", *coefficients: float, **matrix: float) -> LensModel:
    centre = {"fx": 300.0, "fy": 300.0, "cx": width / 2, "cy": height / 2}
    return LensModel(width=width, height=height, distortion=kind, coefficients=coefficients, **centre | matrix)


PLUMB = (-0.31, 0.11, 0.0007, -0.0004, -0.018)
BARREL = lens_of(1280, 720, "plumb_bob", *PLUMB, fx=820.0, fy=818.0, cx=652.3, cy=349.1)
WIDE = (2.1, -1.3, 0.0004, -0.0002, 0.6, 2.4, -1.0, 0.3)
RATIONAL = lens_of(1280, 800, "rational_polynomial", *WIDE, fx=800.0, fy=800.0, cy=405.0)
FISH_EYE = lens_of(1280, 960, "equidistant", 0.01, -0.004, 0.001, -0.0002, fx=560.0, fy=560.0)
IDEAL = lens_of(1280, 720, fx=900.0, fy=900.0, cx=639.5, cy=359.5)
ALL_LENSES = pytest.mark.parametrize("lens", [BARREL, RATIONAL, FISH_EYE, IDEAL], ids=lambda lens: lens.distortion)


def scene(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """A picture of what stands in each direction: straight stripes at several angles, 0 to 255, [..., 3]."""
    waves = [np.sin(40 * x), np.sin(40 * y), np.sin(28 * (x + y))]
    return np.stack([127.5 + 100 * wave for wave in waves], axis=-1)


def rays_of_pixels(lens: LensModel) -> NDArray[Any]:
    """x / z and y / z of every pixel, [H, W, 2]: the lens turned around by Newton's method, on formulas of its own."""
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    wanted = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy], axis=-1)
    rays = wanted.copy()
    for _ in range(30):
        rays = rays + 0.7 * (wanted - bend(lens, rays))
    return rays


def rectifier_of(
    lens: LensModel, *, width: int, height: int, hfov_deg: float | None, allow_upscale: bool = False
) -> Rectifier:
    return Rectifier(lens, widest_camera(lens, width, height, hfov_deg), allow_upscale=allow_upscale)


def bend(lens: LensModel, rays: NDArray[Any]) -> NDArray[Any]:
    """The formulas of the OpenCV manual, written out."""
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    if lens.distortion == "equidistant":
        r = np.sqrt(r2) + 1e-12
        angle = np.arctan(r)
        powers = sum(k * angle ** (2 * i + 2) for i, k in enumerate(lens.coefficients))
        return rays * (angle * (1 + powers) / r)[..., None]
    k1, k2, p1, p2, k3, k4, k5, k6 = (*lens.coefficients, *[0.0] * 8)[:8]
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    along_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    along_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([along_x, along_y], axis=-1)


@cache
def photograph(lens: LensModel) -> Image:
    rays = rays_of_pixels(lens)
    return np.rint(scene(rays[..., 0], rays[..., 1])).clip(0, 255).astype(np.uint8)


def ideal_photograph(camera: Intrinsics) -> NDArray[Any]:
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return scene((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)


def psnr(a: NDArray[Any], b: NDArray[Any]) -> float:
    return 10 * math.log10(255**2 / float(np.mean((a.astype(float) - b) ** 2)))


@ALL_LENSES
def test_pixels_lie_where_the_formulas_of_the_lens_say(lens: LensModel) -> None:
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    wanted = bend(lens, rays) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    np.testing.assert_allclose(project(lens, rays), wanted, atol=1e-6)


@ALL_LENSES
def test_straight_lines_become_straight_and_land_where_the_published_camera_says(lens: LensModel) -> None:
    lens = lens.resized(lens.width // 2, lens.height // 2)
    rectifier = rectifier_of(lens, width=192, height=128, hfov_deg=53.13)
    wanted = ideal_photograph(rectifier.camera)
    out = rectifier.image(photograph(lens))
    assert (out.shape, out.dtype) == ((128, 192, 3), np.uint8)
    inside = np.abs(out.astype(float) - wanted)[2:-2, 2:-2]
    assert inside.mean() < 2.0
    assert np.percentile(inside, 99.9) < 12.0


@ALL_LENSES
def test_a_narrow_lens_gives_the_widest_view_it_fills_to_the_last_pixel(lens: LensModel) -> None:
    camera = widest_camera(lens, 192, 128, 130.0)
    assert 50.0 < camera.hfov_deg < 129.0
    white = np.full((lens.height, lens.width, 3), 255, np.uint8)
    pixels: NDArray[Any] = np.stack(np.meshgrid(np.arange(192) + 0.5, np.arange(128) + 0.5), axis=-1).reshape(-1, 2)
    seen = project(lens, (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy))
    assert (seen > -1.6).all()
    assert (seen < np.array([lens.width, lens.height]) + 0.6).all()
    wider = Intrinsics.from_hfov(camera.hfov_deg + 1.0, 192, 128)
    corners = np.array([[x, y] for x in (0.0, 96.0, 192.0) for y in (0.0, 64.0, 128.0)])
    edge = project(lens, (corners - (wider.cx, wider.cy)) / (wider.fx, wider.fy))
    assert (edge < -1.5).any() or (edge > np.array([lens.width, lens.height]) + 0.5).any()
    out = rectifier_of(lens, width=192, height=128, hfov_deg=None).image(white)
    assert out.min() == 255


def test_a_polynomial_that_turns_back_is_not_followed_and_a_calibration_that_sees_nothing_refused() -> None:
    camera = widest_camera(lens_of(640, 480, "plumb_bob", -0.5, 0.0, 0.0, 0.0, 0.0), 384, 256, 120.0)
    turning_point = math.sqrt(1 / (3 * 0.5))  # where r (1 - r^2 / 2) is largest
    corner = math.hypot(camera.width / 2 / camera.fx, camera.height / 2 / camera.fy)
    assert 0.9 * turning_point < corner < 1.02 * turning_point
    with pytest.raises(ConfigError):
        widest_camera(lens_of(640, 480, "plumb_bob", -9e9, 0.0, 0.0, 0.0, 0.0, cx=0.0, cy=0.0), 384, 256, 53.0)


def detailed_texture(width: int, height: int) -> Image:
    """Noise at every scale down to single pixels, as grass and gravel have it."""
    rng, out = np.random.default_rng(3), np.full((height, width, 3), 127.0)
    for octave in range(8):
        layer = rng.normal(0, 14, (max(2, height >> octave), max(2, width >> octave), 3))
        out += cv2.resize(layer, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.rint(out).clip(0, 255).astype(np.uint8)


def exact(lens: LensModel, camera: Intrinsics, image: Image, times: int) -> Image:
    """Undistorted at `times` the wanted size, then averaged; times = 1 is straight to the wanted size."""
    fine = camera.resized(camera.width * times, camera.height * times)
    target = np.array([[fine.fx, 0, fine.cx - 0.5], [0, fine.fy, fine.cy - 0.5], [0, 0, 1]])
    size = (fine.width, fine.height)
    maps = cv2.initUndistortRectifyMap(lens.matrix, np.array(lens.coefficients), np.eye(3), target, size, cv2.CV_32FC1)
    big = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(big, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)


def test_twice_the_size_is_near_full_resolution_and_far_better_than_straight() -> None:
    image = detailed_texture(BARREL.width, BARREL.height)
    rectifier = rectifier_of(BARREL, width=384, height=256, hfov_deg=60.0)
    full = exact(BARREL, rectifier.camera, image, times=3)
    straight = exact(BARREL, rectifier.camera, image, times=1)
    ours = psnr(rectifier.image(image), full)
    assert ours > 34.0
    assert psnr(straight, full) < ours - 6.0
    rectifier = rectifier_of(BARREL, width=192, height=128, hfov_deg=53.13)  # another size of the same shape is taken
    small = photograph(BARREL.resized(640, 360))
    large = np.asarray(cv2.resize(small, (1280, 720), interpolation=cv2.INTER_CUBIC), np.uint8)
    assert psnr(rectifier.image(small), rectifier.image(large)) > 30.0


def camera_file(folder: Path, fx: float = 800.0) -> str:
    return f"source.calibration={calibration(folder, (1280, 720), fx)}"


def prepared(
    *changes: str, width: int = 1280, height: int = 720, lens: LensModel | None = None, before: Any = None
) -> StreamContext:
    size = {"width": width, "height": height}
    info = SourceInfo(kind="synthetic", id="x", fps_nominal=24.0, clock="replay", lens=lens, **size)
    return prepare_stream(fake_config(*changes), traits(), info, before=before)


def hfov_deg(context: StreamContext) -> float:
    return context.intrinsics.hfov_deg


def test_a_calibration_cuts_to_the_trained_field_of_view_and_a_narrow_one_is_flagged(tmp_path: Path) -> None:
    stated = camera_file(tmp_path)
    run = prepared(stated)
    assert hfov_deg(run) == pytest.approx(53.13)
    assert (run.fit.resize, run.ood) == ("remap2x_area", ())
    with pytest.raises(ConfigError):  # they contradict each other
        prepared(stated, "source.hfov_deg=60.0")
    camera_file(tmp_path, fx=2400.0)
    after = prepared(stated, width=640, height=360, before=run)  # a running node does not follow an edited file
    assert (after.lens, after.intrinsics) == (run.lens, run.intrinsics)
    run = prepared(stated)
    assert (run.ood, run.fit.resize) == (("hfov",), "remap2x_area")
    assert hfov_deg(run) < 30.0
    with pytest.raises(ConfigError):
        prepared(stated, "strict=true")


def test_a_stated_field_of_view_that_is_too_wide_is_cut_to_the_trained_one_where_pixels_are_left() -> None:
    for fps, flags in ((23.976, ()), (20.0, ("fps",))):  # a trained one but for rounding, and none
        run = prepared(f"window.fps={fps}")
        assert (run.fps, run.ood) == (fps, flags)
    run = prepared("source.hfov_deg=90.0")
    assert hfov_deg(run) == pytest.approx(53.13, abs=0.05)
    assert run.ood == ()
    assert run.fit.crop_box(1280, 720) == ((1280 - 640) // 2, (720 - 426) // 2, 640, 426)
    for allowed in (False, True):
        upscale = f"source.allow_upscale={str(allowed).lower()}"
        run = prepared("source.hfov_deg=90.0", upscale, width=WIDTH, height=HEIGHT)
        assert run.ood == (() if allowed else ("hfov",))
        assert hfov_deg(run) == pytest.approx(53.13 if allowed else 90.0, abs=1.0)


def test_a_calibration_for_another_shape_is_refused_at_the_start_and_left_out_in_mid_stream(tmp_path: Path) -> None:
    stated, square = camera_file(tmp_path), {"width": 640, "height": 480}
    with pytest.raises(ConfigError):
        prepared(stated, **square)
    before = prepared(stated)
    run = prepared(stated, before=before, **square)
    assert (run.fit.resize, run.ood) == ("released", ("hfov",))
    kept = prepared(stated, width=640, height=360, before=before)
    assert (kept.fit.resize, kept.ood) == ("remap2x_area", ())
    assert prepared(lens=BARREL, before=prepared(lens=BARREL), **square).ood == ("hfov",)


@ALL_LENSES
def test_depth_goes_where_its_picture_goes_and_nothing_between_is_made_up(lens: LensModel) -> None:
    near = np.add.outer(np.arange(lens.height) // 40, np.arange(lens.width) // 40) % 2 == 0
    fit = rectifier_of(lens, width=WIDTH, height=HEIGHT, hfov_deg=None)
    image = fit.image(np.repeat(np.where(near, 255, 0).astype(np.uint8)[..., None], 3, axis=2))[..., 0]
    depth = fit.depth(np.where(near, 2.0, 7.0).astype(np.float32))
    assert set(np.unique(depth)) <= {0.0, 2.0, 7.0}
    clear = (image < 5) | (image > 250)
    assert clear.mean() > 0.2
    assert np.mean(depth[clear] == np.where(image[clear] > 128, 2.0, 7.0)) > 0.995


# Without a lens.


def noise(width: int, height: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def test_the_released_fit_is_a_centre_crop_and_a_bilinear_resize_and_area_averages() -> None:
    image = noise(640, 480)
    left, top, wide, high = center_crop_box(640, 480, 384 / 256)
    wanted = cv2.resize(image[top : top + high, left : left + wide], (384, 256), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_array_equal(Fit(width=384, height=256).image(image), wanted)
    checks = np.repeat((np.indices((512, 768)).sum(axis=0) % 2 * 255).astype(np.uint8)[:, :, None], 3, axis=2)
    area = Fit(width=192, height=128, resize="area").image(checks)
    assert np.abs(area.astype(float) - 127.5).max() <= 1


def test_too_small_a_picture_is_refused_unless_it_may_be_enlarged_and_a_clip_spans_minus_one_to_one() -> None:
    for width, height in ((320, 240), (1000, 200), (383, 256)):
        with pytest.raises(ConfigError):
            Fit(width=384, height=256).image(noise(width, height))
        enlarged = Fit(width=384, height=256, allow_upscale=True).image(noise(width, height))
        assert enlarged.shape == (256, 384, 3)
    images = np.zeros((2, 4, 5, 3), np.uint8)
    images[1, 2, 3] = (255, 51, 0)
    clip = to_clip_tensor(images)
    assert (clip.shape, clip.dtype, clip.flags.c_contiguous) == ((2, 3, 4, 5), np.float32, True)
    np.testing.assert_allclose(clip[1, :, 2, 3], [1.0, -0.6, -1.0], atol=1e-6)
    assert clip[0].max() == -1.0


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


# What a calibration states, from ROS files and messages, and what no camera has.


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


def stated_lens(**stated: Any) -> LensModel | None:
    """What a message states."""
    roi, binning = stated.pop("roi", (0, 0, 0, 0)), stated.pop("binning", (1, 1))
    part = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True)))
    rectified, model = stated.pop("rectified", False), stated.pop("model")
    sent = SimpleNamespace(distortion_model=model, binning_x=binning[0], binning_y=binning[1], roi=part, **stated)
    return lens_of_message(sent, rectified=rectified)


def read(folder: Path, content: bytes) -> LensModel:
    (folder / "camera.yaml").write_bytes(content)
    return load_lens(folder / "camera.yaml")


def test_a_ros_file_and_the_message_of_the_same_camera_say_the_same(tmp_path: Path) -> None:
    assert read(tmp_path, FILE) == stated_lens(**INFO) == LENS
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
    assert stated_lens(**INFO, rectified=True) == LensModel(fx=400.0, fy=401.0, cx=320.0, cy=240.0, **SIZE)
    assert stated_lens(**INFO | {"k": (0.0,) * 9}) is None
    lens = depthai_lens([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], [], "Fisheye", (640, 480))
    assert (lens.distortion, lens.coefficients) == ("none", ())  # DepthAI has undistorted it


def test_names_of_distortion_become_ours() -> None:
    for model, d, wanted in (
        ("plumb_bob", (), ("none", 0)),
        ("plumb_bob", (0.1,) * 4, ("plumb_bob", 4)),
        ("plumb_bob", (0.1,) * 8, ("rational_polynomial", 8)),
        ("rational_polynomial", (0.1,) * 8, ("rational_polynomial", 8)),
        ("equidistant", (0.1,) * 4, ("equidistant", 4)),
        ("fisheye", (0.1,) * 4, ("equidistant", 4)),
        ("fisheye", (0.0,) * 4, ("none", 0)),  # undistorted already
        # a wrong number of coefficients
        ("plumb_bob", (0.1,) * 3, None),
        ("rational_polynomial", (0.1,) * 5, None),
        ("equidistant", (0.1,) * 5, None),
    ):
        with nullcontext() if wanted else pytest.raises(ConfigError):
            lens = stated_lens(**INFO | {"model": model, "d": d})
            assert (lens.distortion, len(lens.coefficients)) == wanted


def test_resizing_parts_and_joined_pixels_move_every_point_with_the_picture() -> None:
    small = LENS.resized(320, 240)
    point = np.array([0.2, -0.1, 1.0])
    u, v = (LENS.matrix @ point)[:2] + 0.5  # from the corner of the first pixel
    assert (small.matrix @ point)[:2] + 0.5 == pytest.approx([u / 2, v / 2])
    assert small.resized(640, 480) == LENS
    with pytest.raises(ConfigError):
        LENS.resized(640, 360)
    lens = stated_lens(**INFO | {"roi": (100, 40, 400, 300), "binning": (2, 2)})
    assert (lens.width, lens.height, lens.fx, lens.fy) == (200, 150, 433.5 / 2, 432.75 / 2)
    assert (lens.cx, lens.cy) == ((322.25 - 100 + 0.5) / 2 - 0.5, (241.5 - 40 + 0.5) / 2 - 0.5)
