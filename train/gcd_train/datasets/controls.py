"""Control lists: which frames, and in Kubric-4D which cameras, each evaluation sample of a scene has."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from gcd_model.errors import FileError, PoseError
from gcd_model.geometry import Spherical
from gcd_model.small_files import read_json
from gcd_train.errors import DataError

MOST_BYTES = 1 << 24
"""Of a control list."""


class _Entry(msgspec.Struct, frozen=True):
    """Others' file: what else stands in it only informs."""

    frame_start: Annotated[int, msgspec.Meta(ge=0)]
    frame_skip: Annotated[int, msgspec.Meta(ge=1)]
    fps: float | None = None
    spherical_start: tuple[float, float, float] | None = None
    spherical_end: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Control:
    """One evaluation sample. name: as in the file, `sample_00`. frame_start: first frame number. frame_skip: stride.

    start, goal: where the camera is at first and in the end; None in driving, whose path is fixed.
    """

    name: str
    frame_start: int
    frame_skip: int
    start: Spherical | None = None
    goal: Spherical | None = None

    def frame_numbers(self, clip: int) -> tuple[int, ...]:
        """Of a clip of so many frames."""
        return tuple(self.frame_start + self.frame_skip * step for step in range(clip))

    def fps(self, scene_fps: float) -> float:
        """Frames per second of the clip as the network is told it, rounded as published."""
        return float(round(scene_fps / self.frame_skip))


Controls = Mapping[str, tuple[Control, ...]]
"""By scene name, in the order of the file."""


def read_controls(path: Path) -> Controls:
    """Controls of either data set: {scene: {sample: {frame_start, frame_skip, ...}}}.

    Kubric-4D's also have `spherical_start` and `spherical_end`, azimuth and elevation in degrees and radius in metres.
    Scenes that do not exist may be listed.

    Raises: DataError if the file cannot be read or is none, naming scene and sample where the fault has one.
    """
    try:
        listed = read_json(path, dict[str, dict[str, _Entry]], MOST_BYTES)
    except FileError as error:
        raise DataError(f"{path} {error}; a control list has scenes with samples with frame_start") from error
    if not listed:
        raise DataError(f"{path} lists no scene")
    return {
        Path(scene).name: tuple(_control(path, scene, name, entry) for name, entry in sorted(samples.items()))
        for scene, samples in listed.items()
    }


def _control(path: Path, scene: str, name: str, entry: _Entry) -> Control:
    if (entry.spherical_start is None) != (entry.spherical_end is None):
        raise DataError(f"{path}: {scene}, {name} has only one of spherical_start and spherical_end; give both")
    try:
        start, goal = _camera(entry.spherical_start), _camera(entry.spherical_end)
    except PoseError as error:
        raise DataError(f"{path}: {scene}, {name} asks for a camera that cannot be: {error}") from error
    return Control(name=name, frame_start=entry.frame_start, frame_skip=entry.frame_skip, start=start, goal=goal)


def _camera(numbers: tuple[float, float, float] | None) -> Spherical | None:
    if numbers is None:
        return None
    azimuth_deg, elevation_deg, radius_m = numbers
    return Spherical(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, radius_m=radius_m)
