"""`gcd-node soak`: a node under load for hours, and what it holds at the end."""

import logging
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeAlias

import msgspec
import typer
from rich.console import Console
from rich.table import Table
from typer import Option

from gcd_node.errors import OutputError
from gcd_node.load.soak import Sample, SoakOptions, run_soak
from gcd_node.load.soak_report import Growth, SoakLimits, SoakReport, findings

Hours: TypeAlias = Annotated[float, Option(min=0.001, help="How long; 0.01 is 36 s.")]
ReportPath: TypeAlias = Annotated[Path | None, Option("--report", help="A JSON file for the figures.")]
AsJson: TypeAlias = Annotated[bool, Option("--json", help="Print the figures as one line of JSON.")]
Seed: TypeAlias = Annotated[int, Option(min=0, help="Of camera, commands and attacks.")]


def soak(hours: Hours = 1.0, report: ReportPath = None, as_json: AsJson = False, seed: Seed = 0) -> None:
    """Run a node under load and see whether anything grows: memory, threads, files, ages.

    The camera drops, stalls, reverses, changes size, dies and comes back; readers are slow or stall, a client attacks
    every socket, an operator changes views and restarts the stream. The model is a stand-in. Needs neither camera nor
    weights. Ends with 1, and what leaked, if a limit is broken. Ctrl-C ends it early.
    """
    _check_writable(report)
    console = Console(stderr=True)
    with console.status("starting") as status, quiet_node():

        def tell(sample: Sample) -> None:
            left = time.strftime("%H:%M:%S", time.gmtime(sample.left_s))
            status.update(
                f"{left} to go, {sample.arrived} views, {sample.memory_mb:.0f} MiB, {sample.threads} threads, "
                f"{sample.files} files"
            )

        result = run_soak(SoakOptions(hours=hours, seed=seed), tell)
    found = findings(result, SoakLimits())
    line = _record(result, found)
    _write(report, line)
    if as_json:
        typer.echo(line.decode())
    else:
        Console().print(soak_table(result))
    for each in found:
        console.print(f"[red]{each}[/]", highlight=False, soft_wrap=True)
    if found:
        raise typer.Exit(1)


def soak_table(report: SoakReport) -> Table:
    """The figures for people."""
    table = Table(show_header=False, title=f"{report.seconds / 60:.1f} minutes", title_style="dim")
    replies, ages = report.reply_ms, report.age_ms
    rows = (
        ("memory, MiB", _grown(report.memory_mb)),
        ("threads", _grown(report.threads)),
        ("open files", _grown(report.files)),
        ("subscriptions", _grown(report.subscriptions)),
        ("age at a healthy reader, ms", f"p50 {ages.p50:.1f}, p99 {ages.p99:.1f}, most {ages.most:.1f}"),
        ("median age, ms", _grown(report.median_age_ms)),
        ("backlog, windows", str(report.backlog_windows)),
        ("windows rendered", str(report.windows)),
        ("views arrived, missed", f"{report.arrived}, {report.skipped}"),
        ("longest without a view, s", f"{report.silent_s:.1f}"),
        ("camera opened, acts", f"{report.openings}, {sum(report.acts.values())}"),
        ("restarts by command", str(report.restarts)),
        ("replies, ms", f"{replies.count}: p50 {replies.p50:.1f}, p99 {replies.p99:.1f}, most {replies.most:.1f}"),
        ("attacks, cut short", f"{sum(report.attacks.values())}, {report.refused}"),
        ("left after the end", ", ".join(report.left) or "nothing"),
    )
    for row in rows:
        table.add_row(*row)
    return table


def _grown(each: Growth) -> str:
    return f"{each.first:.1f} to {each.last:.1f} ({each.growth:+.1f}), peak {each.peak:.1f}"


def _record(report: SoakReport, found: tuple[str, ...]) -> bytes:
    """The report with its findings; what is no number becomes null."""
    return msgspec.json.encode({**msgspec.to_builtins(report), "findings": found})


@contextmanager
def quiet_node() -> Generator[None]:
    """Without what the node says of every attack and every loss, which are what was asked for; -v shows it."""
    logger = logging.getLogger("gcd_node")
    was = logger.level
    if logging.getLogger().level > logging.INFO:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(was)


def _check_writable(path: Path | None) -> None:
    """To know before hours have passed, not after. Raises OutputError."""
    _write(path, b"{}")


def _write(path: Path | None, line: bytes) -> None:
    if path is None:
        return
    try:
        path.write_bytes(line + b"\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; name another file") from error
