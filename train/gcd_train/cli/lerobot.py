"""`gcd-train export lerobot` and `gcd-train lerobot`: robots' episodes, written and looked at."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar
from gcd_train.lerobot.pairs import LeRobotOptions, LeRobotPairs
from gcd_train.lerobot.tabletop_export import TabletopExport, export_tabletop

app = typer.Typer(no_args_is_help=True, help="Write data in other programs' formats.")


@app.callback()
def about() -> None:
    """Keep `export` a command with sub-commands, one for each format."""


@app.command()
def lerobot(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the data set, new or empty.")],
    episodes: Annotated[int, typer.Option(min=1, help="How many episodes, one seed each.")] = 10,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    frames: Annotated[int, typer.Option(min=2, help="Time steps of an episode, at 24 Hz.")] = 120,
    width: Annotated[int, typer.Option(min=32, help="Of the pictures, pixels, even.")] = 320,
    height: Annotated[int, typer.Option(min=32, help="Of the pictures, pixels, even.")] = 240,
    cameras: Annotated[
        str, typer.Option(help="Two or more of view0 to view15 and wrist, with commas.")
    ] = "view0,view4,view9,wrist",
    oversample: Annotated[int, typer.Option(min=1, max=4, help="Anti-aliasing: pixels drawn per pixel and side.")] = 2,
) -> None:
    """Tabletop episodes as a LeRobot data set (v3.0) with calibrated cameras (extras `scenes` and `lerobot`)."""
    if width % 2 or height % 2:
        raise typer.BadParameter(f"H.264 wants an even width and height, got {width} x {height}")
    export = TabletopExport(
        seeds=range(first_seed, first_seed + episodes),
        frames=frames,
        cameras=tuple(name.strip() for name in cameras.split(",")),
        width=width,
        height=height,
        oversample=oversample,
    )
    with errors_shown(), progress_bar("episodes", episodes, keep=True) as show:
        for done in export_tabletop(out, export):
            show(done)
    told = f"wrote {out}; look at it with `gcd-train lerobot {out}`"
    Console(stderr=True, highlight=False).print(told, markup=False, soft_wrap=True)


def lerobot_command(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A LeRobot data set, v3.0 or v2.1.")],
    calibration: Annotated[
        Path | None, typer.Option(help="JSON file with the cameras, if the set has no meta/cameras.json.")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="How many pairs to read.")] = 8,
    frames: Annotated[int, typer.Option(min=2, help="Frames of a pair.")] = 14,
    fps: Annotated[float | None, typer.Option(help="Rate of a pair; the set's own if left out.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Draws the cameras and windows.")] = 0,
) -> None:
    """Read pairs of cameras of a LeRobot data set as training would, and say what was left out."""
    say = Console(highlight=False, soft_wrap=True).print
    with errors_shown():
        pairs = LeRobotPairs(folder, seed, LeRobotOptions(frames=frames, fps=fps, calibration=calibration))
        rate = pairs.folder.info.fps
        say(f"{len(pairs.folder.episodes)} episodes at {rate:g} frames per second, cameras {', '.join(pairs.cameras)}")
        for index in range(samples):
            sample = pairs.sample(index)
            apart = float(np.linalg.norm(sample.source_from_target[:, :3, 3], axis=-1).mean())
            first, last = sample.frame_numbers[0], sample.frame_numbers[-1]
            say(f"  {sample.scene} rows {first}..{last}: cameras {apart:.3f} m apart, {sample.bytes_read / 1e3:.0f} kB")
        for line in pairs.skips.lines():
            say(line)
