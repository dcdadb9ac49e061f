from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import pytest
import torch
from driving_plane import PlaneClips
from torch import Tensor

from gcd_model import Clip, RenderOptions, Trajectory, View
from gcd_model.class_head import SemanticClass
from gcd_model.clip import Augmentation
from gcd_model.conditioning import SourceFeatures
from gcd_model.config import DRIVING_CLASSES, SMALL
from gcd_model.geometry import CameraMount
from gcd_train.baselines import Prediction, SourceClip, to_pictures
from gcd_train.baselines.copy_source import CopySource
from gcd_train.datasets.paired import PairedClip
from gcd_train.errors import DataError
from gcd_train.evaluation import (
    SynthesizedViews,
    class_grid,
    evaluate,
    figures,
    measure,
    require_same_kind,
    standard_error,
)


@dataclass
class Oracle:
    """Looks its answer up: the target itself, changed as asked."""

    clips: PlaneClips
    brighter: float = 0.0
    blind: bool = False
    name: str = "oracle"
    privileged: bool = True

    def predict(self, clip: SourceClip) -> Prediction:
        (true,) = [each for each in self.clips.clips if each is clip]
        video = (to_pictures(true.target) + self.brighter).clamp(0, 1)
        video[0] = 0.0  # the first frame must not count
        classes = torch.from_numpy(true.target_classes.copy())
        classes[0] = 0
        return Prediction(video=None if self.blind else video, classes=classes)


@dataclass
class FakeTraits:
    """The part of Traits that evaluation asks for."""

    config: object
    name: str = "fake-small"
    classes: tuple[SemanticClass, ...] = DRIVING_CLASSES
    mount: CameraMount | None = None
    asked: list[CameraMount | None] = field(default_factory=list)

    def plan_view(self, *, mount: CameraMount | None = None) -> str:
        self.asked.append(mount)
        return "the fixed path"


@dataclass
class FakeSynthesizer:
    """Gives the source back as view, with its clip's brightness as class map."""

    traits: FakeTraits
    clips: list[Clip] = field(default_factory=list)

    def encode(self, clip: Clip, augmentation: Augmentation | None = None, extra: Tensor | None = None) -> Clip:
        assert augmentation is None
        assert extra is None
        self.clips.append(clip)
        return clip

    def render(
        self, features: SourceFeatures, trajectories: list[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        assert trajectories == ["the fixed path"]
        assert options is None
        clip = self.clips[-1]
        assert features is clip
        view = View.__new__(View)
        for name, value in (("samples", (clip.video[None] + 1) / 2), ("classes", self._classes(clip))):
            object.__setattr__(view, name, value)
        return [view]

    def _classes(self, clip: Clip) -> Tensor:
        return torch.ones(1, clip.frames, *clip.video.shape[-2:], dtype=torch.uint8)


def fake(clips: PlaneClips, classes: tuple[SemanticClass, ...] = DRIVING_CLASSES) -> FakeSynthesizer:
    config = msgspec.structs.replace(SMALL, frames=clips.frames, height=clips.height, width=clips.width)
    return FakeSynthesizer(FakeTraits(config=config, classes=classes))


def test_the_target_itself_is_perfect_and_its_first_frame_is_not_looked_at() -> None:
    clips = PlaneClips.make(2)
    (found,) = evaluate([Oracle(clips)], clips)
    total = found.total
    assert (total.psnr_db, total.last_psnr_db) == pytest.approx((100.0, 100.0))
    ideal = (total.ssim, total.gradient_energy, total.flicker, total.miou, total.miou_full, total.accuracy)
    assert ideal == pytest.approx((1.0,) * 6, abs=1e-6)


def test_a_view_that_is_a_tenth_too_bright_has_20_db_and_the_targets_gradient() -> None:
    clips = PlaneClips.make(2)
    (found,) = evaluate([Oracle(clips, brighter=0.1)], clips)
    assert found.total.psnr_db == pytest.approx(20.0, abs=0.01)
    assert found.total.gradient_energy == pytest.approx(1.0, abs=1e-4)


def test_figures_that_a_predictor_does_not_have_are_nan() -> None:
    clips = PlaneClips.make(2)
    (found,) = evaluate([Oracle(clips, blind=True)], clips)
    assert np.isnan([found.total.psnr_db, found.total.ssim, found.total.gradient_energy, found.total.flicker]).all()
    assert found.total.miou == 1.0


def test_iou_is_pooled_over_clips_not_averaged() -> None:
    clips = PlaneClips.make(2)
    both = [measure(CopySource().predict(clip), clip, grid=class_grid(clips), classes=13) for clip in clips.clips]
    road_hit = sum(float(each.full[1, 1]) for each in both)
    road_any = sum(float(each.full[1].sum() + each.full[:, 1].sum() - each.full[1, 1]) for each in both)
    assert figures(both[0] + both[1]).class_iou_full[1] == pytest.approx(road_hit / road_any)


def test_the_standard_error_of_a_mean_is_the_usual_one() -> None:
    clips = PlaneClips.make(4)
    rows = [measure(CopySource().predict(clip), clip, grid=class_grid(clips), classes=13) for clip in clips.clips]
    each = np.array([figures(row).psnr_db for row in rows])
    assert each.std() > 0
    assert standard_error(rows).psnr_db == pytest.approx(each.std(ddof=1) / 2)


def test_equal_clips_leave_no_error_and_one_clip_tells_nothing_of_it() -> None:
    clips = PlaneClips.make(1)
    row = measure(CopySource().predict(clips[0]), clips[0], grid=class_grid(clips), classes=13)
    error = standard_error([row, row, row])
    assert (error.psnr_db, error.gradient_energy, error.miou) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert np.isnan(standard_error([row]).psnr_db)


def test_every_predictor_sees_the_same_clips_and_progress_is_told() -> None:
    clips, told = PlaneClips.make(2), []
    found = evaluate([CopySource(), Oracle(clips)], clips, progress=lambda *at: told.append(at))
    assert [each.name for each in found] == ["copy_source", "oracle"]
    assert [len(each.clips) for each in found] == [2, 2]
    assert told == [(1, 2), (2, 2)]


def test_a_model_gets_the_clip_in_its_own_range_and_its_shipped_settings() -> None:
    clips = PlaneClips.make(2)
    synthesizer = fake(clips)
    (found, copied) = evaluate([SynthesizedViews.of(synthesizer, clips), CopySource()], clips)
    assert found.name == "fake-small"
    assert found.total.psnr_db == pytest.approx(copied.total.psnr_db, abs=1e-3)
    assert found.total.class_iou[1] == pytest.approx(
        float(np.mean([(clip.target_classes[1:] == 1).mean() for clip in clips.clips])), abs=0.05
    )
    first = synthesizer.clips[0]
    assert first.fps == 10.0
    assert first.video.amin() >= -1
    assert first.video.amin() < 0
    assert synthesizer.traits.asked == [None, None]


def test_a_declared_mount_reaches_the_clip_and_the_path() -> None:
    clips = PlaneClips.make(1)
    synthesizer, mount = fake(clips), CameraMount(height_m=1.8)
    evaluate([SynthesizedViews.of(synthesizer, clips, mount)], clips)
    assert synthesizer.clips[0].mount == mount
    assert synthesizer.traits.asked == [mount]


def test_a_model_of_another_size_or_ontology_is_refused() -> None:
    clips = PlaneClips.make(1)
    with pytest.raises(DataError, match="trained on clips"):
        SynthesizedViews.of(fake(PlaneClips.make(1, frames=5)), clips)
    with pytest.raises(DataError, match="classes"):
        SynthesizedViews.of(fake(clips, DRIVING_CLASSES[:4]), clips)


def test_training_clips_of_another_kind_are_refused() -> None:
    clips = PlaneClips.make(1)
    require_same_kind(clips, clips)
    with pytest.raises(DataError, match="one kind"):
        require_same_kind(PlaneClips.make(1, width=64), clips)
    with pytest.raises(DataError, match="one kind"):
        require_same_kind(replace(clips, classes=DRIVING_CLASSES[:3]), clips)


def test_nothing_to_measure_is_refused() -> None:
    with pytest.raises(DataError, match="3 frames"):
        evaluate([CopySource()], PlaneClips.make(1, frames=2))


def test_a_class_the_ontology_lacks_is_refused() -> None:
    clips = PlaneClips.make(1)
    clip: PairedClip = clips[0]
    clip.target_classes[2, 0, 0] = 13
    with pytest.raises(ValueError, match="below 13"):
        evaluate([CopySource()], clips)
