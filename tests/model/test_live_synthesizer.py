"""The live model behind the door: features frame by frame, views of windows, weights in our own files."""

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
import torch
from live_room import FRAMES, HEIGHT, WIDTH, one_thread, path, room  # noqa: F401  a fixture
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.testing import assert_close

from gcd_model import (
    CameraMount,
    Cancelled,
    CheckpointError,
    Clip,
    Intrinsics,
    NonFiniteError,
    OptionError,
    PoseError,
    RenderOptions,
    SphericalDelta,
    Trajectory,
    View,
    convert_weights,
    inspect_weights,
    load_synthesizer,
    visibility_of,
)
from gcd_model.errors import ShapeError
from gcd_model.geometry import driving_trajectory
from gcd_model.live.config import LIVE_TINY
from gcd_model.live.synthesizer import LiveSynthesizer, save_live
from gcd_model.networks import LiveNetworks, random_networks
from gcd_model.weights.card import LIVE, packed, unpacked
from gcd_model.weights.load import load_weights


@pytest.fixture(scope="module")
def live() -> LiveSynthesizer:
    made = load_synthesizer("random:live", device="cpu")
    assert isinstance(made, LiveSynthesizer)
    return made


def same(a: View, b: View, tolerance: float = 0.0) -> None:
    for name in ("samples", "classes", "visibility", "inverse_depth", "log_variance"):
        mine, other = getattr(a, name), getattr(b, name)
        if mine.is_floating_point():
            assert_close(mine, other, rtol=tolerance, atol=tolerance)
        else:
            assert torch.equal(mine, other), name


# Encoding.


@pytest.mark.parametrize("known", [True, False])
def test_features_joined_frame_by_frame_are_those_encoded_at_once(live: LiveSynthesizer, known: bool) -> None:
    clip = room() if known else room(depth=None, odometry=None)
    tensors = {name: each for name in ("video", "depth", "odometry") if (each := getattr(clip, name)) is not None}
    whole = live.encode(clip)
    parts = [
        live.encode(replace(clip, **{name: each[t : t + 1] for name, each in tensors.items()})) for t in range(FRAMES)
    ]
    joined = parts[0].followed_by(*parts[1:])
    assert joined.frames == FRAMES
    for name in ("metres", "stated"):
        assert torch.equal(getattr(whole, name), getattr(joined, name))
    halves = whole.rows(0, 7).followed_by(whole.rows(7, 14))
    expected, *others = (live.render(each, [path()], RenderOptions(seed=3))[0] for each in (whole, joined, halves))
    for other in others:
        same(expected, other)


def test_the_lens_is_the_clips_then_the_mounts_then_the_forward_cameras(live: LiveSynthesizer) -> None:
    bare = room(1, lens=None)
    for clip, wanted in ((room(1), 70.0), (replace(bare, mount=CameraMount(hfov_deg=60.0)), 60.0), (bare, 85.0)):
        lens = live.encode(clip).lens
        assert lens is not None
        assert lens.hfov_deg == pytest.approx(wanted)


# Bad input at the door.


@pytest.mark.parametrize("bad", [float("nan"), -2.0, float("inf"), 0.0])
def test_depth_that_is_none_is_a_hole_and_nothing_in_it_is_seen(live: LiveSynthesizer, bad: float) -> None:
    depth = torch.full((FRAMES, HEIGHT, WIDTH), bad)
    networks = random_networks(LIVE_TINY, seed=0)
    bias = networks.depth.head.out.bias
    assert bias is not None
    bias.data[LIVE_TINY.depth.bins - 1] = -1e6  # a hole in the sky is the sky, and there is none
    grounded = LiveSynthesizer(networks, live.traits)
    view = grounded.render(grounded.encode(room(depth=depth, odometry=None)), [path(0.0)])[0]
    assert view.visibility is not None
    assert not bool(view.visibility.any())


@pytest.mark.parametrize("size", [(32, 32), (64, 96)])
def test_any_size_in_multiples_of_32(live: LiveSynthesizer, size: tuple[int, int]) -> None:
    clip = Clip(video=torch.rand(FRAMES, 3, *size) - 0.5, fps=10.0)
    view = live.render(live.encode(clip), [path()])[0]
    assert view.samples.shape == (1, FRAMES, 3, *size)


@pytest.mark.parametrize(
    ("make", "paths", "error"),
    [
        (lambda: Clip(video=torch.zeros(1, 3, 32, 40), fps=10.0), [path()], OptionError),
        (lambda: Clip(video=torch.zeros(1, 3, 16, 64), fps=10.0), [path()], OptionError),
        (lambda: room(3), [path(frames=3)], ShapeError),
        (lambda: room(), [], ShapeError),
        (lambda: room(depth=torch.ones(FRAMES, HEIGHT, WIDTH + 1)), [path()], ShapeError),
        (lambda: room(depth=torch.ones(FRAMES, HEIGHT, WIDTH, dtype=torch.float64)), [path()], ShapeError),
        (lambda: room(odometry=torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)), [path()], ShapeError),
        (lambda: room(odometry=2 * torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)), [path()], PoseError),
        (lambda: room(lens=Intrinsics.from_hfov(70.0, 96, 64)), [path()], ShapeError),
    ],
)
def test_other_sizes_lengths_no_view_and_what_does_not_belong_to_the_video_are_refused_in_one_line(
    live: LiveSynthesizer, make: Callable[[], Clip], paths: list[Trajectory], error: type[Exception]
) -> None:
    with pytest.raises(error) as raised:
        live.render(live.encode(make()), paths)
    assert "\n" not in str(raised.value)


# Rendering.


def test_a_view_is_what_its_type_says(live: LiveSynthesizer) -> None:
    view = live.render(live.encode(room()), [path()])[0]
    frame, shapes = (
        (FRAMES, HEIGHT, WIDTH),
        {"samples": (1, FRAMES, 3, HEIGHT, WIDTH), "classes": (1, FRAMES, HEIGHT, WIDTH)},
    )
    for name, dtype in {
        "samples": torch.float32,
        "classes": torch.uint8,
        "visibility": torch.uint8,
        "inverse_depth": torch.float32,
        "log_variance": torch.float32,
    }.items():
        each = getattr(view, name)
        assert (each.dtype, tuple(each.shape)) == (dtype, shapes.get(name, frame)), name
    assert 0.0 <= float(view.samples.min()) <= float(view.samples.max()) <= 1.0
    assert view.visibility is not None
    assert set(view.visibility.unique().tolist()) <= {0, 1, 2}
    assert view.ood is not None
    assert 0.0 <= view.ood <= 1.0
    assert view.uncertainty is not None
    assert bool((view.uncertainty > 0).all())


def test_two_views_in_one_call_are_each_alone(live: LiveSynthesizer) -> None:
    features, options = live.encode(room()), RenderOptions(steps=2, seed=5)
    both = live.render(features, [path(0.4), path(-0.9)], options)
    for view, x in zip(both, (0.4, -0.9), strict=True):
        same(view, live.render(features, [path(x)], options)[0])


def test_samples_are_drawn_in_several_steps_and_the_mean_in_one(live: LiveSynthesizer) -> None:
    features = live.encode(room())
    drawn = live.render(features, [path()], RenderOptions(steps=3, samples=2))[0]
    assert not torch.equal(drawn.samples[0], drawn.samples[1])
    same(
        replace(drawn, samples=drawn.samples[:1], classes=None if drawn.classes is None else drawn.classes[:1]),
        live.render(features, [path()], RenderOptions(steps=3))[0],
    )
    mean = live.render(features, [path()], RenderOptions(steps=1, samples=2))[0]
    assert torch.equal(mean.samples[0], mean.samples[1])
    assert mean.std is not None
    assert float(mean.std.min()) > 0  # as the model states it, however alike the samples are


def test_odometry_that_jumps_costs_the_memory_and_nothing_else(live: LiveSynthesizer) -> None:
    """After the jump the view is that of a clip that begins there."""
    clip = room()
    assert clip.odometry is not None
    jumped = clip.odometry.clone()
    jumped[7:, 0, 3] += 100.0
    networks = random_networks(LIVE_TINY, seed=0)
    moves = networks.depth.head.out.bias
    assert moves is not None
    moves.data[-3] = -1e6  # everything stands still, so everything is remembered
    still = LiveSynthesizer(networks, live.traits)
    view = still.render(still.encode(replace(clip, odometry=jumped)), [path(-1.0)])[0]
    kept = still.render(still.encode(clip), [path(-1.0)])[0]
    assert view.visibility is not None
    assert kept.visibility is not None
    assert int((kept.visibility[7] == 1).sum()) > 0
    assert int((view.visibility[7] == 1).sum()) == 0
    assert torch.equal(view.visibility[:7], kept.visibility[:7])
    assert len(view.lost) == 1
    assert kept.lost == ()


def test_cancel_is_noticed_between_two_frames(live: LiveSynthesizer) -> None:
    cancel, done = threading.Event(), []

    def progress(frame: int, frames: int) -> None:
        done.append((frame, frames))
        if frame == 3:
            cancel.set()

    with pytest.raises(Cancelled):
        live.render(live.encode(room()), [path()], RenderOptions(cancel=cancel, progress=progress))
    assert done == [(1, FRAMES), (2, FRAMES), (3, FRAMES)]


@pytest.mark.parametrize("network", ["depth", "paint"])
def test_nan_in_the_weights_is_an_error_and_no_view(network: str) -> None:
    networks = random_networks(LIVE_TINY, seed=0)
    for parameter in getattr(networks, network).parameters():
        parameter.data.fill_(torch.nan)
    broken = LiveSynthesizer(networks, load_synthesizer("random:live", device="cpu").traits)
    clip = room(depth=None, odometry=None)
    with pytest.raises(NonFiniteError):
        broken.render(broken.encode(clip), [path()])


# Views.


def test_the_default_view_is_the_papers_from_above_and_stands_at_its_goal(live: LiveSynthesizer) -> None:
    mount = CameraMount(height_m=1.2, tilt_deg=5.0)
    for given in (None, mount):
        planned = live.traits.plan_view(mount=given)
        assert all(planned.at_goal)
        wanted = driving_trajectory(frames=FRAMES, move_time=0, mount=given)
        assert_close(planned.source_from_target, wanted.source_from_target)
    assert not all(live.traits.plan_view(move_time=13).at_goal)


def test_a_camera_on_a_vehicle_orbits_upright_about_what_it_looks_at(live: LiveSynthesizer) -> None:
    mount = CameraMount(height_m=1.0, forward_m=0.0, tilt_deg=30.0)
    around = live.traits.plan_view(SphericalDelta(azimuth_deg=90.0), mount=mount)
    vehicle_from_view = mount.vehicle_from_camera @ around.source_from_target[0]
    assert float(vehicle_from_view[2, 3]) == pytest.approx(1.0)  # as high as before
    assert float(vehicle_from_view[2, 0]) == pytest.approx(0.0, abs=1e-12)  # level
    assert vehicle_from_view[:2, 3].tolist() == pytest.approx([3**0.5, -(3**0.5)])


def test_a_placed_view_stands_where_it_says_on_the_vehicle(live: LiveSynthesizer) -> None:
    mount = CameraMount(height_m=0.6, forward_m=0.2, left_m=0.1, tilt_deg=15.0)
    planned = live.traits.plan_placed((-1.0, 0.5, 2.0), (2.0, 0.0, 0.0), mount=mount)
    vehicle_from_view = mount.vehicle_from_camera @ planned.source_from_target[5]
    assert_close(vehicle_from_view[:3, 3], torch.tensor([-1.0, 0.5, 2.0], dtype=torch.float64))
    with pytest.raises(PoseError):
        live.traits.plan_placed((0.0, 0.0, 2.0), (0.0, 0.0, 0.0))
    with pytest.raises(OptionError):
        load_synthesizer("random:kubric90", device="cpu").traits.plan_placed((0.0, 0.0, 2.0), (1.0, 0.0, 0.0))


# Weights.


def test_weights_survive_their_file(tmp_path: Path) -> None:
    networks = random_networks(LIVE_TINY, seed=4)
    save_live(tmp_path / "mine.safetensors", networks, "mine")
    loaded = load_synthesizer(tmp_path / "mine.safetensors", device="cpu", dtype="float32")
    assert isinstance(loaded, LiveSynthesizer)
    assert (loaded.traits.name, loaded.traits.move_time, loaded.traits.config) == ("mine", 0, LIVE_TINY)
    assert {each.dtype for each in loaded.networks.parameters()} == {torch.float32}
    for name, tensor in networks.state_dict().items():
        assert torch.equal(loaded.networks.state_dict()[name], tensor.half().float())
    report = inspect_weights(tmp_path / "mine.safetensors")
    assert (report.family, report.config, report.trained) == (LIVE, LIVE_TINY, True)
    assert [each.name for each in report.networks] == ["depth", "paint", "familiarity"]
    assert report.parameters == sum(each.numel() for each in networks.state_dict().values())
    converted = convert_weights(tmp_path / "mine.safetensors", tmp_path / "wide.safetensors", dtype="float32")
    assert converted.networks[0].dtypes == ("float32",)


def resaved(path: Path, change: Callable[[dict[str, str], dict[str, Tensor]], object]) -> Path:
    save_live(path, LiveNetworks(LIVE_TINY), "mine", overwrite=True)
    tensors = load_file(path)
    with safe_open(path, framework="pt") as file:
        metadata = unpacked(file.metadata())
    change(metadata, tensors)
    save_file(tensors, path, metadata=packed(metadata))
    return path


HOSTILE: dict[str, object] = {
    "bins": {"depth": {"bins": 10**9}},
    "widths": {"paint": {"widths": [10**15, 8, 8]}},
    "negative widths": {"depth": {"widths": [-8, 16, 16]}},
    "no widths": {"depth": {"widths": [0, 0, 0]}},
    "frames": {"frames": -3},
    "size": {"height": 33},
    "area": {"height": 8192, "width": 8192},
    "steps": {"steps": 1000},
    "sigma": {"sigma_max": 1e300},
    "near": {"depth": {"nearest_m": 1e-300}},
    "beyond the sky": {"depth": {"farthest_m": 1e30}},
    "memory": {"memory": 10**12},
    "classes": {"classes": []},
    "far": {"depth": {"farthest_m": 0.1}},
    "unknown": {"teleport": True},
    "kind": {"kind": "dead"},
    "other": {"unet": {}},
    "text": "live",
}


def stated(hostile: object, metadata: dict[str, str]) -> None:
    own = json.loads(metadata["gcd.config"])
    if isinstance(hostile, dict):
        inner = {n: {**own[n], **each} for n, each in hostile.items() if isinstance(each, dict) and n in own}
        hostile = own | hostile | inner
    metadata["gcd.config"] = json.dumps(hostile)


CHANGES: dict[str, Callable[[dict[str, str], dict[str, Tensor]], object]] = {
    **{name: lambda metadata, _, hostile=hostile: stated(hostile, metadata) for name, hostile in HOSTILE.items()},
    "missing weights": lambda _, tensors: tensors.pop("depth.trunk.stem.weight"),
    "other weights": lambda _, tensors: tensors.update(extra=torch.zeros(1)),
    "misshapen weights": lambda _, tensors: tensors.update({"paint.votes.bias": torch.zeros(99)}),
    "another family": lambda metadata, _: metadata.update({"gcd.family": "driving"}),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_a_hostile_config_and_other_weights_are_refused_in_one_line(
    tmp_path: Path, change: Callable[[dict[str, str], dict[str, Tensor]], object]
) -> None:
    file = resaved(tmp_path / "bad.safetensors", change)
    for read in (load_synthesizer, inspect_weights):
        with pytest.raises(CheckpointError) as raised:
            read(file)
        assert "\n" not in str(raised.value)


def test_a_live_file_is_no_diffusion_model_and_says_so(tmp_path: Path) -> None:
    save_live(tmp_path / "mine.safetensors", LiveNetworks(LIVE_TINY), "mine")
    loaded = load_weights(tmp_path / "mine.safetensors")
    with pytest.raises(CheckpointError):
        loaded.diffusion  # noqa: B018
    half = load_synthesizer(tmp_path / "mine.safetensors", device="cpu", dtype="bfloat16")
    assert isinstance(half, LiveSynthesizer)
    assert {each.dtype for each in half.networks.parameters()} == {torch.bfloat16}
    for options in ({"dtype": "float16"}, {"frames": 0}):
        with pytest.raises(OptionError):
            load_synthesizer(tmp_path / "mine.safetensors", device="cpu", **options)  # type: ignore[arg-type]
    fewer = load_synthesizer(tmp_path / "mine.safetensors", device="cpu", frames=5)
    assert fewer.traits.config == msgspec.structs.replace(LIVE_TINY, frames=5)


# What is seen, without a network.


def test_from_where_it_was_taken_all_that_has_a_depth_is_seen_and_a_hole_is_painted() -> None:
    clip = room()
    assert clip.depth is not None
    clip.depth[:, :, :10] = torch.tensor([0.0, torch.nan, -1.0, torch.inf, 0.0] * 2)
    seen = visibility_of(clip, path(0.0))
    assert seen.dtype == torch.uint8
    assert not seen[:, :, :10].any()
    assert bool((seen[:, :, 11:] == 2).all())


def test_a_view_sees_nothing_that_its_source_does_not() -> None:
    aside = visibility_of(room(), path(1.0))
    shift = round(1.0 / 3.0 * room().lens.fx)  # type: ignore[union-attr]
    assert bool((aside[:, :, : WIDTH - shift - 1] == 2).all())
    assert not aside[:, :, WIDTH - shift + 1 :].any()
    assert not visibility_of(room(), path(50.0)).any()
