"""The renderer against geometry worked out by hand: places, depths, labels, hidden surfaces, light."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from headless import needs_egl

from gcd_model.geometry import Intrinsics
from gcd_train.errors import RenderError
from gcd_train.scenes.description import Light, Part, Pattern, Scene, upright
from gcd_train.scenes.primitives import SHAPES, shape
from gcd_train.scenes.renderer import Renderer, Rendering

LIGHT = Light(
    sun_to=(0.0, 0.0, 1.0),
    sun=(1.0, 1.0, 1.0),
    sky=(0.4, 0.4, 0.4),
    ground=(0.2, 0.2, 0.2),
    horizon=(0.7, 0.8, 0.9),
    zenith=(0.3, 0.5, 0.8),
    fog_m=1e6,
    cloud=0.0,
    exposure=1.0,
)
FORWARD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
"""world_from_camera of a level camera 1.5 m above the origin that looks along x."""


def box(x: float, y: float, z: float, size: float = 1.0, **tags: int) -> Part:
    given = {"label": 8, "instance": 5, **tags}
    return Part(shape="box", centre=(x, y, z), size=(size, size, size), colour=(0.5, 0.5, 0.5), **given)


def draw(parts: list[Part], width: int = 96, height: int = 64, poses: np.ndarray | None = None) -> Rendering:
    scene = Scene(
        parts=tuple(parts),
        sheets=(),
        poses=upright(np.zeros((1, 1, 4), np.float32) if poses is None else poses),
        focus=np.zeros((1, 3), np.float32),
        cameras={"camera": FORWARD[None]},
        hfov_deg=90.0,
        light=LIGHT,
    )
    with Renderer(width, height) as renderer:
        return renderer.render(scene)["camera"][0]


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_fit_the_unit_cube_and_face_outwards(name: str) -> None:
    corners, normals = shape(name)
    assert np.abs(corners).max() == pytest.approx(0.5, abs=0.05)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((face * corners.mean(1)).sum(-1) > 0).all()
    assert ((face[:, None] * normals).sum(-1) > 0).all()


@needs_egl
def test_a_box_appears_where_the_pinhole_camera_sees_it() -> None:
    shown = draw([box(10.0, 2.0, 2.5)])
    camera = Intrinsics.from_hfov(90.0, 96, 64)
    rows, columns = np.nonzero(shown.classes == 8)
    near, half = 9.5, 0.5
    assert columns.min() == pytest.approx(camera.cx - camera.fx * (2.0 + half) / near, abs=1.0)
    assert columns.max() + 1 == pytest.approx(camera.cx - camera.fx * (2.0 - half) / (10 + half), abs=1.0)
    assert rows.min() == pytest.approx(camera.cy - camera.fy * (1.0 + half) / near, abs=1.0)
    assert (shown.instances[rows, columns] == 5).all()
    assert shown.depth[rows, columns].min() == pytest.approx(near, abs=1e-3)


@needs_egl
def test_the_nearer_box_hides_the_farther_one() -> None:
    for order in (1, -1):
        shown = draw([box(10.0, 0.0, 1.5, label=8), box(20.0, 0.0, 1.5, size=1.5, label=9)][::order])
        assert shown.classes[32, 48] == 8
        assert not (shown.classes == 9).any()


@needs_egl
def test_depth_is_along_the_axis_and_nothing_is_zero() -> None:
    shown = draw([box(10.0, 0.0, 0.0, size=18.0)])  # its near face fills the picture, 1 m ahead
    np.testing.assert_allclose(shown.depth[:60], 1.0, atol=2e-3)
    assert (draw([box(-10.0, 0.0, 0.0)]).depth == 0).all()


@needs_egl
def test_bodies_carry_their_parts() -> None:
    poses = np.array([[[0, 0, 0, 0], [10.0, 2.0, 2.5, 0.0]]], np.float32)
    moved, placed = draw([box(0.0, 0.0, 0.0, body=1)], poses=poses), draw([box(10.0, 2.0, 2.5)])
    np.testing.assert_array_equal(moved.rgb, placed.rgb)


@needs_egl
def test_a_roof_casts_a_shadow() -> None:
    floor = Part(shape="box", centre=(10.0, 0.0, -0.5), size=(20.0, 20.0, 1.0), colour=(0.5, 0.5, 0.5), label=1)
    roof = Part(shape="box", centre=(6.0, 0.0, 6.0), size=(4.0, 4.0, 0.2), colour=(0.5, 0.5, 0.5), label=5)
    lit, shaded = draw([floor]), draw([floor, roof])
    both = (lit.classes == 1) & (shaded.classes == 1)
    darker = both & (shaded.rgb[..., 0].astype(int) < lit.rgb[..., 0].astype(int) - 20)
    assert 0.05 < darker.sum() / both.sum() < 0.6


@needs_egl
def test_the_sky_has_no_depth_and_its_own_class() -> None:
    dome = Part(
        shape="ball",
        centre=(0, 0, 0),
        size=(-900, 900, 900),
        colour=(1, 1, 1),
        label=0,
        instance=0,
        pattern=Pattern.SKY,
    )
    shown = draw([dome, box(10.0, 0.0, 1.5)])
    assert shown.depth[0, 0] == 0
    assert shown.classes[0, 0] == 0
    assert shown.rgb[0, 0, 2] > shown.rgb[0, 0, 0]  # blue


@needs_egl
def test_too_many_bodies_are_refused() -> None:
    with pytest.raises(RenderError, match="256 bodies, got 300"):
        draw([box(10.0, 0.0, 0.0)], poses=np.zeros((1, 300, 4), np.float32))


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(RenderError, match=r"gcd-node\[scenes\]"):
        Renderer(16, 16)


def test_without_egl_the_system_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    moderngl = pytest.importorskip("moderngl", reason="needs the extra scenes")

    def broken(**_: str) -> None:
        raise RuntimeError("libEGL.so.1 not found")

    monkeypatch.setattr(moderngl, "create_standalone_context", broken)
    with pytest.raises(RenderError, match="libegl1 libgl1-mesa-dri"):
        Renderer(16, 16)


def test_placing_a_part_turns_it_about_the_vertical() -> None:
    part = replace(box(1.0, 0.0, 0.5), yaw=0.25).placed(10.0, 20.0, 0.0, np.pi / 2)
    assert part.centre == pytest.approx((10.0, 21.0, 0.5))
    assert part.yaw == pytest.approx(0.25 + np.pi / 2)
