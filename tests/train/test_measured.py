import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from driving_plane import PlaneClips, seen_of
from msgspec import structs

from gcd_model.config import SemanticClass
from gcd_model.errors import NonFiniteError, ShapeError
from gcd_train.evaluation.clips import HeldOutClip
from gcd_train.evaluation.measure import predicted_and_measured
from gcd_train.evaluation.metrics import NO_CLASS, Lpips, masked_mean, masked_psnr, psnr, ssim_map, window_mask
from gcd_train.evaluation.predictors import Prediction, to_pictures
from gcd_train.evaluation.statistics import ClipTable
from gcd_train.evaluation.store import ClipRecord

FRAMES, HEIGHT, WIDTH, CLASSES = 4, 32, 48, 14
KINDS = tuple(SemanticClass(name=f"kind {number}", colour=(number, 0, 0)) for number in range(CLASSES))


def fixed(prediction: Prediction) -> SimpleNamespace:
    """A method that predicts the same of every clip."""
    return SimpleNamespace(name="noisy", privileged=False, predict=lambda _: prediction)


def held_out(*, visible: bool = True, classes: bool = True) -> HeldOutClip:
    """The painted plane; its left half was visible, of the last frame nothing."""
    clip = PlaneClips.make(1)[0]
    seen = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    seen[:-1, :, : WIDTH // 2] = True
    return HeldOutClip(
        key="plane-0",
        scene="plane",
        seen=seen_of(clip),
        target=clip.target,
        target_classes=clip.target_classes if classes else None,
        visible=seen if visible else None,
        change=(30.0, 10.0, 0.0),
    )


def noisy(clip: HeldOutClip, seed: int) -> Prediction:
    """The target with noise, and class maps of which some pixels are wrong."""
    random = torch.Generator().manual_seed(seed)
    target = to_pictures(clip.target)
    video = (target + 0.1 * torch.randn(target.shape, generator=random)).clamp(0, 1)
    labels = torch.randint(0, CLASSES, (FRAMES, HEIGHT, WIDTH), generator=random).to(torch.uint8)
    return Prediction(video=video, classes=labels)


def drawn(clip: HeldOutClip, draws: int) -> Prediction:
    return replace(noisy(clip, 0), more=tuple(noisy(clip, seed) for seed in range(1, draws)))


@pytest.mark.parametrize("classes", [True, False])
def test_what_shows_a_part_is_measured_as_if_the_clip_were_that_part(classes: bool) -> None:
    clip, part = held_out(classes=classes), (slice(None), slice(4, 28), slice(6, 42))
    made = Prediction(
        video=to_pictures(clip.target[part]) * 0.9, classes=torch.from_numpy(clip.seen.source[part][..., 0] % 2)
    )
    small = replace(clip, target=clip.target[part], visible=clip.visible[part])
    small = replace(small, target_classes=clip.target_classes[part]) if classes else small
    found, wanted = record_of(clip, replace(made, crop=(6, 4, 36, 24))), record_of(small, made)
    assert found.crop == (6, 4, 36, 24)
    assert structs.replace(found, crop=None, seconds=0) == structs.replace(wanted, seconds=0)
    with pytest.raises(ShapeError):
        record_of(clip, made)


def record_of(clip: HeldOutClip, prediction: Prediction, *, lpips: Lpips | None = None) -> ClipRecord:
    return predicted_and_measured(fixed(prediction), clip, classes=KINDS, lpips=lpips)[1]


def test_figures_of_each_draw_and_region_are_those_of_the_metrics() -> None:
    clip = held_out()
    prediction = drawn(clip, 3)
    record, target = record_of(clip, prediction), to_pictures(clip.target)
    seen = torch.from_numpy(clip.visible)
    assert (record.draws, record.frames) == (3, FRAMES)
    for number, draw in enumerate(prediction.draws):
        found, visible = record.regions["all"], record.regions["visible"]
        assert found.psnr_db[number] == pytest.approx(psnr(draw.video, target).tolist())
        assert found.ssim[number] == pytest.approx(ssim_map(draw.video, target).mean(dim=(1, 2)).tolist(), abs=1e-6)
        assert visible.psnr_db[number][:-1] == pytest.approx(masked_psnr(draw.video, target, seen)[:-1].tolist())
        inside = masked_mean(ssim_map(draw.video, target), window_mask(seen))[:-1]
        assert visible.ssim[number][:-1] == pytest.approx(inside.tolist(), abs=1e-6)


def test_a_method_that_only_names_classes_has_no_picture_figures() -> None:
    clip = held_out()
    record = record_of(clip, Prediction(classes=noisy(clip, 0).classes))
    region = record.regions["occluded"]
    assert (region.psnr_db, region.ssim, region.diversity, region.gradient, record.step, record.lpips) == (None,) * 6
    assert region.confusion is not None
    assert len(record.step_target) == FRAMES - 1


def test_void_is_not_counted_where_it_is_true_and_wrong_where_it_is_said() -> None:
    clip = held_out()
    true = torch.from_numpy(clip.target_classes.copy())
    void, road = int(true[0, 0, 0]), int(true[0, -1, WIDTH // 2])
    said = true.clone()
    said[:, -2:] = void  # on the ground
    kinds = [SemanticClass(name="Void", colour=(0, 0, 0)) if i == void else kind for i, kind in enumerate(KINDS)]
    named = fixed(Prediction(classes=said))
    record = predicted_and_measured(named, clip, classes=kinds)[1]
    counted = record.regions["all"].confusion
    assert void not in {label for frame in counted for entry in frame for label in entry[:2]}
    wrong = [sum(count for _, label, count in frame if label == NO_CLASS) for frame in counted]
    assert wrong == [2 * WIDTH] * FRAMES
    assert road in {entry[0] for frame in counted for entry in frame if entry[1] == NO_CLASS}
    found = ClipTable.of([record], CLASSES).scene_sums()
    assert math.isnan(found.value(void))
    assert void not in found.common
    assert found.value("miou_full") < 1.0


def test_views_of_another_size_or_length_are_refused() -> None:
    clip = held_out()
    video = noisy(clip, 0).video
    for wrong in (video[:, :, 1:], video[1:]):
        with pytest.raises(ShapeError, match="one shape"):
            record_of(clip, Prediction(video=wrong))


def test_a_view_that_is_no_number_somewhere_is_an_error_not_a_missing_figure() -> None:
    clip = held_out()
    video = noisy(clip, 0).video
    video[1, 0, 3, 3] = torch.nan
    with pytest.raises(NonFiniteError, match="noisy on plane-0"):
        record_of(clip, Prediction(video=video))


def test_where_targets_are_class_maps_only_class_maps_count() -> None:
    clip = held_out()
    named = fixed(drawn(clip, 2))
    prediction, record = predicted_and_measured(named, clip, classes=KINDS, painted=True)
    assert (record.regions["all"].psnr_db, record.draws) == (None, 2)
    assert record.regions["all"].confusion is not None
    assert [draw.video for draw in prediction.draws] == [None, None]
