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
    out: Annotated[Path, typer.Argument(help="Folder of the data set; it must not be there yet.")],
    episodes: Annotated[int, typer.Option(min=1, help="How many, one seed each.")] = 10,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    frames: Annotated[int, typer.Option(min=2, help="Time steps an episode, at 24 Hz.")] = 120,
    width: Annotated[int, typer.Option(min=32, help="Pixels, even.")] = 320,
    height: Annotated[int, typer.Option(min=32, help="Pixels, even.")] = 240,
    cameras: Annotated[
        str, typer.Option(help="Of view0 .. view15 and wrist, with commas.")
    ] = "view0,view4,view9,wrist",
    arm: Annotated[str, typer.Option(help="primitive, or panda (needs the package gymnasium-robotics).")] = "primitive",
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
        arm=arm,
        oversample=oversample,
    )
    with errors_shown(), progress_bar("episodes", episodes, keep=True) as show:
        for done in export_tabletop(out, export):
            show(done)


def lerobot_command(
    folder: Annotated[Path, typer.Argument(help="A LeRobot data set, v3.0 or v2.1.")],
    calibration: Annotated[Path | None, typer.Option(help="Cameras, if the set has no meta/cameras.json.")] = None,
    samples: Annotated[int, typer.Option(min=1, help="How many pairs to read.")] = 8,
    frames: Annotated[int, typer.Option(min=2, help="Of a pair.")] = 14,
    fps: Annotated[float | None, typer.Option(help="Of a pair; the set's own by default.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the choice of cameras and windows.")] = 0,
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
