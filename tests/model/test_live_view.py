"""The live view frame by frame: state, reset, lenses, and what may be called seen."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import msgspec
import pytest
import torch
from live_room import FRAMES, HEIGHT, LENS, WIDTH, one_thread, path, room  # noqa: F401  a fixture
from torch import Tensor
from torch.testing import assert_close

from gcd_model import Intrinsics, RenderOptions, SeenFrame, load_synthesizer
from gcd_model.live.config import LIVE_TINY, SKY_M, DepthConfig
from gcd_model.live.depth_net import DepthNet, Reference, depth_inputs, read_depth, sweep_costs
from gcd_model.live.eyes import LONGEST, Eyes, References, SeenWorld
from gcd_model.live.synthesizer import LiveSynthesizer, Painter, ViewFrame
from gcd_model.networks import LiveNetworks, random_networks

HERE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def networks() -> LiveNetworks:
    return random_networks(LIVE_TINY, seed=2)


def aside(x: float) -> Tensor:
    pose = HERE.clone()
    pose[0, 3] = x
    return pose


class View:
    """The live model's three parts in a row."""

    def __init__(self, networks: LiveNetworks) -> None:
        self.eyes, self.world, self.painter = Eyes(networks), SeenWorld(networks.config), Painter(networks, steps=1)

    def step(self, frame: Tensor, pose: Tensor, **known: Any) -> tuple[SeenFrame, ViewFrame]:
        seen = self.eyes.see(frame, **{"lens": LENS} | known)
        return seen, self.painter.paint(self.world.place(seen, [pose]))[0]


def steps(view: View, frames: range) -> list[ViewFrame]:
    clip = room()
    assert clip.depth is not None
    assert clip.odometry is not None
    return [view.step(clip.video[t], aside(0.5), depth=clip.depth[t], odometry=clip.odometry[t])[1] for t in frames]


def assert_same(mine: ViewFrame, other: ViewFrame) -> None:
    for field in fields(mine):
        assert torch.equal(getattr(mine, field.name), getattr(other, field.name))


def test_a_window_is_its_frames_when_they_stream(networks: LiveNetworks) -> None:
    whole = LiveSynthesizer(networks, load_synthesizer("random:live", device="cpu").traits)
    features = whole.encode(room())
    window = whole.render(features, [path(0.5)], RenderOptions(seed=2))[0]
    streaming = whole.streaming()
    assert streaming.traits.config.frames == 1

    def streamed() -> Tensor:
        frames = [features.rows(t, t + 1) for t in range(FRAMES)]
        return torch.cat([streaming.render(each, [path(0.5, 1)], RenderOptions(seed=2))[0].video for each in frames])

    assert_close(streamed(), window.video, rtol=0, atol=1e-5)
    assert not torch.equal(streamed(), window.video)  # it goes on from the last frame
    streaming.reset()
    assert_close(streamed(), window.video, rtol=0, atol=1e-5)


def test_another_lens_is_another_camera_of_which_nothing_is_known_yet(networks: LiveNetworks) -> None:
    used, wide = View(networks), Intrinsics.from_hfov(100.0, 2 * WIDTH, 2 * HEIGHT)
    steps(used, range(3))
    frame = torch.zeros(3, 2 * HEIGHT, 2 * WIDTH)
    (seen, again), (_, first) = (view.step(frame, aside(0.5), lens=wide) for view in (used, View(networks)))
    assert_same(again, first)
    assert seen.lost is None


def test_depth_looks_at_an_earlier_frame_where_there_is_one(networks: LiveNetworks) -> None:
    clip = room()
    assert clip.odometry is not None
    view = View(networks)
    made = [view.step(clip.video[t], HERE, odometry=clip.odometry[t])[0].geometry for t in range(3)]
    alone = Eyes(networks).look(clip.video[2], LENS)
    move = torch.linalg.inv(clip.odometry[0]) @ clip.odometry[2]
    compared = view.eyes.look(
        clip.video[2], LENS, reference=Reference(picture=clip.video[0], reference_from_camera=move.double())
    )
    assert not torch.equal(made[2].metres, alone.metres)
    assert_close(made[2].metres, compared.metres)


@pytest.mark.parametrize("hfov_deg", [40.0, 85.0, 120.0])
def test_a_view_from_the_source_shows_the_source_through_any_lens(hfov_deg: float) -> None:
    """Untrained, the paint network adds nothing to the splat."""
    torch.manual_seed(0)
    view = View(LiveNetworks(LIVE_TINY))
    lens = Intrinsics.from_hfov(hfov_deg, WIDTH, HEIGHT)
    frame = room().video[0]
    _, seen = view.step(frame, HERE, lens=lens, depth=torch.full((HEIGHT, WIDTH), 4.0), odometry=HERE)
    inside = (slice(1, -1), slice(1, -1))
    assert bool((seen.visibility[inside] == 2).all())
    assert_close(seen.picture[:, *inside], frame[:, *inside], rtol=0, atol=1e-3)
    assert_close(seen.inverse_depth[inside], torch.full_like(seen.inverse_depth[inside], 0.25), rtol=1e-3, atol=0)


def test_what_points_do_not_cover_is_never_marked_seen(networks: LiveNetworks) -> None:
    """Whatever the network says: its visibility head is made to vote for seen everywhere."""
    torch.manual_seed(1)
    voting = LiveNetworks(LIVE_TINY)
    bias = voting.paint.head.out.bias
    assert bias is not None
    bias.data[-3:] = torch.tensor([-1e6, 0.0, 1e6])
    clip = room()
    depth = torch.where(torch.arange(WIDTH) < WIDTH // 2, 3.0, 0.0).expand(HEIGHT, WIDTH).contiguous()
    view = View(voting)
    world = SeenWorld(LIVE_TINY)
    for t in range(3):
        target = aside(0.3)
        _, made = view.step(clip.video[t], target, depth=depth, odometry=HERE)
        seen = view.eyes.look(clip.video[t], LENS, depth=depth)
        world.look(clip.video[t], seen.metres, seen.labels, seen.static, LENS, HERE)
        covered = world.splat(target, LENS).coverage >= 0.5
        assert bool((made.visibility[covered] == 2).all())
        assert bool((made.visibility[~covered] == 0).all())
        assert bool((~covered).any())


@pytest.mark.parametrize("carries", [True, False])
def test_what_was_painted_is_seen_again_only_where_the_weights_carry_it(carries: bool) -> None:
    config = msgspec.structs.replace(LIVE_TINY, carry_painted=carries, memory=0)
    view = View(random_networks(config, seed=2))
    frame = room().video[0]
    half = torch.where(torch.arange(WIDTH) < WIDTH // 2, 3.0, 0.0).expand(HEIGHT, WIDTH)
    first, second = (view.step(frame, aside(0.3), depth=half, odometry=HERE)[1] for _ in range(2))
    assert bool((first.visibility == 0).any())
    changed = float((first.picture - second.picture).abs().median())  # here and there a class, by the plane sweep
    assert (changed > 1e-3) == carries, changed
    assert torch.equal(first.visibility, second.visibility)


@pytest.mark.parametrize(("sky", "metres"), [(1e6, SKY_M), (-1e6, 0.0)])
def test_holes_are_filled_by_nobody_but_the_sky(sky: float, metres: float) -> None:
    networks = random_networks(LIVE_TINY, seed=2)
    bias = networks.depth.head.out.bias
    assert bias is not None
    bias.data[LIVE_TINY.depth.bins - 1] = sky
    seen = Eyes(networks).look(room().video[0], LENS, depth=torch.full((HEIGHT, WIDTH), torch.nan))
    assert bool((seen.metres == metres).all())


CONFIG = DepthConfig(bins=32, nearest_m=1.0, farthest_m=10.0)


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
    away = Reference(picture=room().video[0], reference_from_camera=aside(100.0))
    made = sweep_costs(room().video[3], LENS, away, CONFIG)[: CONFIG.bins - 1]
    assert bool((made == 1.0).all())


def filmed(places: Iterable[float], metres: Tensor) -> References:
    kept = References()
    for i, x in enumerate(places):
        kept.add(torch.full((3, 4, 4), float(i)), aside(x), metres)
    return kept


def test_the_oldest_frame_from_which_the_scene_looks_alike_is_chosen() -> None:
    metres = torch.full((4, 4), 2.0)
    metres[0] = 1000.0
    assert References().chosen(HERE) is None
    chosen, still = (
        filmed([0.2 * i for i in range(10)], metres).chosen(aside(2.0)),
        filmed([0.0] * 10, metres).chosen(HERE),
    )
    assert chosen is not None
    assert float(chosen.reference_from_camera[0, 3]) == pytest.approx(0.6)  # at most LONGEST of 2 m
    assert LONGEST * 2.0 >= 0.6
    assert still is not None
    assert float(still.picture[0, 0, 0]) == 4.0  # the oldest of the six that are kept
    for depth, moved, known in ((2.0, 0.5, True), (2.0, 0.7, False), (1000.0, 0.1, False), (0.0, 0.1, False)):
        assert (filmed([0.0], torch.full((4, 4), depth)).chosen(aside(moved)) is not None) == known
