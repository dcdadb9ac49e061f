"""How unlike its training a camera looks to the live model."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from live_clips import HEIGHT, WIDTH, write_clip

from gcd_model.live.config import DepthConfig, LiveConfig, PaintConfig
from gcd_model.live.depth_net import Familiarity, summary_of
from gcd_model.live.synthesizer import save_live
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError
from gcd_train.live.other_world import auc, main

TINY = LiveConfig(
    height=HEIGHT,
    width=WIDTH,
    depth=DepthConfig(widths=(8, 16, 16), fine_width=8, bins=8),
    paint=PaintConfig(widths=(8, 16, 16), fine_width=8, embedding_width=16),
    memory=2000,
)


def test_what_the_training_never_had_scores_higher_and_scale_does_not_matter() -> None:
    generator = torch.Generator().manual_seed(0)
    mix = torch.randn(6, 6, generator=generator) * torch.tensor([1e-3, 1.0, 1e3, 1.0, 1.0, 1.0])
    known = torch.randn(500, 6, generator=generator) @ mix + 5.0
    familiar = Familiarity(3)
    familiar.fit(known)
    sure, unsure = (familiar.score(known[:100], torch.full((100,), entropy)) for entropy in (0.05, 0.5))
    foreign = familiar.score(
        known[:100] + 4.0 * known.std(0) * torch.tensor([1, -1, 1, 0, 0, 0]), torch.full((100,), 0.05)
    )
    assert 0.0 <= float(sure.min()) < float(sure.mean()) < float(unsure.mean())
    assert float(foreign.mean()) > 3 * float(sure.mean())
    assert float(torch.maximum(foreign, unsure).max()) <= 1.0
    assert float(-(1 - familiar.score(known, torch.ones(500))).log().mean()) == pytest.approx(1.0, abs=0.05)


def test_a_summary_is_of_the_picture_and_not_of_its_size() -> None:
    features = torch.randn(2, 3, 4, 6)
    twice = features.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
    assert torch.allclose(summary_of(features), summary_of(twice), atol=1e-5)


def test_auc_counts_ties_half() -> None:
    assert auc([0.0, 1.0], [2.0, 3.0]) == 1.0
    assert auc([0.0, 1.0], [1.0]) == 0.75


def test_known_clips_and_videos_are_scored(tmp_path: Path) -> None:
    write_clip(tmp_path / "valid", 1_000_000)
    save_live(tmp_path / "tiny.safetensors", LiveNetworks(TINY), "tiny")
    writer = cv2.VideoWriter(str(tmp_path / "real.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for value in range(20):
        writer.write(np.full((48, 64, 3), value, np.uint8))
    writer.release()
    told = ("--heldout", tmp_path / "valid", "--videos", tmp_path / "real.mp4", "--out", tmp_path / "out.json")
    main([str(each) for each in (*told, "--weights", tmp_path / "tiny.safetensors")])
    report = json.loads((tmp_path / "out.json").read_text())
    scores = [*report["known"].values(), *report["other"].values()]
    assert len(scores) >= 2
    assert all(0 <= score <= 1 for score in scores)
    assert report["auc"] == auc(list(report["known"].values()), list(report["other"].values()))
    with pytest.raises(DataError, match="is no live model"):
        main([str(each) for each in (*told, "--weights", "random:driving")])
