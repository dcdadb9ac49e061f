"""`gcd-train bench data`: what data costs."""

import msgspec
import pytest
from headless import needs_egl
from rich.console import Console
from typer.testing import CliRunner

from gcd_train.bench_data import DataReport, Figure, extrapolated
from gcd_train.cli.bench import bench_table
from gcd_train.cli.main import app


def figure(**changes: object) -> Figure:
    plain = Figure(name="making", unit="CPU s", median=81.25, lowest=80.0, highest=90.0, count=3, wanted=90.0)
    return msgspec.structs.replace(plain, **changes)


def test_a_whole_scene_is_told_from_two_parts_of_it() -> None:
    assert extrapolated(2, 10.0 + 2 * 1.5, 6, 10.0 + 6 * 1.5, 60) == pytest.approx(10.0 + 60 * 1.5)


def test_every_figure_is_shown_with_unit_count_limit_and_how_it_was_come_by() -> None:
    told = figure(note="extrapolated from 2 and 6 of 60 frames", published="595 MB")
    report = DataReport(
        cores=2, machine_load=0.5, quick=True, shrink=1, figures=(told, figure(unit="MB", count=1, wanted=None))
    )
    console = Console(record=True, width=200)
    console.print(bench_table(report))
    first, second = [line for line in console.export_text().splitlines() if "making" in line]
    for part in ("CPU s", "81.2 (80-90)", " 3 ", "<= 90", "595 MB", "extrapolated from 2 and 6 of 60 frames"):
        assert part in first
    assert "MB" in second
    assert "<=" not in second
    assert "(80-90)" not in second


def test_a_report_survives_as_json() -> None:
    report = DataReport(cores=2, machine_load=0.5, quick=False, shrink=1, figures=(figure(),))
    assert msgspec.json.decode(msgspec.json.encode(report), type=DataReport) == report


@needs_egl
@pytest.mark.slow
def test_a_quick_run_on_small_pictures_measures_everything() -> None:
    pytest.importorskip("mujoco", reason="the drop world needs the extra `scenes`")
    run = CliRunner().invoke(app, ["bench", "data", "--quick", "--shrink", "16", "--json"])
    assert run.exit_code == 0, run.output
    report = msgspec.json.decode(run.stdout, type=DataReport)
    assert report.quick
    assert report.shrink == 16
    assert all(each.wanted is None and not each.published for each in report.figures)
    assert {each.unit for each in report.figures} == {"CPU s", "MB"}
    assert all(each.median > 0 and each.lowest <= each.median <= each.highest for each in report.figures)
    for kind in ("drop", "driving"):
        for part in ("whole scene", "reading a time step", "drawing a 384x256 target", "read for a training sample"):
            assert any(each.name.startswith(kind) and part in each.name for each in report.figures)
    assert all("extrapolated" in each.note for each in report.figures if "whole scene" in each.name)
