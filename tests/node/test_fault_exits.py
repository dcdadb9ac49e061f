"""What a shell sees of the failure table: the exit code of each row that has one, and the line that goes with it."""

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from cameras import Bench
from fakes import FakeSource, FakeSynthesizer, traits
from safetensors import safe_open
from safetensors.torch import save_file
from tiny_weights import write_tiny

from gcd_node import session
from gcd_node.cli.main import run_app
from gcd_node.config import PublishConfig
from gcd_node.frame import FrameSource
from gcd_node.publisher import Publisher

SLACK_S = 10.0  # what a machine that does other things may add

Outcome = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Outcome:
    """Runs a launch file as the command line does; gives its exit code and what it said. Camera and model are fakes
    where they are given; the camera is there once."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))

    def ran(
        command: str = "run",
        *,
        source: str = 'kind = "synthetic"\npace = "lockstep"',
        weights: str = "random:driving",
        data: str = f"ipc://{tmp_path}/data",
        opened: FrameSource | None = None,
        fake: bool = True,
    ) -> tuple[int, str]:
        launch = tmp_path / "launch.toml"
        launch.write_text(f"""
            [source]
            {source}
            [model]
            weights = "{weights}"
            [view.main]
            [publish]
            data = "{data}"
            status = "ipc://{tmp_path}/status"
            [control]
            endpoint = "ipc://{tmp_path}/control"
        """)
        if opened is not None:
            left = [opened]
            monkeypatch.setattr(session, "open_source", lambda *_: left.pop() if left else Bench().open())
        if fake:
            monkeypatch.setattr(session, "load_model", lambda _: FakeSynthesizer(traits()))
        return run_app([command, str(launch)]), capsys.readouterr().err

    return ran


def test_f2_check_without_a_camera_is_exit_69(run: Outcome) -> None:
    code, said = run("check", source='kind = "v4l2"\ndevice = "/dev/video-none"')
    assert (code, "/dev/video-none" in said) == (69, True)


def test_f5_a_file_that_ends_is_exit_0_and_one_that_is_too_short_65(run: Outcome) -> None:
    assert run(opened=FakeSource(30))[0] == 0
    code, said = run(opened=FakeSource(13))
    assert (code, "TOO_SHORT n=13" in said) == (65, True)


AV1 = cv2.imencode(".avif", np.zeros((48, 64, 3), np.uint8))[1].tobytes()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "clip.mp4"),
        (b"", "empty"),
        (b"no video at all" * 100, "cannot"),
        (AV1, "no frame of it can be decoded: codec AV01"),
    ],
)
def test_f6_a_file_that_cannot_be_decoded_is_exit_66(
    run: Outcome, content: bytes | None, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "clip.mp4"
    if content is not None:
        path.write_bytes(content)
    code, said = run(source=f'path = "{path}"')
    assert (code, "clip.mp4" in said, words in said) == (66, True, True)


def test_f19_a_wider_bind_without_keys_is_exit_78_and_names_both_settings(run: Outcome) -> None:
    code, said = run(data="tcp://0.0.0.0:0")
    assert (code, "[security] keys" in said, "[security] allow" in said) == (78, True, True)


def test_f20_an_endpoint_in_use_is_exit_73_and_named(run: Outcome, tmp_path: Path) -> None:
    with Publisher(PublishConfig(data=f"ipc://{tmp_path}/data", status=f"ipc://{tmp_path}/status")):
        began_s = time.monotonic()
        code, said = run()
    assert time.monotonic() - began_s < 1.0 + SLACK_S
    assert code == 73
    assert f"{tmp_path}/data" in said


@pytest.mark.parametrize("damage", ["missing", "misshapen"])
def test_f25_weights_that_do_not_fit_are_exit_65_and_the_first_five_are_named(
    run: Outcome, damage: str, tmp_path: Path
) -> None:
    path = tmp_path / "bad.safetensors"
    with safe_open(write_tiny(tmp_path), "pt") as packaged:
        weights = {name: packaged.get_tensor(name) for name in packaged.keys()}  # noqa: SIM118  it is no dict
        told = packaged.metadata()
    count = len(weights)
    spoilt = [name for name in weights if name.endswith(".weight")][:7]
    for name in spoilt:
        weights[name] = torch.zeros(5)
        if damage == "missing":
            del weights[name]
    save_file(weights, path, told)
    code, said = run(weights=str(path), opened=FakeSource(14), fake=False)
    assert code == 65
    assert f"7 of {count} weights are {damage}" in said
    assert sum(name in said for name in spoilt) == 5
