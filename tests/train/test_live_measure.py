"""What the live view is measured by: laws on pictures whose figures are known beforehand."""

import json
import math
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from live_clips import TINY, write_clip
from safetensors.torch import save_file

from gcd_model.errors import CheckpointError
from gcd_model.geometry import Intrinsics
from gcd_model.live.config import LiveConfig
from gcd_model.live.depth_net import Familiarity, summary_of
from gcd_model.live.synthesizer import save_live
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError
from gcd_train.evaluation.metrics import gradient_map
from gcd_train.live.calibration import SpreadHistogram, fit_spread
from gcd_train.live.clips import BEFORE, NEVER, NOW
from gcd_train.live.training import live_model

sys.path.append(str(Path(__file__).parents[2] / "tools"))
figure, measure, other_world = (import_module(name) for name in ("live_figures", "live_measure", "other_world"))
MethodViews, Tally, Truth = figure.MethodViews, figure.Tally, figure.Truth
cells, frechet_distance, surface_motion = figure.cells, figure.frechet_distance, figure.surface_motion
FRAMES, HEIGHT, WIDTH = 4, 64, 96
LENS = Intrinsics.from_hfov(70.0, WIDTH, HEIGHT)


def truth(seed: int = 0) -> Truth:
    """Noise in front of a camera that stands; the left half was never seen, a stripe was seen before."""
    generator = torch.Generator().manual_seed(seed)
    video = torch.rand(FRAMES, 3, HEIGHT, WIDTH, generator=generator)
    visibility = torch.full((FRAMES, HEIGHT, WIDTH), NOW, dtype=torch.uint8)
    visibility[..., : WIDTH // 2], visibility[..., WIDTH // 2 : WIDTH // 2 + 16] = NEVER, BEFORE
    metres = torch.full((FRAMES, HEIGHT, WIDTH), 5.0)
    poses = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    before, static = surface_motion(metres, torch.zeros_like(metres, dtype=torch.bool), poses, LENS)
    return Truth(
        video=video,
        labels=torch.randint(0, 12, (FRAMES, HEIGHT, WIDTH), generator=generator, dtype=torch.uint8),
        visibility=visibility,
        before=before,
        static=static,
        gradient=gradient_map(video[1:]),
        features=cells(video[1:]),
    )


def perfect(of: Truth) -> MethodViews:
    return MethodViews(
        video=of.video,
        classes=of.labels,
        visibility=of.visibility,
        log_variance=torch.full(of.labels.shape, -8.0),
    )


def figures(views: MethodViews, of: Truth) -> dict[str, float]:
    tally = Tally(LiveConfig().classes)
    for _ in range(12):  # enough cells for a covariance
        tally.add("scene", of, views, torch.zeros_like(of.video))
    return tally.figures()


def test_the_truth_itself_has_perfect_figures() -> None:
    made = figures(perfect(truth()), truth())
    for name in ("psnr", "psnr_seen", "psnr_never"):
        assert made[name] == pytest.approx(100.0)
    pictures = ("ssim", "ssim_seen", "gradient_energy", "flicker", "jump")
    for name in (*pictures, "miou", "person", "car", "iou_painted", "iou_before", "iou_now"):
        assert made[name] == pytest.approx(1.0), name
    assert made["frechet_random"] == pytest.approx(0.0, abs=1e-6)
    assert made["error_ratio_seen"] == pytest.approx(0.0)
    assert made["share_never"] == pytest.approx(0.5)
    assert [made[f"inside_90_{state}"] for state in ("painted", "before", "now")] == [1.0, 1.0, 1.0]


def test_fog_has_no_gradients_and_another_distribution() -> None:
    of = truth()
    fog = figures(replace(perfect(of), video=torch.full_like(of.video, 0.5)), of)
    assert fog["gradient_energy"] == pytest.approx(0.0, abs=1e-3)
    assert fog["frechet_random"] > 1.0
    assert fog["psnr"] == pytest.approx(10 * math.log10(12.0), abs=0.1)  # noise in [0, 1] has a variance of 1/12


def test_what_a_method_does_not_say_is_not_a_number_and_the_splat_errs_as_itself() -> None:
    of = truth()
    views = MethodViews(video=of.video.flip(-1))
    tally = Tally(LiveConfig().classes)
    tally.add("scene", of, views, views.video)
    made = tally.figures()
    assert made["error_ratio_seen"] == pytest.approx(1.0)
    assert all(math.isnan(made[name]) for name in ("miou", "iou_now", "inside_90_now"))


def test_fit_spread_holds_ninety_per_cent_of_gaussian_errors_in_every_state() -> None:
    generator = torch.Generator().manual_seed(3)
    state = torch.arange(3).repeat_interleave(40).view(1, 1, -1).expand(8, 60, -1).to(torch.uint8)
    deviation = torch.tensor([0.2, 0.05, 0.01])[state.long()]
    error = torch.randn(8, 3, 60, 120, generator=generator) * deviation[:, None]
    stated = torch.full((8, 60, 120), -5.0)
    before, after = SpreadHistogram(), SpreadHistogram()
    before.add(error, stated, state)
    shifts = torch.tensor(fit_spread(before))
    after.add(error, stated + shifts[state.long()], state)
    torch.testing.assert_close(torch.tensor(after.coverage), torch.full((3,), 0.9), atol=0.005, rtol=0)
    torch.testing.assert_close(
        ((stated[0, 0, 0] + shifts) / 2).exp(), torch.tensor([0.2, 0.05, 0.01]), atol=0, rtol=0.03
    )


def test_a_surface_is_found_where_it_was_a_frame_before() -> None:
    metres = torch.full((2, HEIGHT, WIDTH), 4.0)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 4.0 / LENS.fx * 5  # five pixels to the right
    moves = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    moves[1, :8] = True
    before, static = surface_motion(metres, moves, poses, LENS)
    columns = (before[0, 20, :, 0] + 1) * WIDTH / 2 - 0.5
    torch.testing.assert_close(columns, torch.arange(WIDTH) + 5.0, atol=1e-4, rtol=0)
    assert not static[0, :8].any()
    assert static[0, 8:, : WIDTH - 5].all()
    assert not static[0, :, WIDTH - 5 :].any()


def test_a_shimmering_view_flickers_more_than_its_truth() -> None:
    of = truth()
    still = replace(of, video=of.video[:1].repeat(FRAMES, 1, 1, 1) + torch.rand(FRAMES, 1, 1, 1) * 0.01)
    made = figures(MethodViews(video=of.video), still)
    assert made["flicker"] > 10


def test_the_homography_is_exact_for_a_plane() -> None:
    normal, away_m = torch.tensor([0.1, -0.9, 0.3], dtype=torch.float64), -1.6  # n . x = away in the target's axes
    metres = away_m / (measure.pixel_rays(LENS) @ normal)
    move = torch.eye(4, dtype=torch.float64)
    move[:3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.05, -0.2, 0.02]))[0])
    move[:3, 3] = torch.tensor([0.4, -0.1, 0.7])
    here, there = measure._correspondences(metres, metres > 0, move, LENS, LENS)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for found in measure._candidates(here, there, picture, picture):
        mapped = cv2.perspectiveTransform(here[:, None], found)[:, 0]
        np.testing.assert_allclose(mapped, there, atol=1e-4)


def test_an_interval_of_the_report_holds_its_mean() -> None:
    psnr = {"live": (20.0, 24.0, 21.0, 30.0), "splat": (18.0, 23.0, 22.0, 19.0)}
    tallies = {name: SimpleNamespace(psnr={str(k): [db] for k, db in enumerate(of)}) for name, of in psnr.items()}
    (apart,) = measure.differences(SimpleNamespace(tallies=tallies)).values()
    assert apart["psnr"] == pytest.approx(3.25)
    assert apart["low"] < apart["psnr"] < apart["high"]


def test_frechet_distance_is_that_of_the_means_where_the_spread_is_the_same() -> None:
    features = torch.randn(4000, 64, generator=torch.Generator().manual_seed(1))
    assert frechet_distance(features + 0.5, features) == pytest.approx(64 * 0.25, rel=0.06)
    assert math.isnan(frechet_distance(features[:100], features))


def test_unknown_methods_and_other_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        measure.chosen_methods(["telepathy"], [measure.ExactSplat(training=tmp_path)])
    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError):
        live_model(str(tmp_path / "other.safetensors"))
    with pytest.raises(DataError, match="is no live model"):
        live_model("random:driving")


# how unlike its training a camera looks to the live model


def test_what_the_training_never_had_scores_higher_and_scale_does_not_matter() -> None:
    generator = torch.Generator().manual_seed(0)
    mix = torch.randn(6, 6, generator=generator) * torch.tensor([1e-3, 1.0, 1e3, 1.0, 1.0, 1.0])
    known = torch.randn(500, 6, generator=generator) @ mix + 5.0
    moved = known[:100] + 4.0 * known.std(0) * torch.tensor([1, -1, 1, 0, 0, 0])
    familiar = Familiarity(3)
    familiar.fit(known)
    sure, unsure = (familiar.score(known[:100], torch.full((100,), entropy)) for entropy in (0.05, 0.5))
    foreign = familiar.score(moved, torch.full((100,), 0.05))
    assert 0.0 <= float(sure.min()) < float(sure.mean()) < float(unsure.mean())
    assert float(foreign.mean()) > 3 * float(sure.mean())
    assert float(torch.maximum(foreign, unsure).max()) <= 1.0
    assert float(-(1 - familiar.score(known, torch.ones(500))).log().mean()) == pytest.approx(1.0, abs=0.05)


def test_a_summary_is_of_the_picture_and_not_of_its_size() -> None:
    features = torch.randn(2, 3, 4, 6)
    twice = features.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    assert torch.allclose(summary_of(features), summary_of(twice), atol=1e-5)


def test_auc_counts_ties_half() -> None:
    assert other_world.auc(np.array([0.0, 1.0]), np.array([1.0, 2.0])) == 0.875


def test_clips_are_measured_and_videos_scored_by_the_commands(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "sets" / "one", 1_000_000)
    write_clip(tmp_path / "data", 0)
    weights = ("--weights", tmp_path / "tiny.safetensors")
    save_live(tmp_path / "tiny.safetensors", LiveNetworks(TINY), "tiny")
    told = ("--heldout", tmp_path / "sets", "--training", tmp_path / "data", "--sets", "one", "--out", tmp_path)
    measure.main([str(each) for each in (*told, *weights, "--methods", "live,homography")])
    report = json.loads((tmp_path / "report.json").read_text())["one"]
    assert (report["clips"], set(report["methods"])) == (1, {"splat", "live", "homography"})
    assert (tmp_path / "one.png").stat().st_size > 1000
    writer = cv2.VideoWriter(str(tmp_path / "real.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for value in range(20):
        writer.write(np.full((48, 64, 3), value, np.uint8))
    writer.release()
    told = ("--heldout", clip.parents[1], "--videos", tmp_path / "real.mp4", "--out", tmp_path / "out.json")
    other_world.main([str(each) for each in (*told, *weights)])
    report = json.loads((tmp_path / "out.json").read_text())
    known, other = (np.array(list(report[name].values())) for name in ("known", "other"))
    assert ((np.concatenate([known, other]) >= 0) & (np.concatenate([known, other]) <= 1)).all()
    assert report["auc"] == other_world.auc(known, other)
