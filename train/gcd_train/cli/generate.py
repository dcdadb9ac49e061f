"""`gcd-train generate`: make data."""

import os
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gcd_train.cli.common import errors_shown, progress_bar, say, stop_as_by_ctrl_c
from gcd_train.errors import RecipeError
from gcd_train.live.filming import LIVE_SCENES, WORLDS, LiveWorld, TargetPath, generate_live
from gcd_train.scenes.pair_writer import generate
from gcd_train.scenes.scene_writer import SceneFormat, SceneRun, generate_scenes
from gcd_train.scenes.worlds import (
    SCENE_WORLDS,
    CameraWay,
    PairForm,
    SceneWorld,
    World,
    WorldOptions,
    driving_world,
    orbit_world,
)

app = typer.Typer(no_args_is_help=True, help="Make training data with a procedural world (extra `scenes`).")

Folder = Annotated[Path | None, typer.Argument(help="As --out.", metavar="OUT")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the data; what is there is kept.")]
Scenes = Annotated[int | None, typer.Option(min=1, help="How many scenes, one a seed; by default 1.")]
FirstSeed = Annotated[int, typer.Option(min=0, help="Seed of the first; held-out sets start at 1000000.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; by default one a core.")]
Ray = Annotated[str | None, typer.Option("--ray", help="Run on this Ray cluster (auto, HOST:PORT; extra `cluster`).")]
Compact = Annotated[bool, typer.Option(help="WebP and 16-bit depth: a tenth of the size.")]
Oversample = Annotated[int, typer.Option(min=1, max=4, help="Anti-aliasing: pixels drawn per pixel and side.")]
Frames = Annotated[int | None, typer.Option(min=2, help="Time steps; by default as published.")]
Width = Annotated[int | None, typer.Option(min=16, help="Pixels; by default as published.")]
Height = Annotated[int | None, typer.Option(min=16, help="Pixels; by default as published.")]
Pairs = Annotated[bool, typer.Option("--pairs", help="Pairs of clips in shards, not whole scenes.")]
Clips = Annotated[int | None, typer.Option(min=1, help="How many pairs: implies --pairs; by default 100.")]
ClipsPerScene = Annotated[int, typer.Option(min=1, help="Pairs: how many are cut from one simulation.")]
ClipsPerShard = Annotated[int, typer.Option(min=1, help="Pairs a file.")]


@app.callback()
def about() -> None:
    """Keep `generate` a command with sub-commands, one for each world."""


def _orbited(name: str, about: str) -> None:
    """Add the command of a world that cameras stand round."""

    @app.command(name, help=about)
    def make(  # pyright: ignore[reportUnusedFunction]
        folder: Folder = None,
        out: Out = None,
        scenes: Scenes = None,
        pairs: Pairs = False,
        clips: Clips = None,
        first_seed: FirstSeed = 0,
        workers: Workers = None,
        ray: Ray = None,
        compact: Compact = False,
        oversample: Oversample = 2,
        frames: Frames = None,
        width: Width = None,
        height: Height = None,
        clips_per_scene: ClipsPerScene = 3,
        clips_per_shard: ClipsPerShard = 24,
    ) -> None:
        with errors_shown():
            world, place = SCENE_WORLDS[name], _one_folder(folder, out)
            if _wants_pairs(pairs, clips, scenes, compact):
                form = _pair_form(width, height, frames, oversample, clips_per_shard)
                made = orbit_world(world, form, clips_per_scene=clips_per_scene)
                _make_pairs(place, made, made.seeds_of(first_seed, clips or 100), workers, ray)
                return
            form = _form(world, compact, oversample, frames, width, height)
            _make_scenes(world, place, form, _seeds(first_seed, scenes), workers, ray)


_ORBITED = """%s, seen by 16 cameras, in Kubric-4D's layout (60 frames at 24 Hz).

With --pairs or --clips: a camera that stands, and one that goes round, 192x128 and 14 frames at 12 Hz by default."""
_orbited("drop", _ORBITED % "Things that fall and collide")
_orbited("tabletop", _ORBITED % "A robot arm at work on a table")


@app.command()
def driving(
    folder: Folder = None,
    out: Out = None,
    scenes: Scenes = None,
    pairs: Pairs = False,
    clips: Clips = None,
    first_seed: FirstSeed = 0,
    workers: Workers = None,
    ray: Ray = None,
    compact: Compact = False,
    oversample: Oversample = 2,
    frames: Frames = None,
    width: Width = None,
    height: Height = None,
    clips_per_shard: ClipsPerShard = 8,
    path: Annotated[CameraWay, typer.Option(help="Pairs: the target camera moves all the clip, or stands there.")] = (
        "gradual"
    ),
    mount_height: Annotated[float, typer.Option(help="Pairs: true height of the source camera, metres.")] = 1.55,
    mount_tilt: Annotated[float, typer.Option(help="Pairs: true tilt of the source camera, degrees down.")] = 0.0,
) -> None:
    """Road scenes. Whole, in ParallelDomain-4D's layout (19 cameras, 50 frames at 10 Hz), with OUT or --scenes.

    With --pairs or --clips: a forward camera, and the path to the view from above, 192x128 and 14 frames by default.
    """
    with errors_shown():
        place = _one_folder(folder, out)
        mount = WorldOptions(height_m=mount_height, tilt_deg=mount_tilt)
        told = pairs or mount != WorldOptions() or path != "gradual"
        if _wants_pairs(told, clips, scenes, compact):
            form = _pair_form(width, height, frames, oversample, clips_per_shard)
            world = driving_world(form, mount, path)
            _make_pairs(place, world, world.seeds_of(first_seed, clips or 100), workers, ray)
            return
        drive = SCENE_WORLDS["driving"]
        form = _form(drive, compact, oversample, frames, width, height)
        _make_scenes(drive, place, form, _seeds(first_seed, scenes), workers, ray)


@app.command()
def live(
    out: Annotated[Path, typer.Argument(help="Folder for the clips; those that are there are kept.")],
    world: Annotated[LiveWorld | None, typer.Option(help="Only this world.")] = None,
    path: Annotated[
        TargetPath, typer.Option(help="Which targets: the training's mixture, or one kind, of the worlds that have it.")
    ] = "mixed",
    scenes: Scenes = None,
    first_seed: FirstSeed = 0,
    width: Annotated[int, typer.Option(min=32, help="Pixels.")] = 192,
    height: Annotated[int, typer.Option(min=32, help="Pixels.")] = 128,
    workers: Workers = None,
) -> None:
    """Clips for the live model: any lens, any target, exact depth, classes, motion and visibility.

    By default so many scenes of each world as `live-small` was trained on: over 3,000 clips, an hour of two cores.
    """
    with errors_shown():
        stop_as_by_ctrl_c()
        console, processes = Console(stderr=True, highlight=False), workers or os.cpu_count() or 1
        for each in WORLDS[path] if world is None else (world,):
            seeds = range(first_seed, first_seed + (scenes or LIVE_SCENES[each]))
            there, failures = generate_live(out, each, seeds, path=path, size=(width, height), workers=processes)
            for line in failures:
                console.print(line, markup=False, soft_wrap=True)
            console.print(f"{each}: {there} of {len(seeds)} scenes")


def _wants_pairs(pairs: bool, clips: int | None, scenes: int | None, compact: bool) -> bool:
    wanted = pairs or clips is not None
    if wanted and (scenes is not None or compact):
        raise RecipeError(
            "--scenes and --compact make whole scenes; --clips, --pairs, a mount and a path pairs; give one"
        )
    return wanted


def _one_folder(argument: Path | None, option: Path | None) -> Path:
    if (argument is None) == (option is None):
        raise RecipeError("give one folder for the data, OUT or --out OUT")
    return argument or option or Path()


def _seeds(first: int, count: int | None) -> range:
    return range(first, first + (count or 1))


def _form(
    world: SceneWorld, compact: bool, oversample: int, frames: int | None, width: int | None, height: int | None
) -> SceneFormat:
    return SceneFormat(
        width=width or world.width,
        height=height or world.height,
        frames=frames or world.frames,
        oversample=oversample,
        compact=compact,
    )


def _pair_form(
    width: int | None, height: int | None, frames: int | None, oversample: int, clips_per_shard: int
) -> PairForm:
    usual = PairForm()
    return PairForm(
        width=width or usual.width,
        height=height or usual.height,
        frames=frames or usual.frames,
        oversample=oversample,
        clips_per_shard=clips_per_shard,
    )


def _make_scenes(
    world: SceneWorld,
    out: Path,
    form: SceneFormat,
    seeds: range,
    workers: int | None,
    ray: str | None,
) -> None:
    """Exit code: that of the last failure, 0 without."""
    stop_as_by_ctrl_c()
    run = SceneRun()
    console = Console(stderr=True, highlight=False)
    started = time.monotonic()
    columns = (TextColumn(world.name), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task(world.name, total=len(seeds), rate="")
        processes = workers or os.cpu_count() or 1
        for run in generate_scenes(out, world, form, seeds, workers=processes, ray_address=ray):
            rate = f"{(run.done - run.there) / (time.monotonic() - started):.3g} scenes/s"
            bar.update(task, completed=run.done, rate=rate)
    for line in run.lines():
        say(line)
    if run.failures:
        raise typer.Exit(run.exit_code)


def _make_pairs(out: Path, world: World, seeds: range, workers: int | None, ray: str | None) -> None:
    stop_as_by_ctrl_c()
    with progress_bar("clips", len(seeds), keep=True) as show:
        for done in generate(out, world, seeds, workers or os.cpu_count() or 1, ray):
            show(done)
