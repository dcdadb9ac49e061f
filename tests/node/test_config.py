"""Launch files: their keys, what is wrong with them, changes to them, and the name of what they render."""

from dataclasses import replace
from typing import get_args, get_type_hints

import msgspec
import pytest
from fakes import live_traits, traits

from gcd_model import RenderOptions, Traits
from gcd_model.config import SamplingConfig
from gcd_model.diffusion import QUALITIES, SOLVERS, Sampler
from gcd_node.config import ModelSection, NodeConfig, parse_config, to_toml
from gcd_node.errors import ConfigError
from gcd_node.stream_context import config_digest, drawing_options

PATH, VIEW = 'path = "drive.mp4"', "[view.topdown]"
MINIMAL = f"""
[source]
{PATH}
[model]
weights = "random:driving"
{VIEW}
"""


def parsed(text: str = MINIMAL, *changes: str) -> NodeConfig:
    return parse_config(text.encode(), "test.toml", changes)


def test_what_is_wrong_is_one_line_that_says_where_and_what_would_be_right() -> None:
    for old, new, said in (
        # an unknown key: the nearest known one
        ("path =", "pathh =", ["did you mean `path", "source"]),
        ("weights", "wieghts", ["did you mean `weights", "model"]),
        (VIEW, f'{VIEW}\nknid = "fixed"', ["did you mean `kind", "view"]),
        (VIEW, f"{VIEW}\n[source.pose]\nelevation = 3.0", ["did you mean `elevation_deg", "source.pose"]),
        # a wrong value: where it stands
        (PATH, "", ["source"]),
        (VIEW, f'{VIEW}\nkind = "orbit"', ["rate_deg_s"]),
        (VIEW, f"{VIEW}\nrate_deg_s = 3.0", ["orbit"]),
        (VIEW, f"{VIEW}\n[window]\nfps = 5000.0", ["fps"]),
        (VIEW, f"guidance_interval = [5.0, 0.5]\n{VIEW}", ["guidance_interval"]),
        (VIEW, f'quality = "best"\n{VIEW}', ["quality"]),
        (VIEW, '[view."Top Down"]', ["view"]),
        (VIEW, "[source", []),
        # a key that a kind of source has not: unknown
        (PATH, 'kind = "rtsp"\nurl = "rtsp://x"\ndevice = "0"', ["device", "rtsp"]),
        (PATH, 'kind = "push"\nendpont = "ipc"', ["endpont", "`endpoint`"]),
        (PATH, 'kind = "orbital"', ["orbital", "file", "push"]),
        (PATH, 'kind = "oak"\npace = "lockstep"', ["pace"]),
        (PATH, 'kind = "folder"\npath = "p"', ["fps"]),
    ):
        with pytest.raises(ConfigError) as caught:
            parsed(MINIMAL.replace(old, new))
        line = str(caught.value)
        assert len(line.splitlines()) == 1
        assert [each for each in ("test.toml", *said) if each not in line] == []


def test_everything_of_drawing_reaches_the_model() -> None:
    numbers = {"steps": 3, "samples": 2, "motion_bucket": 9.0, "guidance": (1.0, 2.0), "guidance_interval": (0.5, 5.0)}
    options = RenderOptions(quality="fastest", solver="dpmpp_2m", **numbers)
    stated = {name: getattr(options, name) for name in ModelSection.__struct_fields__ if hasattr(options, name)}
    assert len(stated) == 8  # with the seed, which is not one of drawing
    assert drawing_options(msgspec.convert({"weights": "w", **stated}, ModelSection)) == options


def test_launch_files_know_the_models_qualities_and_solvers() -> None:
    """The words stand in two places, as readers of launch files need no model."""
    hints = get_type_hints(ModelSection)
    assert get_args(hints["quality"]) == QUALITIES
    assert get_args(get_args(hints["solver"])[0]) == SOLVERS


# Changes, and text again.


def test_passwords_are_not_printed() -> None:
    for url, shown in (
        ("rtsp://me:secret@host:554/a?token=secret", "rtsp://me:***@host:554/a?***"),
        ("rtsp://host/a", "rtsp://host/a"),
        ("rtsp://me:sec@ret@host/a", "rtsp://me:***@host/a"),
    ):
        text = MINIMAL.replace(PATH, 'kind = "rtsp"')
        printed = to_toml(parsed(text, f"source.url={url}"))
        assert f'url = "{shown}"' in printed
        assert "secret" not in printed


def test_changes_are_read_as_toml_and_else_as_text() -> None:
    changes = [
        "model.steps=4",
        "source.path=b=c.mp4",
        "view.topdown.azimuth_deg = -3.5",
        "strict=true",
        "view.b.radius=1.0",
    ]
    config = parsed(MINIMAL, *changes, "model.guidance=[1.0, 2.0]", 'model.weights="4"', "model.steps=5")
    assert (config.model.steps, config.source.path, config.strict) == (5, "b=c.mp4", True)
    assert (config.view["topdown"].azimuth_deg, config.view["b"].radius) == (-3.5, 1.0)
    assert (config.model.weights, config.model.guidance) == ("4", (1.0, 2.0))


@pytest.mark.parametrize(
    "change",
    [
        *("model.steps", "=4", "model..steps=4", "model.steps.more=4", "model.stepz=4", "model.steps=0"),
        "view.topdown.kind=orbital",
    ],
)
def test_a_change_that_cannot_be_made_is_refused(change: str) -> None:
    with pytest.raises(ConfigError):
        parsed(MINIMAL, "model.steps=4", change)


# Configurations that render the same have the same name, however they are written.


STEERED, LIVE, UNSTEERED = traits(), live_traits(), traits("svd")


def digest(*changes: str, made: Traits = STEERED) -> str:
    return config_digest(parsed(MINIMAL, *changes), made)


def test_a_default_that_is_written_out_and_where_it_goes_change_nothing() -> None:
    for made, written_out in (
        (STEERED, f"model.steps={STEERED.config.sampling.steps}"),
        (STEERED, f"model.guidance={list(STEERED.config.sampling.guidance)}"),
        (STEERED, f"model.move_time={STEERED.move_time}"),
        (STEERED, "model.family=kubric90"),
        (STEERED, "model.quality=fastest"),
        (STEERED, "model.seed=0"),
        (STEERED, f"window.stride={STEERED.config.frames}"),
        (STEERED, "view.topdown.azimuth_deg=-0.0"),
        (STEERED, "source.pose={elevation_deg = 5, radius = 15.0}"),
        (UNSTEERED, "model.motion_bucket=127"),
        (UNSTEERED, "source.pose={}"),
        # where it goes, and how exactly it is computed
        (STEERED, "publish.data=tcp://127.0.0.1:1"),
        (STEERED, "model.device=cpu"),
        (STEERED, "model.dtype=float32"),
    ):
        assert digest(written_out, made=made) == digest(made=made)


def test_what_changes_the_pixels_changes_the_name() -> None:
    for made, change in (
        (STEERED, "model.steps=3"),
        (STEERED, "model.solver=dpmpp_2m"),
        (STEERED, "model.cond_aug=0.0"),
        (STEERED, "model.seed=1"),
        (STEERED, "window.stride=4"),
        (STEERED, "view.topdown.azimuth_deg=1.0"),
        (STEERED, "view.other={}"),
        (STEERED, "model.depth_model=net.onnx"),
        (STEERED, "source.resize=area"),
        (STEERED, "source.hfov_deg=60.0"),
        (STEERED, "source.pose={radius = 14.0}"),
        (LIVE, "source.pose={height_m = 1.6}"),
        (LIVE, "view.topdown={position_m = [-4.0, 3.0, 3.5], look_at_m = [12.0, 0.0, 0.5]}"),
    ):
        assert digest(change, made=made) != digest(made=made)


def test_a_quality_has_the_name_of_what_it_comes_to() -> None:
    many = replace(STEERED, config=msgspec.structs.replace(STEERED.config, sampling=SamplingConfig()))
    fast = Sampler.of(many.config.sampling, RenderOptions(quality="fast"))
    assert digest("model.quality=fast", made=many) != digest(made=many)
    named = digest(f"model.steps={fast.steps}", f"model.solver={fast.solver}", made=many)
    assert digest("model.quality=fast", made=many) == named


def test_a_camera_and_its_recording_share_a_digest_and_so_their_seeds() -> None:
    camera = 'kind = "v4l2"\ndevice = "0"\nwidth = 640\nfps = 30.0\nstall_ms = 500.0\ncalibration = "lens.yaml"'
    recording = 'kind = "mcap"\npath = "drive.mcap"\npace = "lockstep"'
    live, again, other = (
        config_digest(parsed(MINIMAL.replace('path = "drive.mp4"', each)), STEERED)
        for each in (camera, recording, recording + '\nresize = "area"')
    )
    assert live == again != other
