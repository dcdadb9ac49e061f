"""Which family a checkpoint belongs to, by its name and by the yaml beside it."""

import pytest

from gcd_model.weights.families import Provenance, combined, told_by_name, told_by_yaml

NAMES = [
    ("kubric_gradual_max90", "kubric90", 13),
    ("kubric_direct_max90", "kubric90", 0),
    ("kubric_gradual_max180", "kubric180", 13),
    ("kubric_direct_max180", "kubric180", 0),
    ("pardom_gradual_rgb", "driving", 13),
    ("pardom_direct_rgb", "driving", 0),
    ("pardom_gradual_semantic", "driving-semantic", 13),
    ("pardom_direct_semantic", "driving-semantic", 0),
]


@pytest.mark.parametrize(("name", "family", "move_time"), NAMES)
def test_every_published_name_tells_family_and_move_time(name: str, family: str, move_time: int) -> None:
    for stem in (name, f"{name}_bf16", f"my-{name.upper()}"):
        told = told_by_name(stem)
        assert (told.family, told.move_time, told.told_by) == (family, move_time, "file name")


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("svd", None),
        ("stable-video-diffusion-img2vid", None),
        ("svd_xt", 25),
        ("stable-video-diffusion-img2vid-xt", 25),
    ],
)
def test_the_base_models_are_known_by_their_whole_names(name: str, frames: int | None) -> None:
    told = told_by_name(name)
    assert (told.family, told.frames, told.move_time) == ("svd", frames, None)


@pytest.mark.parametrize("name", ["", "last", "my_svd_finetune", "kubric_gradual_max900", "kubric_gradual", "svd2"])
def test_other_names_tell_nothing(name: str) -> None:
    assert told_by_name(name) == Provenance()


YAML = """
data:
  params:
    # azimuth_range: [-180.0, 180.0]
    azimuth_range: [0.0, 360.0]
    elevation_range: [0.0, 50.0]
    {azimuth}
    {elevation}
    trajectory: interpol_linear
    move_time: {move_time}  # frames
"""
INLINE = ("delta_azimuth_range: [-{0}, {0}]", "delta_elevation_range: [ -{0}.0 , {0}.0 ]")
BLOCK = ("delta_azimuth_range:\n    - -{0}\n    - {0}", "delta_elevation_range:\n      - -{0}.0\n      - {0}.0")


@pytest.mark.parametrize("style", [INLINE, BLOCK], ids=["inline", "block"])
@pytest.mark.parametrize(("azimuth", "elevation", "family"), [(90, 30, "kubric90"), (180, 60, "kubric180")])
def test_angle_ranges_of_a_yaml_tell_the_family(
    style: tuple[str, str], azimuth: int, elevation: int, family: str
) -> None:
    text = YAML.format(azimuth=style[0].format(azimuth), elevation=style[1].format(elevation), move_time=13)
    assert told_by_yaml(text) == Provenance(family=family, move_time=13, told_by="yaml")


def test_ranges_that_contradict_each_other_or_no_family_tell_none() -> None:
    for azimuth, elevation in ((90, 60), (45, 30)):
        text = YAML.format(azimuth=INLINE[0].format(azimuth), elevation=INLINE[1].format(elevation), move_time=0)
        assert told_by_yaml(text) == Provenance(move_time=0)


def test_driving_views_and_modality_tell_the_driving_families() -> None:
    text = "input_mode: ego_forward\noutput_mode: topdown1\nmove_time: 13\noutput_modality: {}\n"
    assert told_by_yaml(text.format("rgb")).family == "driving"
    assert told_by_yaml(text.format("segm")).family == "driving-semantic"
    assert told_by_yaml(text.format("'segm'")).move_time == 13


@pytest.mark.parametrize(
    "text", ["", "move_time: soon", "azimuth: [1, 2", "\x00\xff", "a: " + "-" * 200_000, " " * 200_000]
)
def test_yaml_that_says_nothing_is_no_error(text: str) -> None:
    assert told_by_yaml(text) == Provenance()


def test_each_fact_comes_from_the_first_that_knows_it() -> None:
    named = Provenance(family="kubric180", move_time=0, told_by="file name")
    assert combined(Provenance(), named, Provenance(family="kubric90", move_time=13, told_by="yaml")) == named
    option = Provenance(family="kubric90", told_by="option")
    assert combined(option, named) == Provenance(family="kubric90", move_time=0, told_by="option")
