"""The live model's training at a tiny size: every stage runs, resumes, and leaves alone what is not its own."""

import os
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from live_clips import HEIGHT, TINY, WIDTH, write_clip
from safetensors.torch import load_file
from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]
from torch.multiprocessing.spawn import start_processes

from gcd_model import load_synthesizer
from gcd_model.geometry import Intrinsics
from gcd_model.live.config import DepthConfig
from gcd_model.live.depth_net import (
    DepthNet,
    DepthOutput,
    bin_width,
    depth_inputs,
    first_bin,
    plane_depth,
    read_depth,
)
from gcd_model.live.paint_net import Painted, PaintNet, Seen, filled
from gcd_model.networks import LiveNetworks
from gcd_train.data.sample import to_network
from gcd_train.errors import DataError, Interrupted
from gcd_train.live.batches import FrameBatches, pictures_of
from gcd_train.live.calibration import SpreadHistogram, calibrate, floors_of, frames_of
from gcd_train.live.clips import Shelf, TrainingClips, read_clip, training_paths
from gcd_train.live.depth_training import DepthTask, edge_matches, measure_depth
from gcd_train.live.paint_training import HeldOutViews, PaintTask
from gcd_train.live.training import train_live
from gcd_train.live.views import (
    InputShelf,
    ViewBatches,
    Views,
    carried_through,
    carry,
    make_inputs,
    splats_of,
    views_of,
)
from gcd_train.recipe import LiveRecipe, LiveStage, OptimiserRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe, LogRecipe
from gcd_train.training.distributed import ALONE, Processes, processes_of
from gcd_train.training.loop import Progress
from gcd_train.training.monitor import RunFolder

CPU = torch.device("cpu")
changed = msgspec.structs.replace


def stage(updates: int, parts: int = 1) -> LiveStage:
    optimiser = OptimiserRecipe(rate=1e-3, clip=1.0)
    return LiveStage(budget=Budget(updates=updates), batch=2, parts=parts, optimiser=optimiser)


RECIPE = LiveRecipe(
    kind="live",
    name="tiny-live",
    model=TINY,
    depth=stage(3),
    paint=stage(3),
    detail=stage(2),
    log=LogRecipe(log_s=0.001, measure_s=1000.0),
)
SHARED = changed(RECIPE, depth=stage(3, parts=2), paint=stage(3, parts=2))


def write_data(folder: Path) -> Path:
    """Three clips to learn from and one to measure on."""
    for seed in range(3):
        write_clip(folder / "data", seed)
    write_clip(folder / "valid", 1_000_000)
    return folder


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return write_data(tmp_path)


@pytest.fixture
def path(data: Path) -> Path:
    """A clip, of which it is worked out what is seen."""
    path = training_paths(data / "data")[0]
    make_inputs(data / "inputs", [path], None, TINY, 0)
    return path


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of data with a finished run in it."""
    data = write_data(tmp_path_factory.mktemp("trained"))
    train(data)
    return data


def train(
    data: Path,
    recipe: LiveRecipe = RECIPE,
    out: str = "out",
    stop: threading.Event | None = None,
    processes: Processes = ALONE,
) -> Path:
    return train_live(
        recipe, data / "data", data / "valid", RunFolder(data / out), stop or threading.Event(), processes
    )


def view_batches(data: Path, size: int, carried: float) -> ViewBatches:
    """Of the clips of which it is worked out what is seen."""
    clips = TrainingClips(data / "data", CPU)
    return ViewBatches(clips, InputShelf(clips, [data / "inputs"]), TINY, size, 0, carried)


def views_at(data: Path, path: Path, *frames: int) -> list[Views]:
    inputs = data / "inputs" / path.parent.name / path.name
    return [views_of(path, inputs, slice(t, t + 1)) for t in frames]


def differing(one: Path, other: Path) -> set[str]:
    """Names of the weights that are not the same in two files."""
    ones, others = load_file(one), load_file(other)
    return {name for name, value in ones.items() if not torch.equal(value, others[name])}


class StopAfter(threading.Event):
    """Set once it was asked so many times."""

    def __init__(self, asked: int) -> None:
        super().__init__()
        self._left = asked

    def is_set(self) -> bool:
        self._left -= 1
        return self._left < 0


def test_all_stages_run_and_a_stopped_run_goes_on_to_the_same_weights(trained: Path, data: Path) -> None:
    with pytest.raises(Interrupted):
        train(data, stop=StopAfter(2))
    whole = trained / "out" / "tiny-live.safetensors"
    assert whole.read_bytes() == train(data).read_bytes()
    assert load_synthesizer(whole).traits.name == "tiny-live"


def test_the_detail_stage_leaves_all_other_weights_as_they_are(trained: Path) -> None:
    changes = differing(*(trained / "out" / f"tiny-live-{stage}.safetensors" for stage in ("paint", "detail")))
    assert changes
    assert all(name.startswith("paint.detail.") for name in changes)


@pytest.mark.slow
def test_a_training_begins_from_a_weight_file_and_leaves_what_it_is_told_to_keep(trained: Path) -> None:
    begun = trained / "out" / "tiny-live.safetensors"
    more = changed(RECIPE, weights=str(begun), keep=frozenset({"depth"}))
    changes = differing(begun, train(trained, more, "more")) - {"depth.head.out.bias"}  # calibrated anew
    assert any(name.startswith("paint.") for name in changes)
    assert not any(name.startswith("depth.") for name in changes)
    wider = changed(TINY, paint=changed(TINY.paint, widths=(16, 16, 16)))
    with pytest.raises(DataError, match="other networks"):
        train(trained, changed(more, model=wider), "wider")


def test_data_that_cannot_be_used_is_refused(data: Path) -> None:
    with pytest.raises(DataError, match="takes clips of"):
        train(data, changed(RECIPE, model=changed(TINY, width=TINY.width + 32)))
    write_clip(data / "valid", 2)  # a scene is never both learned and measured
    with pytest.raises(DataError, match="driving/0000002"):
        train(data)


def test_scenes_from_a_million_on_are_not_learned_from(data: Path) -> None:
    write_clip(data / "data", 1_000_000)
    assert [path.stem for path in training_paths(data / "data")] == ["0000000-0", "0000001-0", "0000002-0"]


def in_one_of_two(rank: int, data: Path, port: int) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    os.environ["TORCHELASTIC_USE_AGENT_STORE"] = "True"
    torch.set_num_threads(1)
    with processes_of(ComputeRecipe(device="cpu", parallel="ddp")) as processes:
        train(data, SHARED, "two", processes=processes)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_processes_end_with_the_weights_of_one(data: Path) -> None:
    """Half a minute of two CPUs."""
    alone = load_file(train(data, SHARED))
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # as torchrun has it
    start_processes(in_one_of_two, (data, store.port), nprocs=2, start_method="spawn")
    together = load_file(data / "two" / f"{SHARED.name}.safetensors")
    for name in (name for name in alone if name.startswith("depth.")):
        assert torch.allclose(alone[name].float(), together[name].float(), atol=2e-3), name


@pytest.mark.parametrize("change", [{"keep": frozenset({"depth"})}, {"detail": stage(1, parts=2)}])
def test_stages_kept_of_no_weights_and_a_detail_of_several_batches_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"weights|detail"):
        changed(RECIPE, **change)


def test_batches_follow_from_the_update_alone(data: Path) -> None:
    clips = TrainingClips(data / "data", CPU)
    one, two, other = (FrameBatches(clips, 3, 7).batch(update) for update in (11, 11, 12))
    assert torch.equal(one[0].video, two[0].video)
    assert torch.equal(one[1], two[1])
    assert not torch.equal(other[0].video, one[0].video)


def test_clips_that_are_kept_in_memory_are_those_on_disk_until_it_is_full(data: Path) -> None:
    names, files, frames = ["source.rgb", "source.depth"], np.array([1, 0, 1]), np.array([3, 3, 13])
    sizes: list[int] = []

    def read(path: Path, frames: slice, names: Sequence[str]) -> dict[str, Any]:
        return read_clip(path, frames, names).arrays

    def room(size: int) -> int:
        sizes.append(size)
        return 2

    kept, disk = (Shelf(read, names, CPU, each) for each in (room, None))
    paths = training_paths(data / "data")
    assert [kept.add(path) for path in paths] == [True, True, False]
    assert all(disk.add(path) for path in paths)
    assert sizes == [14 * HEIGHT * WIDTH * (3 + 2)]
    for name, array in disk.take(files, frames, names).items():
        assert torch.equal(array, kept.take(files, frames, names)[name])


def test_clips_that_are_added_to_the_folder_are_taken_in(data: Path) -> None:
    clips = TrainingClips(data / "data", CPU)
    added = write_clip(data / "data", 1, "drop")
    clips.grow()
    assert clips.paths[-1] == added
    assert len(clips) == len({*clips.paths}) == 4


def test_true_logits_are_read_as_the_true_depth() -> None:
    config = DepthConfig()
    metres = torch.tensor([[[0.4, 3.0], [47.0, 1000.0]]])
    place = (metres.log() - first_bin(config)) / bin_width(config)
    nearest = place.round().clamp(0, config.bins - 2).long()
    label = torch.where(metres >= config.farthest_m, config.bins - 1, nearest)
    logits = 50.0 * torch.nn.functional.one_hot(label, config.bins).permute(0, 3, 1, 2).float()
    offsets = torch.zeros_like(logits)[:, 1:].scatter(1, nearest[:, None], ((place - nearest) / 1.5).atanh()[:, None])
    nowhere = dict.fromkeys(("ground", "ground_place", "summary"), torch.zeros_like(logits[:, :1]))
    output = DepthOutput(logits=logits, raw_offsets=offsets, classes=logits[:, :2], moves=metres, **nowhere)
    assert torch.allclose(read_depth(output, config).metres, metres, rtol=1e-3)


def test_where_the_gate_is_open_depth_is_that_of_the_declared_ground() -> None:
    net = DepthNet(TINY.depth, len(TINY.classes)).eval()
    assert net.head.out.bias is not None
    net.head.out.bias.data.zero_()
    net.head.out.bias.data[-2] = 1e6
    lens = Intrinsics.from_hfov(85.0, TINY.width, TINY.height)
    rays = lens.rays()
    ground = plane_depth(rays, torch.tensor([0.0, -0.985, -0.174]), 1.5)
    inputs = depth_inputs(torch.zeros(1, 3, TINY.height, TINY.width), rays[None], ground[None])
    with torch.no_grad():
        net.head.out.weight.zero_()
        metres = read_depth(net(inputs), TINY.depth).metres[0]
    near = (ground > TINY.depth.nearest_m * 1.5) & (ground < 20.0)
    assert near.float().mean() > 0.2
    assert ((metres / ground - 1).abs()[near] < 0.05).float().mean() > 0.98


@pytest.mark.slow
def test_depth_learns_one_picture_by_heart(data: Path) -> None:
    torch.manual_seed(0)
    net, clips = DepthNet(TINY.depth, len(TINY.classes)), TrainingClips(data / "data", CPU)
    paths = clips.paths[:1]
    task = DepthTask(net, TINY, clips, paths, changed(stage(1), small_share=0.0), 0)
    before = measure_depth(net, TINY, paths)["mean_relative"]
    optimiser = torch.optim.Adam(net.parameters(), 1e-2)
    for update in range(60):
        optimiser.zero_grad()
        task.step_loss(Progress(update, 0.0)).total.backward()
        optimiser.step()
    net.eval()
    assert measure_depth(net, TINY, paths)["mean_relative"] < 0.5 * before


def test_edges_match_within_a_pixel() -> None:
    step = torch.ones(1, 8, 16)
    step[..., 8:] = 3.0
    beside, far = step.roll(1, -1), step.roll(5, -1)
    beside[..., 0], far[..., :5] = 1.0, 1.0
    same, near, away = (edge_matches(other, step) for other in (step, beside, far))
    assert same[0] == same[1] == same[2] > 0
    assert near[0] == near[1]
    assert away[0] == 0


def test_inputs_come_back_as_they_were_splatted(data: Path, path: Path) -> None:
    clip = read_clip(path)
    splat = splats_of(clip, pictures_of(clip), TINY)[5]
    (back,) = views_at(data, path, 5)
    assert (back.seen.coverage[0] - splat.coverage).abs().mean() < 0.03
    seen = splat.coverage > 0.5
    assert seen.float().mean() > 0.5
    # the stored one is by depth that is off by a few per cent, so colours agree in the middle of tiles alone
    assert (back.seen.colour[0] - splat.colour).abs().mean(0)[seen].median() < 0.05


def test_an_untrained_paint_network_shows_the_splat(data: Path, path: Path) -> None:
    net = PaintNet(TINY.paint, len(TINY.classes)).eval()
    (view,) = views_at(data, path, 5)
    with torch.no_grad():
        made = net.first_step(view.seen, filled(view.seen), TINY.sigma_max)
        whole = net.first_step(replace(view.seen, coverage=torch.ones_like(view.seen.coverage)), made.mean, 1.0)
    assert torch.equal(made.mean, filled(view.seen))
    assert torch.equal(whole.picture, whole.mean)


def test_what_was_painted_is_carried_to_where_the_camera_sees_it(data: Path, path: Path) -> None:
    before, now = views_at(data, path, 4, 5)
    nothing = replace(before.seen, coverage=torch.zeros_like(before.seen.coverage))
    before = replace(before, seen=nothing)
    net = PaintNet(TINY.paint, len(TINY.classes)).eval()
    with torch.no_grad():
        painted = net.first_step(nothing, filled(nothing), TINY.sigma_max)
    true = replace(painted, log_depth=before.log_depth, mean=before.target, detail=torch.zeros_like(before.target))
    road = torch.nn.functional.one_hot(torch.ones_like(before.labels), 17).permute(0, 3, 1, 2).float()
    moved = carry(replace(true, classes=road), before, now, torch.zeros(17, dtype=torch.bool)).seen
    there = moved.painted_coverage > 0.9
    assert there.float().mean() > 0.6
    floor = there & (now.labels == 1)
    assert (moved.painted - now.target).abs().mean(1)[floor].median() < 0.1
    car = torch.zeros(17, dtype=torch.bool)
    car[1] = True
    assert not carry(replace(true, classes=road), before, now, car).seen.painted_coverage.any()


def test_painted_pixels_of_several_frames_in_a_row_drift_and_no_others(data: Path, path: Path) -> None:
    assert path
    batches = view_batches(data, 3, carried=0.7)
    net = PaintNet(TINY.paint, len(TINY.classes)).eval()
    runs: set[int] = set()
    drifted = 0

    def through(before: tuple[Views, ...], now: Views, random: np.random.Generator) -> Seen:
        def first_step(seen: Seen) -> Painted:
            return net.first_step(seen, filled(seen), TINY.sigma_max)

        return carried_through(first_step, before, now, torch.zeros(17).bool(), random).seen

    for update in range(12):
        before, now, random = batches.batch(update)
        runs.add(len(before))
        made, other = through(before, now, random), through(before, now, np.random.default_rng(99))
        drifted += int((made.painted != other.painted).sum())
        carried = len(before[0].poses) if before else 0
        assert all(len(views.poses) == carried for views in before)
        assert not made.painted_coverage[carried:].any()
        assert not made.painted[(made.painted_coverage == 0)[:, None].expand_as(made.painted)].any()
        assert made.painted.abs().max() <= 1
    assert {1, 2, 3} <= runs
    assert drifted > 0


def paint_task(data: Path, path: Path, carried: float) -> PaintTask:
    net, views = PaintNet(TINY.paint, len(TINY.classes)), HeldOutViews([path], data / "inputs")
    return PaintTask(net, TINY, [view_batches(data, 2, carried)], [path], views, 0.0)


def test_paint_losses_are_lowest_at_the_truth(data: Path, path: Path) -> None:
    task = paint_task(data, path, 0.35)
    _, now, _ = view_batches(data, 2, 0.35).batch(0)
    with torch.no_grad():
        made = PaintNet(TINY.paint, len(TINY.classes)).first_step(now.seen, filled(now.seen), TINY.sigma_max)
        losses = task.losses(made, now)
        best = task.losses(replace(made, mean=now.target, log_depth=now.log_depth), now)
    assert best["square"] == best["absolute"] == best["gradient"] == best["depth"] == 0
    assert losses["square"] > 0


def test_the_second_half_of_the_training_carries_and_denoises(data: Path, path: Path) -> None:
    task = paint_task(data, path, 1.0)
    early, late = ([task.step_loss(Progress(u, share)).parts for u in range(8)] for share in (0.0, 0.9))
    assert all("denoising" not in parts for parts in early)
    denoised = [parts["denoising"] for parts in late if "denoising" in parts]
    assert 0 < len(denoised) < 8
    assert all(bool(loss.isfinite()) and float(loss.detach()) > 0 for loss in denoised)
    plain = [(a["square"], b["square"]) for a, b in zip(early, late, strict=True) if "square" in b]
    assert any(float(a.detach()) != float(b.detach()) for a, b in plain)  # what was carried along is seen


def test_calibration_makes_the_interval_hold_and_takes_back_what_rare_classes_got(data: Path, path: Path) -> None:
    torch.manual_seed(0)
    networks, views = LiveNetworks(TINY).eval(), HeldOutViews([path], data / "inputs")
    assert networks.depth.head.out.bias is not None
    biases = networks.depth.head.out.bias.requires_grad_(False)
    first = 2 * TINY.depth.bins - 1
    labels = pictures_of(read_clip(path)).labels
    biases[first + int(labels.flatten().mode().values)] = 10.0
    rare = first + 10
    biases[rare] = 30.0  # a class that does not occur wins
    weights = torch.ones(len(TINY.classes))
    weights[10] = torch.tensor(40.0).exp()
    assert not bool((labels == 10).any())
    calibrate(networks, [path], [path], views, weights, torch.ones_like(weights))
    assert float(biases[rare]) <= 10.0
    inside, clip = SpreadHistogram(), read_clip(path)
    source, truth = pictures_of(clip), (to_network(clip.arrays["target.rgb"]) + 1) / 2
    for frame, true in zip(frames_of(networks, clip, source, floors_of(source))[1:], truth[1:], strict=True):
        error = (frame.picture.clamp(-1, 1) + 1) / 2 - true
        inside.add(error[None], frame.log_variance[None], frame.visibility[None])
    shares = [share for share in inside.coverage if share == share]
    assert shares
    assert all(0.89 < share < 0.91 for share in shares)
    assert 0.0 < networks.config.ood_threshold <= 1.0
