"""Data sets looked after: repacked, verified, encoded once; LeRobot sets written and read."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from gcd_model import printable
from gcd_train.cli.common import (
    Limit,
    Ray,
    Workers,
    errors_shown,
    progress_bar,
    say,
    stop_as_by_ctrl_c,
    with_fields_of,
)
from gcd_train.data.cache import CacheIndex, only_writer, read_index
from gcd_train.data.cache_writer import CacheJob, CacheOptions, cache_job, cache_scenes, missing_scenes
from gcd_train.data.compact import Compaction
from gcd_train.data.dataset4d import layout_of
from gcd_train.data.files import MANIFEST, faults
from gcd_train.data.lerobot import LeRobotPairs
from gcd_train.data.lerobot_export import TabletopExport, export_tabletop
from gcd_train.errors import DataError
from gcd_train.files import remove_leftovers
from gcd_train.parallel import map_items, one_thread_each

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
    limit: Limit = None,
    workers: Workers = 1,
    ray: Ray = None,
) -> None:
    """Repack Kubric-4D or ParallelDomain-4D: WebP, depth of 16 bit, ids as they are; a twentieth of the bytes to read.

    A scene appears when all of it was read again and compared. Stopped at any point, the same line goes on.
    """
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
                try:
                    lines = list(faults(scene))
                except DataError as error:
                    lines = [str(error)]
                if lines:
                    damaged[scene] = lines
                show(number)
        for line in (line for lines in damaged.values() for line in lines):
            say(printable(line), stderr=False)
        advice = "; delete the others and run the line that made them again" if damaged else ""
        whole = len(found) - len(damaged)
        say(f"{whole} of {len(found)} scenes are as they were written{advice}", stderr=False)
    if damaged:
        raise typer.Exit(DataError.exit_code)


def _scenes_of(place: Path) -> list[Path]:
    """The folder itself if it is a scene, else the scenes in it."""
    if (place / MANIFEST).exists() or layout_of(place.resolve().name):
        return [place]
    if not place.is_dir():
        raise DataError(f"{place} is no folder; give scene folders, or the folder that `gcd-train generate` filled")
    inside = sorted(path for path in place.iterdir() if layout_of(path.name))
    if not inside:
        raise DataError(f"{place} holds no scene (scnNNNNN, scene_NNNNNN) and is none; give another folder")
    return inside


@export.command()
@with_fields_of(TabletopExport)
def lerobot(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the data set, new or empty.")], **options: Any
) -> None:
    """Tabletop episodes as a LeRobot data set (v3.0) with calibrated cameras (extras `scenes` and `lerobot`)."""
    wanted = TabletopExport(**options)
    with errors_shown(), progress_bar("episodes", wanted.episodes, keep=True) as show:
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
    tell = partial(say, stderr=False)
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


@with_fields_of(CacheOptions)
def cache(
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="Folder with scene_000000 and so on (ParallelDomain-4D's layout).")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the cache; run the same line again to go on.")],
    workers: Workers = 1,
    ray: Ray = None,
    **options: Any,
) -> None:
    """Encode a driving set once, so that training never runs the frozen encoders again."""
    with errors_shown():
        _cache(cache_job(data, out, CacheOptions(**options)), workers, ray)


def _cache(job: CacheJob, workers: int, ray: str | None) -> None:
    folder, scenes, failed = job.folder, job.pictures.scenes, 0
    with only_writer(folder), progress_bar("scenes", len(scenes), keep=True) as show:
        missing = missing_scenes(job)
        show(there := len(scenes) - len(missing))
        outcomes = cache_scenes(job, missing, workers=workers, ray_address=ray)
        for number, outcome in enumerate(outcomes, start=there + 1):
            if outcome.value is None:
                failed += 1
                say(f"{outcome.item}  left out: {outcome.error}")
            elif outcome.value.missing:
                say(f"{outcome.item}  {len(outcome.value.missing)} frames missing")
            show(number)
    index = read_index(folder, CacheIndex)
    kept = [] if index is None else [index.scenes[name] for name in scenes if name in index.scenes]
    if kept:
        count, size = len(kept), sum(entry.bytes for entry in kept) / 1e6
        seconds, missing = sum(entry.seconds for entry in kept), sum(len(entry.missing) for entry in kept)
        say(
            f"{folder}: {count} scenes, {size:.2f} MB, {size / count:.2f} MB and {seconds / count:.1f} s a scene, "
            f"{missing} frames missing (named in index.json)",
            stderr=False,
        )
    if failed:
        raise DataError(f"{failed} of {len(scenes)} scenes could not be cached, see above; the others are whole")
