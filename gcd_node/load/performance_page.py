"""The page of measurements: a section per JSON file, and what people have written beside them."""

from collections.abc import Mapping, Sequence

from gcd_model import Implementation, ModelBench, StageFigures
from gcd_node.load.bench_record import BenchRecord
from gcd_node.load.figure_tables import FigureTable, figure
from gcd_node.load.stream_report import StreamBench

_HEAD = """# Performance

What the model and the node take, measured. Every table names its command and its machine; under another load or torch
figures differ. To measure here:

```sh
gcd-node bench model --weights package:driving-small                              # stages of a model
gcd-node bench model --weights random:kubric90 --peer diffusers --memory          # beside diffusers' modules
gcd-node bench model --weights random:full --stages step --steps 1 --repeats 1 --warm 0 --peer diffusers   # full size
gcd-node bench stream --seconds 60                                                # the whole node on a stream
gcd-node bench node                                                               # everything but the model
```

`--json FILE` keeps the figures, `--plot FILE.png` draws them. This page is written from such files:

```sh
gcd-node bench page docs/performance/*.json --out docs/performance.md
```

*Median* and *p95* are seconds by the clock, *CPU* is the time of all cores together, *TFLOP* is counted from shapes,
multiplications and additions apart. *Times ours* is how many times as long something takes as the first row of its
stage, by the clock and in CPU time; on a machine with other work only CPU time compares. A *step* is one network
evaluation with its guidance. The first of a window also prepares what is constant over it, and counts only where it is
the only one. Beside a peer the clip is a still picture and camera control is left out, because diffusers has one image
token a clip and no camera; both sides compute on the same tensors.
"""


def performance_page(records: Mapping[str, BenchRecord], notes: str = "") -> str:
    """The page as Markdown. records: by the name of their file, in this order. notes: sections of their own."""
    sections = [_section(name, record) for name, record in records.items()]
    return "\n".join([_HEAD, *sections, *([notes.strip() + "\n"] if notes.strip() else [])])


def report_tables(report: ModelBench | StreamBench) -> tuple[FigureTable, ...]:
    """The figures of a report."""
    return model_tables(report) if isinstance(report, ModelBench) else (stream_table(report),)


def _section(name: str, record: BenchRecord) -> str:
    tables = "\n\n".join(table.markdown() for table in report_tables(record.report))
    return (
        f"## {name.removesuffix('.json').replace('-', ' ').replace('_', ' ')}\n\n"
        f"```sh\n{record.command}\n```\n\n"
        f"{record.date}, {record.machine.words}; load before: {record.load_before:.1f}.\n\n{tables}\n"
    )


def model_tables(report: ModelBench) -> tuple[FigureTable, ...]:
    """Stages, and where they were measured memory and differences."""
    tables = [_stage_table(report)]
    if any(each.memory is not None for each in report.implementations):
        tables.append(_memory_table(report.implementations))
    if report.differences:
        tables.append(
            FigureTable(
                title="Largest difference of a window from the first row's, of its largest value",
                columns=("", "latents", "pictures"),
                rows=tuple(
                    (each.name, figure(each.latents, 2), figure(each.pictures, 2)) for each in report.differences
                ),
            )
        )
    return tuple(tables)


def _stage_table(report: ModelBench) -> FigureTable:
    steps = f"{report.steps} step{'' if report.steps == 1 else 's'}"
    guided = "no guidance" if report.guidance == (1.0, 1.0) else "guidance {:g} to {:g}".format(*report.guidance)
    threads = f", {report.threads} thread{'' if report.threads == 1 else 's'}" if report.device == "cpu" else ""
    title = (
        f"{report.model}, {report.parameters:.1f} M parameters: {report.frames} x {report.height} x {report.width}, "
        f"{steps}, {guided}, {report.precision} on {report.device}{threads}"
    )
    columns = ("stage", "", "runs", "median s", "p95 s", "CPU s", "TFLOP", "TFLOP/s", "times ours", "in CPU time")
    return FigureTable(title=title, columns=columns, rows=tuple(_stage_rows(report.implementations)), names=2)


def _stage_rows(implementations: Sequence[Implementation]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for first in implementations[0].stages:
        for implementation in implementations:
            rows += [
                _stage_row(implementation.name, each, first)
                for each in implementation.stages
                if each.stage == first.stage
            ]
    return rows


def _stage_row(name: str, each: StageFigures, first: StageFigures) -> tuple[str, ...]:
    same = each is first
    return (
        each.stage,
        name,
        str(each.runs),
        figure(each.median_s),
        figure(each.p95_s),
        figure(each.cpu_s),
        figure(each.tflop),
        figure(each.tflop / each.median_s if each.median_s else None, 2),
        "" if same else figure(each.median_s / first.median_s if first.median_s else None),
        "" if same else figure(each.cpu_s / first.cpu_s if first.cpu_s else None),
    )


def _memory_table(implementations: Sequence[Implementation]) -> FigureTable:
    measured = [(each.name, each.memory) for each in implementations if each.memory is not None]
    return FigureTable(
        title="Most memory of a fresh process that does one such window, GB; mapped weight files count as resident",
        columns=("", "resident", "private", "on the GPU"),
        rows=tuple(
            (name, figure(memory.resident_gb), figure(memory.private_gb), figure(memory.device_gb))
            for name, memory in measured
        ),
    )


def stream_table(report: StreamBench) -> FigureTable:
    """A stream in one column."""
    ages, steps = report.ages, f"{report.steps} step{'' if report.steps == 1 else 's'}"
    title = (
        f"{report.model} on {report.source} at {report.fps:g} FPS for {report.seconds:g} s: windows of {report.frames} "
        f"frames, each {report.new_s:.2f} s further, {steps}, {report.precision} on {report.device}"
    )
    rows = (
        ("age of the newest frame when its view arrives, p50, ms", figure(ages.p50_ms)),
        ("the same, p95, ms", figure(ages.p95_ms)),
        ("the same, p99, ms", figure(ages.p99_ms)),
        ("the same, most, ms", figure(ages.most_ms)),
        ("a window in the model, p50, s", figure(report.work_p50_s)),
        ("the same, p95, s", figure(report.work_p95_s)),
        ("real-time factor (1 or more keeps up)", figure(report.real_time_factor)),
        ("windows that came, that were missed", f"{report.windows}, {report.missed}"),
        ("process start to first view, s", figure(report.first_view_s)),
        ("cores the process used", figure(report.cores)),
        ("most memory, resident, MiB", figure(report.resident_mb)),
        ("most memory, private, MiB", figure(report.private_mb)),
    )
    return FigureTable(title=title, columns=("", "measured"), rows=rows)
