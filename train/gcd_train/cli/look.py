"""`gcd-train show` and `gallery`: a scene to look at, and views of real videos, for which there is no ground truth."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Argument, Option

from gcd_model import SphericalDelta, Traits, Trajectory, ViewSynthesizer, load_synthesizer
from gcd_model.errors import NonFiniteError
from gcd_train.cli.common import (
    Device,
    Dtype,
    FamilyName,
    NoiseSeed,
    Steps,
    command_line,
    errors_shown,
    progress_bar,
    say,
)
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.look.gallery import (
    RealVideo,
    ViewRecipe,
    WindowChoice,
    Windowed,
    find_videos,
    paths,
    read_windows,
    view_window,
    write_page,
    write_views,
)
from gcd_train.look.sheet import Footage, write_sheet, write_trajectory, write_video
from gcd_train.look.show import ShowOptions, open_scene
from gcd_train.pictures import require_matplotlib


def show(
    scene: Annotated[
        Path, Argument(metavar="SCENE", help="Folder scnNNNNN or scene_NNNNNN, or pair shards (folder or one zip).")
    ],
    out: Annotated[Path, Option(help="Folder for sheet.png, trajectory.png and video.mp4.")] = Path("show"),
    start: Annotated[int | None, Option(min=0, help="First frame of the clip; drawn by --seed if left out.")] = None,
    stride: Annotated[int | None, Option(min=1, help="Every how many frames; drawn by --seed if left out.")] = None,
    seed: Annotated[int, Option(min=0, help="Draws the clip and the camera path.")] = 0,
    clip: Annotated[
        int | None, Option(min=0, help="In pair shards: seed of the clip to show; the first if left out.")
    ] = None,
    video: Annotated[bool, Option(help="Also write the video.")] = True,
    points: Annotated[
        bool, Option("--points", help="Draw the target from the cameras' points, not from geometry.npz.")
    ] = False,
) -> None:
    """Contact sheet, video, camera path and facts of one clip of a scene (extra `train`)."""
    with errors_shown():
        require_matplotlib()
        place = next(path for path in (out, *out.absolute().parents) if path.exists())
        if not place.is_dir() or not os.access(place, os.W_OK):  # before minutes are spent on what would go there
            raise RunError(f"{out} cannot be written to; give a folder that takes files with --out")
        footage = open_scene(scene, ShowOptions(start=start, stride=stride, seed=seed, exact=not points, clip=clip))
        _print_facts(footage)
        write_sheet(footage, out / "sheet.png")
        write_trajectory(footage, out / "trajectory.png")
        if video:
            write_video(footage, out / "video.mp4")
        say(f"wrote {out}: sheet.png, trajectory.png" + (", video.mp4" if video else ""))


def _print_facts(footage: Footage) -> None:
    table = Table(title=footage.title, box=SIMPLE, show_header=False, title_justify="left")
    table.add_column(no_wrap=True)
    table.add_column()
    for fact in footage.facts():
        table.add_row(*fact)
    Console(highlight=False).print(table)


def gallery_command(
    videos: Annotated[list[Path], Argument(metavar="VIDEOS", help="Videos, folders of videos, folders of pictures.")],
    weights: Annotated[str, Option(help="package:NAME, random:FAMILY or a path.")],
    out: Annotated[Path, Option(help="Folder for index.html, sheets and videos.")] = Path("gallery"),
    angles: Annotated[
        list[str] | None,
        Option(help="Goal as AZIMUTH,ELEVATION,RADIUS: degrees, and units of the trained scenes; may be repeated."),
    ] = None,
    windows: Annotated[int, Option(min=1, help="At most so many windows of each video.")] = 2,
    start: Annotated[float, Option(min=0.0, help="Where the first window begins, seconds.")] = 0.0,
    rate: Annotated[float | None, Option(min=0.1, help="Frames a second of folders of pictures.")] = None,
    hfov_deg: Annotated[
        float | None,
        Option(min=1.0, max=179.0, help="Field of view of the videos, degrees across; cut to the model's."),
    ] = None,
    source_elevation_deg: Annotated[
        float | None, Option(help="Where a steered model's source camera stands, above its centre. Else 5.")
    ] = None,
    source_radius: Annotated[float | None, Option(help="Its distance to the scene's centre. Else 15.")] = None,
    mount_height: Annotated[
        float | None, Option(min=0.1, help="Driving: height of the camera above the road, metres; else as trained.")
    ] = None,
    mount_tilt: Annotated[
        float | None, Option(help="Driving: tilt of the camera, degrees down; else as trained.")
    ] = None,
    samples: Annotated[int, Option(min=1, help="Draws of each view.")] = 1,
    steps: Steps = None,
    seed: NoiseSeed = 0,
    family: FamilyName = None,
    device: Device = "auto",
    dtype: Dtype = None,
) -> None:
    """View real videos from other cameras: sheets, videos, and a page of them all. A bad video is one line."""
    with errors_shown():
        found = find_videos(videos)
        stands = {"elevation_deg": source_elevation_deg, "radius_m": source_radius}
        stands = {name: number for name, number in stands.items() if number is not None}
        recipe = ViewRecipe(
            angles=tuple(_angles(text) for text in angles or ()),
            samples=samples,
            steps=steps,
            seed=seed,
            source=replace(Traits.ASSUMED_SOURCE, **stands) if stands else None,
            height_m=mount_height,
            tilt_deg=mount_tilt,
        )
        model = load_synthesizer(weights, family=family, device=device, dtype=dtype)
        assumed = _assumed(paths(model.traits, recipe), recipe)  # refused before any video is read
        choice = WindowChoice(count=windows, start_s=start, rate=rate, hfov_deg=hfov_deg)
        viewed, faults = _viewed(found, model, choice, recipe, out)
        write_page(viewed, faults, [*_facts(model, recipe), *assumed], out / "index.html")
        for _, told in assumed:
            say(f"source camera: {told}")
        if not viewed:
            raise DataError(f"none of {len(found)} videos can be shown; {faults[0]}")
    say(f"wrote {out}/index.html: {len(viewed)} windows")


def _angles(text: str) -> SphericalDelta:
    """`30,15,0` as a goal; the radius may be left out, and the elevation too."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3:
        raise RecipeError(f"--angles wants AZIMUTH,ELEVATION,RADIUS in numbers such as 30,15,0, got {text!r}")
    azimuth_deg, elevation_deg, radius_m = (*numbers, 0.0, 0.0)[:3]
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def _assumed(paths: Sequence[tuple[str, Trajectory]], recipe: ViewRecipe) -> list[tuple[str, str]]:
    """Where a steered model's source camera is taken to stand, if nobody said it."""
    start = paths[0][1].source
    if start is None or recipe.source is not None or (recipe.height_m, recipe.tilt_deg) != (None, None):
        return []
    stands = f"taken to stand at an elevation of {start.elevation_deg:g} degrees and a radius of {start.radius_m:g}"
    return [("source camera", f"{stands}; say where with --source-elevation-deg and --source-radius")]


def _viewed(
    videos: Sequence[RealVideo],
    model: ViewSynthesizer,
    choice: WindowChoice,
    recipe: ViewRecipe,
    out: Path,
) -> tuple[list[Windowed], list[str]]:
    """What was shown, and a line for each video that could not be."""
    viewed, faults = list[Windowed](), list[str]()
    with progress_bar("videos", len(videos)) as show:
        for number, video in enumerate(videos, 1):
            try:
                for window in read_windows(video, model.traits, choice):
                    write_views(window, view_window(model, window, recipe), out)
                    viewed.append(window)
            except (DataError, NonFiniteError) as error:
                faults.append(f"{video.path}: {error}" if isinstance(error, NonFiniteError) else str(error))
                say(f"left out: {faults[-1]}")
            show(number)
    return viewed, faults


def _facts(model: ViewSynthesizer, recipe: ViewRecipe) -> list[tuple[str, str]]:
    traits = model.traits
    family = "unknown" if traits.family is None else traits.family.name
    return [
        ("command", command_line()),
        ("weights", f"{traits.name} ({traits.sha256_12}), family {family}" + ("" if traits.trained else ", untrained")),
        ("steps", str(recipe.steps or traits.config.sampling.steps)),
        ("samples, seed", f"{recipe.samples}, {recipe.seed}"),
    ]
