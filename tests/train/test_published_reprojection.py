"""The paper's reprojections: the source's points alone, by the published renderer; and baselines by their names."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from driving_plane import PlaneClips, plane_clip

from gcd_model.config import SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.data.sample import SceneView
from gcd_train.errors import RecipeError
from gcd_train.evaluation.baselines import BaselineSettings, baselines
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import CameraPair, SourceClip
from gcd_train.evaluation.reprojection import ReprojectRgbd, ReprojectSemd, source_views
from gcd_train.pointcloud import visibility

FRAMES, HEIGHT, WIDTH = 3, 64, 96
CLASSES = PlaneClips.make(1).classes
PAIR = CameraPair.driving(CameraMount(), frames=FRAMES, height=HEIGHT, width=WIDTH)
CLIP = plane_clip(PAIR)
SEEN = SourceClip(
    source=CLIP.source,
    source_depth=CLIP.source_depth,
    source_classes=CLIP.source_classes,
    cameras=PAIR,
    fps=10.0,
    key="plane-0",
)


@cache
def picture() -> torch.Tensor:
    return picture_of(SEEN)


def picture_of(clip: SourceClip) -> torch.Tensor:
    made = ReprojectRgbd().predict(clip)
    assert made.video is not None
    assert made.classes is None
    return made.video


def classes(clip: SourceClip = SEEN, kinds: tuple[SemanticClass, ...] = CLASSES) -> torch.Tensor:
    made = ReprojectSemd(classes=kinds).predict(clip)
    assert made.video is None
    assert made.classes is not None
    return made.classes


def shown(video: torch.Tensor) -> torch.Tensor:
    return video.sum(dim=1) > 1e-7


def test_what_it_shows_is_what_the_published_rule_calls_visible() -> None:
    for t, view in enumerate(source_views(SEEN)):
        pose = PAIR.source_from_target[t].numpy()
        rule = visibility(view, pose, PAIR.target, width=WIDTH, height=HEIGHT)
        assert np.array_equal(shown(picture())[t].numpy(), rule)


def test_classes_are_read_back_from_the_nearest_colour_and_holes_are_of_no_class() -> None:
    made, target = classes(), torch.from_numpy(CLIP.target_classes)
    there = shown(picture())
    near = torch.from_numpy((CLIP.target_depth > 0) & (CLIP.target_depth < 15))
    assert (made == target)[there & near].float().mean() > 0.9
    assert (~there).any()
    assert (made[~there] == NO_CLASS).all()
    assert (made[there] == NO_CLASS).float().mean() < 0.05  # edges that points cover to less than half


def test_points_of_the_data_sets_own_views_are_drawn_instead_where_there_are_some() -> None:
    large = CameraPair.driving(CameraMount(), frames=FRAMES, height=2 * HEIGHT, width=2 * WIDTH)
    own, moved = plane_clip(large), np.eye(4)
    moved[:3, 3] = [40.0, -7.0, 3.0]  # another world: only the relative pose counts

    def points() -> list[SceneView]:
        seen = replace(SEEN, source=own.source, source_depth=own.source_depth, source_classes=own.source_classes)
        return [replace(view, world_from_camera=moved) for view in source_views(replace(seen, cameras=large))]

    finer = replace(SEEN, points=points)
    made, usual = picture_of(finer), picture()
    both = shown(made) & shown(usual)
    assert made.shape == (FRAMES, 3, HEIGHT, WIDTH)
    assert shown(made)[-1].sum() >= shown(usual)[-1].sum()
    off = (made - usual).abs().mean(dim=1)[both]
    assert 0.0 < float(off.mean()) < 0.05
    assert (classes(finer) == classes())[both].float().mean() > 0.9


def test_the_usual_baselines_are_those_that_the_clips_have_enough_for() -> None:
    clips = PairedSet.of(PlaneClips.make(1), "plane")
    every = ["copy_source", "ground_homography", "reproject_rgbd", "reproject_semd"]

    def usual(of: PairedSet) -> list[str]:
        return [method.name for method in baselines(None, of, BaselineSettings())]

    assert usual(clips) == every
    assert usual(replace(clips, classes=())) == every[:3]
    assert usual(replace(clips, painted=True)) == [*every[:2], every[3]]
    for name in ("reproject_rgbd", "hexplane_1"):
        with pytest.raises(RecipeError, match=f"{name} makes no class maps"):
            baselines([name], replace(clips, painted=True), BaselineSettings())
    with pytest.raises(RecipeError, match="reproject_semd wants clips with class maps"):
        baselines(["reproject_semd"], replace(clips, classes=()), BaselineSettings())
    (told,) = baselines(["reproject_rgbd"], clips, BaselineSettings(published=True))
    assert (told.told, told.make()) == (
        {"baseline": "reproject_rgbd", "published rounding": "yes"},
        ReprojectRgbd(published=True),
    )
