"""`gcd-train data`: what is done with data sets that were downloaded."""

from pathlib import Path
from typing import Annotated

import typer

from gcd_model import printable
from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar, say, stop_as_by_ctrl_c
from gcd_train.errors import DataError

app = typer.Typer(no_args_is_help=True, help="Downloaded data sets: repacking.")

Source = Annotated[Path, typer.Argument(help="Folder with scn00000 or scene_000000 and so on; nothing in it changes.")]
Out = Annotated[Path, typer.Argument(help="Folder for the packed scenes; those that are there are kept.")]
Gaps = Annotated[bool, typer.Option("--gaps", help="Pack scenes that lack pictures, too; training passes these over.")]
Camera = Annotated[list[str] | None, typer.Option(help="A camera to pack; may be repeated. By default all published.")]
Limit = Annotated[int | None, typer.Option(min=1, help="Only the first so many scenes.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes.")]
Ray = Annotated[str | None, typer.Option("--ray", help="Run on this Ray cluster (auto, HOST:PORT; extra `cluster`).")]


@app.callback()
def about() -> None:
    """Keep `data` a command with sub-commands."""


@app.command()
def compact(
    source: Source,
    out: Out,
    gaps: Gaps = False,
    camera: Camera = None,
    limit: Limit = None,
    workers: Workers = 1,
    ray: Ray = None,
) -> None:
    """Repack Kubric-4D or ParallelDomain-4D: WebP, depth of 16 bit, ids as they are; a twentieth of the bytes to read.

    A scene appears when all of it was read again and compared. Stopped at any point, the same line goes on.
    """
    from gcd_train.files import remove_leftovers
    from gcd_train.layouts.compact import Compaction
    from gcd_train.parallel import map_items, one_thread_each

    stop_as_by_ctrl_c()
    with errors_shown():
        work = Compaction.of(source, out, cameras=tuple(camera or ()), gaps=gaps)
        scenes = work.scenes[:limit]
        remove_leftovers(work.out)
        one_thread_each()
        packed, there, damaged, read, written = 0, 0, 0, 0, 0
        with progress_bar("scenes", len(scenes), keep=True) as show:
            for number, outcome in enumerate(map_items(work, scenes, workers=workers, ray_address=ray), start=1):
                try:
                    done = outcome.unwrap()
                except DataError as fault:
                    damaged += 1
                    say(printable(f"{outcome.item}: {fault}"))
                else:
                    packed, there = packed + done.made, there + (not done.made)
                    read, written = read + done.read, written + done.written
                    if done.gaps:
                        say(f"{outcome.item}: packed without {done.gaps} views that are missing")
                show(number)
        sizes = f", {read / 1e6:.1f} MB in {written / 1e6:.1f} MB" if packed else ""
        say(f"scenes: {packed} packed{sizes}; {there} there already; {damaged} damaged")
    if damaged:
        raise typer.Exit(DataError.exit_code)
