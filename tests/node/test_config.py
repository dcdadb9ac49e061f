from typing import get_args, get_type_hints

import msgspec
import pytest

from gcd_model import RenderOptions
from gcd_model.diffusion import QUALITIES, SOLVERS
from gcd_node.config import ModelSection, NodeConfig, parse_config
from gcd_node.errors import ConfigError
from gcd_node.stream_context import drawing_options

PATH, VIEW = 'path = "drive.mp4"', "[view.topdown]"
MINIMAL = f"""
[source]
{PATH}
[model]
weights = "random:driving"
{VIEW}
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
    ("old", "new", "said"),
    [
        # an unknown key: the nearest known one
        ("path =", "pathh =", ["did you mean `path", "source"]),
        ("weights", "wieghts", ["did you mean `weights", "model"]),
        (VIEW, f'{VIEW}\nknid = "fixed"', ["did you mean `kind", "view"]),
        (VIEW, f"{VIEW}\n[publsh]\ndata = 'ipc'", ["did you mean `publish"]),
        (VIEW, f"{VIEW}\n[source.pose]\nelevation = 3.0", ["did you mean `elevation_deg", "source.pose"]),
        # a wrong value: where it stands
        (PATH, "", ["source"]),
        (VIEW, f'{VIEW}\nkind = "orbit"', ["rate_deg_s"]),
        (VIEW, f"{VIEW}\nrate_deg_s = 3.0", ["orbit"]),
        (VIEW, f"{VIEW}\n[window]\nfps = 5000.0", ["fps"]),
        (VIEW, f"{VIEW}\n[window]\nfps = 'ten'", ["fps"]),
        (PATH, 'kind = "push"\nfps = 90000.0', ["fps"]),
        (VIEW, f"guidance_interval = [5.0, 0.5]\n{VIEW}", ["guidance_interval"]),
        (VIEW, f'quality = "best"\n{VIEW}', ["quality"]),
        (VIEW, '[view."Top Down"]', ["view"]),
        (VIEW, "[view]", ["view"]),
        (VIEW, f"{VIEW}\n[publish]\njpeg_quality = 20", ["jpeg_quality"]),
        (VIEW, "[source", []),
        # a key that a kind of source has not: unknown
        (PATH, 'kind = "rtsp"\nurl = "rtsp://x"\ndevice = "0"', ["device", "rtsp"]),
        (PATH, 'kind = "push"\nendpont = "ipc"', ["endpont", "`endpoint`"]),
        (PATH, 'kind = "orbital"', ["orbital", "file", "push"]),
        (PATH, 'kind = "oak"\npace = "lockstep"', ["pace"]),
        (PATH, 'kind = "folder"\npath = "p"', ["fps"]),
        (PATH, 'kind = "mcap"', ["path"]),
    ],
)
def test_what_is_wrong_is_one_line_that_says_where_and_what_would_be_right(old: str, new: str, said: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parsed(MINIMAL.replace(old, new))
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert [each for each in ("test.toml", *said) if each not in line] == []


def test_everything_of_drawing_reaches_the_model() -> None:
    options = RenderOptions(
        quality="fastest",
        steps=3,
        solver="dpmpp_2m",
        guidance=(1.0, 2.0),
        guidance_interval=(0.5, 5.0),
        samples=2,
        motion_bucket=9.0,
    )
    stated = {name: getattr(options, name) for name in ModelSection.__struct_fields__ if hasattr(options, name)}
    assert len(stated) == 8  # with the seed, which is not one of drawing
    assert drawing_options(msgspec.convert({"weights": "w", **stated}, ModelSection)) == options


def test_launch_files_know_the_models_qualities_and_solvers() -> None:
    """The words stand in two places, as readers of launch files need no model."""
    hints = get_type_hints(ModelSection)
    assert get_args(hints["quality"]) == QUALITIES
    assert get_args(get_args(hints["solver"])[0]) == SOLVERS
