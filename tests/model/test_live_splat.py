"""Laws of the splatter, what a moved camera sees of surfaces whose picture is a formula; and of the memory of them."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gcd_model.geometry import Intrinsics
from gcd_model.live.eyes import remembered, unrefuted
from gcd_model.live.paint_net import crisp
from gcd_model.live.splat import Splat, Surfels, splat, unproject

LENS = Intrinsics.from_hfov(70.0, 96, 64)
HERE = torch.eye(4, dtype=torch.float64)
CLASSES = 4


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, pitch_deg: float = 0.0, yaw_deg: float = 0.0) -> Tensor:
    """A camera moved in its own axes, then turned; a positive pitch looks down."""
    pitch, yaw = math.radians(pitch_deg), math.radians(yaw_deg)
    tilt = torch.tensor([[1, 0, 0], [0, math.cos(pitch), math.sin(pitch)], [0, -math.sin(pitch), math.cos(pitch)]])
    turn = torch.tensor([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    pose = HERE.clone()
    pose[:3, :3] = turn.double() @ tilt.double()
    pose[:3, 3] = torch.tensor([x, y, z])
    return pose


def texture(x: Tensor, y: Tensor) -> Tensor:
    """A smooth pattern of points of a plane, [3, H, W] in [-1, 1]."""
    return torch.stack([torch.sin(3 * x), torch.cos(4 * y), torch.sin(2 * x + 3 * y)])


def wall(z: float, colour: Tensor | None = None, label: int = 0, stamp: float = 0.0, **more: bool | Tensor) -> Surfels:
    """A fronto-parallel wall at z, textured by default."""
    right, down = LENS.rays()
    shown = texture(right * z, down * z) if colour is None else colour.view(3, 1, 1).expand(3, *right.shape)
    labels = torch.full(right.shape, label, dtype=torch.uint8)
    return unproject(torch.full_like(right, z), shown, labels, LENS, HERE, stamp, **more)


def seen(surfels: Surfels, pose: Tensor = HERE, now: float = 0.0) -> Splat:
    return splat(surfels, pose, LENS, CLASSES, now)


def band(first: int, last: int) -> Tensor:
    """Columns first to last as a mask [H, W]."""
    column = torch.arange(LENS.width).expand(LENS.height, LENS.width)
    return (column >= first) & (column < last)


def test_the_same_camera_gets_its_picture_back() -> None:
    torch.manual_seed(0)
    size = (LENS.height, LENS.width)
    depth = 1 + 50 * torch.rand(size)
    depth[10:20, 30:40] = torch.tensor([0.0, -1.0, torch.nan, torch.inf, 0.0]).repeat(2)
    colour, label = torch.rand(3, *size) * 2 - 1, torch.randint(CLASSES, size, dtype=torch.uint8)
    there = depth.isfinite() & (depth > 0)
    pose = moved(3.0, -2.0, 5.0, pitch_deg=20.0, yaw_deg=-70.0)
    out = splat(unproject(depth, colour, label, LENS, pose, stamp=7.0), pose, LENS, CLASSES, now=7.0)
    assert_close(out.colour * there, colour * there, atol=1e-3, rtol=0)
    assert_close(out.inverse_depth[there], 1 / depth[there], atol=1e-3, rtol=1e-3)
    assert_close(out.coverage, there.float(), atol=1e-3, rtol=0)
    assert bool((out.votes.argmax(0) == label)[there].all())
    assert bool((out.now_share[there] == 1).all())


@pytest.mark.parametrize("magnified", [0.5, 1.0, 3.0])
def test_a_wall_seen_from_nearer_or_farther_is_resampled_without_holes(magnified: float) -> None:
    near, (right, down) = 6.0 / magnified, LENS.rays()
    out = seen(wall(6.0), moved(0.1, -0.05, 6.0 - near))
    inside = (right.abs() < 0.9 * LENS.cx / LENS.fx * min(1, magnified)) & (
        down.abs() < 0.9 * LENS.cy / LENS.fy * min(1, magnified)
    )
    truth = texture(right * near + 0.1, down * near - 0.05)
    assert bool((out.coverage[inside] > 0.98).all())
    assert float((out.colour - truth).abs()[:, inside].mean()) < 0.02
    assert_close(out.inverse_depth[inside], torch.full_like(out.inverse_depth[inside], 1 / near), rtol=1e-4, atol=0)


@pytest.mark.parametrize("yaw_deg", [-50.0, 35.0])
def test_a_wall_seen_at_an_angle_keeps_its_texture_and_its_depth(yaw_deg: float) -> None:
    turn = moved(yaw_deg=yaw_deg)[:3, :3].float()
    pose = moved(-4 * math.tan(math.radians(yaw_deg)), 0.0, 0.0, yaw_deg=yaw_deg)
    out = seen(wall(4.0), pose)
    right, down = LENS.rays()
    x, y, z = (turn @ torch.stack([right, down, torch.ones_like(right)]).view(3, -1)).view(3, *right.shape)
    away = torch.where(z > 0.2, 4 / z, 100.0)  # along the optical axis of the turned camera
    x, y = away * x + pose[0, 3].float(), away * y
    inside = (x.abs() < 0.9 * 4 * LENS.cx / LENS.fx) & (y.abs() < 0.9 * 4 * LENS.cy / LENS.fy) & (away < 20)
    assert inside.float().mean() > 0.2
    assert bool((out.coverage[inside] > 0.9).all())
    assert float((out.colour - texture(x, y)).abs()[:, inside].mean()) < 0.04
    assert_close(out.inverse_depth[inside], 1 / away[inside], rtol=5e-3, atol=0)


def test_the_ground_seen_from_above_has_no_gaps_between_far_rows() -> None:
    _, down = LENS.rays()
    depth = torch.where(down > 0.02, 1.5 / down.clamp(min=1e-3), 0.0)
    colour = texture(depth * 0.1, depth * 0.2)
    ground = unproject(depth, colour, torch.zeros_like(depth, dtype=torch.uint8), LENS, HERE, 0.0)
    out = seen(ground, moved(0.0, -6.5, -4.0, pitch_deg=25.0))  # 8 m above
    ray = moved(pitch_deg=25.0)[:3, :3].float() @ torch.stack(
        [LENS.rays()[0].flatten(), down.flatten(), torch.ones(down.numel())]
    )
    reach = (8.0 / ray[1].clamp(min=1e-3)).view(down.shape)
    x, z = ray[0].view(down.shape) * reach, ray[2].view(down.shape) * reach - 4.0
    inside = (z > 4) & (z < 30) & (x.abs() < 0.9 * z * LENS.cx / LENS.fx)
    assert inside.sum() > 500
    assert bool((out.coverage[inside] > 0.9).all())
    assert_close(out.inverse_depth[inside], 1 / reach[inside], rtol=0.02, atol=0)


def test_nearer_hides_farther_whatever_the_order() -> None:
    red, blue = torch.tensor([1.0, -1.0, -1.0]), torch.tensor([-1.0, -1.0, 1.0])
    near, far = wall(4.0, red, label=1, keep=band(30, 60)), wall(9.0, blue, label=2)
    one, other = seen(near.joined(far)), seen(far.joined(near))
    assert_close(one.colour, other.colour, atol=1e-5, rtol=0)
    assert_close(one.votes, other.votes, atol=1e-5, rtol=0)
    expected = torch.where(band(30, 60), red.view(3, 1, 1), blue.view(3, 1, 1))
    assert_close(one.colour, expected, atol=1e-3, rtol=0)
    assert bool((one.votes.argmax(0) == torch.where(band(30, 60), 1, 2)).all())


def test_far_things_do_not_shine_through_a_near_wall_that_is_magnified() -> None:
    red, blue = torch.tensor([1.0, -1.0, -1.0]), torch.tensor([-1.0, -1.0, 1.0])
    out = seen(wall(8.0, red).joined(wall(20.0, blue)), moved(0.07, 0.03, 5.5, yaw_deg=8.0))
    covered = out.coverage > 0
    assert covered.float().mean() > 0.95
    assert float((out.colour - red.view(3, 1, 1)).abs()[:, covered].max()) < 1e-3


def test_the_newest_wins_on_one_surface_and_the_age_says_what_was_older() -> None:
    old, new = torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 0.0, 0.0])
    out = seen(wall(5.0, old, stamp=4.0).joined(wall(5.0, new, stamp=6.0, keep=band(0, 48))), now=6.0)
    left, right = band(2, 46), band(50, 94)
    assert float(out.now_share[left].min()) > 0.8
    assert float(out.colour[0][left].min()) > 0.6
    assert float(out.now_share[right].max()) == 0.0
    assert_close(out.age[right], torch.full_like(out.age[right], 2.0))


def test_what_was_painted_gives_way_to_what_was_seen_and_is_never_seen_now() -> None:
    colour = torch.tensor([0.5, 0.5, 0.5])
    painted = wall(5.0, colour, stamp=6.0, painted=True)
    assert float(seen(painted, now=6.0).now_share.max()) == 0.0
    beside = seen(painted.joined(wall(5.0, -colour, stamp=3.0)), now=6.0)
    assert float(beside.colour.max()) < -0.3


@pytest.mark.parametrize(
    ("surfels", "pose"),
    [
        (Surfels.empty(), HERE),
        (wall(5.0), moved(0.0, 0.0, 50.0)),
        (wall(4.0), moved(0.0, 0.0, 8.0, yaw_deg=180.0)),  # from behind
    ],
)
def test_without_surfels_in_sight_the_picture_is_empty(surfels: Surfels, pose: Tensor) -> None:
    out = seen(surfels, pose)
    assert not any(bool(each.any()) for each in (out.coverage, out.colour, out.votes, out.inverse_depth, out.age))


ROAD, GRASS = (-0.6, -0.6, -0.5), (-0.5, 0.4, -0.7)


def test_a_soft_edge_between_two_classes_becomes_a_step_and_their_colours_stay() -> None:
    share = ((torch.arange(96) - 40.0) / 24).clamp(0, 1).expand(64, 96)  # of grass, from left to right
    colours = torch.tensor([ROAD, GRASS])
    mean = (colours[0, :, None, None] * (1 - share) + colours[1, :, None, None] * share)[None]
    logits = torch.logit(share.clamp(1e-4, 1 - 1e-4))
    made = crisp(mean, torch.stack([-logits / 2, logits / 2, torch.full_like(logits, -20.0)])[None])[0]
    assert (made[:, :, :51] - colours[0, :, None, None]).abs().max() < 0.1
    assert (made[:, :, 53:] - colours[1, :, None, None]).abs().max() < 0.1


def test_a_sure_class_is_a_smoothed_mean_and_that_of_a_single_pixel_has_a_finite_colour() -> None:
    mean, classes = torch.linspace(-1, 1, 128).expand(1, 3, 64, 128), torch.zeros(1, 4, 64, 128)
    classes[:, 2] = 30.0
    assert (crisp(mean, classes) - mean)[..., 30:-30].abs().max() < 0.02
    classes[0, 1, 7, 9] = 80.0
    assert bool(crisp(torch.rand(1, 3, 64, 128), classes).isfinite().all())


# What a memory of surfels keeps and drops when a newer frame looks at the same place.

PIXELS = LENS.width * LENS.height
KNOWN = torch.ones(LENS.height, LENS.width, dtype=torch.bool)


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


def updated(memory: Surfels, depth: Tensor, pose: Tensor, fresh: Surfels, known: Tensor = KNOWN) -> Surfels:
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
def test_what_the_camera_sees_through_is_dropped_and_a_hole_in_the_depth_proves_nothing(behind: float) -> None:
    known = KNOWN.clone()
    known[:, :10] = False
    memory = updated(memory_of(surfels(flat(5.0), stamp=0.0)), flat(behind), HERE, Surfels.empty(), known)
    assert len(memory) == 10 * LENS.height
    assert len(updated(memory, flat(behind), HERE, Surfels.empty())) == 0


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


def test_over_capacity_the_oldest_go_and_so_does_what_is_too_old() -> None:
    memory = memory_of(*(surfels(flat(4.0), stamp=float(stamp)) for stamp in (2, 0, 1)), capacity=PIXELS + 5)
    assert [int((memory.stamp == stamp).sum()) for stamp in range(3)] == [0, 5, PIXELS]
    memory = memory_of(*(surfels(flat(4.0), stamp=float(stamp)) for stamp in range(5)), oldest_frames=2)
    assert memory.stamp.unique().tolist() == [2.0, 3.0, 4.0]


def test_painted_stays_painted_until_it_is_seen() -> None:
    memory = memory_of(surfels(flat(5.0), stamp=0.0, painted=True))
    assert bool(memory.painted.all())
    assert not bool(updated(memory, flat(5.0), HERE, surfels(flat(5.0), stamp=1.0)).painted.any())
