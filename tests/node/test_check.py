"""`gcd-node check`, and launch files with changes, as text again."""

from pathlib import Path

import numpy as np
import pytest
from fakes import write_tiny
from media import write_video

from gcd_node.check import check_launch
from gcd_node.cli.main import run_app
from gcd_node.config import PublishConfig, load_config, parse_config
from gcd_node.publisher import Publisher


@pytest.fixture
def launch(tmp_path: Path) -> Path:
    """Of a video that is smaller than any model takes unless it may be enlarged."""
    write_video(tmp_path / "v.mkv", [np.full((128, 192, 3), 5 * i, np.uint8) for i in range(16)], 10.0)
    path = tmp_path / "launch.toml"
    path.write_text(f"""
        [source]
        path = "{tmp_path}/v.mkv"
        allow_upscale = true
        [model]
        weights = "random:driving"
        [view.main]
        [publish]
        data = "ipc://{tmp_path}/data"
        status = "ipc://{tmp_path}/status"
        [control]
        endpoint = "ipc://{tmp_path}/control"
    """)
    return path


def found(launch: Path, *changes: str, memory: int | None = None) -> dict[str, tuple[str, str]]:
    return {each.topic: (each.verdict, each.detail) for each in check_launch(load_config(launch, changes), memory)}


def test_a_good_launch_file_is_looked_at_from_end_to_end(launch: Path) -> None:
    findings = found(launch)
    assert list(findings) == ["endpoints", "source", "weights", "views"]
    assert [verdict for verdict, _ in findings.values()] == ["ok", "ok", "warning", "ok"]  # random weights are noise
    assert "192 x 128 at 10 FPS" in findings["source"][1]
    assert "14 frames at 10 FPS" in findings["views"][1]
    assert not (launch.parent / "data").exists()  # nothing stays bound


@pytest.mark.parametrize(
    ("change", "topic", "code"),
    [
        ("source.path=/no/such.mp4", "source", 66),
        ("model.weights=/no/such.ckpt", "weights", 65),
        ("model.weights=package:unheard", "weights", 65),
        ("view.main.azimuth_deg=5", "views", 64),
        ("publish.data=tcp://0.0.0.0:5580", "endpoints", 78),
    ],
)
def test_what_would_fail_is_named_and_is_the_exit_code(
    change: str, topic: str, code: int, launch: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert found(launch, change)[topic][0] == "failed"
    assert run_app(["check", str(launch), "--set", change]) == code
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")


def test_one_failure_does_not_hide_the_next(launch: Path) -> None:
    endpoints = PublishConfig(data=f"ipc://{launch.parent}/data", status=f"ipc://{launch.parent}/status")
    with Publisher(endpoints, linger_ms=0):
        findings = found(launch, "source.path=/no/such.mp4", "model.weights=/no/such.ckpt")
    assert [findings[topic][0] for topic in ("endpoints", "source", "weights")] == ["failed"] * 3
    assert "in use" in findings["endpoints"][1]


def test_weights_that_do_not_fit_into_memory_are_refused_before_they_are_loaded(launch: Path, tmp_path: Path) -> None:
    packaged = f"model.weights={write_tiny(tmp_path)}"
    assert found(launch, packaged, memory=10_000)["weights"][0] == "failed"
    assert found(launch, packaged, memory=2**40)["weights"][0] == "ok"


def test_where_recordings_would_go_is_looked_at(launch: Path, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "recordings"
    verdict, detail = found(launch, f"record.folder={folder}", "record.keep_free_mb=0")["record"]
    assert verdict == "ok"
    assert "inputs, views" in detail
    assert list(folder.iterdir()) == []
    assert found(launch, f"record.folder={folder}", "record.keep_free_mb=1e12")["record"][0] == "warning"
    (tmp_path / "file").write_text("")
    verdict, detail = found(launch, f"record.folder={tmp_path}/file/x")["record"]
    assert verdict == "failed"
    assert "check folder in [record]" in detail


# The configuration as text.


def test_what_is_printed_is_the_same_launch_file_again(launch: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["run", str(launch), "--set", "model.steps=7", "--print-config"]) == 0
    again = parse_config(capsys.readouterr().out.encode(), "printed")
    assert again == load_config(launch, ["model.steps=7"])
    assert again.model.steps == 7
