import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tiny_scenes4d import draw as drawn_by_rays
from torch import Tensor
from torch.testing import assert_close

from gcd_model.geometry import Intrinsics, Spherical, Trajectory, relative_pose, to_pose
from gcd_train.data.sample import SceneView
from gcd_train.evaluation.gaussians import GaussianSplatting, MovedGaussians, first_points
from gcd_train.evaluation.hexplane import SPACE, TIME, HexPlane, HexPlanes, resampled
from gcd_train.evaluation.per_scene import Camera, PerScene, SceneBounds
from gcd_train.evaluation.predictors import CameraPair, SourceClip
from gcd_train.evaluation.rasteriser import NEAREST_M, rotations

LENS = Intrinsics.from_hfov(53.0, 24, 16)
FRAMES = 2
BOX_X = (-2.0, 2.0)
"""Where the box stands in the first and in the last frame."""
TINY = HexPlane(
    updates=60, rays=256, coarse=16, fine=12, features=6, hidden=24, sides=(12, 24), smoothness=1e-4, device="cpu"
)
TINY_GAUSSIANS = GaussianSplatting(updates=150, points=300, most=500, every=30, features=4, side=12, device="cpu")
SOURCE, HELD_OUT = (15.0, 20.0), (60.0, 20.0)
RING = [(105.0, 20.0), (330.0, 20.0), (50.0, 50.0), (30.0, 5.0)]


def pose_of(angles: tuple[float, float]) -> Tensor:
    return to_pose(Spherical(azimuth_deg=angles[0], elevation_deg=angles[1], radius_m=9.0))


def view(angles: tuple[float, float], frame: int = 0) -> SceneView:
    """A chequered ground and a box that moves."""
    pose = pose_of(angles).numpy()
    seen = drawn_by_rays(pose, LENS, box_x=BOX_X[frame])
    return SceneView(
        rgb=seen.rgb, depth=seen.depth, classes=seen.ids, instances=None, world_from_camera=pose, lens=LENS
    )


def video(angles: tuple[float, float]) -> list[SceneView]:
    return [view(angles, frame) for frame in range(FRAMES)]


def colours(views: list[SceneView]) -> Tensor:
    """[T, 3, H, W]."""
    return torch.from_numpy(np.stack([each.rgb for each in views])).permute(0, 3, 1, 2).float() / 255.0


def source_clip() -> SourceClip:
    """The box from a camera that stands; the view that is wanted stands too."""
    pose = relative_pose(pose_of(SOURCE), pose_of(HELD_OUT)).expand(FRAMES, 4, 4)
    path = Trajectory(source_from_target=pose)
    seen = video(SOURCE)
    return SourceClip(
        source=np.stack([each.rgb for each in seen]),
        source_depth=np.stack([each.depth for each in seen]),
        source_classes=None,
        cameras=CameraPair(ground_from_source=pose_of(SOURCE), source=LENS, target=LENS, trajectory=path),
        fps=12.0,
        key="scn1.sample_00",
        others=lambda count: [video(angles) for angles in RING[:count]],
    )


def psnr_db(one: Tensor, other: Tensor) -> float:
    return -10.0 * math.log10(float(((one - other) ** 2).mean()))


def test_each_plane_of_space_is_multiplied_with_the_plane_that_shares_no_axis_with_it() -> None:
    assert [set(one) | set(other) for one, other in zip(SPACE, TIME, strict=True)] == [{0, 1, 2, 3}] * 3
    planes = HexPlanes(features=1, side=4, moments=4, generator=torch.Generator().manual_seed(0))
    line = torch.linspace(-1, 1, 4)
    with torch.no_grad():
        planes.space.copy_(line.expand(4, 4) + 10.0 * line[:, None])
        planes.time.copy_(100.0 * line.expand(4, 4) + 1000.0 * line[:, None])
    x, y, z, t = 0.2, -0.4, 0.7, 0.5
    expected = [(x + 10 * y) * (100 * z + 1000 * t), (x + 10 * z) * (100 * y + 1000 * t)]
    expected += [(y + 10 * z) * (100 * x + 1000 * t)]
    assert_close(planes(torch.tensor([[x, y, z, t]]))[0], torch.tensor(expected), rtol=1e-4, atol=1e-2)


def test_samples_gather_where_the_light_is_and_keep_the_ends() -> None:
    edges = torch.linspace(0, 1, 11).expand(1, 11)
    share = F.one_hot(torch.tensor([6]), 10).float()
    found = resampled(edges, share, 20, None)
    assert (found.diff(dim=1) >= 0).all()
    assert_close(found[0, [0, -1]], torch.tensor([0.0, 1.0]))
    assert ((found > 0.6 - 1e-6) & (found < 0.7 + 1e-6)).sum() >= 18
    moved = resampled(edges, share, 20, torch.Generator().manual_seed(0))
    assert (moved.diff(dim=1) >= 0).all()
    assert not torch.equal(moved, found)


def test_the_cube_stands_where_cameras_of_an_orbit_look() -> None:
    poses = torch.stack([pose_of(angles) for angles in [SOURCE, *RING]])
    found = SceneBounds.around(poses)
    assert_close(found.centre, torch.tensor([0.0, 0.0, 1.0]), rtol=0, atol=0.02)
    assert found.half_m == pytest.approx(4.5, abs=0.01)
    assert found.begin == pytest.approx(0.6, abs=0.01)
    assert found.reach == pytest.approx(2.5, abs=0.01)


def made(method: PerScene, **options: object) -> Tensor:
    """The held-out view, [T, 3, H, W]."""
    return replace(method, **options).predict(source_clip()).video


both = pytest.mark.parametrize("method", [TINY, TINY_GAUSSIANS], ids=lambda each: each.stem)


@pytest.fixture(scope="module", params=[TINY, TINY_GAUSSIANS], ids=lambda each: each.stem)
def learnt(request: pytest.FixtureRequest) -> Tensor:
    """From the source and four more cameras."""
    return made(request.param, views=5)


def test_several_views_tell_what_another_camera_sees(learnt: Tensor) -> None:
    target, source = colours(video(HELD_OUT)), colours(video(SOURCE))
    one_colour = target.mean(dim=(2, 3), keepdim=True).expand_as(target)
    assert learnt.shape == target.shape
    assert psnr_db(learnt, target) > psnr_db(source, target) + 3.0
    assert psnr_db(learnt, target) > psnr_db(one_colour, target) + 0.5


def test_what_moves_is_where_it_is_at_each_moment(learnt: Tensor) -> None:
    target = colours(video(HELD_OUT))
    swapped = target.flip(0)
    moved = ((target - swapped).abs().sum(dim=1, keepdim=True) > 0.2).expand_as(target)
    assert psnr_db(learnt[moved], target[moved]) > psnr_db(learnt[moved], swapped[moved]) + 2.0


@both
def test_the_same_seed_learns_the_same_and_another_seed_something_else(method: PerScene) -> None:
    first, again, other = (made(method, updates=3, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_first_points_lie_where_other_cameras_see_the_same() -> None:
    poses = [pose_of((azimuth_deg, 50.0)) for azimuth_deg in (0.0, 90.0, 200.0)]
    pictures = []
    for pose in poses:
        camera = Camera(lens=LENS, world_from_camera=pose, time=-1.0)
        rays = camera.rays()
        ground = rays[:, :2] - rays[:, 2:3] / rays[:, 5:6] * rays[:, 3:5]  # no two places have the same colour
        shown = torch.cat([0.5 + ground / 30.0, torch.full_like(rays[:, :1], 0.5)], dim=1)
        pictures.append((shown.T.reshape(3, LENS.height, LENS.width), camera))
    points, shown = first_points(
        pictures, SceneBounds.around(torch.stack(poses)), 200, torch.Generator().manual_seed(0)
    )
    near = points[:, :2].norm(dim=1) < 2.0  # which all three see
    assert near.sum() > 20
    assert float((points[near, 2].abs() < 0.3).float().mean()) > 0.9
    assert_close(shown[near, :2], 0.5 + points[near, :2] / 30.0, rtol=0, atol=0.02)


# --- Gaussians that are taken away and doubled -----------------------------------------------------------------------


def scene_of(count: int, *, step: bool = False) -> tuple[MovedGaussians, torch.optim.Adam]:
    """Gaussians that show, and their optimiser, before or after its first step."""
    generator = torch.Generator().manual_seed(0)
    points, shown = (torch.rand(count, 3, generator=generator) for _ in range(2))
    bounds = SceneBounds(centre=torch.zeros(3), half_m=4.5, begin=0.6, reach=2.5)
    scene = TINY_GAUSSIANS.scene(points, shown, bounds, FRAMES, generator)
    optimiser = TINY_GAUSSIANS.optimiser(scene)
    if step:
        sum((value**2).sum() for value in scene.parameters()).backward()
        optimiser.step()
    return scene, optimiser


def renewed(scene: MovedGaussians, optimiser: torch.optim.Adam, pull: Tensor, most: int) -> None:
    TINY_GAUSSIANS.renew(scene, optimiser, pull, most, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("step", [False, True])
def test_what_is_kept_keeps_its_moments_and_twins_begin_anew(step: bool) -> None:
    scene, optimiser = scene_of(16, step=step)
    with torch.no_grad():
        scene.rest["opacities"][3] = -20.0
    before = {name: value.detach().clone() for name, value in scene.rest.items()}
    moments = {g["name"]: dict(optimiser.state[g["params"][0]]) for g in optimiser.param_groups if g["name"] in before}
    renewed(scene, optimiser, torch.arange(16.0), 17)
    kept = [number for number in range(16) if number != 3]
    for group in optimiser.param_groups:
        if group["name"] in before:
            (value,) = group["params"]
            assert value is scene.rest[group["name"]]
            assert len(value) == 16
            if group["name"] in ("opacities", "colours", "quaternions"):  # the last is doubled: it is pulled most
                assert_close(value.detach(), before[group["name"]][[*kept, 15]])
            for name, old in moments[group["name"]].items():
                if name != "step":
                    assert_close(optimiser.state[value][name], torch.cat([old[kept], torch.zeros_like(old[:1])]))


def test_halves_lie_as_the_whole_did() -> None:
    scene, optimiser = scene_of(4000)
    turned = torch.tensor([0.9, 0.1, -0.4, 0.2])
    with torch.no_grad():
        scene.rest["means"].zero_()
        scene.rest["quaternions"].copy_(turned.expand(4000, 4))
        scene.rest["scales"].copy_(torch.tensor([0.5, 0.1, 0.02]).log().expand(4000, 3))
        scene.rest["scales"][2000:] -= 1.0  # too small to be halved
    renewed(scene, optimiser, torch.arange(4000.0, 0.0, -1.0), 8000)
    means, scales = scene.rest["means"].detach(), scene.rest["scales"].detach().exp()
    assert_close(means[:500], -means[4000:])
    rotation = rotations(turned[None])[0]
    expected = rotation @ torch.diag(torch.tensor([0.5, 0.1, 0.02]) ** 2) @ rotation.T
    assert_close(means[4000:].T.cov(), expected, rtol=0.2, atol=2e-3)
    assert_close(scales[[0, 4000, 1000], 0], torch.tensor([0.5, 0.5, 0.8]) / torch.tensor([1.6, 1.6, 1.6]))
    assert not means[500:4000].any()


def test_a_scene_may_be_emptied_and_what_shows_at_a_time_alone_stays() -> None:
    scene, optimiser = scene_of(8, step=True)
    with torch.no_grad():
        scene.rest["opacities"].fill_(-20.0)
        scene.heads[3].bias.fill_(20.0)
    renewed(scene, optimiser, torch.zeros(8), 8)
    assert len(scene.rest["means"]) == 8
    with torch.no_grad():
        scene.heads[3].bias.zero_()
    for _ in range(2):
        renewed(scene, optimiser, torch.zeros(len(scene.rest["means"])), 8)
        assert len(scene.rest["means"]) == 0
        made, _ = scene.seen(Camera(lens=LENS, world_from_camera=pose_of(SOURCE), time=0.0), 0.0)
        made.sum().backward()
        optimiser.step()


def test_the_first_updates_after_the_warm_up_move_little() -> None:
    """Adam would move everything by its full rate, and the planes of space with it, where their gradient is nothing."""
    pictures = [
        (colours(video(each))[0], Camera(lens=LENS, world_from_camera=pose_of(each), time=-1.0)) for each in RING
    ]
    bounds = SceneBounds.around(torch.stack([camera.world_from_camera for _, camera in pictures]))
    shares = (replace(TINY_GAUSSIANS, updates=20, still=share, every=10) for share in (1.0, 0.94))
    still, begun = (each.learn(pictures, bounds, FRAMES).args[0] for each in shares)
    moved = (begun(-1.0).means - begun(None).means).norm(dim=1).mean()
    assert 0.0 < moved < 0.005 * bounds.half_m
    assert (begun.planes.space - still.planes.space).abs().max() < 0.002
    assert len(begun.rest["means"]) > TINY_GAUSSIANS.points  # some were doubled on the way


def test_a_camera_that_turns_in_place_learns_something() -> None:
    turned = torch.eye(4, dtype=torch.float64)
    turned[:2, :2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
    clip = source_clip()
    path = Trajectory(source_from_target=torch.stack([torch.eye(4, dtype=torch.float64), turned]))
    clip = replace(clip, cameras=replace(clip.cameras, trajectory=path))
    bounds = SceneBounds.around(clip.cameras.ground_from_source @ clip.cameras.source_from_target)
    assert bounds.reach * bounds.half_m > 2 * NEAREST_M  # there is room in which Gaussians are drawn
    made = replace(TINY_GAUSSIANS, updates=40).predict(clip).video
    assert psnr_db(made[0], colours(video(SOURCE))[0]) > 12.0
