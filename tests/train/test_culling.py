"""Views without what they cannot see: the pictures are the same, and less is drawn."""

from dataclasses import replace

import numpy as np
import pytest
from headless import needs_egl
from numpy.typing import NDArray
from stage_world import LIGHT

from gcd_train.scenes.description import STREET, Part, Pattern, Scene, Sheet, upright
from gcd_train.scenes.frozen import Groups, Vertices, grouped, runs_of, vertices_of
from gcd_train.scenes.renderer import Renderer, Rendering, clip_from_camera, sunlight_from_world

SUN_TO = (0.6, 0.0, 0.8)


def looking(x: float, y: float, z: float, ahead: tuple[float, float, float]) -> NDArray[np.float64]:
    """world_from_camera [4, 4] of a camera at a place that looks along `ahead`."""
    forward = np.array(ahead) / np.linalg.norm(ahead)
    right = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[2]) > 0.99 else (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = x, y, z
    return pose


CAMERAS = {
    "ahead": looking(0, 0, 1.5, (1, 0, 0)),
    "behind": looking(0, 0, 1.5, (-1, 0.1, -0.05)),
    "above": looking(5, 3, 25, (0, 0, -1)),
    "aside": looking(0, -30, 6, (0.2, 1, -0.2)),
    "upwards": looking(0, 0, 1.5, (1, 0, 0.8)),
}


def town() -> Scene:
    """Eighty things about the origin, a fifth of them on three bodies of which one drives off; ground; sky."""
    random = np.random.default_rng(5)
    shapes, patterns = ("box", "sphere"), (Pattern.PLAIN, Pattern.WINDOWS, Pattern.LEAVES)
    parts = [
        Part(
            shape=shapes[n % 2],
            centre=(*random.uniform(-60, 60, 2), random.uniform(0, 6)),
            size=tuple(random.uniform(0.5, 8, 3)),
            colour=tuple(random.uniform(0.1, 0.9, 3)),
            label=1 + n % 9,
            yaw=float(random.uniform(0, 6)),
            pattern=patterns[n % 3],
            gloss=float(n % 4 == 0),
            body=max(0, n % 16 - 12),
        )
        for n in range(80)
    ]
    sky = Part(shape="ball", centre=(0, 0, 0), size=(-900, 900, 900), colour=(1, 1, 1), label=0, pattern=Pattern.SKY)
    ground = np.array([[(-90, -90, 0), (90, -90, 0), (90, 90, 0)], [(-90, -90, 0), (90, 90, 0), (-90, 90, 0)]])
    rows = np.array([[[0, 0, 0, 0], [9, 4, 0, 1], [-20, 0, 1, 2], [step * 150, 8, 0, 0.3]] for step in (0, 1)])
    return Scene(
        parts=(*parts, sky),
        sheets=(Sheet(corners=ground.astype(np.float32), colour=(0.4, 0.4, 0.4), label=10),),
        poses=upright(rows.astype(np.float32)),
        focus=np.array([[0, 0, 0], [8, 0, 0]], np.float32),
        cameras={name: np.repeat(pose[None], 2, 0) for name, pose in CAMERAS.items()},
        hfov_deg=85.0,
        light=replace(LIGHT, sun_to=SUN_TO),
    )


@pytest.fixture(scope="module")
def parted() -> tuple[Vertices, Vertices, Groups]:
    vertices = vertices_of(town())
    return vertices, *grouped(vertices, runs_of(vertices))


def everything(groups: Groups, clip_from_world: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.bool_]:
    assert clip_from_world.shape == (4, 4)
    return np.ones(len(places), np.bool_)


@needs_egl
def test_a_view_without_what_it_cannot_see_is_the_same_to_the_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = town()
    with Renderer(96, 72, oversample=1) as renderer:
        culled = renderer.render(scene)
        monkeypatch.setattr(Groups, "within", everything)
        whole = renderer.render(scene)
    for name, views in whole.items():
        for ours, wanted in zip(culled[name], views, strict=True):
            for field in Rendering.__dataclass_fields__:
                np.testing.assert_array_equal(getattr(ours, field), getattr(wanted, field), err_msg=name)
        assert len(np.unique(views[0].classes)) > 1


def test_a_camera_draws_a_part_of_the_scene_only(parted: tuple[Vertices, Vertices, Groups]) -> None:
    _, _, groups = parted
    lens = clip_from_camera(85.0, 96 / 72, STREET)
    places = groups.placed(town().poses[0])
    drawn = {name: groups.within(lens @ np.linalg.inv(pose), places).mean() for name, pose in CAMERAS.items()}
    assert 0.02 < drawn["ahead"] < 0.5
    assert 0.02 < drawn["behind"] < 0.5
    assert drawn["above"] < 0.5
    assert drawn["upwards"] < 0.5


@pytest.mark.parametrize("step", [0, 1])
def test_no_corner_within_the_picture_is_left_out(parted: tuple[Vertices, Vertices, Groups], step: int) -> None:
    _, vertices, groups = parted
    scene = town()
    pose = scene.poses[step][vertices["tags"][:, 2]].astype(np.float64)
    corners = (pose[..., :3] @ vertices["position"].astype(np.float64)[..., None])[..., 0] + pose[..., 3]
    lens = clip_from_camera(85.0, 96 / 72, STREET)
    sun = sunlight_from_world(np.array(SUN_TO), scene.focus[step].astype(np.float64), STREET)
    for clip_from_world in (sun, *(lens @ np.linalg.inv(camera) for camera in CAMERAS.values())):
        clip = corners @ clip_from_world[:, :3].T + clip_from_world[:, 3]
        seen = (np.abs(clip[:, :3]) <= clip[:, 3:]).all(1)
        shown = groups.within(clip_from_world, groups.placed(scene.poses[step]))
        assert seen.any()
        assert np.repeat(shown, np.diff(groups.ends))[seen].all()


def test_groups_hold_every_triangle_once_within_its_run(parted: tuple[Vertices, Vertices, Groups]) -> None:
    before, after, groups = parted
    assert groups.ends[0] == 0
    assert groups.ends[-1] == len(before)
    assert (np.diff(groups.ends) > 0).all()
    assert runs_of(before) == runs_of(after)
    for run in runs_of(before):
        one, other = (v[run.first : run.first + run.count].reshape(-1, 3) for v in (before, after))
        assert sorted(row.tobytes() for row in one) == sorted(row.tobytes() for row in other)
    group = np.repeat(np.arange(len(groups.body)), np.diff(groups.ends))
    np.testing.assert_array_equal(after["tags"][:, 2], groups.body[group])
    away = np.linalg.norm(after["position"] - groups.centre[group], axis=1)
    assert (away < groups.radius[group]).all()


def test_stretches_are_what_is_shown_within_a_run() -> None:
    groups = Groups(
        ends=np.array([0, 3, 9, 12, 18, 21]), body=np.zeros(5, int), centre=np.zeros((5, 3)), radius=np.ones(5)
    )
    shown = np.array([True, True, False, True, True])
    assert list(groups.stretches(shown, 0, 21)) == [(0, 9), (12, 9)]
    assert list(groups.stretches(shown, 3, 15)) == [(3, 6), (12, 6)]
    assert list(groups.stretches(shown, 9, 3)) == []
    assert list(groups.stretches(~shown, 0, 21)) == [(9, 3)]


def test_a_scene_of_nothing_has_no_groups() -> None:
    vertices, groups = grouped(vertices_of(town())[:0], [])
    assert len(vertices) == 0
    assert groups.ends.tolist() == [0]
    assert groups.within(np.eye(4), groups.placed(town().poses[0])).tolist() == []
