from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
import pytest
import torch
from driving_plane import STAGE_SOURCE, PlaneClips
from torch import Tensor

from gcd_model import FAMILIES, Clip, Family, ModelConfig, RenderOptions, Trajectory, View
from gcd_model.class_head import SemanticClass
from gcd_model.clip import Augmentation
from gcd_model.conditioning import SourceFeatures
from gcd_model.config import DRIVING_CLASSES, SMALL
from gcd_model.geometry import CameraMount, Spherical, SphericalDelta, driving_trajectory, spherical_trajectory
from gcd_train.baselines import (
    CopySource,
    GroundHomography,
    Prediction,
    Predictor,
    SourceClip,
    fit_statistics,
    to_pictures,
)
from gcd_train.datasets.paired import PairedClip
from gcd_train.errors import DataError
from gcd_train.evaluation import (
    Measures,
    SynthesizedViews,
    TrueView,
    class_grid,
    evaluate,
    figures,
    lead,
    measure,
    require_same_kind,
    source_side,
    summed_up,
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
        (true,) = [each for each in self.clips.clips if each.source is clip.source]
        video = (to_pictures(true.target) + self.brighter).clamp(0, 1)
        video[0] = 0.0  # the first frame must not count
        classes = torch.from_numpy(true.target_classes.copy())
        classes[0] = 0
        return Prediction(video=None if self.blind else video, classes=classes if self.clips.classes else None)


@dataclass
class FakeTraits:
    """The part of Traits that evaluation asks for."""

    config: ModelConfig
    family: Family = FAMILIES["driving"]
    name: str = "fake-small"
    classes: tuple[SemanticClass, ...] = DRIVING_CLASSES
    mount: CameraMount | None = None
    move_time: int = 3
    asked: list[object] = field(default_factory=list)

    def plan_view(
        self, delta: SphericalDelta | None = None, *, source: Spherical | None = None, mount: CameraMount | None = None
    ) -> Trajectory:
        frames = self.config.frames
        if delta is None or source is None:
            self.asked.append(mount)
            return driving_trajectory(frames=frames, move_time=frames - 1)
        self.asked.append((delta, source))
        return spherical_trajectory(source, delta, frames=frames, move_time=self.move_time)


@dataclass
class FakeSynthesizer:
    """Gives the source back as view, and road everywhere as class map; keeps what it was asked."""

    traits: FakeTraits
    clips: list[Clip] = field(default_factory=list)
    paths: list[Trajectory] = field(default_factory=list)
    steps: list[int | None] = field(default_factory=list)

    def encode(self, clip: Clip, augmentation: Augmentation | None = None, extra: Tensor | None = None) -> Clip:
        assert augmentation is None
        assert extra is None
        self.clips.append(clip)
        return clip

    def render(
        self, features: SourceFeatures, trajectories: list[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        (path,) = trajectories
        self.paths.append(path)
        self.steps.append(None if options is None else options.steps)
        clip = self.clips[-1]
        assert features is clip
        classes = torch.ones(1, clip.frames, *clip.video.shape[-2:], dtype=torch.uint8)
        return [
            View(
                samples=(clip.video[None] + 1) / 2,
                latents=torch.zeros(1),
                trajectory=path,
                motion_bucket=0.0,
                classes=classes if self.traits.classes else None,
            )
        ]


def fake(clips: PlaneClips, classes: tuple[SemanticClass, ...] = DRIVING_CLASSES) -> FakeSynthesizer:
    config = msgspec.structs.replace(SMALL, frames=clips.frames, height=clips.height, width=clips.width)
    if clips.camera == "none":
        config = msgspec.structs.replace(
            config, camera="none", unet=msgspec.structs.replace(config.unet, camera_width=0)
        )
    return FakeSynthesizer(FakeTraits(config=config, classes=classes))


def measured(clips: PlaneClips, predictor: Predictor) -> list[Measures]:
    """A predictor's sums of each clip."""
    grid, classes = class_grid(clips), len(clips.classes)
    return [
        measure(
            predictor.predict(source_side(clips, number, clip, None)),
            TrueView.of(clip, grid=grid, classes=classes),
            classes=classes,
        )
        for number, clip in enumerate(clips.clips)
    ]


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
    both = measured(clips, CopySource())
    road_hit = sum(float(each.full[1, 1]) for each in both)
    road_any = sum(float(each.full[1].sum() + each.full[:, 1].sum() - each.full[1, 1]) for each in both)
    assert figures(both[0] + both[1]).class_iou_full[1] == pytest.approx(road_hit / road_any)


@dataclass
class Painted:
    """Says the same of every clip."""

    video: Tensor | None = None
    classes: Tensor | None = None
    name: str = "painted"
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        return Prediction(video=self.video, classes=self.classes)


CAR, PERSON = 8, 11


def block(label: int, rows: slice, columns: slice) -> Tensor:
    """Road everywhere but for a block of another class, uint8 [4, 32, 48]."""
    classes = torch.ones(4, 32, 48, dtype=torch.uint8)
    classes[:, rows, columns] = label
    return classes


def test_iou_of_car_and_person_is_what_one_counts_by_hand() -> None:
    clips = PlaneClips.make(1)
    clip = clips[0]
    clip.target_classes[:] = block(CAR, slice(0, 8), slice(0, 12)).numpy()  # 96 pixels, 24 cells
    clip.target_classes[:, 16:20, 0:4] = PERSON  # 16 pixels, 4 cells
    said = block(CAR, slice(0, 8), slice(4, 16))  # 96 pixels, 64 of them right: 64 / 128
    said[:, 16:20, 2:10] = PERSON  # 32 pixels, 8 of them right: 8 / 40
    (found,) = evaluate([Painted(classes=said)], clips)
    for iou in (found.total.class_iou, found.total.class_iou_full):
        assert iou[CAR] == pytest.approx(64 / 128)
        assert iou[PERSON] == pytest.approx(8 / 40)
    road = (32 * 48 - 96 - 16, 32 * 48 - 96 - 32)  # true, said
    both = 32 * 48 - 128 - 40  # neither a car nor a person for either of them
    expected = (64 / 128 + 8 / 40 + both / (sum(road) - both)) / 3
    assert found.total.miou_full == pytest.approx(expected)


def test_flicker_is_the_views_change_over_the_targets() -> None:
    clips = PlaneClips.make(1)
    clip = clips[0]
    for t, level in enumerate((0, 100, 110, 130)):  # changes by 10 and by 20; the first frame does not count
        clip.target[t] = level
    video = torch.tensor([0.9, 0.2, 0.2, 0.2 + 15 / 255]).view(4, 1, 1, 1).expand(4, 3, 32, 48)  # by 0 and by 15
    (found,) = evaluate([Painted(video=video)], clips)
    assert found.total.flicker == pytest.approx(15 / 30)


def test_the_standard_error_of_a_mean_is_the_usual_one() -> None:
    clips = PlaneClips.make(4)
    (found,) = evaluate([CopySource()], clips)
    each = np.array([clip.psnr_db for clip in found.clips])
    assert each.std() > 0
    assert found.error.psnr_db == pytest.approx(each.std(ddof=1) / 2)


def test_clips_of_one_scene_count_as_one() -> None:
    clips = replace(PlaneClips.make(4), clips_per_scene=2)
    (found,) = evaluate([CopySource()], clips)
    each = np.array([clip.psnr_db for clip in found.clips]).reshape(2, 2).mean(axis=1)
    assert len(found.without) == 2
    assert found.error.psnr_db == pytest.approx(each.std(ddof=1) / np.sqrt(2))


def test_equal_clips_leave_no_error_and_one_scene_tells_nothing_of_it() -> None:
    row = measured(PlaneClips.make(1), CopySource())[0]
    error = summed_up("copy", [row, row, row], [0, 1, 2], seconds=1.0).error
    assert (error.psnr_db, error.gradient_energy, error.miou) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    alone = summed_up("copy", [row, row], [7, 7], seconds=1.0)
    assert np.isnan(alone.error.psnr_db)
    assert np.isnan(lead(alone, alone, lambda of: of.psnr_db)[1])


def test_a_lead_is_paired_over_scenes() -> None:
    clips = PlaneClips.make(4)
    first, other = evaluate([Oracle(clips, brighter=0.1), CopySource()], clips)
    apart = np.array([a.psnr_db - b.psnr_db for a, b in zip(first.clips, other.clips, strict=True)])
    ahead, error = lead(first, other, lambda of: of.psnr_db)
    assert ahead == pytest.approx(apart.mean())
    assert error == pytest.approx(apart.std(ddof=1) / 2)
    assert lead(first, first, lambda of: of.miou) == (0.0, 0.0)


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
    assert synthesizer.steps == [None, None]


def test_the_same_weights_are_measured_with_other_steps_too() -> None:
    clips = PlaneClips.make(1)
    synthesizer = fake(clips)
    rows = [SynthesizedViews.of(synthesizer, clips, steps) for steps in (None, 1, 4)]
    found = evaluate(rows, clips)
    assert [each.name for each in found] == ["fake-small", "fake-small (1 step)", "fake-small (4 steps)"]
    assert synthesizer.steps == [None, 1, 4]


def test_a_declared_mount_reaches_the_clip_the_path_and_the_baselines() -> None:
    clips = PlaneClips.make(1)
    synthesizer, mount = fake(clips), CameraMount(height_m=1.8)
    homography = GroundHomography(fill=fit_statistics(clips))
    _, told = evaluate([SynthesizedViews.of(synthesizer, clips), homography], clips, declared=mount)
    assert synthesizer.clips[0].mount == mount
    assert synthesizer.traits.asked == [mount]
    (true,) = evaluate([homography], clips)
    assert told.total.psnr_db < true.total.psnr_db


CHANGES = (SphericalDelta(azimuth_deg=40.0, elevation_deg=10.0), SphericalDelta(azimuth_deg=-60.0, radius_m=1.5))


def test_a_steered_model_goes_each_clips_own_way_from_where_its_source_stands() -> None:
    clips = PlaneClips.orbits(CHANGES)
    synthesizer = fake(clips, classes=())
    found, copied = evaluate([SynthesizedViews.of(synthesizer, clips), CopySource()], clips)
    assert found.total.psnr_db == pytest.approx(copied.total.psnr_db, abs=1e-3)
    assert synthesizer.traits.asked == [(change, STAGE_SOURCE) for change in CHANGES]
    for path, wanted in zip(synthesizer.paths, clips.paths, strict=True):
        assert torch.equal(path.source_from_target, wanted.source_from_target)
    assert synthesizer.clips[0].fps == 12.0
    assert synthesizer.clips[0].mount is None
    assert np.isnan(found.total.miou)
    assert found.total.class_iou == ()


def test_a_model_that_moves_at_another_pace_than_the_clips_is_refused() -> None:
    clips = PlaneClips.orbits(CHANGES)
    synthesizer = fake(clips, classes=())
    synthesizer.traits.move_time = 0
    with pytest.raises(DataError, match="reaches its goal in frame 0"):
        evaluate([SynthesizedViews.of(synthesizer, clips)], clips)


def test_a_model_that_paints_classes_is_compared_by_its_class_map_alone() -> None:
    clips = PlaneClips.make(1)
    synthesizer = fake(clips)
    synthesizer.traits.family = FAMILIES["driving-semantic"]
    (found,) = evaluate([SynthesizedViews.of(synthesizer, clips)], clips)
    assert np.isnan(found.total.psnr_db)
    assert found.total.class_iou[1] > 0
    synthesizer.traits.classes = ()
    with pytest.raises(DataError, match="names no classes"):
        SynthesizedViews.of(synthesizer, clips)


def test_a_model_of_another_size_ontology_or_camera_is_refused() -> None:
    clips = PlaneClips.make(1)
    with pytest.raises(DataError, match="trained on clips"):
        SynthesizedViews.of(fake(PlaneClips.make(1, frames=5)), clips)
    with pytest.raises(DataError, match="classes"):
        SynthesizedViews.of(fake(clips, DRIVING_CLASSES[:4]), clips)
    with pytest.raises(DataError, match="camera control 'none', the clips 'spherical'"):
        SynthesizedViews.of(fake(clips), PlaneClips.orbits(CHANGES))


def test_training_clips_of_another_kind_are_refused() -> None:
    clips = PlaneClips.make(1)
    require_same_kind(clips, clips)
    with pytest.raises(DataError, match="one kind"):
        require_same_kind(PlaneClips.make(1, width=64), clips)
    with pytest.raises(DataError, match="one kind"):
        require_same_kind(replace(clips, classes=DRIVING_CLASSES[:3]), clips)
    with pytest.raises(DataError, match="camera control"):
        require_same_kind(replace(PlaneClips.orbits(CHANGES), classes=DRIVING_CLASSES), clips)


def test_nothing_to_measure_is_refused() -> None:
    with pytest.raises(DataError, match="3 frames"):
        evaluate([CopySource()], PlaneClips.make(1, frames=2))


def test_a_class_the_ontology_lacks_is_refused() -> None:
    clips = PlaneClips.make(1)
    clip: PairedClip = clips[0]
    clip.target_classes[2, 0, 0] = 13
    with pytest.raises(ValueError, match="below 13"):
        evaluate([CopySource()], clips)
