"""What a memory of surfels keeps and drops when a newer frame looks at the same place."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gcd_model.geometry import Intrinsics
from gcd_model.live.eyes import remembered, unrefuted
from gcd_model.live.splat import Surfels, unproject

LENS = Intrinsics.from_hfov(70.0, 48, 32)
HERE = torch.eye(4, dtype=torch.float64)
PIXELS = LENS.width * LENS.height


def flat(z: float) -> Tensor:
    return torch.full((LENS.height, LENS.width), z)


def surfels(depth: Tensor, stamp: float, pose: Tensor = HERE, painted: bool = False) -> Surfels:
    colour = depth.expand(3, -1, -1) * 0
    return unproject(depth, colour, torch.zeros(depth.shape, dtype=torch.uint8), LENS, pose, stamp, painted)


def memory_of(*parts: Surfels, capacity: int = 10 * PIXELS, oldest_frames: int = 1000) -> Surfels:
    memory = Surfels.empty()
    for part in parts:
        memory = remembered(memory, part, capacity, oldest_frames)
    return memory


def updated(memory: Surfels, depth: Tensor, pose: Tensor, fresh: Surfels, known: Tensor | None = None) -> Surfels:
    known = torch.ones(LENS.height, LENS.width, dtype=torch.bool) if known is None else known
    return memory_of(unrefuted(memory, depth, LENS, pose, known), fresh)


@pytest.mark.parametrize("pitch", [0.0, 1.5])
def test_a_surface_seen_again_is_replaced(pitch: float) -> None:
    """Also on a street 1.5 m below, where the depth changes by half from row to row."""
    down = (torch.arange(LENS.height) + 0.5 - LENS.cy)[:, None].expand(LENS.height, LENS.width) / LENS.fy
    depth = torch.where(down > 0, pitch / down.clamp(min=1e-3), 0.0) if pitch else flat(5.0)
    nearer = HERE.clone()
    nearer[2, 3] = 0.4
    memory = memory_of(surfels(depth, stamp=0.0))
    again = depth if pitch else flat(4.6)
    memory = updated(memory, again, nearer, surfels(again, stamp=1.0, pose=nearer))
    old = memory.rows(memory.stamp == 0.0)
    x, y, z = (old.position - torch.tensor([0.0, 0.0, 0.4])).T
    inside = (z > 0.5) & ((LENS.fx * x / z).abs() < LENS.cx) & ((LENS.fy * y / z).abs() < LENS.cy)
    assert int(inside.sum()) == 0
    assert int((memory.stamp == 1.0).sum()) == int((again > 0).sum())


@pytest.mark.parametrize("behind", [9.0, 0.0, torch.inf])
def test_what_the_camera_sees_through_is_dropped(behind: float) -> None:
    memory = memory_of(surfels(flat(5.0), stamp=0.0))
    memory = updated(memory, flat(behind), HERE, Surfels.empty())
    assert len(memory) == 0


def test_a_hole_in_the_depth_proves_nothing() -> None:
    memory = memory_of(surfels(flat(5.0), stamp=0.0))
    known = torch.ones(LENS.height, LENS.width, dtype=torch.bool)
    known[:, :10] = False
    memory = updated(memory, flat(0.0), HERE, Surfels.empty(), known)
    assert len(memory) == 10 * LENS.height


def test_what_is_hidden_or_outside_the_picture_stays() -> None:
    first = surfels(flat(5.0), stamp=0.0)
    memory = memory_of(first)
    memory = updated(memory, flat(3.0), HERE, Surfels.empty())
    assert_close(memory.position, first.position)
    away = HERE.clone()
    away[0, 3] = 30.0
    memory = updated(memory, flat(9.0), away, Surfels.empty())
    memory = updated(memory, flat(9.0), torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])), Surfels.empty())  # looks back
    assert_close(memory.position, first.position)


def test_a_thing_that_passes_costs_the_wall_behind_it_nothing() -> None:
    memory = memory_of(surfels(flat(8.0), stamp=0.0))
    for step in range(1, 8):
        depth = flat(8.0)
        depth[8:24, 4 * step : 4 * step + 8] = 3.0
        static = unproject(depth, torch.zeros(3, *depth.shape), depth.byte(), LENS, HERE, float(step), keep=depth > 5.0)
        memory = updated(memory, depth, HERE, static)
        assert len(memory) == PIXELS


def test_over_capacity_the_oldest_go() -> None:
    memory = memory_of(*(surfels(flat(4.0), stamp=float(stamp)) for stamp in (2, 0, 1)), capacity=PIXELS + 5)
    assert len(memory) == PIXELS + 5
    assert int((memory.stamp == 2).sum()) == PIXELS
    assert int((memory.stamp == 1).sum()) == 5


def test_what_is_too_old_goes() -> None:
    memory = memory_of(*(surfels(flat(4.0), stamp=float(stamp)) for stamp in range(5)), oldest_frames=2)
    assert memory.stamp.unique().tolist() == [2.0, 3.0, 4.0]


def test_painted_stays_painted_until_it_is_seen() -> None:
    memory = memory_of(surfels(flat(5.0), stamp=0.0, painted=True))
    assert bool(memory.painted.all())
    memory = updated(memory, flat(5.0), HERE, surfels(flat(5.0), stamp=1.0))
    assert not bool(memory.painted.any())
