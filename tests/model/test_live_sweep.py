"""What an earlier frame tells of depth: the right depth explains it best."""

import pytest
import torch
from live_room import LENS, room
from torch.testing import assert_close

from gcd_model.live.config import DepthConfig
from gcd_model.live.depth_net import DepthNet, Reference, depth_inputs, read_depth, sweep_costs
from gcd_model.live.eyes import LONGEST, References

CONFIG = DepthConfig(bins=32, nearest_m=1.0, farthest_m=10.0)
HERE = torch.eye(4, dtype=torch.float64)


def at(x: float) -> torch.Tensor:
    pose = HERE.clone()
    pose[0, 3] = x
    return pose


def reference(frames: int) -> Reference:
    """The room's wall is 3 m away; its camera goes to the right."""
    clip = room()
    assert clip.odometry is not None
    move = torch.linalg.inv(clip.odometry[0]) @ clip.odometry[frames]
    return Reference(picture=clip.video[0], reference_from_camera=move)


def test_the_true_depth_costs_least() -> None:
    costs = sweep_costs(room().video[3], LENS, reference(3), CONFIG)[: CONFIG.bins - 1, 2:-2, 2:-4].mean(dim=(1, 2))
    best = 1.0 * (10.0 / 1.0) ** ((int(costs.argmin()) + 0.5) / (CONFIG.bins - 1))
    assert best == pytest.approx(3.0, rel=0.08)
    assert costs.min() < 0.5 * costs.median()


def test_a_network_that_trusts_the_sweep_reads_its_depth_off_it() -> None:
    net = DepthNet(DepthConfig(widths=(8, 16), bins=32, nearest_m=1.0, farthest_m=10.0), 3).eval()
    bias = net.head.out.bias
    assert bias is not None
    with torch.no_grad():
        net.head.out.weight.zero_()
        bias.zero_()
        bias[-1] = 50.0
        picture = room().video[3]
        inputs = depth_inputs(picture[None], LENS.rays()[None], torch.zeros(1, LENS.height, LENS.width))
        costs = sweep_costs(picture, LENS, reference(3), net.config)[None]
        output = net(inputs, costs)
        some = torch.randint(0, LENS.height * LENS.width, (1, 40))
        sampled = net(inputs, costs, some)
    metres = read_depth(output, net.config).metres[0, 4:-4, 4:-8]
    assert ((metres / 3.0 - 1).abs() < 0.1).float().mean() > 0.8
    whole = output.logits.flatten(2).gather(2, some[:, None].expand(-1, 32, -1))
    assert_close(sampled.logits[..., 0], whole)


def test_what_the_earlier_frame_did_not_see_costs_the_same_at_any_depth() -> None:
    away = Reference(picture=room().video[0], reference_from_camera=at(100.0))
    made = sweep_costs(room().video[3], LENS, away, CONFIG)[: CONFIG.bins - 1]
    assert bool((made == 1.0).all())


def test_the_oldest_frame_from_which_the_scene_looks_alike_is_chosen() -> None:
    kept, metres = References(), torch.full((4, 4), 2.0)
    metres[0] = 1000.0
    assert kept.chosen(HERE) is None
    for i in range(10):
        kept.add(torch.full((3, 4, 4), float(i)), at(0.2 * i), metres)
    chosen = kept.chosen(at(2.0))
    assert chosen is not None
    assert float(chosen.reference_from_camera[0, 3]) == pytest.approx(0.6)  # at most LONGEST of 2 m
    assert LONGEST * 2.0 >= 0.6
    standing = References()
    for i in range(10):
        standing.add(torch.full((3, 4, 4), float(i)), HERE, metres)
    still = standing.chosen(HERE)
    assert still is not None
    assert float(still.picture[0, 0, 0]) == 4.0  # the oldest of the six that are kept


def test_one_depth_everywhere_is_a_median_and_nothing_but_sky_is_none() -> None:
    for metres, moved, known in ((2.0, 0.5, True), (2.0, 0.7, False), (1000.0, 0.1, False), (0.0, 0.1, False)):
        kept = References()
        kept.add(torch.zeros(3, 4, 4), HERE, torch.full((4, 4), metres))
        assert (kept.chosen(at(moved)) is not None) == known
