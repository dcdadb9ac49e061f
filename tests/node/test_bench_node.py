"""The bench gives figures, and they can be true; how fast this machine is, no test says."""

import json
import math
from dataclasses import replace

import pytest

from gcd_node.cli import bench as cli_bench
from gcd_node.cli.main import run_app
from gcd_node.load import bench
from gcd_node.load.bench import (
    BenchOptions,
    BenchReport,
    FirstView,
    Latency,
    SlowModel,
    SourceBack,
    StalledReader,
    bench_node,
)
from gcd_node.load.first_view import first_view

SMALL = BenchOptions(windows=4, slow_windows=3, stall_s=2.0, returns=1, outage_s=0.2, starts=1, width=96, height=64)
REPORT = BenchReport(
    machine_load=0.25,
    frames=14,
    width=384,
    height=256,
    latency=Latency(count=100, p50_ms=8.0, p99_ms=20.0),
    stages_ms={"window": 0.5, "publish": 3.0},
    slow_model=SlowModel(
        work_ms=1166.7,
        window_ms=583.3,
        windows=12,
        first_ms=1300.0,
        last_ms=1310.0,
        most_ms=1700.0,
        backlog_windows=0,
        dropped=14,
    ),
    stalled_reader=StalledReader(
        stall_s=60.0,
        before=Latency(count=100, p50_ms=8.0, p99_ms=20.0),
        during=Latency(count=205, p50_ms=8.1, p99_ms=21.0),
        memory_growth_mb=12.5,
        skipped=0,
    ),
    source_back=SourceBack(
        count=3,
        outage_s=1.0,
        after_first_ms=600.0,
        after_first_most_ms=610.0,
        after_plugged_ms=1100.0,
        after_plugged_most_ms=1200.0,
        window_ms=583.3,
    ),
    first_view=FirstView(count=3, median_s=6.0, most_s=6.5),
)


@pytest.mark.slow  # twelve seconds of a real model; test_faults.py waits for first views of real processes
@pytest.mark.timeout(900)
def test_a_first_view_comes_from_a_process_of_its_own() -> None:
    found = first_view(1)
    assert found.count == 1
    assert 0 < found.median_s == found.most_s


@pytest.mark.timeout(900)
def test_every_figure_comes_out_and_can_be_true(monkeypatch: pytest.MonkeyPatch) -> None:
    parts: list[str] = []
    monkeypatch.setattr(bench, "first_view", lambda starts: FirstView(count=starts, median_s=6.0, most_s=6.0))
    report = bench_node(SMALL, parts.append)
    assert len(parts) == 5
    assert (report.frames, report.height, report.width) == (14, 64, 96)
    assert report.latency.count == SMALL.windows
    assert 0 < report.latency.p50_ms <= report.latency.p99_ms < 60_000
    assert {"window", "encode", "render", "publish", "age"} <= report.stages_ms.keys()
    slow = report.slow_model
    assert slow.work_ms == pytest.approx(2 * slow.window_ms)
    assert slow.windows == SMALL.slow_windows
    assert min(slow.first_ms, slow.last_ms) >= slow.work_ms  # nothing is younger than its own rendering
    assert slow.most_ms >= max(slow.first_ms, slow.last_ms)
    assert slow.dropped > 0
    stalled = report.stalled_reader
    assert stalled.before.count == SMALL.windows
    assert stalled.during.count > 0
    assert 0 <= stalled.memory_growth_mb < 1000
    back = report.source_back
    assert back.count == 1
    assert back.after_first_ms >= 13 / 14 * back.window_ms  # the frames of a window come first
    assert back.after_plugged_ms >= back.after_first_ms
    assert report.first_view == FirstView(count=1, median_s=6.0, most_s=6.0)


def test_the_command_shows_every_figure_beside_what_is_wanted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[BenchOptions] = []

    def measured(options: BenchOptions, on_part: object) -> BenchReport:
        asked.append(options)
        return REPORT

    monkeypatch.setattr(cli_bench, "bench_node", measured)
    monkeypatch.setenv("COLUMNS", "160")
    assert run_app(["bench", "node", "--windows", "10", "--stall", "5"]) == 0
    out = capsys.readouterr().out
    assert asked == [replace(BenchOptions(), windows=10, stall_s=5.0)]
    for shown in (
        "14 x 256 x 384",
        "p50 8.0, p99 20.0 (100 windows)",
        "0, 14 dropped",
        "+12.5",
        "1583",
        "600, most 610",
        "6.0, most 6.5",
    ):
        assert shown in out


def test_the_command_prints_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = replace(REPORT, latency=Latency(count=0, p50_ms=math.nan, p99_ms=math.nan))

    def measured(options: BenchOptions, on_part: object) -> BenchReport:
        return nothing

    monkeypatch.setattr(cli_bench, "bench_node", measured)
    assert run_app(["bench", "node", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["latency"] == {"count": 0, "p50_ms": None, "p99_ms": None}
    assert told["slow_model"]["backlog_windows"] == 0
