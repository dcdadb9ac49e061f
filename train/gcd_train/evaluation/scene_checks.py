"""What is wrong with all scenes of an evaluation, or with their control list, said before anything is measured."""

from collections.abc import Sequence
from pathlib import Path

from gcd_train.datasets.controls import Control, Controls
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.skips import Skips
from gcd_train.errors import DataError
from gcd_train.evaluation.protocols import ClipControls

_NAMED = 4  # cameras in a message


def controlled(
    scenes: Sequence[str], controls: ClipControls, listed: Path | None, folder: Path, notes: Skips
) -> tuple[str, ...]:
    """Scenes that have clips; the others are noted.

    Args:
        listed: the control list, None without. folder: where the scenes lie.
    Raises:
        DataError: there are scenes, and the list has none of them.
    """
    there = tuple(scene for scene in scenes if controls.names(scene))
    if scenes and not there:
        raise DataError(
            f"the control list {listed} has none of the {len(scenes)} scenes in {folder}, first {scenes[0]}; "
            "give the list of these scenes"
        )
    for scene in scenes:
        if scene not in there:
            notes.add(scene, str(listed), "has no control for it")
    return there


def require_cameras(data: Dataset4D) -> None:
    """Raises DataError, with the first fault, where no scene can be opened with all of its cameras."""
    faults: list[DataError] = []
    for scene in data.scenes:
        try:
            data.frames(scene)
        except DataError as fault:
            faults.append(fault)
        else:
            return
    if faults:
        raise DataError(
            f"none of {len(faults)} scenes can be opened with {_cameras(data.cameras)}: {faults[0]}; name those there "
            "are with --camera"
        ) from faults[0]


def _cameras(names: Sequence[str]) -> str:
    few = f"the cameras {', '.join(names)}"
    return few if len(names) <= _NAMED else f"its {len(names)} cameras"


def orbit_notes(controls: Controls, chosen: Sequence[tuple[str, str]], listed: Path) -> tuple[str, ...]:
    """What is odd in the cameras of an orbit's control list, in words.

    Args:
        chosen: scene and name of each control that is used.
    Raises:
        DataError: one has no cameras: the list is for driving.
    """
    each = [(scene, control) for scene, control in _of(controls, chosen)]
    for scene, control in each:
        if control.start is None or control.goal is None:
            raise DataError(
                f"{listed}: {scene}, {control.name} has no spherical_start: it is a driving control, and these scenes "
                "are seen along orbits; give Kubric-4D's controls"
            )
    below = [(scene, control.name) for scene, control in each if _lowest(control) < 0]
    if not below:
        return ()
    first = ", ".join(below[0])
    return (
        f"{listed}: {len(below)} of {len(each)} clips have a camera below the ground, first {first}; see its angles",
    )


def _of(controls: Controls, chosen: Sequence[tuple[str, str]]) -> list[tuple[str, Control]]:
    wanted = set(chosen)
    return [
        (scene, control)
        for scene in dict.fromkeys(scene for scene, _ in chosen)
        for control in controls[scene]
        if (scene, control.name) in wanted
    ]


def _lowest(control: Control) -> float:
    """Elevation in degrees."""
    return min(camera.elevation_deg for camera in (control.start, control.goal) if camera is not None)
