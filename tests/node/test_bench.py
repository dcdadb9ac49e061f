"""`gcd-node bench` counts right and reads a real node; how fast this machine is, no test says."""

import json
from pathlib import Path

import pytest
from fakes import write_tiny

from gcd_node.cli.bench import Arrival, view_figures
from gcd_node.cli.main import run_app
from gcd_node.errors import NodeError


def arrivals(*views: tuple[int, int, range]) -> list[Arrival]:
    """Of (arrival in ms, age in ms, sequence numbers)."""
    return [Arrival(at_ns=at_ms * 1_000_000, age_ms=age_ms, seqs=tuple(seqs)) for at_ms, age_ms, seqs in views]


def named(views: dict[str, list[Arrival]], *names: str) -> list[float]:
    figures = {name.partition(".")[2]: value for name, value in view_figures(views).items()}
    return [figures[name] for name in names]


def test_windows_answer_their_frames_and_a_lost_one_misses_as_many() -> None:
    windows = arrivals((1000, 500, range(14)), (2400, 700, range(14, 28)), (5200, 600, range(42, 56)))
    names = ("NUM_FRAMES_SENT", "NUM_MISSED_FRAMES", "MEAN_FRAME_RATE", "MEAN_PLAYBACK_FRAME_RATE")
    assert named({"top": windows}, *names) == pytest.approx([56, 14, 28 / 4.2, 42 / 4.2])
    ages = named({"top": windows}, "MEAN_LATENCY", "P50_LATENCY", "P95_LATENCY", "MAX_LATENCY", "MAX_JITTER")
    assert ages == [600, 600, 700, 700, 1400]


def test_a_frame_is_answered_once_every_view_has_it() -> None:
    top = arrivals(*((100 * seq, 80, range(seq, seq + 1)) for seq in range(10)))
    side = arrivals(*((100 * seq + 50, 120, range(seq, seq + 1)) for seq in range(1, 10) if seq != 5))
    counted = named({"top": top, "side": side}, "NUM_FRAMES_SENT", "NUM_MISSED_FRAMES", "NUM_VIEWS", "MAX_LATENCY")
    assert counted == [9, 1, 18, 120]
    with pytest.raises(NodeError, match="--seconds"):
        view_figures({"top": top, "side": side[:2]})


@pytest.mark.timeout(300)
def test_a_real_node_is_measured_under_the_published_names(tmp_path: Path) -> None:
    launch = tmp_path / "launch.toml"
    launch.write_text(f'[source]\nkind = "synthetic"\n[model]\nweights = "{write_tiny(tmp_path)}"\n[view.top]\n')
    out = tmp_path / "bench.json"
    options = ["--set", "model.threads=1", "--seconds", "12", "--json", str(out)]
    assert run_app(["bench", str(launch), "--rate", "50", *options]) == 0
    figures = json.loads(out.read_text())
    assert figures["metadata"]["BenchmarkMetadata.INPUT_DATA_PATH"] == "synthetic"
    for run in (figures, figures["50.0fps"]):
        assert run["BasicPerformanceMetrics.NUM_FRAMES_SENT"] >= 42
        assert run["BasicPerformanceMetrics.MEAN_FRAME_RATE"] > 0
        assert 0 < run["GcdNodeMetrics.P50_LATENCY"] <= run["BasicPerformanceMetrics.MAX_LATENCY"]
        assert run["BasicPerformanceMetrics.MEAN_JITTER"] >= 0
        assert 0 <= run["ResourceMetrics.MEAN_OVERALL_CPU_UTILIZATION"] <= 100
        assert run["GcdNodeMetrics.PEAK_MEMORY"] > 100
        assert run["GcdNodeMetrics.FIRST_VIEW"] > 0
    assert figures["BasicPerformanceMetrics.NUM_MISSED_FRAMES"] == 0  # in lockstep


@pytest.mark.parametrize(
    ("source", "code", "said"), [('kind = "v4l2"', 64, "--stream"), ('path = "none.mp4"', 70, "none.mp4")]
)
def test_what_cannot_be_measured_is_one_line(
    source: str, code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    launch = tmp_path / "launch.toml"
    launch.write_text(f'[source]\n{source}\n[model]\nweights = "random:kubric90"\n[view.top]\n')
    assert run_app(["bench", str(launch)]) == code
    assert said in capsys.readouterr().err
