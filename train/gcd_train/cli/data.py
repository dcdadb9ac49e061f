"""Data sets looked after: repacked, verified, LeRobot sets written and read."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from gcd_model import printable
from gcd_train.cli.common import errors_shown, progress_bar, say, stop_as_by_ctrl_c
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.files import MANIFEST, faults
from gcd_train.errors import DataError

data = typer.Typer(no_args_is_help=True, help="Downloaded data sets: repacking.")
export = typer.Typer(no_args_is_help=True, help="Write data in other programs' formats.")


@data.callback()
@export.callback()
def about() -> None:
    """Keep these commands with sub-commands, however many there are."""


@data.command()
def compact(
    source: Annotated[
        Path, typer.Argument(help="Folder with scn00000 or scene_000000 and so on; nothing in it changes.")
    ],
    out: Annotated[Path, typer.Argument(help="Folder for the packed scenes; those that are there are kept.")],
    gaps: Annotated[
        bool, typer.Option("--gaps", help="Pack scenes that lack pictures, too; training passes these over.")
    ] = False,
    camera: Annotated[
        list[str] | None, typer.Option(help="A camera to pack; may be repeated. By default all published.")
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many scenes.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    ray: Annotated[
        str | None, typer.Option("--ray", help="Run on this Ray cluster (auto, HOST:PORT; extra `cluster`).")
    ] = None,
) -> None:
    """Repack Kubric-4D or ParallelDomain-4D: WebP, depth of 16 bit, ids as they are; a twentieth of the bytes to read.

    A scene appears when all of it was read again and compared. Stopped at any point, the same line goes on.
    """
    from gcd_train.data.compact import Compaction
    from gcd_train.files import remove_leftovers
    from gcd_train.parallel import map_items, one_thread_each

    stop_as_by_ctrl_c()
    with errors_shown():
        work = Compaction.of(source, out, cameras=tuple(camera or ()), gaps=gaps)
        scenes = work.scenes[:limit]
        remove_leftovers(work.out)
        one_thread_each()
        packed, there, damaged, written = 0, 0, 0, 0
        with progress_bar("scenes", len(scenes), keep=True) as show:
            for number, outcome in enumerate(map_items(work, scenes, workers=workers, ray_address=ray), start=1):
                try:
                    done = outcome.unwrap()
                except DataError as fault:
                    damaged += 1
                    say(printable(f"{outcome.item}: {fault}"))
                else:
                    packed, there = packed + done.made, there + (not done.made)
                    written += done.written
                    if done.gaps:
                        say(f"{outcome.item}: packed without {done.gaps} views that are missing")
                show(number)
        sizes = f", {written / 1e6:.1f} MB" if packed else ""
        say(f"scenes: {packed} packed{sizes}; {there} there already; {damaged} damaged")
    if damaged:
        raise typer.Exit(DataError.exit_code)


def verify_command(
    scenes: Annotated[list[Path], typer.Argument(help="Scene folders, or folders full of them.")],
) -> None:
    """Compare every file of generated scenes with its SHA-256; exit code 66 and the files' names if one differs."""
    with errors_shown():
        found = [scene for place in scenes for scene in _scenes_of(place)]
        damaged: dict[Path, list[str]] = {}
        with progress_bar("scenes", len(found)) as show:
            for number, scene in enumerate(found, start=1):
                lines = _faults_of(scene)
                if lines:
                    damaged[scene] = lines
                show(number)
        _tell(len(found), damaged)
    if damaged:
        raise typer.Exit(DataError.exit_code)


def _scenes_of(place: Path) -> list[Path]:
    """The folder itself if it is a scene, else the scenes in it."""
    if (place / MANIFEST).exists() or _is_scene_name(place.resolve().name):
        return [place]
    if not place.is_dir():
        raise DataError(f"{place} is no folder; give scene folders, or the folder that `gcd-train generate` filled")
    inside = sorted(path for path in place.iterdir() if _is_scene_name(path.name))
    if not inside:
        raise DataError(f"{place} holds no scene (scnNNNNN, scene_NNNNNN) and is none; give another folder")
    return inside


def _is_scene_name(name: str) -> bool:
    return kubric4d.scene_number(name) is not None or parallel_domain4d.scene_number(name) is not None


def _faults_of(scene: Path) -> list[str]:
    try:
        return list(faults(scene))
    except DataError as error:
        return [str(error)]


def _tell(count: int, damaged: dict[Path, list[str]]) -> None:
    out = Console(highlight=False)
    for line in (line for lines in damaged.values() for line in lines):
        out.print(printable(line), markup=False, soft_wrap=True)
    whole = f"{count - len(damaged)} of {count} scenes are as they were written"
    advice = "; delete the others and run the line that made them again" if damaged else ""
    out.print(whole + advice, markup=False, soft_wrap=True)


@export.command()
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
    from gcd_train.data.lerobot_export import TabletopExport, export_tabletop

    wanted = TabletopExport(
        seeds=range(first_seed, first_seed + episodes),
        frames=frames,
        cameras=tuple(name.strip() for name in cameras.split(",")),
        width=width,
        height=height,
        oversample=oversample,
    )
    with errors_shown(), progress_bar("episodes", episodes, keep=True) as show:
        for done in export_tabletop(out, wanted):
            show(done)
    say(f"wrote {out}; look at it with `gcd-train lerobot {out}`")


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
    from gcd_train.data.lerobot import LeRobotPairs

    tell = Console(highlight=False, soft_wrap=True).print
    with errors_shown():
        pairs = LeRobotPairs(folder, seed, frames=frames, fps=fps, calibration=calibration)
        rate = pairs.info.fps
        tell(f"{len(pairs.episodes)} episodes at {rate:g} frames per second, cameras {', '.join(pairs.cameras)}")
        for index in range(samples):
            sample = pairs.sample(index)
            apart = float(np.linalg.norm(sample.source_from_target[:, :3, 3], axis=-1).mean())
            first, last = sample.frame_numbers[0], sample.frame_numbers[-1]
            tell(f"  {sample.scene} rows {first}..{last}: cameras {apart:.3f} m apart")
        for line in pairs.skips.lines():
            tell(line)
