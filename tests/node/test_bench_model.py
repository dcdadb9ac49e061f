"""`gcd-node bench model`, `stream` and `page`: what is asked for, shown, written and read again. How fast anything is,
no test says."""

import json
import mmap
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from wire_messages import view_header

from gcd_model import (
    STAGES,
    Difference,
    Implementation,
    MemoryFigures,
    ModelBench,
    ModelBenchOptions,
    StageFigures,
    StageName,
)
from gcd_node.cli import bench_model as cli_model
from gcd_node.cli import bench_stream as cli_stream
from gcd_node.cli.bench_model import chosen_implementations, chosen_stages
from gcd_node.cli.bench_page import written_page
from gcd_node.cli.main import run_app
from gcd_node.errors import NodeError, SourceError, UsageError
from gcd_node.load import model_bench, model_memory
from gcd_node.load.bench_record import BenchRecord, read_record, write_record
from gcd_node.load.figure_tables import figure
from gcd_node.load.machine import Machine, this_machine
from gcd_node.load.model_bench import ModelRun
from gcd_node.load.model_memory import MemoryTask
from gcd_node.load.performance_page import model_tables, performance_page, report_tables
from gcd_node.load.process_meter import PrivatePeak, cpu_s, memory
from gcd_node.load.stand_in import StandInModel
from gcd_node.load.stream_bench import SYNTHETIC, Arrival, StreamBenchOptions, Watched, stream_config, stream_report
from gcd_node.load.stream_report import StreamBench

ROOT = Path(__file__).parent.parent.parent
PERFORMANCE = ROOT / "docs" / "performance"


def stage(name: StageName, seconds: float, tflop: float = 2.0) -> StageFigures:
    return StageFigures(stage=name, runs=3, median_s=seconds, p95_s=1.2 * seconds, cpu_s=2 * seconds, tflop=tflop)


REPORT = ModelBench(
    model="random-kubric90",
    parameters=12.3,
    frames=14,
    height=128,
    width=192,
    steps=2,
    guidance=(1.0, 1.5),
    precision="float32",
    device="cpu",
    threads=2,
    implementations=(
        Implementation(
            name="ours",
            stages=(stage("step", 0.5), stage("decode", 0.25)),
            memory=MemoryFigures(resident_gb=1.5, private_gb=0.5),
        ),
        Implementation(
            name="diffusers",
            stages=(stage("step", 0.75), stage("decode", 0.5)),
            memory=MemoryFigures(resident_gb=2.0, private_gb=0.75),
        ),
    ),
    differences=(Difference(name="diffusers", latents=2.5e-6, pictures=None),),
)
MACHINE = Machine(cpu="Some CPU", cores=2, memory_gb=16.4, device=None, torch="2.13", python="3.11.9")
RECORD = BenchRecord(
    command="gcd-node bench model --weights random:kubric90 --peer diffusers",
    date="2026-11-22",
    machine=MACHINE,
    load_before=0.25,
    report=REPORT,
)


def arrival(window: int, age_ms: float, work_s: float) -> Arrival:
    """Windows 1.4 s apart."""
    header = view_header()
    header = replace(
        header,
        window_id=window,
        t_capture_ns=tuple(each + round(window * 1.4e9) for each in header.t_capture_ns),
        t_infer_end_ns=header.t_infer_start_ns + round(work_s * 1e9),
    )
    return Arrival(at_s=1.4 * window, age_ms=age_ms, header=header)


WATCHED = Watched(
    first_view_s=6.5,
    arrivals=(arrival(1, 900.0, 0.7), arrival(2, 800.0, 0.6), arrival(4, 1000.0, 0.8)),
    lasted_s=6.0,
    used_cpu_s=9.0,
    resident_bytes=400 * 2**20,
    private_bytes=300 * 2**20,
)


# --- the command ---------------------------------------------------------------------------------------------------


def test_the_model_bench_shows_ratios_memory_and_differences_and_records_how_it_was_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    asked: list[ModelRun] = []

    def measured(run: ModelRun, on_part: Callable[[str], None]) -> ModelBench:
        asked.append(run)
        return REPORT

    monkeypatch.setattr(cli_model, "run_model_bench", measured)
    out = tmp_path / "kubric.json"
    said = ["bench", "model", "--weights", "random:kubric90", "--peer", "diffusers", "--compiled", "--memory"]
    said += ["--stages", "decode,step", "--guidance", "1", "1.5", "--engine", "cuda", "--engine", "torch"]
    assert run_app([*said, "--json", str(out)]) == 0
    (run,) = asked
    assert run.options.implementations == ("ours on cuda", "ours", "diffusers", "diffusers compiled")
    assert run.options.stages == ("step", "decode")
    assert (run.options.guidance, run.memory, run.device) == ((1.0, 1.5), True, "auto")
    shown = capsys.readouterr().out
    for each in ("14 x 128 x 192, 2 steps, guidance 1 to 1.5", "1.50", "2.00", "2.5e-06", "0.750", "4.0"):
        assert each in shown
    record = read_record(out)
    assert record.report == REPORT
    assert record.machine == this_machine()
    assert record.command == (
        "gcd-node bench model --weights random:kubric90 --peer diffusers --compiled --engine cuda --engine torch "
        "--guidance 1.0 1.5 --stages decode,step --memory"
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--stages", "step,steps"], "--stages takes some of tower"),
        (["--stages", ","], "--stages takes some of tower"),
        (["--engine", "tpu"], "--engine takes one of torch, cuda, "),
        (["--compiled"], "--compiled is about a peer"),
        (["--repeats", "0"], "Invalid value for '--repeats'"),
    ],
)
def test_a_mistaken_request_is_one_line(options: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["bench", "model", "--weights", "random:kubric90", *options]) == 64
    assert said in capsys.readouterr().err


def test_stages_come_in_the_order_of_a_window_and_ours_before_the_peer() -> None:
    assert chosen_stages("window, tower") == ("tower", "window")
    assert chosen_stages(",".join(reversed(STAGES))) == STAGES
    assert chosen_implementations(["torch"], None, compiled=False) == ("ours",)
    assert chosen_implementations(["torch", "cuda"], "diffusers", compiled=False) == (
        "ours",
        "ours on cuda",
        "diffusers",
    )
    with pytest.raises(UsageError):
        chosen_implementations([], None, compiled=True)


def test_memory_is_measured_in_a_process_for_each_and_put_beside_the_times(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tasks: list[MemoryTask] = []

    def measured(task: MemoryTask) -> MemoryFigures:
        tasks.append(task)
        assert Path(task.weights).is_file()  # written once, to be mapped by all
        return MemoryFigures(resident_gb=float(len(tasks)), private_gb=0.5)

    monkeypatch.setattr(model_bench, "measured_memory", measured)
    monkeypatch.setattr(model_bench, "load_measured", lambda *_, **__: None)
    monkeypatch.setattr(model_bench, "save_random", lambda _, out, __: out.write_bytes(b""))
    monkeypatch.setattr(model_bench, "bench_model", lambda *_: replace_memory(REPORT))
    options = ModelBenchOptions(implementations=("ours", "diffusers"), stages=("step",))
    run = ModelRun(weights="random:full", options=options, memory=True)
    report = model_bench.run_model_bench(run, lambda _: None)
    assert [each.memory.resident_gb for each in report.implementations if each.memory is not None] == [1.0, 2.0]
    assert [task.implementation for task in tasks] == ["ours", "diffusers"]
    assert all(task.without_camera and task.stages == ("step",) for task in tasks)
    assert not Path(tasks[0].weights).exists()


def replace_memory(report: ModelBench) -> ModelBench:
    bare = tuple(msgspec.structs.replace(each, memory=None) for each in report.implementations)
    return msgspec.structs.replace(report, implementations=bare)


TASK = MemoryTask(
    weights="random:kubric90",
    implementation="diffusers",
    stages=("tower",),
    device="cpu",
    dtype=None,
    height=64,
    width=64,
    steps=1,
    guidance=(1.0, 1.0),
    threads=None,
    without_camera=True,
)


def test_the_memory_of_one_window_is_that_of_the_process_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[ModelBenchOptions] = []

    def window(synthesizer: StandInModel, options: ModelBenchOptions) -> None:
        asked.append(options)
        taken = os.urandom(64 * 2**20)
        time.sleep(0.1)
        assert len(taken) == 64 * 2**20

    monkeypatch.setattr(model_memory, "load_measured", lambda *_, **__: StandInModel())
    monkeypatch.setattr(model_memory, "bench_model", window)
    before = memory(os.getpid()).private
    found = model_memory.own_memory(TASK)
    assert 1e9 * found.private_gb > before + 32 * 2**20
    assert found.private_gb < found.resident_gb
    assert found.device_gb is None
    (options,) = asked
    assert (options.implementations, options.warm + options.repeats, options.count) == (("diffusers",), 1, False)
    assert msgspec.json.decode(msgspec.json.encode(TASK), type=MemoryTask) == TASK


@pytest.mark.slow  # loads torch and diffusers in processes of their own
@pytest.mark.timeout(900)
def test_a_process_of_its_own_tells_its_memory_or_why_it_could_not() -> None:
    found = model_memory.measured_memory(TASK)
    assert 0 < found.private_gb < found.resident_gb
    with pytest.raises(NodeError, match="measures the memory of diffusers ended with 1"):
        model_memory.measured_memory(msgspec.structs.replace(TASK, weights="package:none"))


# --- what a process uses -------------------------------------------------------------------------------------------


def test_a_process_is_seen_to_take_memory_and_time_and_one_that_is_gone_is_said_to_be() -> None:
    pid, before = os.getpid(), memory(os.getpid())
    with PrivatePeak(pid) as peak:
        taken = mmap.mmap(-1, 32 * 2**20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # a heap may have it at hand
        taken.write(os.urandom(len(taken)))
        after = memory(pid)
        time.sleep(0.05)
    taken.close()
    assert after.private - before.private > 16 * 2**20
    assert peak.bytes >= after.private
    assert after.peak_resident >= after.private
    assert 0 < cpu_s(pid) <= time.process_time() + 1
    with pytest.raises(ProcessLookupError, match="no process"):
        cpu_s(2**22 + 1)


# --- a stream ------------------------------------------------------------------------------------------------------


def test_a_stream_is_told_by_its_views() -> None:
    report = stream_report(StreamBenchOptions(), WATCHED)
    assert (report.windows, report.missed) == (3, 1)
    assert report.new_s == pytest.approx(1.4)
    assert report.work_p95_s == pytest.approx(0.8)
    assert report.real_time_factor == pytest.approx(1.4 / 0.8)
    assert (report.ages.p50_ms, report.ages.most_ms) == (900.0, 1000.0)
    assert report.cores == pytest.approx(1.5)
    assert (report.resident_mb, report.private_mb) == (400.0, 300.0)
    assert msgspec.json.decode(msgspec.json.encode(report), type=StreamBench) == report


def test_a_stream_of_one_view_tells_nothing() -> None:
    few = replace(WATCHED, arrivals=WATCHED.arrivals[:1])
    with pytest.raises(NodeError, match=r"1 views came in 6 s .* give more --seconds"):
        stream_report(StreamBenchOptions(), few)


def test_a_stream_plays_a_file_in_a_loop_or_draws_a_street(tmp_path: Path) -> None:
    played = stream_config(StreamBenchOptions(fps=12.5, stride=7, threads=1, steps=2), tmp_path)
    assert (played.source.kind, played.source.fps, played.source.loop) == ("file", 12.5, True)
    assert (played.window.stride, played.model.threads, played.model.steps) == (7, 1, 2)
    drawn = stream_config(StreamBenchOptions(source=SYNTHETIC), tmp_path)
    assert (drawn.source.kind, drawn.source.path, drawn.source.fps) == ("synthetic", None, 10.0)


def test_the_stream_bench_asks_for_what_was_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[StreamBenchOptions] = []

    def measured(options: StreamBenchOptions, on_part: Callable[[str], None]) -> StreamBench:
        asked.append(options)
        return stream_report(options, WATCHED)

    monkeypatch.setattr(cli_stream, "bench_stream", measured)
    assert run_app(["bench", "stream", "--seconds", "30", "--stride", "7"]) == 0
    assert asked == [StreamBenchOptions(seconds=30.0, stride=7)]
    shown = capsys.readouterr().out
    assert "1.75" in shown
    assert "3, 1" in shown


@pytest.mark.slow  # half a minute of a real node
@pytest.mark.timeout(900)
def test_a_real_node_is_watched(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "stream.json"
    assert run_app(["bench", "stream", "--seconds", "20", "--threads", "1", "--json", str(out)]) == 0
    report = read_record(out).report
    assert isinstance(report, StreamBench)
    assert report.windows >= 2
    assert report.first_view_s > 0
    assert 0 < report.private_mb < report.resident_mb
    assert report.cores > 0


# --- files and the page --------------------------------------------------------------------------------------------


def test_a_record_survives_its_file_and_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    write_record(path, RECORD)
    assert read_record(path) == RECORD
    with pytest.raises(SourceError, match="cannot read"):
        read_record(tmp_path / "none.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"lode": 1}))
    with pytest.raises(SourceError, match="no record of gcd-node bench: Object contains unknown field `lode`"):
        read_record(path)


def test_the_page_has_a_section_per_file_with_its_command_and_machine_and_the_notes_last() -> None:
    text = performance_page({"small-cpu.json": RECORD}, "## Predictions\n\nNone.\n")
    for each in (
        "## small cpu",
        "```sh\ngcd-node bench model --weights random:kubric90 --peer diffusers\n```",
        "2026-11-22, Some CPU, 2 cores, 16 GB, no GPU, torch 2.13, Python 3.11.9; load before: 0.2.",
        "| step | diffusers | 3 | 0.750 | 0.900 | 1.50 | 2.00 | 2.7 | 1.50 | 1.50 |",
        "| diffusers | 2.00 | 0.750 |  |",
        "| diffusers | 2.5e-06 |  |",
    ):
        assert each in text
    assert text.endswith("## Predictions\n\nNone.\n")
    assert "Predictions" not in performance_page({"small-cpu.json": RECORD})


def test_tables_are_as_wide_as_their_heads() -> None:
    for report in (REPORT, stream_report(StreamBenchOptions(), WATCHED)):
        for table in report_tables(report):
            assert {len(row) for row in table.rows} == {len(table.columns)}
    assert len(model_tables(replace_memory(REPORT))) == len(model_tables(REPORT)) - 1


@pytest.mark.parametrize(
    ("value", "shown"),
    [(None, ""), (0.0, "0.000"), (1.2345, "1.23"), (123.45, "123"), (0.0012345, "0.00123"), (2.5e-6, "2.50e-06")],
)
def test_figures_have_three_digits(value: float | None, shown: str) -> None:
    assert figure(value) == shown


def test_the_committed_page_is_what_the_command_writes(tmp_path: Path) -> None:
    records = sorted(PERFORMANCE.glob("*.json"))
    assert records
    out = tmp_path / "performance.md"
    assert run_app(["bench", "page", *map(str, records), "--out", str(out)]) == 0
    assert out.read_text() == (ROOT / "docs" / "performance.md").read_text()
    assert written_page(list(reversed(records))) == out.read_text()


def test_a_plot_is_a_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra `train`")
    from gcd_node.load.plots import write_plot

    for name, report in (("model", REPORT), ("stream", stream_report(StreamBenchOptions(), WATCHED))):
        path = tmp_path / f"{name}.png"
        write_plot(path, report)
        assert path.read_bytes().startswith(b"\x89PNG")
