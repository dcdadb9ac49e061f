from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch
from driving_plane import STAGE_SOURCE, PlaneClips, evaluated
from fake_model import FakeModel

from gcd_model import Trajectory
from gcd_model.config import DRIVING_CLASSES, SMALL, ModelConfig, SemanticClass
from gcd_model.geometry import CameraMount, Spherical, SphericalDelta, driving_trajectory, spherical_trajectory
from gcd_model.weights.card import FAMILIES, Family
from gcd_train.errors import DataError
from gcd_train.evaluation.baselines import CopySource
from gcd_train.evaluation.clips import PairedSet
from gcd_train.evaluation.predictors import (
    Prediction,
    SourceClip,
    pixel_rays,
    to_pictures,
    to_pixels,
)
from gcd_train.evaluation.synthesized import SynthesizedViews


@dataclass
class FakeTraits:
    """The part of Traits that evaluation asks for."""

    live = False
    splat = "none"
    config: ModelConfig
    family: Family = FAMILIES["driving"]
    name: str = "fake-small"
    classes: tuple[SemanticClass, ...] = DRIVING_CLASSES
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


def fake(clips: PlaneClips, classes: tuple[SemanticClass, ...] = DRIVING_CLASSES) -> FakeModel:
    config = msgspec.structs.replace(SMALL, frames=clips.frames, height=clips.height, width=clips.width)
    if clips.camera == "none":
        config = msgspec.structs.replace(
            config, camera="none", unet=msgspec.structs.replace(config.unet, camera_width=0)
        )
    return FakeModel(FakeTraits(config=config, classes=classes), classes=bool(classes))


def test_the_target_itself_is_perfect_and_its_first_frame_is_not_looked_at() -> None:
    clips = PlaneClips.make(2)

    def looked_up(clip: SourceClip) -> Prediction:
        (true,) = [each for each in clips.clips if each.source is clip.source]
        video, classes = to_pictures(true.target), torch.from_numpy(true.target_classes.copy())
        video[0], classes[0] = 0.0, 0
        return Prediction(video=video, classes=classes)

    (found,) = evaluated([SimpleNamespace(name="oracle", privileged=True, predict=looked_up)], clips)
    assert found.value("psnr_db") == pytest.approx(100.0)
    names = ("ssim", "gradient_energy", "flicker", "miou_full", "miou_common")
    assert [found.value(name) for name in names] == pytest.approx([1.0] * 5, abs=1e-6)


def test_a_model_gets_the_clip_in_its_own_range_and_its_shipped_settings() -> None:
    clips = PlaneClips.make(2)
    synthesizer = fake(clips)
    model = SynthesizedViews.of(lambda: synthesizer, clips)
    found, copied = evaluated([model, CopySource()], clips)
    assert model.name == "fake-small"
    assert found.value("psnr_db") == pytest.approx(copied.value("psnr_db"), abs=1e-3)
    assert found.value(1) == pytest.approx(
        float(np.mean([(clip.target_classes[1:] == 1).mean() for clip in clips.clips])), abs=0.05
    )
    first = synthesizer.clips[0]
    assert first.fps == 10.0
    assert first.video.amin() >= -1
    assert first.video.amin() < 0
    assert synthesizer.traits.asked == [None, None]
    assert [each.steps for each in synthesizer.options] == [None, None]
    assert synthesizer.noise == [None, None]


def test_the_live_model_is_told_the_mount() -> None:
    clips = PlaneClips.make(1)
    synthesizer = fake(clips)
    synthesizer.traits.live = True
    evaluated([SynthesizedViews.of(lambda: synthesizer, clips)], clips)
    assert synthesizer.clips[0].mount == CameraMount()


def test_a_class_that_the_clips_do_not_have_is_none_of_theirs() -> None:
    """The live model knows robots and tables, streets have none: 16 is no driving class."""
    clips = PlaneClips.make(1)
    model = SynthesizedViews.of(lambda: fake(clips), clips)
    labels = torch.tensor([1, 12, 16], dtype=torch.uint8).expand(1, 2, 4, 3)
    shown = model.shown(SimpleNamespace(samples=torch.zeros(1, 2, 3, 4, 3), classes=labels))
    assert shown.classes[0, 0].tolist() == [1, 12, 255]


CHANGES = (SphericalDelta(azimuth_deg=40.0, elevation_deg=10.0), SphericalDelta(azimuth_deg=-60.0, radius_m=1.5))


def test_a_steered_model_goes_each_clips_own_way_from_where_its_source_stands() -> None:
    clips = PlaneClips.orbits(CHANGES)
    synthesizer = fake(clips, classes=())
    found, copied = evaluated([SynthesizedViews.of(lambda: synthesizer, clips), CopySource()], clips)
    assert found.value("psnr_db") == pytest.approx(copied.value("psnr_db"), abs=1e-3)
    assert synthesizer.traits.asked == [(change, STAGE_SOURCE) for change in CHANGES]
    for path, wanted in zip(synthesizer.paths, clips.paths, strict=True):
        assert torch.equal(path.source_from_target, wanted.source_from_target)
    assert synthesizer.clips[0].fps == 12.0
    assert synthesizer.clips[0].mount is None
    assert np.isnan(found.value("miou_full"))


def test_a_model_that_paints_classes_is_compared_by_its_class_map_alone() -> None:
    clips = PlaneClips.make(1)
    synthesizer = fake(clips)
    synthesizer.traits.family = FAMILIES["driving-semantic"]
    (found,) = evaluated([SynthesizedViews.of(lambda: synthesizer, clips)], clips)
    assert np.isnan(found.value("psnr_db"))
    assert found.value(1) > 0
    synthesizer.traits.classes, synthesizer.classes = (
        (),
        False,
    )  # as in the published files: then the clips say what the colours mean
    (read,) = evaluated([SynthesizedViews.of(lambda: synthesizer, clips)], clips)
    assert np.isnan(read.value("psnr_db"))
    assert not np.isnan(read.value("miou_full"))
    with pytest.raises(DataError, match="names no classes"):
        SynthesizedViews.of(lambda: synthesizer, replace(PairedSet.of(clips, "plane"), classes=()))


def test_a_model_of_another_size_ontology_or_camera_is_refused() -> None:
    clips = PlaneClips.make(1)
    with pytest.raises(DataError, match="trained on clips"):
        SynthesizedViews.of(lambda: fake(PlaneClips.make(1, frames=5)), clips)
    with pytest.raises(DataError, match="classes"):
        SynthesizedViews.of(lambda: fake(clips, DRIVING_CLASSES[:4]), clips)
    with pytest.raises(DataError, match="camera control 'none', the clips 'spherical'"):
        SynthesizedViews.of(lambda: fake(clips), PlaneClips.orbits(CHANGES))


def test_a_model_of_another_pace_than_driving_clips_is_refused() -> None:
    clips = PlaneClips.make(1)
    synthesizer = fake(clips)
    seen = PairedSet.of(clips, "plane").clip("plane-00000000").seen
    direct = replace(seen.cameras, trajectory=driving_trajectory(frames=4, move_time=0))
    with pytest.raises(DataError, match="arrive in frame 0"):
        SynthesizedViews.of(lambda: synthesizer, clips).predict(replace(seen, cameras=direct))


def test_on_a_plane_what_lies_in_the_source_picture_is_visible_and_nothing_else() -> None:
    clips = PlaneClips.orbits(CHANGES)
    pairs = PairedSet.of(clips, "plane")
    held_out, clip = pairs.clip("plane-00000000"), clips.clips[0]
    cameras = held_out.seen.cameras
    depth = torch.from_numpy(clip.target_depth[3]).double()
    points = pixel_rays(cameras.target) * depth[..., None]
    pose = cameras.source_from_target[3]
    place = to_pixels(points @ pose[:3, :3].T + pose[:3, 3], cameras.source)
    inside = ((place > 0) & (place < place.new_tensor([48.0, 32.0]))).all(dim=-1).numpy()
    ground = clip.target_depth[3] > 0
    assert 0.1 < inside[ground].mean() < 1.0
    assert (held_out.visible[3][ground] == inside[ground]).mean() > 0.99
