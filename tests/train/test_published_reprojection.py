"""The paper's reprojections: the source's points alone, by the published renderer; and baselines by their names."""

import pickle
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from driving_plane import PlaneClips, plane_clip

from gcd_model.config import SemanticClass
from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.baselines import (
    BaselineSettings,
    ClassesAlone,
    baseline_names,
    build,
    described,
    usual_baselines,
)
from gcd_train.evaluation.metrics import NO_CLASS
from gcd_train.evaluation.predictors import CameraPair, Prediction, SourceClip, fit_statistics, to_pictures
from gcd_train.evaluation.reprojection import ReprojectRgbd, ReprojectSemd, source_views
from gcd_train.pointcloud import visibility
from gcd_train.scene_view import SceneView

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
SETTINGS = BaselineSettings(frames=FRAMES, height=HEIGHT, width=WIDTH, classes=CLASSES)


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


def test_in_the_source_camera_itself_the_picture_is_the_source_but_for_the_blur() -> None:
    made, source = picture()[0], to_pictures(CLIP.source)[0]
    assert (made.sum(dim=0) > 0).float().mean() > 0.99
    inner = (slice(None), slice(8, -8), slice(8, -8))
    assert (made - source)[inner].abs().mean() < 0.02


def test_what_it_shows_is_what_the_published_rule_calls_visible() -> None:
    for t, view in enumerate(source_views(SEEN)):
        pose = PAIR.source_from_target[t].numpy()
        rule = visibility(view, pose, PAIR.target, width=WIDTH, height=HEIGHT)
        assert np.array_equal(shown(picture())[t].numpy(), rule)


def test_on_a_plane_it_agrees_with_the_picture_drawn_by_rays_and_is_black_elsewhere() -> None:
    made, target = picture(), to_pictures(CLIP.target)
    there = shown(made)
    near = torch.from_numpy((CLIP.target_depth > 0) & (CLIP.target_depth < 15))
    error = ((made - target) ** 2).mean(dim=1)
    assert float((there & near)[1:].float().mean()) > 0.05
    assert float(error[there & near].mean()) < 0.03
    assert 0.1 < float((~there)[-1].float().mean()) < 0.9
    assert not made.permute(0, 2, 3, 1)[~there].any()


def test_classes_are_read_back_from_the_nearest_colour_and_holes_are_of_no_class() -> None:
    made, target = classes(), torch.from_numpy(CLIP.target_classes)
    there = shown(picture())
    near = torch.from_numpy((CLIP.target_depth > 0) & (CLIP.target_depth < 15))
    assert (made == target)[there & near].float().mean() > 0.9
    assert (~there).any()
    assert (made[~there] == NO_CLASS).all()
    assert (made[there] == NO_CLASS).float().mean() < 0.05  # edges that points cover to less than half


@pytest.mark.parametrize("published", [False, True])
def test_no_colour_of_a_class_makes_a_hole_match(published: bool) -> None:
    black = tuple(SemanticClass(name=each.name, colour=(0, 0, label)) for label, each in enumerate(CLASSES))
    holes = []
    for kinds in (black, CLASSES):
        made = ReprojectSemd(classes=kinds, published=published).predict(SEEN).classes
        assert made is not None
        holes.append(made == NO_CLASS)
    assert holes[0].any()
    assert torch.equal(*holes)


def test_edges_of_holes_are_not_read_as_darker_classes() -> None:
    bright = (*CLASSES, SemanticClass(name="night", colour=(40, 40, 40)))
    assert not (classes(kinds=bright) == len(CLASSES)).any()


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


def test_a_clip_without_classes_or_with_unknown_ones_is_refused_by_its_name() -> None:
    with pytest.raises(DataError, match="class maps, got plane-0 without"):
        classes(replace(SEEN, source_classes=None))
    with pytest.raises(DataError, match="plane-0 has class 4 of 2"):
        classes(kinds=CLASSES[:2])


def test_every_listed_name_is_built_and_keeps_its_name() -> None:
    settings = replace(
        SETTINGS, statistics=fit_statistics(PlaneClips.make(1, frames=FRAMES, height=HEIGHT, width=WIDTH))
    )
    names = baseline_names(hexplane=(1, 3))
    made = {name: build(name, settings).name for name in names if name != "vanilla_svd"}
    assert list(made) == list(made.values())
    assert [name for name in names if build_privileged(name, settings)] == [
        "depth_reprojection",
        "depth_reprojection_on_mean",
        "reproject_rgbd",
        "reproject_semd",
        "hexplane_3",
    ]


def build_privileged(name: str, settings: BaselineSettings) -> bool:
    return name != "vanilla_svd" and build(name, settings).privileged


def test_a_baseline_is_built_in_another_process_as_here() -> None:
    make = pickle.loads(pickle.dumps(partial(build, "reproject_semd", SETTINGS)))
    assert make() == build("reproject_semd", SETTINGS)


def test_a_name_that_is_none_gets_the_nearest_one() -> None:
    with pytest.raises(RecipeError, match="did you mean reproject_rgbd"):
        build("reproject_rgb", SETTINGS)


def test_a_run_is_told_where_holes_of_class_maps_are_of_no_class() -> None:
    filled = replace(SETTINGS, statistics=fit_statistics(PlaneClips.make(1)))
    names = ("copy_source", "ground_homography", "depth_reprojection", "reproject_semd")
    told = {name: [described(name, each).get("holes") for each in (SETTINGS, filled)] for name in names}
    nothing = "of no class"
    assert told == {
        "copy_source": [None, None],
        "ground_homography": [nothing, None],
        "depth_reprojection": [nothing, None],
        "reproject_semd": [nothing, nothing],
    }
    assert described("ground_homography", replace(SETTINGS, classes=())) == {}


@pytest.mark.parametrize("name", ["mean_target", "majority_map", "depth_reprojection_on_mean"])
def test_means_want_training_clips(name: str) -> None:
    with pytest.raises(RecipeError, match=f"{name} wants training clips .* give --train"):
        build(name, SETTINGS)


def test_without_training_clips_holes_are_black_and_the_others_are_offered() -> None:
    assert usual_baselines(SETTINGS) == (
        "copy_source",
        "ground_homography",
        "depth_reprojection",
        "reproject_rgbd",
        "reproject_semd",
    )
    made = build("ground_homography", SETTINGS).predict(SEEN)
    assert made.video is not None
    assert made.classes is not None
    assert not made.video[:, :, 0].any()  # the horizon lies lower
    assert (made.classes[:, 0] == NO_CLASS).all()


def test_where_targets_are_class_maps_only_class_maps_count() -> None:
    painted = replace(SETTINGS, painted=True)
    assert "reproject_rgbd" not in usual_baselines(painted)
    copied = build("copy_source", painted)
    assert isinstance(copied, ClassesAlone)
    assert (copied.name, copied.privileged) == ("copy_source", False)
    made = copied.predict(SEEN)
    assert made.video is None
    assert made.classes is not None
    for name in ("reproject_rgbd", "hexplane_2"):
        with pytest.raises(RecipeError, match=f"{name} makes no class maps"):
            build(name, painted)


def test_where_targets_are_class_maps_further_draws_lose_their_pictures_too() -> None:
    class Twice:
        name, privileged = "twice", False

        def predict(self, clip: SourceClip) -> Prediction:
            one = Prediction(video=to_pictures(clip.source), classes=torch.from_numpy(CLIP.source_classes))
            return replace(one, more=(one,))

    made = ClassesAlone(inner=Twice()).predict(SEEN)
    assert [draw.video for draw in made.draws] == [None, None]
    assert all(draw.classes is not None for draw in made.draws)


def test_without_an_ontology_nothing_of_classes_is_offered_or_built() -> None:
    plain = replace(SETTINGS, classes=())
    assert [name for name in usual_baselines(plain) if "sem" in name or "majority" in name] == []
    assert plain.fill.majority is None
    for name in ("reproject_semd", "majority_map"):
        statistics = replace(SETTINGS.fill, majority=None)
        with pytest.raises(RecipeError, match="class maps, got some without"):
            build(name, replace(plain, statistics=statistics))
