"""Which clips of whole scenes are measured: as in the paper, or as its released test script does.

Paper: one part of each scene's video, in Kubric-4D seen on the way to four goals. The source stands at an elevation of
5 degrees, all else is drawn, goals up to 90 degrees away whatever the model; a control list fixes all of it. Source:
Van Hoorick et al. 2024 (GCD), appendix.
Release: the first clip of each scene's controls, or the script's own angles; frames of the command line win.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from gcd_model.geometry import Spherical, SphericalDelta
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import Skips
from gcd_train.data.paths import Control, Controls, DrivingSampling, OrbitSampling, generator
from gcd_train.errors import DataError

ProtocolName: TypeAlias = Literal["paper", "release"]

PAPER_ELEVATION_DEG = 5.0
"""How high the source camera stands in the paper's evaluation on Kubric-4D."""
RELEASED_SOURCE = Spherical(azimuth_deg=20.0, elevation_deg=10.0, radius_m=15.0)
"""Where the released script's source camera stands without controls."""
_RELEASED_CHANGE = SphericalDelta(azimuth_deg=30.0, elevation_deg=15.0, radius_m=0.0)  # where it goes from there
_RELEASED_START, _RELEASED_SKIP = 0, 2  # its first frame and stride
SAMPLES: dict[ProtocolName, int] = {"paper": 4, "release": 2}
"""Draws of each clip of a scene; of pairs, which no protocol cuts, there is one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneControls:
    """Which clips are cut from each scene; the same for a scene whatever others there are.

    clips: of each scene, at most. sampling: how they are drawn, from the seed and the scene's number; those of an orbit
    have one source and the same frames, and differ in the goal. listed: clips by scene, instead of drawn ones. start,
    skip: first frame and stride of every clip, whatever is listed or drawn; None for those.
    """

    clips: int
    sampling: OrbitSampling | DrivingSampling
    seed: int = 0
    listed: Controls | None = None
    start: int | None = None
    skip: int | None = None

    def names(self, scene: str) -> Sequence[str]:
        """Of the clips of a scene, in order: `sample_00`; none for a scene that is not listed."""
        if self.listed is not None:
            return tuple(control.name for control in self.listed.get(scene, ())[: self.clips])
        return tuple(f"sample_{number:02d}" for number in range(self.clips))

    def control(self, scene: str, name: str, frames: int) -> Control:
        """One of them, for a scene of so many time steps. Raises DataError if the scene is too short."""
        if self.listed is not None:
            found = next(each for each in self.listed[scene] if each.name == name)
            start = found.frame_start if self.start is None else self.start
            return replace(found, frame_start=start, frame_skip=found.frame_skip if self.skip is None else self.skip)
        seeds, clip = (self.seed, scene_number(scene)), self.names(scene).index(name)
        if not isinstance(self.sampling, OrbitSampling):
            start, skip = self._frames(generator(*seeds, clip), frames)
            return Control(name=name, frame_start=start, frame_skip=skip)
        rng = generator(*seeds)
        start, skip = self._frames(rng, frames)
        source = replace(self.sampling.source(rng), elevation_deg=PAPER_ELEVATION_DEG)
        goal = source + self.sampling.change(generator(*seeds, 1 + clip), source)
        return Control(name=name, frame_start=start, frame_skip=skip, start=source, goal=goal)

    def _frames(self, rng: np.random.Generator, frames: int) -> tuple[int, int]:
        """First frame and stride."""
        if self.start is not None and self.skip is not None:
            return self.start, self.skip
        usual = self.sampling.frames
        strides = usual.strides if self.skip is None else (self.skip,)
        numbers, stride = replace(usual, strides=strides, reverse=0.0).draw(rng, frames)
        return numbers[0] if self.start is None else self.start, stride


def released_controls(scenes: Sequence[str], *, orbit: bool) -> Controls:
    """The one clip of each scene that the released script makes without a control list. orbit: False in driving."""
    control = Control(
        name="sample_00",
        frame_start=_RELEASED_START,
        frame_skip=_RELEASED_SKIP,
        start=RELEASED_SOURCE if orbit else None,
        goal=RELEASED_SOURCE + _RELEASED_CHANGE if orbit else None,
    )
    return dict.fromkeys(scenes, (control,))


def scene_number(scene: str) -> int:
    """By the name of its folder, in either layout. Raises DataError for another name."""
    number = kubric4d.scene_number(scene)
    number = parallel_domain4d.scene_number(scene) if number is None else number
    if number is None:
        raise DataError(f"{scene} is no scene's name; wanted scn00042 or scene_000042")
    return number


_NAMED = 4  # cameras in a message


def controlled(
    scenes: Sequence[str], controls: SceneControls, listed: Path | None, folder: Path, notes: Skips
) -> tuple[str, ...]:
    """Scenes that have clips; the others are noted.

    Args:
        listed: the control list, None without. folder: where the scenes lie.
    Raises:
        DataError: there are scenes, and the list has none of them, or is for driving and they are seen along orbits.
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
    if controls.listed is not None and isinstance(controls.sampling, OrbitSampling):
        for scene, control in ((name, control) for name in there for control in controls.listed[name]):
            if control.start is None or control.goal is None:
                raise DataError(
                    f"{listed}: {scene}, {control.name} has no spherical_start: it is a driving control, and these "
                    "scenes are seen along orbits; give Kubric-4D's controls"
                )
    return there


def require_cameras(data: Dataset4D) -> None:
    """Raises DataError, with the first fault, where no scene can be opened with all of its cameras."""
    faults: list[DataError] = []
    for scene in data.scenes:
        try:
            data.frames(scene)
            return
        except DataError as error:
            faults.append(error)
    names, count = ", ".join(data.cameras), len(data.cameras)
    cameras = f"the cameras {names}" if count <= _NAMED else f"its {count} cameras"
    raise DataError(
        f"none of {len(data.scenes)} scenes can be opened with {cameras}: {faults[0]}; name those there are with "
        "--camera"
    ) from faults[0]
