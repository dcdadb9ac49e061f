import pytest

from gcd_node.config import NodeConfig, parse_config
from gcd_node.errors import ConfigError

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
    ("wrong", "reason"),
    [
        (MINIMAL.replace('path = "drive.mp4"', ""), "needs a path"),
        (MINIMAL.replace('path = "drive.mp4"', 'path = "a"\nkind = "synthetic"'), "takes no path"),
        (MINIMAL.replace('path = "drive.mp4"', 'path = "a"\nkind = "folder"'), "give fps"),
        (MINIMAL + 'kind = "orbit"', "rate_deg_s and amplitude_deg"),
        (MINIMAL + "[window]\nfps = 5000.0", "fps"),
        (MINIMAL.replace('path = "drive.mp4"', 'kind = "push"\nfps = 90000.0'), "fps"),
        (MINIMAL.replace("[view", "guidance_interval = [5.0, 0.5]\n[view"), "got 5 to 0.5"),
        (MINIMAL.replace("[view", 'quality = "best"\n[view'), "best"),
        (MINIMAL + "rate_deg_s = 3.0", "orbit"),
        (MINIMAL.replace("[view.topdown]", '[view."Top Down"]'), "a-z0-9_"),
        (MINIMAL.replace("[view.topdown]", "[view]"), ">= 1"),
        (MINIMAL + "[publish]\njpeg_quality = 20", ">= 50"),
        (MINIMAL + "[window]\nmax_skew = 2.0", "<= 0.5"),
        (MINIMAL + "[window]\nfps = 'ten'", "Expected `float"),
        (MINIMAL + "[source", "not valid TOML"),
    ],
)
def test_a_wrong_value_is_an_error_that_says_what_was_wanted(wrong: str, reason: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parsed(wrong)
    assert reason in str(caught.value)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ('kind = "rtsp"\nurl = "rtsp://x"\ndevice = "0"', ["device", "v4l2", "oak"]),
        ('kind = "v4l2"\nframes = 3', ["frames", "synthetic"]),
        ('kind = "push"\nendpont = "ipc"', ["endpont", "`endpoint`"]),
        ('kind = "orbital"', ["orbital", "file", "push"]),
        ('kind = "oak"\npace = "lockstep"', ["does not wait", "pace"]),
        ('kind = "folder"\npath = "p"', ["fps"]),
        ('kind = "mcap"', ["path"]),
    ],
)
def test_a_key_that_a_kind_of_source_has_not_is_refused_with_those_that_have_it(source: str, said: list[str]) -> None:
    text = f'[source]\n{source}\n[model]\nweights = "w"\n[view.a]\n'
    with pytest.raises(ConfigError) as caught:
        parse_config(text.encode(), "file.toml")
    assert [each for each in ("file.toml", *said) if each not in str(caught.value)] == []
