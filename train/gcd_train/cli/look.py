"""`gcd-train show` and `gallery`: a scene to look at, and views of real videos, for which there is no ground truth."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from gcd_model import ViewSynthesizer, load_synthesizer
from gcd_model.errors import NonFiniteError
from gcd_train.cli.common import (
    Device,
    Dtype,
    FamilyName,
    command_line,
    errors_shown,
    progress_bar,
    say,
    with_fields_of,
)
from gcd_train.errors import DataError, RunError
from gcd_train.look.gallery import (
    GalleryOptions,
    RealVideo,
    Windowed,
    find_videos,
    paths,
    read_windows,
    view_window,
    write_page,
    write_views,
)
from gcd_train.look.sheet import write_sheet, write_trajectory, write_video
from gcd_train.look.show import ShowOptions, open_scene
from gcd_train.pictures import require_matplotlib


@with_fields_of(ShowOptions)
def show(
    scene: Annotated[
        Path, Argument(metavar="SCENE", help="Folder scnNNNNN or scene_NNNNNN, or pair shards (folder or one zip).")
    ],
    out: Annotated[Path, Option(help="Folder for sheet.png, trajectory.png and video.mp4.")] = Path("show"),
    video: Annotated[bool, Option(help="Also write the video.")] = True,
    **options: Any,
) -> None:
    """Contact sheet, video, camera path and facts of one clip of a scene (extra `train`)."""
    with errors_shown():
        require_matplotlib()
        place = next(path for path in (out, *out.absolute().parents) if path.exists())
        if not place.is_dir() or not os.access(place, os.W_OK):  # before minutes are spent on what would go there
            raise RunError(f"{out} cannot be written to; give a folder that takes files with --out")
        footage = open_scene(scene, ShowOptions(**options))
        for name, fact in (("title", footage.title), *footage.facts()):
            say(f"{name + ':':10}{fact}", stderr=False)
        write_sheet(footage, out / "sheet.png")
        write_trajectory(footage, out / "trajectory.png")
        if video:
            write_video(footage, out / "video.mp4")
        say(f"wrote {out}: sheet.png, trajectory.png" + (", video.mp4" if video else ""))


@with_fields_of(GalleryOptions)
def gallery_command(
    videos: Annotated[list[Path], Argument(metavar="VIDEOS", help="Videos, folders of videos, folders of pictures.")],
    weights: Annotated[str, Option(help="package:NAME, random:FAMILY or a path.")],
    out: Annotated[Path, Option(help="Folder for index.html, sheets and videos.")] = Path("gallery"),
    family: FamilyName = None,
    device: Device = "auto",
    dtype: Dtype = None,
    **given: Any,
) -> None:
    """View real videos from other cameras: sheets, videos, and a page of them all. A bad video is one line."""
    with errors_shown():
        found, options = find_videos(videos), GalleryOptions(**given)
        model = load_synthesizer(weights, family=family, device=device, dtype=dtype)
        start, facts = paths(model.traits, options)[0][1].source, _facts(model, options)  # refused before any is read
        if start and options.source is None and (options.mount_height, options.mount_tilt) == (None, None):
            stands = f"taken to stand {start.elevation_deg:g} degrees up and {start.radius_m:g} away"
            facts.append(("source camera", f"{stands}; say where with --source-elevation-deg and --source-radius"))
            say(": ".join(facts[-1]))
        viewed, faults = _viewed(found, model, options, out)
        write_page(viewed, faults, facts, out / "index.html")
        if not viewed:
            raise DataError(f"none of {len(found)} videos can be shown; {faults[0]}")
    say(f"wrote {out}/index.html: {len(viewed)} windows")


def _viewed(
    videos: Sequence[RealVideo], model: ViewSynthesizer, options: GalleryOptions, out: Path
) -> tuple[list[Windowed], list[str]]:
    """What was shown, and a line for each video that could not be."""
    viewed, faults = list[Windowed](), list[str]()
    with progress_bar("videos", len(videos)) as show:
        for number, video in enumerate(videos, 1):
            try:
                for window in read_windows(video, model.traits, options):
                    write_views(window, view_window(model, window, options), out)
                    viewed.append(window)
            except (DataError, NonFiniteError) as error:
                faults.append(f"{video.path}: {error}" if isinstance(error, NonFiniteError) else str(error))
                say(f"left out: {faults[-1]}")
            show(number)
    return viewed, faults


def _facts(model: ViewSynthesizer, options: GalleryOptions) -> list[tuple[str, str]]:
    traits = model.traits
    family = "unknown" if traits.family is None else traits.family.name
    return [
        ("command", command_line()),
        ("weights", f"{traits.name} ({traits.sha256_12}), family {family}" + ("" if traits.trained else ", untrained")),
        ("steps", str(options.steps or traits.config.sampling.steps)),
        ("samples, seed", f"{options.samples}, {options.seed}"),
    ]
