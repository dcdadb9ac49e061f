"""Depth from elsewhere in views: of a recording, of a network beside the model; and a source that is
unlike the training."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from cameras import noise
from fakes import (
    HEIGHT,
    WIDTH,
    Box,
    FakeSource,
    FakeSynthesizer,
    fake_classes,
    fake_config,
    fake_maps,
    live_traits,
    painting_traits,
    run,
    traits,
)
from msgspec.structs import replace as struct_replace

from gcd_client.images import depth_m, images, inverse_depth
from gcd_client.protocol import to_json
from gcd_model import Clip, RenderOptions, SourceFeatures, Traits, Trajectory, View
from gcd_model.config import SplatDepth, with_splat
from gcd_node.cli.main import run_app
from gcd_node.errors import ConfigError, DepthError, SourceError, TooShortError, UsageError
from gcd_node.frame import Frame, Image
from gcd_node.image_io import write_video
from gcd_node.messages import ontology
from gcd_node.offline import ClipRequest, read_clip

LIVE = live_traits()
FRAMES = 14


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Twice as wide as the model's shape: the middle half is used."""
    pictures = [np.full((HEIGHT, 2 * WIDTH, 3), 5 * i, np.uint8) for i in range(30)]
    write_video(tmp_path / "v.mkv", pictures, 10.0)
    return tmp_path / "v.mkv"


def read(path: Path, **request: Any) -> Clip:
    return read_clip(path, ClipRequest(**request), LIVE)


def test_depth_takes_the_way_of_its_pictures_from_a_file_as_from_a_folder(video: Path, tmp_path: Path) -> None:
    depth = np.arange(1, 31)[:, None, None] + np.zeros((HEIGHT, 1)) + np.arange(2 * WIDTH) / 100  # metres
    np.save(tmp_path / "d.npy", depth.astype(np.float32))
    (tmp_path / "d").mkdir()
    for i, each in enumerate(depth):
        cv2.imwrite(str(tmp_path / "d" / f"{i}.png"), np.rint(each * 1000).astype(np.uint16))
    wanted = depth[1 : 1 + 2 * FRAMES : 2, :, WIDTH // 2 : 3 * WIDTH // 2]
    for path in (tmp_path / "d.npy", tmp_path / "d"):
        clip = read(video, depth=path, start=1, stride=2)
        assert np.allclose(clip.depth.numpy(), wanted, atol=6e-4)


@pytest.mark.parametrize(
    ("depth", "error"),
    [
        (np.full((30, HEIGHT, 2 * WIDTH), np.nan, np.float32), DepthError),
        (np.ones((30, HEIGHT, WIDTH), np.float32), DepthError),
        (np.ones((30, HEIGHT, 2 * WIDTH), np.uint8), DepthError),
        (np.ones((HEIGHT, 2 * WIDTH), np.float32), SourceError),
        (np.ones((13, HEIGHT, 2 * WIDTH), np.float32), TooShortError),
    ],
)
def test_depth_of_other_pictures_is_refused(
    video: Path, tmp_path: Path, depth: np.ndarray, error: type[Exception]
) -> None:
    np.save(tmp_path / "d.npy", depth)
    with pytest.raises(error):
        read(video, depth=tmp_path / "d.npy")


def synthesize(source: Path, weights: str, out: Path, *options: object) -> int:
    return run_app(["synthesize", str(source), "--weights", weights, "--out", str(out), *map(str, options)])


@pytest.fixture
def still_clip(tmp_path: Path) -> Path:
    depth = np.full((FRAMES, HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, :, :20] = np.nan
    np.save(tmp_path / "depth.npy", depth)
    return noise(tmp_path / "clip", HEIGHT, WIDTH)


def test_a_live_view_is_written_with_all_it_tells(still_clip: Path, tmp_path: Path) -> None:
    orbit = ("--depth", tmp_path / "depth.npy", "--source-radius", 2.7, "--azimuth-deg", 10)
    assert synthesize(still_clip, "random:live", tmp_path, *orbit) == 0
    arrays = np.load(tmp_path / "view.npz")
    assert arrays["visibility"].shape == arrays["inverse_depth"].shape == (FRAMES, HEIGHT, WIDTH)
    assert arrays["classes"].shape == (1, FRAMES, HEIGHT, WIDTH)
    assert (tmp_path / "seen.mp4").stat().st_size > 0


def test_with_depth_a_published_model_tells_what_was_seen_in_its_units(still_clip: Path, tmp_path: Path) -> None:
    orbit = ("--azimuth-deg", 5, "--steps", 1, "--height", HEIGHT, "--width", WIDTH)
    np.save(tmp_path / "small.npy", np.load(tmp_path / "depth.npy") / 10)
    for name, (file, unit_m) in {"a": ("depth.npy", 1), "b": ("small.npy", 0.1), "c": ("small.npy", 1)}.items():
        options = (*orbit, "--depth", tmp_path / file, "--unit-m", unit_m)
        assert synthesize(still_clip, "random:kubric90", tmp_path / name, *options) == 0
    a, b, c = (np.load(tmp_path / name / "view.npz")["visibility"] for name in "abc")
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert (a[0, :, :20] == 0).all()  # a hole is painted, whatever the model drew there; it has not moved yet
    assert (a[0, :, 21:] == 2).all()
    assert synthesize(still_clip, "random:kubric90", tmp_path / "d", *orbit) == 0
    assert "visibility" not in np.load(tmp_path / "d" / "view.npz")


@pytest.mark.parametrize(
    ("weights", "options", "code"),
    [
        ("random:svd", ["--depth", "depth.npy"], 64),
        ("random:live", ["--calibration", "calib.json"], 64),
        ("random:live", ["--depth", "depth.npy", "--unit-m", "0.1"], 64),
        ("random:kubric90", ["--depth", "depth.npy", "--unit-m", "0"], 64),
        ("random:live", ["--depth", "missing.onnx"], 78),
    ],
)
def test_depth_that_cannot_be_used_is_refused_in_one_line(
    still_clip: Path, capsys: pytest.CaptureFixture[str], weights: str, options: Sequence[str], code: int
) -> None:
    placed = [still_clip.parent / each if each.endswith(("npy", "onnx")) else each for each in options]
    assert synthesize(still_clip, weights, still_clip.parent / "out", *placed) == code
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.fixture
def bad(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """A depth network that gives a frame's number in metres, and fails on the frames of this set."""
    failing: set[int] = set()

    class Network:
        def __init__(self, path: Path, *, kind: str, scale: object) -> None:
            assert (kind, scale) == ("metric", None)

        def __call__(self, *pictures: Image) -> np.ndarray:
            number = int(pictures[0][0, 0, 0]) - 20
            if number in failing:
                raise DepthError("no depth today")
            return np.full((HEIGHT, WIDTH), number, np.float32)

    monkeypatch.setattr("gcd_node.stream_context.OnnxDepth", Network)
    return failing


def played(model: FakeSynthesizer, *changes: str, frames: int = 28) -> Box:
    return run(fake_config(*changes), model, FakeSource(frames, fps=10.0))


def reasons(box: Box) -> list[str]:
    """In the last status."""
    return box.told("status")[-1]["reasons"]


def test_a_network_beside_the_model_gives_every_frame_its_depth(bad: set[int]) -> None:
    model = FakeSynthesizer(LIVE)
    bad |= {0, 3}  # and frame 0 is 0 m everywhere: all holes
    box = played(model, "model.depth_model=net.onnx")
    depths = [None if clip.depth is None else int(clip.depth.unique().item()) for clip in model.clips]
    assert depths == [None, 1, 2, None, *range(4, 28)]
    assert box.ids() == [0, 1]
    assert [event["message"] for event in box.events("DEPTH_BAD")] == ["no depth today"]
    assert box.told("status")[-1]["model"]["bad_depths"] == 2
    assert "DEPTH_BAD" not in reasons(box)  # the second window had none


def test_windows_without_the_right_depth_are_dropped_where_that_is_asked_for(bad: set[int]) -> None:
    bad.add(5)
    box = played(FakeSynthesizer(LIVE), "model.depth_model=net.onnx", "model.on_bad_depth=stop", frames=42)
    assert box.ids() == [1, 2]
    assert box.told("status")[-1]["drops"]["model"] == 1


class Measuring(FakeSource):
    """Its frames have depth in their middle, and odometry 0.1 m ahead with each, except where a test puts others."""

    def __init__(self, frames: int, depths: dict[int, np.ndarray], poses: dict[int, np.ndarray]) -> None:
        super().__init__(frames, fps=10.0, size=(2 * WIDTH, HEIGHT))
        self._depths, self._poses = depths, poses

    def frames(self) -> Iterator[Frame]:
        for frame in super().frames():
            depth, pose = np.tile(np.arange(2 * WIDTH, dtype=np.float32), (HEIGHT, 1)), np.eye(4)
            pose[2, 3] = 0.1 * frame.seq
            depth, pose = self._depths.get(frame.seq, depth), self._poses.get(frame.seq, pose)
            yield replace(frame, depth=depth, odometry=pose)


def test_what_a_source_measures_reaches_the_live_model_frame_by_frame() -> None:
    holes, far, torn = np.zeros((HEIGHT, 2 * WIDTH), np.float32), np.eye(4), np.full((4, 4), np.nan)
    far[0, 3] = 100.0
    streaming = replace(LIVE, config=struct_replace(LIVE.config, frames=1))
    model = FakeSynthesizer(streaming)
    box = run(fake_config(), model, Measuring(14, {3: holes}, {5: far, 9: torn}))
    assert [n for n, clip in enumerate(model.clips) if clip.depth is None] == [3]
    assert [n for n, clip in enumerate(model.clips) if clip.odometry is None] == [5, 6, 9]  # there and back
    depth, pose = model.clips[-1].depth, model.clips[-1].odometry
    assert np.array_equal(depth[0, 0].numpy(), np.arange(WIDTH / 2, 3 * WIDTH / 2))  # cut as its picture
    assert pose[0, 2, 3].item() == pytest.approx(1.3)
    assert [len(box.events(code)) for code in ("DEPTH_BAD", "ODOMETRY_BAD")] == [1, 2]
    assert len(box.of("win")) == 14
    model = FakeSynthesizer(traits())  # others are given neither
    run(fake_config(), model, Measuring(28, {}, {}))
    assert {(clip.depth, clip.odometry) for clip in model.clips} == {(None, None)}


@pytest.mark.parametrize(("made", "kind"), [(traits(), "metric"), (LIVE, "metric"), (LIVE, "inverse")])
def test_a_node_refuses_depth_that_it_cannot_use(made: Traits, kind: str) -> None:
    with pytest.raises(ConfigError):
        played(FakeSynthesizer(made), "model.depth_model=missing.onnx", f"model.depth_kind={kind}")


@pytest.mark.parametrize("splat", ["given", "estimated"])
def test_of_weights_that_are_shown_points_a_node_runs_those_that_estimate_depth(splat: SplatDepth) -> None:
    model = FakeSynthesizer(replace(traits(), config=with_splat(traits().diffusion, splat)))
    if splat == "given":
        with pytest.raises(ConfigError, match="estimated"):
            played(model)
    else:
        assert played(model, frames=28).of("win")
        assert model.clips[-1].lens is not None


def test_the_field_of_view_can_be_stated_to_weights_that_estimate_depth(video: Path) -> None:
    shown = replace(traits(), config=with_splat(traits().diffusion, "estimated"))
    clip = read_clip(video, ClipRequest(hfov_deg=90.0), shown)
    assert clip.lens is not None
    assert clip.lens.hfov_deg == pytest.approx(53.13, abs=0.01)  # across the middle half of the picture
    with pytest.raises(UsageError):
        read_clip(video, ClipRequest(hfov_deg=90.0), traits())


class Telling(FakeSynthesizer):
    """Says something of each of its windows."""

    def __init__(self, *told: dict[str, Any]) -> None:
        super().__init__(LIVE)
        self._told = list(told)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        told = self._told.pop(0)
        return [replace(view, **told) for view in super().render(features, trajectories, options)]


def test_a_source_of_another_world_is_flagged_as_long_as_it_lasts() -> None:
    above, below = LIVE.ood_threshold + 0.2, LIVE.ood_threshold - 0.2
    box = played(Telling({"ood": below}, {"ood": above}))
    headers = [message.header for message in box.of("win")]
    assert [header.quality.ood_score for header in headers] == [below, above]
    assert ["world" in header.quality.ood for header in headers] == [False, True]
    assert "world" in reasons(box)
    assert len(box.events("world")) == 1
    assert box.told("status")[-1]["model"]["ood_score"] == round(above, 3)
    assert "world" not in reasons(played(Telling({"ood": above}, {"ood": below})))
    box = played(FakeSynthesizer(traits()))  # which cannot tell
    header = box.of("win")[0].header
    assert set(to_json(header)["quality"]) == {"nan_frames", "ood", "steps", "seed"}
    assert "world" not in header.quality.ood
    assert "ood_score" not in box.told("status")[-1]["model"]


def test_a_motion_that_is_lost_is_told_when_it_begins_and_over_with_the_next_window() -> None:
    lost, known = {"lost": ("the odometry jumps by 100 m", "too few points")}, {"lost": ()}
    box = played(Telling(lost, lost, known), frames=42)
    events = [(event["message"], event["frames"]) for event in box.events("MOTION_LOST")]
    assert events == [("the odometry jumps by 100 m", 2)]
    assert "MOTION_LOST" not in reasons(box)
    assert "MOTION_LOST" in reasons(played(Telling(known, lost)))


# Class maps, visibility, depth and a stated spread, from the view that holds them: what is published, and when.


HELD = ("visibility", "inverse_depth")


def published(*holds: str, frames: int = 28, encoding: str = "rgb8") -> Box:
    model = FakeSynthesizer(painting_traits(), holds=holds)
    return run(fake_config(f"publish.encoding={encoding}"), model, FakeSource(frames, fps=10.0))


def test_every_window_of_a_view_that_holds_them_comes_with_its_own() -> None:
    box, made = published(*HELD), painting_traits()
    order = [message.topic.rpartition("/")[2] for message in box.views[:4]]
    assert order == ["win", "cls", "vis", "depth"]
    same = ("window_id", "t_capture_ns", "source_from_view", "view_rev", "intrinsics", "frame_role", "age_ms", "model")
    for kind, proto in (("cls", "gcd/1.0"), ("vis", "gcd/1.1"), ("depth", "gcd/1.1")):
        for message, window in zip(box.of(kind), box.of("win"), strict=True):
            assert all(getattr(message.header, name) == getattr(window.header, name) for name in same)
            assert (message.header.proto, window.header.proto) == (proto, "gcd/1.0")
    assert np.array_equal(images(box.of("vis")[1])[..., 0], fake_maps()["visibility"].numpy())
    drawn, told = fake_classes(made, 1), box.of("cls")[0].header.classes
    assert np.array_equal(images(box.of("cls")[0])[..., 0], drawn[0].numpy())
    assert told == ontology(made)
    assert box.told("meta")[0]["classes"] == [
        {"id": each.id, "name": each.name, "colour": each.colour} for each in told
    ]


def test_depth_loses_less_than_a_thousandth_and_what_is_none_stays_none(monkeypatch: pytest.MonkeyPatch) -> None:
    sent, wanted = inverse_depth(published(*HELD, frames=14).of("depth")[0]), fake_maps()["inverse_depth"].numpy()
    known = wanted > 0
    assert (wanted[known].min() < 1 / 199, wanted[known].max() > 1 / 0.31) == (True, True)
    assert np.array_equal(sent > 0, known)
    assert (np.abs(sent[known] / wanted[known] - 1) < 0.0005).all()
    bad = {**fake_maps(), "inverse_depth": torch.full((14, 64, 96), 0.5)}
    bad["inverse_depth"][:, :, :4] = torch.tensor([torch.nan, torch.inf, -torch.inf, -1.0])
    monkeypatch.setattr("fakes.fake_maps", lambda: bad)
    metres = depth_m(published(*HELD, frames=14).of("depth")[0])
    assert np.isnan(metres[..., :4]).all()
    assert (metres[..., 4:] == 2.0).all()


def test_what_a_view_does_not_hold_is_neither_published_nor_ended_and_what_it_held_ends_once() -> None:
    for holds in ((), ("visibility",), ("inverse_depth",), HELD):
        box = published(*holds)
        kinds = {
            "win",
            "frm",
            "cls",
            *(kind for kind, name in zip(("vis", "depth"), HELD, strict=True) if name in holds),
        }
        assert {message.topic for message in box.views} == {f"view/main/{kind}" for kind in kinds}
        assert sorted(message.topic for message in box.ends) == sorted(f"view/main/{kind}" for kind in kinds)
        assert {end.header.proto for end in box.ends if end.topic.endswith(("/vis", "/depth"))} <= {"gcd/1.1"}
    windows = iter((HELD, ("visibility",), ("visibility",)))
    model = FakeSynthesizer(traits(), lambda _: setattr(model, "holds", next(windows)))
    box = run(fake_config(), model, FakeSource(42))
    assert [message.header.window_id for message in box.of("depth")] == [0]
    ends = sorted((message.topic[10:], message.header.window_id) for message in box.ends)
    assert ends == [("depth", 1), ("frm", 2), ("vis", 2), ("win", 2)]


@pytest.mark.slow
def test_maps_are_never_made_lossy_and_one_sample_of_a_model_that_states_its_spread_has_a_deviation() -> None:
    raw, packed = (published(*HELD, "log_variance", frames=14, encoding=encoding) for encoding in ("rgb8", "jpeg"))
    assert packed.of("win")[0].header.encoding == "jpeg"
    for kind in ("vis", "depth"):
        assert bytes(packed.of(kind)[0].payload) == bytes(raw.of(kind)[0].payload)
    (message,) = raw.of("std")
    assert message.header.scale is not None
    assert np.allclose(images(message) * message.header.scale, 25.5, atol=0.1)  # a tenth, in grey levels
    plain = published(*HELD, frames=14)
    assert plain.of("std") == []
    assert len(raw.ends) == len(plain.ends) + 1
    for family in ("kubric90", "driving", "svd"):  # without a class head
        box = run(fake_config(), FakeSynthesizer(traits(family)), FakeSource(28, fps=10.0))
        assert "view/main/cls" not in {message.topic for message in (*box.views, *box.ends)}
        assert box.told("meta")[0]["classes"] == []
