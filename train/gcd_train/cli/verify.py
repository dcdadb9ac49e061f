"""`gcd-train verify`: are scenes as they were written?"""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from rich.console import Console

from gcd_model import printable
from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar
from gcd_train.errors import DataError
from gcd_train.layouts import kubric4d, parallel_domain4d
from gcd_train.layouts.manifest import MANIFEST, faults

Scenes: TypeAlias = Annotated[list[Path], typer.Argument(help="Scene folders, or folders full of them.")]


def verify_command(scenes: Scenes) -> None:
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
    say = Console(highlight=False)
    for line in (line for lines in damaged.values() for line in lines):
        say.print(printable(line), markup=False, soft_wrap=True)
    whole = f"{count - len(damaged)} of {count} scenes are as they were written"
    advice = "; delete the others and run the line that made them again" if damaged else ""
    say.print(whole + advice, markup=False, soft_wrap=True)
