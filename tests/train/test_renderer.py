"""The renderer against geometry worked out by hand: places, depths, labels, hidden surfaces, light."""

import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_world import LIGHT
from headless import drawn, needs_egl

from gcd_model.geometry import Intrinsics
from gcd_train.errors import DataError, RenderError
from gcd_train.scenes.description import DOMES, ORBIT, STREET, Extent, Paint, Part, Pattern, Scene, Sheet, upright
from gcd_train.scenes.renderer import Renderer, Rendering
from gcd_train.scenes.triangles import CONVEX, SHAPES, FrozenScene, freeze, indexed, runs_of, shape, vertices_of

FORWARD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]])
"""world_from_camera of a level camera 1.5 m above the origin that looks along x."""


GREY = Paint((0.5, 0.5, 0.5))


def box(x: float, y: float, z: float, size: float = 1.0, **tags: int) -> Part:
    given = {"label": 8, "instance": 5, **tags}
    return Part("box", (x, y, z), (size, size, size), GREY, **given)


STEP_ASIDE = np.zeros((4, 4))
STEP_ASIDE[1, 3] = -5.0 * 10 / 48
"""To the right by 10 pixels on what is 5 m away."""


def scene(
    parts: list[Part], *, poses: Any = None, camera: Any = FORWARD, extent: Extent = STREET, focus: Any = (0, 0, 0)
) -> Scene:
    return Scene(
        parts=tuple(parts),
        sheets=(),
        poses=upright(np.zeros((1, 1, 4), np.float32) if poses is None else poses),
        focus=np.array([focus], np.float32),
        cameras={"camera": camera[None]},
        hfov_deg=90.0,
        light=LIGHT,
        extent=extent,
    )


def only(views: dict[str, Rendering]) -> Rendering:
    return Rendering(**{each.name: getattr(views["camera"], each.name)[0] for each in fields(Rendering)})


def draw(parts: list[Part], width: int = 96, height: int = 64, oversample: int = 1, **stage: Any) -> Rendering:
    return only(drawn(scene(parts, **stage), width, height, oversample))


def faces(corners: np.ndarray) -> np.ndarray:
    """Twice the area of each triangle, along the side from which its corners run anticlockwise: [N, 3]."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_fit_the_unit_cube_are_closed_and_face_outwards(name: str) -> None:
    corners, normals = shape(name)
    assert np.abs(corners).max() == pytest.approx(0.5, abs=0.075)
    assert ((faces(corners)[:, None] * normals).sum(-1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    if name in CONVEX:
        assert ((faces(corners) * corners.mean(1)).sum(-1) > 0).all()
    if name != "gable":  # which has no floor
        np.testing.assert_allclose(faces(corners).sum(0), 0, atol=1e-4)  # area vectors of a closed surface cancel
        assert 0.05 < (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6 < 1.001


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
    floor = Part("box", (10.0, 0.0, -0.5), (20.0, 20.0, 1.0), GREY, 1)
    roof = Part("box", (6.0, 0.0, 6.0), (4.0, 4.0, 0.2), GREY, 5)
    lit, shaded = draw([floor]), draw([floor, roof])
    both = (lit.classes == 1) & (shaded.classes == 1)
    darker = both & (shaded.rgb[..., 0].astype(int) < lit.rgb[..., 0].astype(int) - 20)
    assert 0.05 < darker.sum() / both.sum() < 0.6


@needs_egl
def test_the_sky_has_no_depth_and_its_own_class() -> None:
    dome = Part("ball", (0, 0, 0), (-900, 900, 900), Paint((1, 1, 1), pattern=Pattern.SKY), 0)
    shown = draw([dome, box(10.0, 0.0, 1.5)])
    assert shown.depth[0, 0] == 0
    assert shown.classes[0, 0] == 0
    assert shown.rgb[0, 0, 2] > shown.rgb[0, 0, 0]  # blue


@needs_egl
@pytest.mark.parametrize("pattern", DOMES)
def test_a_dome_has_its_distance_and_casts_no_shadow(pattern: Pattern) -> None:
    dome = Part("sphere", (0, 0, 0), (-80, 80, 80), Paint((0.7, 0.6, 0.5), pattern=pattern), 0)
    floor = box(10.0, 0.0, -9.0, size=18.0, label=1)
    alone, under = draw([floor], extent=ORBIT), draw([dome, floor], extent=ORBIT)
    rays = np.stack([*np.meshgrid((np.arange(96) - 47.5) / 48, (np.arange(64) - 31.5) / 48), np.ones((64, 96))], -1)
    points = under.depth[..., None] * (rays @ FORWARD[:3, :3].T) + FORWARD[:3, 3]
    background = under.classes == 0
    assert 0.2 < background.mean() < 0.9
    np.testing.assert_allclose(np.linalg.norm(points[background], axis=-1), 40.0, atol=0.4)  # it is made of triangles
    np.testing.assert_array_equal(under.rgb[under.classes == 1], alone.rgb[under.classes == 1])


@needs_egl
@pytest.mark.parametrize("pattern", [p for p in Pattern if p >= Pattern.WOOD and p not in DOMES])
def test_solid_paints_show_both_colours_and_stick_to_their_body(pattern: Pattern) -> None:
    wall = replace(box(0.0, 0.0, 0.0, size=6.0, body=1), paint=Paint((0.9, 0.1, 0.1), (0.1, 0.1, 0.9), pattern))
    poses = np.array([[[0, 0, 0, 0], [8.0, 0.0, 1.5, 0.0]]], np.float32)
    near, moved = draw([wall], poses=poses), draw([wall], poses=poses, camera=FORWARD + STEP_ASIDE)
    red, blue = (near.rgb[16:48, 24:72, channel].astype(int) for channel in (0, 2))
    assert (red > blue + 40).any()
    assert (red.max() - red.min()) > 40
    # the camera stepped aside by 10 pixels: the same paint, 10 pixels farther to the left
    difference = np.abs(near.rgb[16:48, 34:66].astype(int) - moved.rgb[16:48, 24:56].astype(int))
    assert np.median(difference) <= 2


@needs_egl
def test_a_bowl_is_hollow() -> None:
    tilt = (np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0)  # its opening, which is up, towards the camera
    bowl = Part("bowl", (6.0, 0.0, 1.5), (4, 4, 4), Paint((0.8, 0.8, 0.8)), 3, tilt)
    shown = draw([bowl])
    rim, bottom = shown.depth[shown.classes == 3].min(), shown.depth[32, 48]
    assert rim == pytest.approx(6.0 - 0.24 * 4, abs=0.05)
    assert bottom == pytest.approx(6.0 + 0.17 * 4, abs=0.05)


@needs_egl
def test_a_floor_alone_is_a_scene() -> None:
    corners = np.array([[(1, -50, 0), (90, 50, 0), (1, 50, 0)], [(1, -50, 0), (90, -50, 0), (90, 50, 0)]], np.float32)
    floor = Sheet(corners, GREY, 4)
    shown = only(drawn(replace(scene([]), sheets=(floor,)), 96, 64))
    assert (shown.classes[40:] == 4).all()
    np.testing.assert_allclose(shown.depth[40:, 48], 1.5 * 48 / (np.arange(40, 64) + 0.5 - 32), rtol=1e-4)


@needs_egl
def test_shadows_fall_within_the_extent_only() -> None:
    floor, roof = box(10.0, 0.0, -9.0, size=18.0, label=1), box(8.0, 0.0, 5.0, size=3.0, label=2)
    here, elsewhere = (draw([floor, roof], extent=ORBIT, focus=(x, 0.0, 0.0)) for x in (8.0, 50.0))
    darker = here.rgb.sum(-1, dtype=int) < elsewhere.rgb.sum(-1, dtype=int) - 60
    assert (here.classes[darker] == 1).all()
    assert darker.mean() > 0.005


@needs_egl
def test_oversampling_averages_colours_and_keeps_labels_whole() -> None:
    part = box(10.0, 2.0, 2.5)
    fine, smooth = draw([part], width=192, height=128), draw([part], oversample=2)
    mean = fine.rgb.reshape(64, 2, 96, 2, 3).mean((1, 3))
    np.testing.assert_array_equal(smooth.rgb, np.rint(mean))
    np.testing.assert_array_equal(smooth.depth, fine.depth[1::2, 1::2])
    assert set(np.unique(smooth.classes)) == {0, 8}
    assert set(np.unique(smooth.instances)) == {0, 5}


def test_vertices_that_neighbours_share_are_kept_once() -> None:
    vertices = vertices_of(scene([box(10.0, 0.0, 0.0), replace(box(5.0, 0.0, 0.0), shape="sphere")]))
    unique, indices = indexed(vertices)
    np.testing.assert_array_equal(unique[indices], vertices)
    assert len(unique) < len(vertices) / 4


def test_runs_cover_all_triangles_and_are_painted_alike() -> None:
    parts = [
        replace(box(float(i), 0.0, 0.0), paint=replace(GREY, pattern=p, gloss=i % 2))
        for i, p in enumerate((*Pattern, *Pattern))
    ]
    vertices = vertices_of(scene(parts))
    runs = runs_of(vertices)
    assert [run.first for run in runs] == [0, *np.cumsum([run.count for run in runs])[:-1]]
    assert sum(run.count for run in runs) == len(vertices)
    for run in runs:
        tags = vertices["tags"][run.first : run.first + run.count]
        assert set(tags[:, 3]) == {run.pattern}
    assert len(runs) < 2 * len(Pattern)  # the windows' glass shines, told or not
    assert runs_of(vertices[:0]) == []


def test_a_scene_survives_its_file(tmp_path: Path) -> None:
    kept = freeze(scene([box(10.0, 0.0, 0.0)], extent=ORBIT))
    with (tmp_path / "geometry.npz").open("wb") as file:
        kept.save(file)
    again = FrozenScene.load(tmp_path / "geometry.npz")
    assert (again.extent, again.light, again.hfov_deg) == (ORBIT, LIGHT, 90.0)
    np.testing.assert_array_equal(again.vertices, kept.vertices)
    np.testing.assert_array_equal(again.poses, kept.poses)


def test_a_scene_file_of_another_version_or_a_torn_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "geometry.npz"
    monkeypatch.setattr("gcd_train.scenes.triangles._FORMAT", 1)
    with path.open("wb") as file:
        freeze(scene([box(10.0, 0.0, 0.0)])).save(file)
    monkeypatch.undo()
    with pytest.raises(DataError, match=r"its format is 1.*generate the scene again"):
        FrozenScene.load(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DataError, match=r"geometry\.npz is no drawable scene"):
        FrozenScene.load(path)


@needs_egl
def test_renderers_beside_each_other_do_not_mix() -> None:
    world = freeze(scene([box(10.0, 2.0, 2.5)], poses=np.zeros((1, 1, 4), np.float32)))
    cameras = dict.fromkeys("ab", FORWARD[None])
    with Renderer(96, 64, oversample=1) as large, Renderer(48, 32, oversample=1) as small:
        pairs = list(zip(large.views(world, cameras), small.views(world, cameras), strict=True))
    alone = draw([box(10.0, 2.0, 2.5)])
    for (_, _, one), (_, _, other) in pairs:
        np.testing.assert_array_equal(one.rgb, alone.rgb)
        assert other.rgb.shape == (32, 48, 3)
        assert set(np.unique(other.classes)) == {0, 8}


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
