"""Data sets looked after: repacked, encoded once; LeRobot sets written, read, and given more cameras."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

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
from gcd_train.data.anyview import EpisodeExport
from gcd_train.data.cache_writer import CacheOptions, cache_job, cache_scenes
from gcd_train.data.compact import Compaction
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.lerobot import LeRobotPairs
from gcd_train.data.lerobot_augment import Augmentation, AugmentOptions
from gcd_train.data.lerobot_export import TabletopExport, export_tabletop
from gcd_train.data.splits import write_sweep
from gcd_train.errors import DataError
from gcd_train.files import only_writer, remove_leftovers
from gcd_train.parallel import Outcome, map_items, one_thread_each

Done = TypeVar("Done")

data = typer.Typer(no_args_is_help=True, help="Downloaded data sets: repacking.")
export = typer.Typer(no_args_is_help=True, help="Write data in other programs' formats.")
augment = typer.Typer(no_args_is_help=True, help="Write data sets with more cameras than filmed them.")


@data.callback()
@export.callback()
@augment.callback()
def about() -> None:
    """Keep these commands with sub-commands, however many there are."""


@data.command()
def compact(
    source: Annotated[Path, typer.Argument(help="Folder with scn00000 or scene_000000 and so on; stays as it is.")],
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
        outcomes = map_items(work, scenes, workers=workers, ray_address=ray)
        made, damaged = _worked_through(
            outcomes,
            len(scenes),
            lambda done: f"packed without {done.gaps} views that are missing" if done.gaps else "",
        )
        packed = [done for done in made if done.made]
        sizes = f", {sum(done.written for done in packed) / 1e6:.1f} MB" if packed else ""
        say(f"scenes: {len(packed)} packed{sizes}; {len(made) - len(packed)} there already; {damaged} damaged")
    if damaged:
        raise typer.Exit(DataError.exit_code)


def _worked_through(
    outcomes: Iterable[Outcome[str, Done]], count: int, remark: Callable[[Done], str]
) -> tuple[list[Done], int]:
    """What became of scenes, each shown as it is done, and how many cannot be read; any other error ends the run.

    count: of scenes. remark: what there is to say of one, if anything.
    """
    made, damaged = list[Done](), 0
    with progress_bar("scenes", count, keep=True) as show:
        for number, outcome in enumerate(outcomes, start=1):
            try:
                made.append(outcome.unwrap())
            except DataError as fault:
                damaged += 1
                said = str(fault)
            else:
                said = remark(made[-1])
            if said:
                say(printable(f"{outcome.item}: {said}"))
            show(number)
    return made, damaged


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


@augment.command("lerobot")
@with_fields_of(AugmentOptions)
def augment_lerobot(
    source: Annotated[Path, typer.Argument(metavar="DATASET", help="A LeRobot data set, v3.0 or v2.1.")],
    out: Annotated[Path, typer.Option(help="The new data set; run the same line again to go on.")],
    workers: Workers = 1,
    **options: Any,
) -> None:
    """Copy a LeRobot data set and give it novel views of a camera, marked synthetic, with what of them was seen.

    Everything else stays byte by byte. OUT appears when it is whole; episodes that are done are kept until then.
    """
    stop_as_by_ctrl_c()
    with errors_shown():
        if workers > 1:
            one_thread_each()
        work = Augmentation.of(source, out, AugmentOptions(**options))
        with only_writer(work.parts), progress_bar("episodes", len(work.episodes), keep=True) as show:
            work.claim()
            for done, outcome in enumerate(map_items(work, work.episodes, workers=workers), 1):
                outcome.unwrap()
                show(done)
            work.finish()
        say(f"wrote {out}: {', '.join(work.features)}")


@export.command()
def anyview(
    source: Annotated[Path, typer.Argument(metavar="DATA", help="Scenes in a published layout, or pairs.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the episodes; those that are there are kept.")],
    view: Annotated[
        list[str] | None,
        typer.Option(help="Scenes: INPUT:TARGET, two cameras; may be repeated. By default the usual, the farthest."),
    ] = None,
    limit: Limit = None,
    workers: Workers = 1,
    ray: Ray = None,
) -> None:
    """Scenes or pairs as episodes of AnyViewBench, for other people's models.

    `gcd-train evaluate --data OUT --protocol anyviewbench --predictions NAME=FOLDER` measures what these make of them.
    """
    stop_as_by_ctrl_c()
    with errors_shown():
        work = EpisodeExport.of(source, out, tuple(view or ()), limit)
        one_thread_each()
        outcomes = map_items(work, work.items, workers=workers, ray_address=ray)
        made, damaged = _worked_through(outcomes, len(work.items), lambda done: "")
        splits = work.finish()
        say(f"episodes: {sum(made)} written, {len(made) - sum(made)} there already; {damaged} damaged")
        say(f"splits in {out}: {', '.join(splits)}")
    if damaged:
        raise typer.Exit(DataError.exit_code)


@export.command()
def sweep(
    scenes: Annotated[Path, typer.Argument(metavar="DATA", help="Folder with scn00000 and so on.")],
    out: Annotated[Path, typer.Argument(metavar="FILE", help="The control list, JSON.")],
    step_deg: Annotated[float, typer.Option(min=1.0, max=180.0, help="From one goal to the next.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Draws the azimuth of each scene's source.")] = 0,
    limit: Limit = None,
) -> None:
    """The paper's study of angles as a control list: goals 0 to 180 degrees to the right of the source camera.

    `gcd-train evaluate --controls FILE` measures them, `gcd-train figure angles` draws them.
    """
    with errors_shown():
        names = Kubric4D(scenes).scenes[:limit]
        count = write_sweep(out, names, step_deg=step_deg, seed=seed)
    say(f"wrote {out}: {count} clips of each of {len(names)} scenes")


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
        job = cache_job(data, out, CacheOptions(**options))
        outcomes = cache_scenes(job, workers=workers, ray_address=ray)
        count = len(job.pictures.scenes)
        kept, failed = _worked_through(
            outcomes, count, lambda shard: f"{len(shard.missing)} frames missing" if shard.missing else ""
        )
        if kept:
            size, seconds = sum(shard.bytes for shard in kept) / 1e6, sum(shard.seconds for shard in kept)
            say(
                f"{out}: {len(kept)} scenes, {size:.2f} MB, {size / len(kept):.2f} MB and {seconds / len(kept):.1f} s "
                f"a scene, {sum(len(shard.missing) for shard in kept)} frames missing (named in index.json)",
                stderr=False,
            )
        if failed:
            raise DataError(f"{failed} of {count} scenes could not be cached, see above; the others are whole")
