"""`gcd-train generate`: make data."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from gcd_train.cli.common import Ray, errors_shown, progress_bar, say, stop_as_by_ctrl_c
from gcd_train.errors import RecipeError
from gcd_train.live.filming import LIVE_SCENES, WORLDS, LiveWorld, TargetPath, generate_live
from gcd_train.scenes.pair_writer import generate
from gcd_train.scenes.scene_writer import SceneRun, generate_scenes
from gcd_train.scenes.worlds import (
    SCENE_WORLDS,
    CameraWay,
    SceneFormat,
    SceneWorld,
    pair_world,
)

app = typer.Typer(no_args_is_help=True, help="Make training data with a procedural world (extra `scenes`).")

Folder = Annotated[Path | None, typer.Argument(help="As --out.", metavar="OUT")]
Out = Annotated[Path | None, typer.Option("--out", help="Folder for the data; what is there is kept.")]
Scenes = Annotated[int | None, typer.Option(min=1, help="How many scenes, one a seed; by default 1.")]
FirstSeed = Annotated[int, typer.Option(min=0, help="Seed of the first; held-out sets start at 1000000.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; by default one a core.")]
Compact = Annotated[bool, typer.Option(help="WebP and 16-bit depth: a tenth of the size.")]
Oversample = Annotated[int, typer.Option(min=1, max=4, help="Anti-aliasing: pixels drawn per pixel and side.")]
Frames = Annotated[int | None, typer.Option(min=2, help="Time steps; by default as published.")]
Width = Annotated[int | None, typer.Option(min=16, help="Pixels; by default as published.")]
Height = Annotated[int | None, typer.Option(min=16, help="Pixels; by default as published.")]
Pairs = Annotated[bool, typer.Option("--pairs", help="Pairs of clips in shards, not whole scenes.")]
Clips = Annotated[int | None, typer.Option(min=1, help="How many pairs: implies --pairs; by default 100.")]
ClipsPerScene = Annotated[int, typer.Option(min=1, help="Pairs: how many are cut from one simulation.")]
ClipsPerShard = Annotated[int, typer.Option(min=1, help="Pairs a file.")]
Way = Annotated[CameraWay, typer.Option(help="Driving, pairs: the target camera moves all the clip, or stands there.")]


@app.callback()
def about() -> None:
    """Keep `generate` a command with sub-commands, one for each world."""


def _add(world: SceneWorld, about: str, *, clips_a_scene: int, clips_a_shard: int) -> None:
    """Add the command of a world."""

    @app.command(world.name, help=about)
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
        clips_per_scene: ClipsPerScene = clips_a_scene,
        clips_per_shard: ClipsPerShard = clips_a_shard,
        path: Way = "gradual",
    ) -> None:
        with errors_shown():
            if (folder is None) == (out is None):
                raise RecipeError("give one folder for the data, OUT or --out OUT")
            place, processes = folder or out or Path(), workers or os.cpu_count() or 1
            on_road = world.name == "driving"
            if path != "gradual" and not on_road:
                raise RecipeError(f"a path is for pairs of driving; {world.name} draws its cameras")
            if on_road and clips_per_scene != clips_a_scene:
                raise RecipeError("a pair of driving has a simulation of its own; leave out --clips-per-scene")
            stop_as_by_ctrl_c()
            size = {"width": width, "height": height, "frames": frames, "oversample": oversample}
            given: dict[str, Any] = {name: number for name, number in size.items() if number is not None}
            if not (pairs or path != "gradual" or clips is not None):
                published = {"width": world.width, "height": world.height, "frames": world.frames}
                form = SceneFormat(compact=compact, **{**published, **given})
                _make_scenes(world, place, form, range(first_seed, first_seed + (scenes or 1)), processes, ray)
                return
            if scenes is not None or compact:
                raise RecipeError(
                    "--scenes and --compact make whole scenes; --clips, --pairs and a path pairs; give one"
                )
            shards = {"clips_per_scene": clips_per_scene, "clips_per_shard": clips_per_shard}
            made = pair_world(world, SceneFormat(**given), path=path, **shards)
            first = first_seed * made.clips_per_scene
            seeds = range(first, first + (clips or 100))
            with progress_bar("clips", len(seeds), keep=True) as show:
                for done in generate(place, made, seeds, processes, ray):
                    show(done)


_ORBITED = """%s, seen by 16 cameras, in Kubric-4D's layout (60 frames at 24 Hz).

With --pairs or --clips: a camera that stands, and one that goes round, 192x128 and 14 frames at 12 Hz by default."""
_DRIVEN = """Road scenes. Whole, in ParallelDomain-4D's layout (19 cameras, 50 frames at 10 Hz), with OUT or --scenes.

With --pairs or --clips: a forward camera, and the path to the view from above, 192x128 and 14 frames by default."""
_add(SCENE_WORLDS["drop"], _ORBITED % "Things that fall and collide", clips_a_scene=3, clips_a_shard=24)
_add(SCENE_WORLDS["tabletop"], _ORBITED % "A robot arm at work on a table", clips_a_scene=3, clips_a_shard=24)
_add(SCENE_WORLDS["driving"], _DRIVEN, clips_a_scene=1, clips_a_shard=8)


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
        processes = workers or os.cpu_count() or 1
        for each in WORLDS[path] if world is None else (world,):
            seeds = range(first_seed, first_seed + (scenes or LIVE_SCENES[each]))
            there, failures = generate_live(out, each, seeds, path=path, size=(width, height), workers=processes)
            for line in failures:
                say(line)
            say(f"{each}: {there} of {len(seeds)} scenes")


def _make_scenes(world: SceneWorld, out: Path, form: SceneFormat, seeds: range, workers: int, ray: str | None) -> None:
    """Exit code: that of the last failure, 0 without."""
    run = SceneRun()
    with progress_bar(world.name, len(seeds), keep=True) as show:
        for run in generate_scenes(out, world, form, seeds, workers=workers, ray_address=ray):
            show(run.done)
    for line in run.lines():
        say(line)
    if run.failures:
        raise typer.Exit(run.exit_code)
