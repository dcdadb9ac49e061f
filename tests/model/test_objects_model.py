"""Small models for orbits, which warp by the planes of a stage, and models that paint their classes."""

from dataclasses import replace

import msgspec
import pytest
import torch
from msgspec import structs
from small_models import (
    TINY,
    TINY_CLASSES,
    TINY_DRIVING,
    TINY_OBJECTS,
    TINY_SEMANTIC,
    random_clip,
    tiny_driving,
    tiny_synthesizer,
)
from torch import Tensor
from torch.testing import assert_close

from gcd_model.class_head import nearest_classes, palette
from gcd_model.clip import RenderOptions
from gcd_model.config import DRIVING_CLASSES, DRIVING_SEMANTIC_SMALL, DRIVING_SMALL, OBJECTS_SMALL, ModelConfig
from gcd_model.errors import OptionError, PoseError, ViewRangeError
from gcd_model.families import DRIVING, DRIVING_SEMANTIC
from gcd_model.geometry import CameraMount, Spherical, SphericalDelta, pose_trajectory
from gcd_model.networks import empty_networks
from gcd_model.plane_warp import clip_warps
from gcd_model.synthesizer import Synthesizer
from gcd_model.traits import ASSUMED_SOURCE, Traits

GOAL = SphericalDelta(azimuth_deg=35.0, elevation_deg=10.0)
HIGH = Spherical(azimuth_deg=0.0, elevation_deg=25.0, radius_m=13.0)


@pytest.fixture(scope="module")
def orbits() -> Synthesizer:
    return tiny_synthesizer(TINY_OBJECTS)


def painter(config: ModelConfig = TINY_SEMANTIC) -> Synthesizer:
    made = tiny_driving(config)
    return Synthesizer(made.networks, replace(made.traits, family=DRIVING_SEMANTIC))


# --- orbits ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", [None, HIGH])
def test_the_u_net_sees_the_warps_of_where_the_source_camera_stands(source: Spherical | None) -> None:
    synthesizer, seen = tiny_synthesizer(TINY_OBJECTS), list[Tensor]()
    synthesizer.networks.unet.stem.register_forward_pre_hook(lambda _, given: seen.append(given[0][:, 4:]))
    clip = random_clip(TINY_OBJECTS)
    path = synthesizer.traits.plan_view(GOAL, source=source)
    assert path.source == (source or ASSUMED_SOURCE)
    features = synthesizer.encode(clip)
    synthesizer.render(features, [path])
    warped = clip_warps(TINY_OBJECTS, path).channels(clip.video, torch.arange(TINY_OBJECTS.frames))
    assert_close(seen[0], torch.cat([features.latents, warped], dim=1))


def test_views_in_a_batch_are_as_they_are_alone(orbits: Synthesizer) -> None:
    features = orbits.encode(random_clip(TINY_OBJECTS))
    paths = [orbits.traits.plan_view(GOAL, source=source) for source in (None, HIGH)]
    both = orbits.render(features, paths, RenderOptions(samples=2))
    for view, path in zip(both, paths, strict=True):
        assert_close(view.samples, orbits.render(features, [path], RenderOptions(samples=2))[0].samples)
        assert view.classes is None
    assert not torch.equal(both[0].samples, both[1].samples)


def test_a_mount_says_nothing_of_an_orbit(orbits: Synthesizer) -> None:
    clip = random_clip(TINY_OBJECTS)
    assert orbits.traits.mount is None
    assert orbits.encode(replace(clip, mount=CameraMount(height_m=3.0))).mount is None
    with pytest.raises(OptionError, match="leave the mount out"):
        orbits.traits.plan_view(GOAL, mount=CameraMount())


def test_an_orbit_needs_to_know_where_its_source_camera_stands(orbits: Synthesizer) -> None:
    features = orbits.encode(random_clip(TINY_OBJECTS))
    path = orbits.traits.plan_view(GOAL)
    assert path.delta is not None
    nowhere = replace(pose_trajectory(path.source_from_target), delta=path.delta)
    with pytest.raises(PoseError, match="where the source camera stands"):
        orbits.render(features, [nowhere])
    below = Spherical(azimuth_deg=0.0, elevation_deg=-10.0, radius_m=15.0)
    for plan in (
        lambda: orbits.traits.plan_view(SphericalDelta(elevation_deg=20.0), source=below),
        lambda: orbits.traits.plan_poses(path.source_from_target, source=below),
    ):
        with pytest.raises(OptionError, match=r"above the ground, got a height of -1\.6"):
            plan()


def test_a_stated_source_makes_limits_absolute(orbits: Synthesizer) -> None:
    farther = SphericalDelta(radius_m=3.0)
    assert orbits.traits.plan_view(farther).goal_delta == farther
    with pytest.raises(ViewRangeError, match=r"radius_m 3 is outside \[-3, 1\]"):
        orbits.traits.plan_view(farther, source=Spherical(azimuth_deg=0.0, elevation_deg=5.0, radius_m=17.0))


def test_a_source_in_other_units_than_the_scenes_is_named_as_such(orbits: Synthesizer) -> None:
    for source, words in (
        (Spherical(azimuth_deg=0.0, elevation_deg=5.0, radius_m=1.5), r"radius_m 1\.5 of the source camera"),
        (Spherical(azimuth_deg=0.0, elevation_deg=85.0, radius_m=15.0), "elevation_deg 85 of the source camera"),
    ):
        with pytest.raises(ViewRangeError, match=words):
            orbits.traits.plan_view(source=source)


def test_poses_are_warped_as_the_nearest_angles(orbits: Synthesizer) -> None:
    features = orbits.encode(random_clip(TINY_OBJECTS))
    path = orbits.traits.plan_view(GOAL, source=HIGH)
    again = orbits.traits.plan_poses(path.source_from_target, source=HIGH)
    expected, found = (orbits.render(features, [each])[0].samples for each in (path, again))
    assert_close(found, expected, rtol=0, atol=1e-3)


# --- models that paint their classes ---------------------------------------------------------------------------------


def test_a_painted_view_comes_with_the_classes_of_its_colours() -> None:
    synthesizer = painter()
    clip, path = random_clip(TINY_SEMANTIC), synthesizer.traits.plan_view()
    view = synthesizer.render(synthesizer.encode(clip), [path], RenderOptions(samples=2))[0]
    assert synthesizer.traits.classes == TINY_CLASSES
    assert view.classes is not None
    assert view.classes.shape == (2, TINY_SEMANTIC.frames, TINY_SEMANTIC.height, TINY_SEMANTIC.width)
    away = (view.samples.unsqueeze(3) - palette(TINY_CLASSES).T[:, :, None, None] / 255).square().sum(dim=2)
    assert torch.equal(view.classes.long(), away.argmin(dim=2))


def test_classes_are_named_only_where_pictures_are_painted() -> None:
    family_of_photographs = replace(painter().traits, family=DRIVING)
    assert family_of_photographs.classes == ()
    unnamed = painter(structs.replace(TINY_SEMANTIC, semantic_classes=()))
    assert unnamed.traits.classes == ()
    path = unnamed.traits.plan_view()
    assert unnamed.render(unnamed.encode(random_clip(TINY_SEMANTIC)), [path])[0].classes is None


@pytest.mark.parametrize("classes", [TINY_CLASSES, DRIVING_CLASSES])
def test_a_painted_map_is_read_back_even_a_little_off_colour(classes: tuple[object, ...]) -> None:
    ontology = DRIVING_CLASSES if classes is DRIVING_CLASSES else TINY_CLASSES
    generator = torch.Generator().manual_seed(3)
    truth = torch.randint(len(classes), (2, 7, 9), generator=generator)
    painted = palette(ontology)[truth].permute(0, 3, 1, 2) / 255
    noisy = (painted + 0.03 * (torch.rand(painted.shape, generator=generator) - 0.5)).clamp(0, 1)
    for pixels in (painted, noisy):
        found = nearest_classes(pixels, ontology)
        assert found.dtype == torch.uint8
        assert torch.equal(found.long(), truth)


# --- the named set-ups -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [OBJECTS_SMALL, DRIVING_SEMANTIC_SMALL, TINY_OBJECTS, TINY_SEMANTIC])
def test_a_set_up_survives_its_file_and_can_be_built(config: ModelConfig) -> None:
    assert msgspec.json.decode(msgspec.json.encode(config), type=ModelConfig) == config
    assert config.is_ours
    assert 2 * sum(parameter.numel() for parameter in empty_networks(config).parameters()) < 25_000_000


def test_set_ups_are_what_their_names_say() -> None:
    assert OBJECTS_SMALL.plane_warp is not None
    assert (OBJECTS_SMALL.camera, OBJECTS_SMALL.plane_warp.frame, OBJECTS_SMALL.class_head) == (
        "spherical",
        "stage",
        None,
    )
    assert (OBJECTS_SMALL.sampling, OBJECTS_SMALL.vae) == (DRIVING_SMALL.sampling, DRIVING_SMALL.vae)
    assert DRIVING_SEMANTIC_SMALL.unet == DRIVING_SMALL.unet
    assert DRIVING_SEMANTIC_SMALL.semantic_classes == DRIVING_CLASSES
    assert (DRIVING_SEMANTIC_SMALL.plane_mix, DRIVING_SEMANTIC_SMALL.class_head) == (None, None)
    assert DRIVING_SEMANTIC_SMALL.sampling.steps > 1


def test_a_config_written_before_stages_existed_is_a_vehicles() -> None:
    content = msgspec.json.decode(msgspec.json.encode(DRIVING_SMALL))
    del content["semantic_classes"], content["plane_warp"]["frame"], content["plane_warp"]["offsets_m"]
    assert msgspec.convert(content, ModelConfig) == DRIVING_SMALL


def test_an_ontology_that_cannot_be_told_apart_is_refused() -> None:
    content = msgspec.to_builtins(TINY_SEMANTIC)
    for classes, words in (([0, 0], "a colour of its own"), ([0], "2 to 256 classes, got 1")):
        content["semantic_classes"] = [msgspec.to_builtins(TINY_CLASSES[i]) for i in classes]
        with pytest.raises(msgspec.ValidationError, match=words):
            msgspec.convert(content, ModelConfig)
    with pytest.raises(OptionError, match="not both"):
        structs.replace(TINY_DRIVING, semantic_classes=TINY_CLASSES)


def test_the_published_model_paints_nothing_it_could_name() -> None:
    assert TINY.semantic_classes == ()
    traits: Traits = replace(tiny_synthesizer().traits, family=DRIVING_SEMANTIC)
    assert traits.classes == ()
