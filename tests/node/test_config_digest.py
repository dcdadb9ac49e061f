"""Configurations that render the same have the same name, however they are written."""

from dataclasses import replace

import msgspec
import pytest
from fakes import live_traits, traits

from gcd_model import RenderOptions, Traits
from gcd_model.config import SamplingConfig
from gcd_model.diffusion import Sampler
from gcd_node.config import NodeConfig, parse_config
from gcd_node.stream_context import config_digest

MINIMAL = """
[source]
path = "drive.mp4"
[model]
weights = "fake"
[view.topdown]
"""
STEERED, LIVE, UNSTEERED = traits(), live_traits(), traits("svd")


def parsed(text: str = MINIMAL, *changes: str) -> NodeConfig:
    return parse_config(text.encode(), "test.toml", changes)


def digest(*changes: str, made: Traits = STEERED) -> str:
    return config_digest(parsed(MINIMAL, *changes), made)


@pytest.mark.parametrize(
    ("made", "written_out"),
    [
        (STEERED, f"model.steps={STEERED.config.sampling.steps}"),
        (STEERED, f"model.guidance={list(STEERED.config.sampling.guidance)}"),
        (STEERED, f"model.move_time={STEERED.move_time}"),
        (STEERED, "model.family=kubric90"),
        (STEERED, "model.quality=fastest"),
        (STEERED, "model.solver=euler"),
        (STEERED, "model.seed=0"),
        (STEERED, f"window.stride={STEERED.config.frames}"),
        (STEERED, "view.topdown.azimuth_deg=-0.0"),
        (STEERED, "source.pose={}"),
        (STEERED, "source.pose={elevation_deg = 5, radius = 15.0}"),
        (UNSTEERED, "model.motion_bucket=127"),
        (UNSTEERED, "source.pose={}"),
        # where it goes, and how exactly it is computed
        (STEERED, "publish.data=tcp://127.0.0.1:1"),
        (STEERED, "model.threads=3"),
        (STEERED, "model.device=cpu"),
        (STEERED, "model.dtype=float32"),
    ],
)
def test_a_default_that_is_written_out_and_where_it_goes_change_nothing(made: Traits, written_out: str) -> None:
    assert digest(written_out, made=made) == digest(made=made)


@pytest.mark.parametrize(
    ("made", "change"),
    [
        (STEERED, "model.steps=3"),
        (STEERED, "model.guidance=[1.0, 3.0]"),
        (STEERED, "model.solver=dpmpp_2m"),
        (STEERED, "model.cond_aug=0.0"),
        (STEERED, "model.move_time=0"),
        (STEERED, "model.seed=1"),
        (STEERED, "window.stride=4"),
        (STEERED, "view.topdown.azimuth_deg=1.0"),
        (STEERED, "view.other={}"),
        (STEERED, "model.depth_model=net.onnx"),
        (STEERED, "source.resize=area"),
        (STEERED, "source.hfov_deg=60.0"),
        (STEERED, "source.pose={radius = 14.0}"),
        (LIVE, "source.pose={height_m = 1.6}"),
    ],
)
def test_what_changes_the_pixels_changes_the_name(made: Traits, change: str) -> None:
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
