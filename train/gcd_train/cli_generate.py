"""`gcd-train generate`: make data."""

import os
import signal
from pathlib import Path
from typing import Annotated

import typer

from gcd_model.geometry import CameraMount
from gcd_train.cli_errors import errors_shown
from gcd_train.progress_bar import progress_bar
from gcd_train.scenes.contact_sheet import write_contact_sheet
from gcd_train.scenes.driving import FPS, HFOV_DEG
from gcd_train.scenes.film import write_film
from gcd_train.scenes.worlds import WorldOptions
from gcd_train.scenes.writer import World, generate

app = typer.Typer(no_args_is_help=True, help="Make training data with a procedural world (extra `scenes`).")


@app.callback()
def about() -> None:
    """Keep `generate` a command with sub-commands, one for each world."""


@app.command()
def driving(
    out: Annotated[Path, typer.Option(help="Folder for the shards; an unfinished one is continued.")],
    clips: Annotated[int, typer.Option(min=1, help="How many clips, one scene each.")] = 100,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first clip; held-out sets start at 1000000.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; by default one a core.")] = None,
    width: Annotated[int, typer.Option(min=16, help="Pixels.")] = 192,
    height: Annotated[int, typer.Option(min=16, help="Pixels.")] = 128,
    frames: Annotated[int, typer.Option(min=2, help="Time steps a clip, at 10 Hz.")] = 14,
    oversample: Annotated[int, typer.Option(min=1, max=4, help="Anti-aliasing: pixels drawn per pixel and side.")] = 2,
    clips_per_shard: Annotated[int, typer.Option(min=1, help="Clips a file.")] = 8,
    mount_height: Annotated[float, typer.Option(help="True height of the source camera, metres.")] = 1.55,
    mount_tilt: Annotated[float, typer.Option(help="True tilt of the source camera, degrees down.")] = 0.0,
    contact_sheet: Annotated[Path | None, typer.Option(help="Also draw the first clips into this PNG.")] = None,
) -> None:
    """Road scenes: a forward camera, and the path to the view from above (ParallelDomain-4D's set-up)."""
    with errors_shown():
        CameraMount(height_m=mount_height, tilt_deg=mount_tilt)  # refuses what is no mount before anything is made
    world = World(
        name="driving",
        width=width,
        height=height,
        frames=frames,
        fps=FPS,
        hfov_deg=HFOV_DEG,
        oversample=oversample,
        clips_per_shard=clips_per_shard,
        options=WorldOptions(height_m=mount_height, tilt_deg=mount_tilt),
    )
    with errors_shown():
        _generate(out, world, range(first_seed, first_seed + clips), workers or os.cpu_count() or 1)
        if contact_sheet is not None:
            write_contact_sheet(out, contact_sheet)


@app.command()
def film(
    out: Annotated[Path, typer.Option(help="An .mp4 file.")],
    seed: Annotated[int, typer.Option(min=0, help="Scene; those from 2000000 on are in no data set.")] = 2_000_021,
    frames: Annotated[int, typer.Option(min=2, help="Time steps at 10 Hz.")] = 42,
    width: Annotated[int, typer.Option(min=16, help="Pixels.")] = 432,
    height: Annotated[int, typer.Option(min=16, help="Pixels.")] = 288,
) -> None:
    """One longer drive as a video, seen from the forward camera; the packaged drive was made so."""
    with errors_shown():
        write_film(out, seed, frames=frames, width=width, height=height)


def _generate(out: Path, world: World, seeds: range, workers: int) -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, so that no worker is left behind
    with progress_bar("clips", len(seeds), keep=True) as show:
        for progress in generate(out, world, seeds, workers):
            show(progress.done)
