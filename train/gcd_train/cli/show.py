"""`gcd-train show`: a scene to look at."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from typer import Argument, Option

from gcd_train.cli.common import errors_shown
from gcd_train.errors import RunError

if TYPE_CHECKING:
    from gcd_train.look.sheet import Footage

SceneFolder: TypeAlias = Annotated[
    Path, Argument(metavar="SCENE", help="Folder scnNNNNN or scene_NNNNNN, or pair shards (folder or one zip).")
]
Out: TypeAlias = Annotated[Path, Option(help="Folder for sheet.png, trajectory.png and video.mp4.")]
Start: TypeAlias = Annotated[int | None, Option(min=0, help="First frame of the clip; drawn by --seed if left out.")]
Stride: TypeAlias = Annotated[int | None, Option(min=1, help="Every how many frames; drawn by --seed if left out.")]
Seed: TypeAlias = Annotated[int, Option(min=0, help="Draws the clip and the camera path.")]
Clip: TypeAlias = Annotated[
    int | None, Option(min=0, help="In pair shards: seed of the clip to show; the first if left out.")
]
Video: TypeAlias = Annotated[bool, Option(help="Also write the video.")]
Points: TypeAlias = Annotated[
    bool, Option("--points", help="Draw the target from the cameras' points, not from geometry.npz.")
]


def show(
    scene: SceneFolder,
    out: Out = Path("show"),
    start: Start = None,
    stride: Stride = None,
    seed: Seed = 0,
    clip: Clip = None,
    video: Video = True,
    points: Points = False,
) -> None:
    """Contact sheet, video, camera path and facts of one clip of a scene (extra `train`)."""
    with errors_shown():
        from gcd_train.look.sheet import write_sheet, write_trajectory, write_video
        from gcd_train.look.show import ShowOptions, open_scene
        from gcd_train.pictures import require_matplotlib

        require_matplotlib()
        _refuse_unwritable(out)
        footage = open_scene(scene, ShowOptions(start=start, stride=stride, seed=seed, exact=not points, clip=clip))
        _print_facts(footage)
        write_sheet(footage, out / "sheet.png")
        write_trajectory(footage, out / "trajectory.png")
        if video:
            write_video(footage, out / "video.mp4")
        written = "sheet.png, trajectory.png" + (", video.mp4" if video else "")
        Console(stderr=True, highlight=False).print(f"wrote {out}: {written}", markup=False, soft_wrap=True)


def _refuse_unwritable(folder: Path) -> None:
    """Said before minutes are spent on what would go there; nothing is made yet."""
    place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise RunError(f"{folder} cannot be written to; give a folder that takes files with --out")


def _print_facts(footage: "Footage") -> None:
    table = Table(title=footage.title, box=SIMPLE, show_header=False, title_justify="left")
    table.add_column(no_wrap=True)
    table.add_column()
    for fact in footage.facts():
        table.add_row(*fact)
    Console(highlight=False).print(table)
