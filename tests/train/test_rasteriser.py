import math
import sys
from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gcd_model.geometry import Intrinsics, Spherical, to_pose
from gcd_train.evaluation import rasteriser
from gcd_train.evaluation.per_scene import Camera
from gcd_train.evaluation.rasteriser import DENSEST, FAINTEST, LOW_PASS, NEAREST_M, Gaussians, rasterised, rotations

NAMES = ("means", "quaternions", "scales", "opacities", "colours")
LENS = Intrinsics(fx=20.0, fy=22.0, cx=11.0, cy=7.0, width=21, height=13)  # no whole number of tiles
CAMERA = Camera(
    lens=LENS, world_from_camera=to_pose(Spherical(azimuth_deg=30.0, elevation_deg=20.0, radius_m=6.0)), time=0.0
)


def some(count: int, *, grown: float = 0.4, seed: int = 0) -> Gaussians:
    """About the middle of the picture, one behind the camera and one that is too faint among them."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(*size: int) -> Tensor:
        return torch.rand(*size, generator=generator, dtype=torch.float64)

    means, opacities = 4.0 * drawn(count, 3) - 2.0, drawn(count) ** 0.3
    means[0], opacities[1] = 2.0 * CAMERA.world_from_camera[:3, 3], 0.5 * FAINTEST
    return Gaussians(
        means=means,
        quaternions=drawn(count, 4) - 0.5,
        scales=grown * drawn(count, 3) + 0.02,
        opacities=opacities,
        colours=drawn(count, 3),
    )


def by_loops(of: Gaussians, camera: Camera) -> tuple[Tensor, Tensor]:
    """Colours [H, W, 3] and what light passes [H, W], pixel by pixel, Gaussian by Gaussian."""
    lens, pose = camera.lens, camera.world_from_camera
    found, at = [], torch.linalg.inv(pose)
    for mean, turn, scale, opacity, colour in zip(
        of.means, rotations(of.quaternions), of.scales, of.opacities, of.colours, strict=True
    ):
        x, y, z = at[:3, :3] @ mean + at[:3, 3]
        if z > NEAREST_M:
            u, v = float(lens.fx * x / z + lens.cx), float(lens.fy * y / z + lens.cy)
            u, v = (min(max(each, -0.15 * size), 1.15 * size) for each, size in ((u, lens.width), (v, lens.height)))
            rows = [[lens.fx / z, 0, (lens.cx - u) / z], [0, lens.fy / z, (lens.cy - v) / z]]
            jacobian = torch.tensor(rows, dtype=torch.float64) @ at[:3, :3] @ turn
            flat = jacobian @ torch.diag(scale**2) @ jacobian.T + LOW_PASS * torch.eye(2, dtype=torch.float64)
            middle = torch.stack([lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy])
            found.append((float(z), middle, torch.linalg.inv(flat), opacity, colour))
    colours = torch.zeros(lens.height, lens.width, 3, dtype=torch.float64)
    passed = torch.ones(lens.height, lens.width, dtype=torch.float64)
    for _, middle, inverse, opacity, colour in sorted(found, key=lambda each: each[0]):
        for row in range(lens.height):
            for column in range(lens.width):
                away = torch.tensor([column + 0.5, row + 0.5]) - middle
                alpha = min(float(opacity) * math.exp(-float(away @ inverse @ away) / 2), DENSEST)
                if alpha >= FAINTEST:
                    colours[row, column] += passed[row, column] * alpha * colour
                    passed[row, column] *= 1 - alpha
    return colours, passed


@pytest.mark.parametrize("count", [2, 12])
def test_tiles_show_what_a_loop_over_pixels_and_gaussians_shows(count: int) -> None:
    gaussians = some(count)
    drawn, (colours, passed) = rasterised(gaussians, CAMERA), by_loops(gaussians, CAMERA)
    assert_close(drawn.colours, colours, rtol=0, atol=1e-9)
    assert_close(drawn.passed, passed, rtol=0, atol=1e-9)
    assert (count > 2) == bool((passed < 0.9).any())


@pytest.mark.parametrize("seed", range(4))
def test_needles_are_drawn_in_single_precision_as_in_double(seed: int) -> None:
    """20 m long, 1 mm thick; one behind the camera."""
    scales = torch.tensor([20.0, 1e-3, 1e-3], dtype=torch.float64).expand(200, 3)
    needles = replace(some(200, seed=seed), scales=scales)
    single = Gaussians(**{name: getattr(needles, name).float() for name in NAMES})
    exact, drawn = rasterised(needles, CAMERA), rasterised(single, CAMERA)
    assert_close(drawn.passed.double(), exact.passed, rtol=0, atol=5e-3)


def test_a_ball_ahead_is_a_bump_of_its_size() -> None:
    camera = replace(CAMERA, world_from_camera=torch.eye(4, dtype=torch.float64))
    ball = Gaussians(
        means=torch.tensor([[0.0, 0.0, 5.0]]),
        quaternions=torch.tensor([[0.3, -2.0, 0.4, 1.0]]),
        scales=torch.full((1, 3), 0.5),
        opacities=torch.tensor([0.8]),
        colours=torch.tensor([[1.0, 0.5, 0.0]]),
    )
    x, y = torch.arange(LENS.width) + 0.5 - LENS.cx, torch.arange(LENS.height)[:, None] + 0.5 - LENS.cy
    wide, high = ((focal * 0.5 / 5.0) ** 2 + LOW_PASS for focal in (LENS.fx, LENS.fy))
    alpha = 0.8 * torch.exp(-(x**2 / wide + y**2 / high) / 2)
    assert_close(rasterised(ball, camera).passed, 1.0 - torch.where(alpha < FAINTEST, 0.0, alpha))


def test_a_quaternion_is_w_x_y_z_and_turns_to_the_world() -> None:
    """Against the exponential of its axis and angle."""
    x, y, z = axis = torch.nn.functional.normalize(torch.tensor([0.3, -2.0, 0.4]), dim=0)
    quaternion = torch.cat([torch.tensor([math.cos(0.35)]), math.sin(0.35) * axis])
    turning = 0.7 * torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    assert_close(rotations(3.0 * quaternion[None])[0], torch.linalg.matrix_exp(turning))


def test_its_gradient_is_that_of_its_picture() -> None:
    of = some(7, grown=0.8, seed=3)
    towards = torch.rand(LENS.height, LENS.width, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def weighed(*values: Tensor) -> Tensor:
        drawn = rasterised(Gaussians(**dict(zip(NAMES, values, strict=True))), CAMERA)
        return (torch.cat([drawn.colours, drawn.passed[..., None]], dim=-1) * towards).sum()

    assert torch.autograd.gradcheck(weighed, [getattr(of, name).requires_grad_() for name in NAMES], eps=1e-7)


def test_gsplat_that_is_there_and_cannot_draw_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = ModuleType("gsplat")  # as its source alone: no CUDA, nothing compiled
    broken.__spec__ = ModuleSpec("gsplat", None)
    monkeypatch.setitem(sys.modules, "gsplat", broken)
    rasteriser.has_gsplat.cache_clear()
    assert not rasteriser.has_gsplat(torch.device("cuda"))
    rasteriser.has_gsplat.cache_clear()


def test_gsplat_is_given_what_its_documentation_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        given.update(viewmats=viewmats, Ks=Ks, **options)
        drawn = rasteriser.rasterised_plainly(
            Gaussians(means=means, quaternions=quats, scales=scales, opacities=opacities, colours=colors), CAMERA
        )
        return drawn.colours[None], 1.0 - drawn.passed[None, ..., None], {"means2d": drawn.centres[None]}

    plain = rasterised(some(12), CAMERA)
    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    monkeypatch.setattr(rasteriser, "has_gsplat", lambda device: True)
    drawn = rasterised(some(12), CAMERA)
    assert_close((drawn.colours, drawn.passed, drawn.centres[0]), (plain.colours, plain.passed, plain.centres))
    assert_close(given["viewmats"][0] @ CAMERA.world_from_camera, torch.eye(4, dtype=torch.float64))
    assert_close(given["Ks"][0], LENS.matrix)
    assert (given["packed"], given["eps2d"], given["near_plane"]) == (False, LOW_PASS, NEAREST_M)
