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
from live_clips import HEIGHT, WIDTH, write_clip
from safetensors.torch import load_file
from torch.distributed import TCPStore  # pyright: ignore[reportPrivateImportUsage]
from torch.multiprocessing.spawn import start_processes

from gcd_model import load_synthesizer
from gcd_model.geometry import Intrinsics
from gcd_model.live.config import DepthConfig, LiveConfig, PaintConfig
from gcd_model.live.depth_net import (
    DepthNet,
    DepthOutput,
    bin_width,
    depth_inputs,
    first_bin,
    pixel_rays,
    plane_depth,
    read_depth,
)
from gcd_model.live.paint_net import Painted, PaintNet, Seen, filled
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError, Interrupted, RecipeError
from gcd_train.live.batches import FrameBatches, pictures_of
from gcd_train.live.calibration import calibrate
from gcd_train.live.clips import read_clip
from gcd_train.live.depth_training import DepthTask, edge_matches, measure_depth
from gcd_train.live.measure_figures import SpreadHistogram
from gcd_train.live.measure_methods import LiveModel
from gcd_train.live.paint_training import HeldOutViews, PaintTask
from gcd_train.live.recipe import LiveRecipe, LiveStage, load_live_recipe
from gcd_train.live.store import Shelf, TrainingClips, training_paths
from gcd_train.live.training import LivePlaces, train_live
from gcd_train.live.views import (
    InputShelf,
    ViewBatches,
    Views,
    carried_through,
    carry,
    exact_geometry,
    make_inputs,
    read_inputs,
    splats_of,
    views_of,
)
from gcd_train.recipe import OptimiserRecipe
from gcd_train.recipe_data import Budget, ComputeRecipe, LogRecipe
from gcd_train.training.distributed import processes_of
from gcd_train.training.loop import Progress

TINY = LiveConfig(
    height=HEIGHT,
    width=WIDTH,
    depth=DepthConfig(widths=(8, 16, 16), mixers=1, fine_width=8, half_width=8, bins=8),
    paint=PaintConfig(widths=(8, 16, 16), fine_width=8, half_width=8, embedding_width=16),
    memory=2000,
)

CPU = torch.device("cpu")


def stage(updates: int) -> LiveStage:
    return LiveStage(budget=Budget(updates=updates), batch=2, optimiser=OptimiserRecipe(rate=1e-3, clip=1.0))


RECIPE = LiveRecipe(
    kind="live",
    name="tiny-live",
    model=TINY,
    depth=stage(3),
    paint=stage(3),
    detail=stage(2),
    log=LogRecipe(log_s=0.001, measure_s=1000.0),
)


SHARED = msgspec.structs.replace(
    RECIPE,
    depth=msgspec.structs.replace(stage(3), parts=2),
    paint=msgspec.structs.replace(stage(3), parts=2),
)


@pytest.fixture
def places(tmp_path: Path) -> LivePlaces:
    for seed in range(3):
        write_clip(tmp_path / "data", seed)
    write_clip(tmp_path / "valid", 1_000_000)
    return LivePlaces(data=tmp_path / "data", valid=tmp_path / "valid", out=tmp_path / "out")


@pytest.fixture
def path(places: LivePlaces) -> Path:
    """A clip, of which it is worked out what is seen."""
    path = training_paths(places.data)[0]
    make_inputs(places.out, [path], None, TINY, 0)
    return path


def view_batches(places: LivePlaces, size: int, carried: float) -> ViewBatches:
    """Of the clips of which it is worked out what is seen."""
    clips = TrainingClips(places.data, CPU)
    return ViewBatches(clips, InputShelf(clips, [places.out]), TINY, size, 0, carried)


class StopAfter(threading.Event):
    """Set once it was asked so many times."""

    def __init__(self, asked: int) -> None:
        super().__init__()
        self._left = asked

    def is_set(self) -> bool:
        self._left -= 1
        return self._left < 0


def test_all_stages_run_and_a_stopped_run_goes_on_to_the_same_weights(places: LivePlaces) -> None:
    whole = train_live(RECIPE, places, threading.Event())
    other = replace(places, out=places.out.with_name("stopped"))
    with pytest.raises(Interrupted):
        train_live(RECIPE, other, StopAfter(2))
    stopped = train_live(RECIPE, other, threading.Event())
    assert whole.read_bytes() == stopped.read_bytes()
    assert load_synthesizer(whole).traits.name == "tiny-live"


def test_a_scene_is_never_both_learned_and_measured(places: LivePlaces) -> None:
    write_clip(places.valid, 2)
    with pytest.raises(DataError, match="driving/0000002"):
        train_live(RECIPE, places, threading.Event())


def test_clips_of_another_shape_than_the_recipes_are_refused(places: LivePlaces) -> None:
    wide = msgspec.structs.replace(RECIPE, model=msgspec.structs.replace(TINY, width=TINY.width + 32))
    with pytest.raises(DataError, match="takes clips of"):
        train_live(wide, places, threading.Event())


def test_scenes_from_a_million_on_are_not_learned_from(tmp_path: Path) -> None:
    write_clip(tmp_path, 5)
    write_clip(tmp_path, 1_000_000)
    assert [path.stem for path in training_paths(tmp_path)] == ["0000005-0"]


def test_the_detail_stage_leaves_all_other_weights_as_they_are(places: LivePlaces) -> None:
    with_detail = load_file(train_live(RECIPE, places, threading.Event()))
    short = msgspec.structs.replace(RECIPE, detail=stage(1))
    without = load_file(train_live(short, replace(places, out=places.out.with_name("short")), threading.Event()))
    changed = {name for name in with_detail if not torch.equal(with_detail[name], without[name])}
    assert changed
    assert all(name.startswith("paint.detail.") for name in changed)


def test_a_training_begins_from_a_weight_file_and_leaves_what_it_is_told_to_keep(places: LivePlaces) -> None:
    begun = train_live(RECIPE, places, threading.Event())
    more = msgspec.structs.replace(RECIPE, weights=str(begun), keep=frozenset({"depth"}))
    ended = load_file(train_live(more, replace(places, out=places.out.with_name("more")), threading.Event()))
    head = {"depth.head.out.bias"}  # calibrated anew
    changed = {name for name, value in load_file(begun).items() if not torch.equal(value, ended[name])} - head
    assert any(name.startswith("paint.") for name in changed)
    assert not any(name.startswith("depth.") for name in changed)
    wider = msgspec.structs.replace(TINY, paint=msgspec.structs.replace(TINY.paint, widths=(16, 16, 16)))
    with pytest.raises(DataError, match="other networks"):
        train_live(msgspec.structs.replace(more, model=wider), places, threading.Event())


def in_one_of_two(rank: int, places: LivePlaces, port: int) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    os.environ["TORCHELASTIC_USE_AGENT_STORE"] = "True"
    torch.set_num_threads(1)
    with processes_of(ComputeRecipe(device="cpu", parallel="ddp")) as processes:
        train_live(SHARED, places, threading.Event(), processes)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_processes_end_with_the_weights_of_one(places: LivePlaces) -> None:
    """Half a minute of two CPUs."""
    alone = load_file(train_live(SHARED, places, threading.Event()))
    other = replace(places, out=places.out.with_name("two"))
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # as torchrun has it
    start_processes(in_one_of_two, (other, store.port), nprocs=2, start_method="spawn")
    together = load_file(other.out / f"{SHARED.name}.safetensors")
    for name in (name for name in alone if name.startswith("depth.")):
        assert torch.allclose(alone[name].float(), together[name].float(), atol=2e-3), name


@pytest.mark.parametrize(
    "change", [{"keep": frozenset({"depth"})}, {"detail": msgspec.structs.replace(stage(1), parts=2)}]
)
def test_stages_kept_of_no_weights_and_a_detail_of_several_batches_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(RecipeError):
        msgspec.structs.replace(RECIPE, **change)


def test_an_unknown_key_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "live.toml"
    path.write_text('kind = "live"\nname = "x"\nspeed = 1\n')
    with pytest.raises(RecipeError, match="speed"):
        load_live_recipe(str(path))


def test_batches_follow_from_the_update_alone(places: LivePlaces) -> None:
    clips = TrainingClips(places.data, CPU)
    one, two = (FrameBatches(clips, 3, 7).batch(11) for _ in range(2))
    assert torch.equal(one[0].video, two[0].video)
    assert torch.equal(one[1], two[1])
    assert not torch.equal(FrameBatches(clips, 3, 7).batch(12)[0].video, one[0].video)


def test_clips_that_are_kept_in_memory_are_those_on_disk_until_it_is_full(places: LivePlaces) -> None:
    names, files, frames = ["source.rgb", "source.depth"], np.array([1, 0, 1]), np.array([3, 3, 13])

    def read(path: Path, frames: slice, names: Sequence[str]) -> dict[str, Any]:
        return read_clip(path, frames, names).arrays

    sizes: list[int] = []

    def room(size: int) -> int:
        sizes.append(size)
        return 2

    kept, disk = (Shelf(read, names, CPU, each) for each in (room, None))
    paths = training_paths(places.data)
    assert [kept.add(path) for path in paths] == [True, True, False]
    assert all(disk.add(path) for path in paths)
    assert sizes == [14 * HEIGHT * WIDTH * (3 + 2)]
    for name, array in disk.take(files, frames, names).items():
        assert torch.equal(array, kept.take(files, frames, names)[name])


def test_clips_that_are_added_to_the_folder_are_taken_in(places: LivePlaces) -> None:
    clips = TrainingClips(places.data, CPU)
    write_clip(places.data, 1, "drop")
    clips.grow()
    assert [f"{path.parent.name}/{path.stem}" for path in clips.paths][-1] == "drop/0000001-0"
    assert len(clips) == len({*clips.paths}) == 4


def test_true_logits_are_read_as_the_true_depth() -> None:
    config = DepthConfig()
    metres = torch.tensor([[[0.4, 3.0], [47.0, 1000.0]]])
    place = (metres.log() - first_bin(config)) / bin_width(config)
    nearest = place.round().clamp(0, config.bins - 2).long()
    label = torch.where(metres >= config.farthest_m, config.bins - 1, nearest)
    logits = 50.0 * torch.nn.functional.one_hot(label, config.bins).permute(0, 3, 1, 2).float()
    offsets = torch.zeros_like(logits)[:, 1:].scatter(1, nearest[:, None], ((place - nearest) / 1.5).atanh()[:, None])
    nowhere = torch.zeros_like(logits[:, :1])
    output = DepthOutput(
        logits=logits,
        raw_offsets=offsets,
        classes=logits[:, :2],
        moves=metres,
        ground=nowhere,
        ground_place=nowhere,
        summary=nowhere,
    )
    assert torch.allclose(read_depth(output, config).metres, metres, rtol=1e-3)


def test_where_the_gate_is_open_depth_is_that_of_the_declared_ground() -> None:
    net = DepthNet(TINY.depth, len(TINY.classes)).eval()
    assert net.head.out.bias is not None
    net.head.out.bias.data.zero_()
    net.head.out.bias.data[-2] = 1e6
    lens = Intrinsics.from_hfov(85.0, TINY.width, TINY.height)
    rays = pixel_rays(lens)
    ground = plane_depth(rays, torch.tensor([0.0, -0.985, -0.174]), 1.5)
    inputs = depth_inputs(torch.zeros(1, 3, TINY.height, TINY.width), rays[None], ground[None])
    with torch.no_grad():
        net.head.out.weight.zero_()
        metres = read_depth(net(inputs), TINY.depth).metres[0]
    near = (ground > TINY.depth.nearest_m * 1.5) & (ground < 20.0)
    assert near.float().mean() > 0.2
    assert ((metres / ground - 1).abs()[near] < 0.05).float().mean() > 0.98


def test_depth_learns_one_picture_by_heart(places: LivePlaces) -> None:
    torch.manual_seed(0)
    net = DepthNet(TINY.depth, len(TINY.classes))
    clips = TrainingClips(places.data, CPU)
    paths = clips.paths[:1]
    task = DepthTask(net, TINY, clips, paths, msgspec.structs.replace(stage(1), small_share=0.0), 0)
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


def test_inputs_come_back_as_they_were_splatted(places: LivePlaces, path: Path) -> None:
    clip = read_clip(path)
    splats = splats_of(clip, exact_geometry(pictures_of(clip, "source")), TINY)
    back = views_of(clip, read_inputs(places.out / path.parent.name / path.name, slice(0, 14)), ground=True).seen
    assert (back.coverage[5] - splats[5].coverage).abs().mean() < 0.03
    seen = splats[5].coverage > 0.5
    assert seen.float().mean() > 0.5
    # the stored one is by depth that is off by a few per cent, so colours agree in the middle of tiles alone
    assert (back.colour[5] - splats[5].colour).abs().mean(0)[seen].median() < 0.05


def test_an_untrained_paint_network_shows_the_splat(places: LivePlaces, path: Path) -> None:
    net = PaintNet(TINY.paint, len(TINY.classes)).eval()
    (view, *_) = HeldOutViews([path], places.out).on(torch.device("cpu"))
    with torch.no_grad():
        made = net.first_step(view.seen, filled(view.seen), TINY.sigma_max)
        whole = net.first_step(replace(view.seen, coverage=torch.ones_like(view.seen.coverage)), made.mean, 1.0)
    assert torch.equal(made.mean, filled(view.seen))
    assert torch.equal(whole.picture, whole.mean)


def test_what_was_painted_is_carried_to_where_the_camera_sees_it(places: LivePlaces, path: Path) -> None:
    inputs = places.out / path.parent.name / path.name
    before, now = (
        views_of(read_clip(path, slice(t, t + 1)), read_inputs(inputs, slice(t, t + 1)), ground=True) for t in (4, 5)
    )
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


def test_painted_pixels_of_several_frames_in_a_row_drift_and_no_others(places: LivePlaces, path: Path) -> None:
    batches = view_batches(places, 3, carried=0.7)
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


def test_paint_losses_are_lowest_at_the_truth(places: LivePlaces, path: Path) -> None:
    batches = view_batches(places, 2, carried=0.35)
    views = HeldOutViews([path], places.out)
    net = PaintNet(TINY.paint, len(TINY.classes))
    task = PaintTask(net, TINY, [batches], [path], views, 0.0)
    _, now, _ = batches.batch(0)
    with torch.no_grad():
        made = net.first_step(now.seen, filled(now.seen), TINY.sigma_max)
        losses = task.losses(made, now)
        best = task.losses(replace(made, mean=now.target, log_depth=now.log_depth), now)
    assert best["square"] == best["absolute"] == best["gradient"] == best["depth"] == 0
    assert losses["square"] > 0


def test_the_second_half_of_the_training_carries_and_denoises(places: LivePlaces, path: Path) -> None:
    net = PaintNet(TINY.paint, len(TINY.classes))
    batches = view_batches(places, 2, carried=1.0)
    task = PaintTask(net, TINY, [batches], [path], HeldOutViews([path], places.out), 0.0)
    early, late = ([task.step_loss(Progress(u, share)).parts for u in range(8)] for share in (0.0, 0.9))
    assert all("denoising" not in parts for parts in early)
    denoised = [parts["denoising"] for parts in late if "denoising" in parts]
    assert 0 < len(denoised) < 8
    assert all(bool(loss.isfinite()) and float(loss.detach()) > 0 for loss in denoised)
    plain = [(a["square"], b["square"]) for a, b in zip(early, late, strict=True) if "square" in b]
    assert any(float(a.detach()) != float(b.detach()) for a, b in plain)  # what was carried along is seen


def test_calibration_makes_the_interval_hold_and_takes_back_what_rare_classes_were_given(places: LivePlaces) -> None:
    torch.manual_seed(0)
    networks = LiveNetworks(TINY).eval()
    paths = [*places.data.glob("*/*.safetensors")][:1]
    make_inputs(places.out, paths, None, TINY, 0)
    views = HeldOutViews(paths, places.out)
    assert networks.depth.head.out.bias is not None
    biases = networks.depth.head.out.bias.requires_grad_(False)
    first = 2 * TINY.depth.bins - 1
    labels = pictures_of(read_clip(paths[0]), "source").labels
    biases[first + int(labels.flatten().mode().values)] = 10.0
    rare = first + 10
    biases[rare] = 30.0  # a class that does not occur wins
    weights = torch.ones(len(TINY.classes))
    weights[10] = torch.tensor(40.0).exp()
    assert not bool((labels == 10).any())
    calibrate(networks, paths, paths, views, weights, torch.ones_like(weights))
    assert float(biases[rare]) <= 10.0
    inside = SpreadHistogram()
    clip = read_clip(paths[0])
    made = LiveModel(networks=networks).views(clip)
    assert made.log_variance is not None
    assert made.visibility is not None
    error = (made.video - torch.from_numpy(clip.arrays["target.rgb"]).permute(0, 3, 1, 2) / 255)[1:]
    inside.add(error, made.log_variance[1:], made.visibility[1:])
    shares = [share for share in inside.coverage if share == share]
    assert shares
    assert all(0.89 < share < 0.91 for share in shares)
    assert 0.0 < networks.config.ood_threshold <= 1.0
