"""`gcd-node replay` and `diff`: a recording through the model into a run on disk, and two such runs compared."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer
from rich.console import Console
from rich.text import Text
from typer import Argument, Option

from gcd_node.cli.main import table
from gcd_node.cli.run import Changes, ConfigPath, in_words
from gcd_node.config import load_config
from gcd_node.inference import WindowReport
from gcd_node.replay.compare import REPORT, Tolerance, compare, report_text, to_plain, write_report
from gcd_node.replay.lockstep import replay
from gcd_node.replay.run import open_run

RunOut = Annotated[Path, Option("--out", metavar="RUN", help="Folder for the run; new, or empty.")]
RunA = Annotated[Path, Argument(metavar="RUN_A", help="A run of `gcd-node replay`, such as the golden one.")]
RunB = Annotated[Path, Argument(metavar="RUN_B", help="The run to compare with it.")]
MinPsnr = Annotated[
    float | None,
    Option(metavar="DB", help="What each frame of each view must reach; else all pixels must be identical."),
]
MaxClassShare = Annotated[
    float, Option(metavar="SHARE", help="Of a view's class pixels in a window, how many may differ, 0 to 1.")
]
DiffOut = Annotated[
    Path | None, Option("--out", metavar="DIR", help="Folder for diff.json and pictures of the worst windows.")
]
AsJson = Annotated[bool, Option("--json", help="Print the whole comparison as one line of JSON.")]


def replay_launch(config: ConfigPath, out: RunOut, changes: Changes = None) -> None:
    """Replay a launch file's recording in lockstep, as fast as the model goes, into a run that can be compared.

    RUN gets manifest.json (what it was made from, and a SHA-256 of every view of every window) and the pixels without
    loss. It appears when it is complete. Opens no socket; the same machine gives the same hashes every time.
    """
    settings = load_config(config, changes or ())
    console = Console(stderr=True, markup=False)
    with console.status(Text(f"loading {settings.model.weights}")) as status:

        def tell(report: WindowReport) -> None:
            status.update(f"window {report.window.window_id}: {report.render_s * 1000:.0f} ms")

        run = replay(settings, out, tell)
    totals, made_from = run.manifest.totals, run.manifest.made_from
    machine = ", ".join(made_from[f"machine {name}"] for name in ("device", "processor", "threads"))
    rows = (
        ("weights", f"{made_from['weights name']} {made_from['weights sha256_12']}"),
        ("frames read", totals.frames),
        ("windows rendered", totals.windows),
        ("windows rejected", in_words(totals.rejected)),
        ("windows with NaN", totals.nan_windows),
        ("views", ", ".join(run.manifest.views)),
        ("on", f"{machine} threads"),
    )
    Console(markup=False).print(table(rows))
    Console(markup=False).print(f"wrote {run.path}", soft_wrap=True, highlight=False)


def diff(
    run_a: RunA,
    run_b: RunB,
    min_psnr: MinPsnr = None,
    max_class_share: MaxClassShare = 0.0,
    out: DiffOut = None,
    as_json: AsJson = False,
) -> None:
    """Compare two runs window by window: identical, or how far apart, where first, and what they were made from.

    Ends with 0 if they are identical or near enough, with 1 if not, with 65 or 66 if one is damaged or missing.
    """
    tolerance = Tolerance(min_psnr_db=min_psnr, max_class_share=max_class_share)
    runs = open_run(run_a), open_run(run_b)
    with Console(stderr=True, markup=False).status("comparing"):
        comparison = compare(*runs)
        written = () if out is None else (out / REPORT, *write_report(out, comparison, tolerance))
    if as_json:
        typer.echo(msgspec.json.encode(to_plain(comparison, tolerance)).decode())
    else:
        for line in (report_text(comparison, tolerance), *(f"wrote {path}" for path in written)):
            typer.echo(line)
    if comparison.failures(tolerance):
        raise typer.Exit(1)
