"""`gcd-train gallery`: views of real videos, for which there is no ground truth."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from gcd_model.errors import NonFiniteError
from gcd_train.cli.common import errors_shown, progress_bar, say
from gcd_train.errors import DataError, RecipeError

if TYPE_CHECKING:
    from gcd_model import Spherical, SphericalDelta, Trajectory, ViewSynthesizer
    from gcd_train.look.gallery import RealVideo, ViewRecipe, WindowChoice, Windowed


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
    steps: Annotated[int | None, Option(min=1, help="Steps of the sampler instead of the shipped number.")] = None,
    seed: Annotated[int, Option(min=0, help="Of the noise samples begin with.")] = 0,
    family: Annotated[str | None, Option(help="Family of the weights, where their file does not tell.")] = None,
    device: Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    dtype: Annotated[str | None, Option(help="float32, bfloat16 or float16.")] = None,
) -> None:
    """View real videos from other cameras: sheets, videos, and a page of them all. A bad video is one line."""
    with errors_shown():
        from gcd_model import load_synthesizer
        from gcd_train.look.gallery import ViewRecipe, WindowChoice, find_videos, paths, write_page

        found = find_videos(videos)
        recipe = ViewRecipe(
            angles=tuple(_angles(text) for text in angles or ()),
            samples=samples,
            steps=steps,
            seed=seed,
            source=_source(source_elevation_deg, source_radius),
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


def _angles(text: str) -> "SphericalDelta":
    """`30,15,0` as a goal; the radius may be left out, and the elevation too."""
    from gcd_model import SphericalDelta

    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3:
        raise RecipeError(f"--angles wants AZIMUTH,ELEVATION,RADIUS in numbers such as 30,15,0, got {text!r}")
    azimuth_deg, elevation_deg, radius_m = (*numbers, 0.0, 0.0)[:3]
    return SphericalDelta(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)


def _source(elevation_deg: float | None, radius: float | None) -> "Spherical | None":
    """None where neither is given. Raises PoseError for what is no camera."""
    from gcd_model import Spherical, Traits

    if elevation_deg is None and radius is None:
        return None
    return Spherical(
        azimuth_deg=Traits.ASSUMED_SOURCE.azimuth_deg,
        elevation_deg=Traits.ASSUMED_SOURCE.elevation_deg if elevation_deg is None else elevation_deg,
        radius_m=Traits.ASSUMED_SOURCE.radius_m if radius is None else radius,
    )


def _assumed(paths: "Sequence[tuple[str, Trajectory]]", recipe: "ViewRecipe") -> list[tuple[str, str]]:
    """Where a steered model's source camera is taken to stand, if nobody said it."""
    start = paths[0][1].source
    if start is None or recipe.source is not None or (recipe.height_m, recipe.tilt_deg) != (None, None):
        return []
    stands = f"taken to stand at an elevation of {start.elevation_deg:g} degrees and a radius of {start.radius_m:g}"
    return [("source camera", f"{stands}; say where with --source-elevation-deg and --source-radius")]


def _viewed(
    videos: "Sequence[RealVideo]",
    model: "ViewSynthesizer",
    choice: "WindowChoice",
    recipe: "ViewRecipe",
    out: Path,
) -> "tuple[list[Windowed], list[str]]":
    """What was shown, and a line for each video that could not be."""
    from gcd_train.look.gallery import read_windows, view_window, write_views

    viewed: list[Windowed] = []
    faults: list[str] = []
    with progress_bar("videos", len(videos)) as show:
        for number, video in enumerate(videos, 1):
            try:
                windows = read_windows(video, model.traits, choice)
            except DataError as error:
                _leave_out(str(error), faults)
                windows = ()
            for window in windows:
                try:
                    write_views(window, view_window(model, window, recipe), out)
                except NonFiniteError as error:
                    _leave_out(f"{video.path}: {error}", faults)
                    break
                viewed.append(window)
            show(number)
    return viewed, faults


def _leave_out(fault: str, faults: list[str]) -> None:
    faults.append(fault)
    say(f"left out: {fault}")


def _facts(model: "ViewSynthesizer", recipe: "ViewRecipe") -> list[tuple[str, str]]:
    traits = model.traits
    family = "unknown" if traits.family is None else traits.family.name
    return [
        ("command", shlex.join(["gcd-train", *sys.argv[1:]])),
        ("weights", f"{traits.name} ({traits.sha256_12}), family {family}" + ("" if traits.trained else ", untrained")),
        ("steps", str(recipe.steps or traits.config.sampling.steps)),
        ("samples, seed", f"{recipe.samples}, {recipe.seed}"),
    ]
