from typing import get_args, get_type_hints

import pytest

from gcd_model import RenderOptions
from gcd_model.clip import QUALITIES, SOLVERS
from gcd_node.config import ModelSection, NodeConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.stream_context import drawing_options

MINIMAL = """
[source]
path = "drive.mp4"
[model]
weights = "random:driving"
[view.topdown]
"""


def parsed(text: str) -> NodeConfig:
    return parse_config(text.encode(), "test.toml")


def test_defaults_are_those_of_a_live_node_on_this_machine() -> None:
    config = parsed(MINIMAL)
    assert config.source.kind == "file"
    assert config.source.pace == "realtime"
    assert config.publish.data == "ipc"
    assert config.view["topdown"].kind == "fixed"


@pytest.mark.parametrize(
    ("wrong", "near", "place"),
    [
        (MINIMAL.replace("path =", "pathh ="), "path", "source"),
        (MINIMAL.replace("weights", "wieghts"), "weights", "model"),
        (MINIMAL + 'knid = "fixed"', "kind", "view"),
        (MINIMAL + "[publsh]\ndata = 'ipc'", "publish", ""),
        (MINIMAL + "[source.pose]\nelevation = 3.0", "elevation_deg", "source.pose"),
    ],
)
def test_an_unknown_key_is_an_error_that_names_the_nearest_known_one(wrong: str, near: str, place: str) -> None:
    with pytest.raises(ConfigError, match=f"did you mean `{near}`") as caught:
        parsed(wrong)
    assert place in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        (MINIMAL.replace('path = "drive.mp4"', ""), "source"),
        (MINIMAL + 'kind = "orbit"', "rate_deg_s"),
        (MINIMAL + "[window]\nfps = 5000.0", "fps"),
        (MINIMAL.replace('path = "drive.mp4"', 'kind = "push"\nfps = 90000.0'), "fps"),
        (MINIMAL.replace("[view", "guidance_interval = [5.0, 0.5]\n[view"), "guidance_interval"),
        (MINIMAL.replace("[view", 'quality = "best"\n[view'), "quality"),
        (MINIMAL + "rate_deg_s = 3.0", "orbit"),
        (MINIMAL.replace("[view.topdown]", '[view."Top Down"]'), "view"),
        (MINIMAL.replace("[view.topdown]", "[view]"), "view"),
        (MINIMAL + "[publish]\njpeg_quality = 20", "jpeg_quality"),
        (MINIMAL + "[window]\nfps = 'ten'", "fps"),
        (MINIMAL + "[source", "test.toml"),
    ],
)
def test_a_wrong_value_is_an_error_that_says_where_it_stands(wrong: str, place: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parsed(wrong)
    assert place in str(caught.value)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ('kind = "rtsp"\nurl = "rtsp://x"\ndevice = "0"', ["device", "rtsp"]),
        ('kind = "push"\nendpont = "ipc"', ["endpont", "`endpoint`"]),
        ('kind = "orbital"', ["orbital", "file", "push"]),
        ('kind = "oak"\npace = "lockstep"', ["pace"]),
        ('kind = "folder"\npath = "p"', ["fps"]),
        ('kind = "mcap"', ["path"]),
    ],
)
def test_a_key_that_a_kind_of_source_has_not_or_lacks_is_refused(source: str, said: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parsed(MINIMAL.replace('path = "drive.mp4"', source))
    assert [each for each in ("test.toml", *said) if each not in str(caught.value)] == []


def test_everything_of_drawing_reaches_the_model() -> None:
    section = ModelSection(
        weights="w",
        quality="fastest",
        steps=3,
        solver="dpmpp_2m",
        guidance=(1.0, 2.0),
        guidance_interval=(0.5, 5.0),
        samples=2,
        motion_bucket=9.0,
    )
    assert drawing_options(section) == RenderOptions(
        quality="fastest",
        steps=3,
        solver="dpmpp_2m",
        guidance=(1.0, 2.0),
        guidance_interval=(0.5, 5.0),
        samples=2,
        motion_bucket=9.0,
    )


def test_launch_files_know_the_models_qualities_and_solvers() -> None:
    """The words stand in two places, as readers of launch files need no model."""
    hints = get_type_hints(ModelSection)
    assert get_args(hints["quality"]) == QUALITIES
    assert get_args(get_args(hints["solver"])[0]) == SOLVERS
