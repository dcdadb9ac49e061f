"""Which scenes are for training, validation and test, by number, split file or list; which clips are evaluated."""

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from filecmp import cmp
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from gcd_model.errors import FileError, PoseError
from gcd_model.geometry import Spherical, SphericalDelta
from gcd_model.small_files import read_json, read_small
from gcd_train.data.dataset4d import layout_of, scene_number
from gcd_train.data.files import Skips
from gcd_train.data.paths import Control, Controls, OrbitSampling, Sampling, generator
from gcd_train.errors import DataError, RecipeError
from gcd_train.files import write_whole

Part = Literal["train", "val", "test"]

MOST_BYTES = 1 << 24
"""Of a control list."""
_KUBRIC_RANGES: dict[Part, range] = {"train": range(2800), "val": range(2800, 2900), "test": range(2900, 3000)}
_NAMED = 5  # scenes in a message
_LIST_MARK = re.compile(r"\binvalid\b", re.IGNORECASE)


class SplitFile(msgspec.Struct, frozen=True, kw_only=True):
    """ParallelDomain-4D's split. Others' file: counts and seed that stand in it are not needed."""

    train: tuple[str, ...]
    val: tuple[str, ...]
    test: tuple[str, ...]


def kubric_split(scenes: Iterable[str], part: Part) -> tuple[str, ...]:
    """The scenes of one part of Kubric-4D, by number: 0-2799 train, 2800-2899 val, 2900-2999 test."""
    wanted = _KUBRIC_RANGES[part]
    return tuple(scene for scene in scenes if scene_number(scene) in wanted)


def read_split(path: Path, part: Part) -> tuple[str, ...]:
    """The scenes of one part of a ParallelDomain-4D split file, in its order.

    Raises: DataError if it cannot be read, or a scene is in two parts.
    """
    try:
        split = read_json(path, SplitFile)
    except FileError as error:
        raise DataError(f"{path} is no split file with lists train, val and test: it {error}") from error
    scenes = [Path(name).name for name in (*split.train, *split.val, *split.test)]
    if len(set(scenes)) < len(scenes):
        twice = sorted({name for name in scenes if scenes.count(name) > 1})
        raise DataError(f"{path} has {len(twice)} scenes in more than one part, first: {twice[0]}")
    return tuple(Path(name).name for name in getattr(split, part))


def read_scene_list(path: Path, skips: Skips) -> tuple[str, ...]:
    """A list of scenes, one path a line, of which only the last component counts.

    Blank lines and comments (from # on) do not count. A line whose comment says "invalid", also one that is a comment
    altogether, as in the published lists, is a scene that is left out, and so is what is no scene name or stands there
    twice; each is counted in `skips`.

    Raises: DataError if the file cannot be read or no scene is left.
    """
    try:
        lines = read_small(path).splitlines()
    except FileError as error:
        raise DataError(f"{path} is no list of scenes: it {error}") from error
    scenes: list[str] = []
    for number, line in enumerate(lines, 1):
        name, reason = _entry(line)
        if name and not reason and name in scenes:
            reason = "stands there twice"
        if reason:
            skips.add(name, path, f"line {number}: {reason}")
        elif name:
            scenes.append(name)
    if not scenes:
        raise DataError(f"{path} lists no scene; it wants one path like data/scene_000048 a line")
    return tuple(scenes)


def present(wanted: Sequence[str], available: Sequence[str], skips: Skips, origin: Path | str) -> tuple[str, ...]:
    """Those of the wanted scenes that there are; the others are counted in `skips` as told by `origin`."""
    known = set(available)
    for scene in wanted:
        if scene not in known:
            skips.add(scene, str(origin), "names a scene that is not in the data folder")
    return tuple(scene for scene in wanted if scene in known)


def require_apart(learned: Mapping[str, Path | str], held_out: Mapping[str, Path | str]) -> None:
    """The one check that nothing is measured on what was learned from: it would say nothing about other scenes.

    Scenes or episodes by name, with their world or file: of one name they are the same where the worlds are, or the
    files, byte by byte. Raises DataError naming those that are in both parts.
    """
    shared = [name for name in held_out if name in learned and _is_same(learned[name], held_out[name])]
    if shared:
        named = ", ".join(sorted(shared)[:_NAMED]) + ", ..." * (len(shared) > _NAMED)
        raise DataError(
            f"training and held-out data share {len(shared)} scenes or episodes, {named}; hold out others, or leave "
            "out --valid where a part of --data can be held out"
        )


def _is_same(one: Path | str, other: Path | str) -> bool:
    if isinstance(one, Path) and isinstance(other, Path):
        return one.is_file() and other.is_file() and cmp(one, other, shallow=False)
    return one == other


def _entry(line: str) -> tuple[str, str]:
    """Scene name (or "") of a line, and why it is left out (or "")."""
    line = line.strip()
    if line.startswith("#") and not _LIST_MARK.search(line):
        return "", ""
    place, _, comment = line.lstrip("# \t").partition("#")
    name = Path(place.strip()).name
    if line.startswith("#") and not layout_of(name):
        return "", ""  # prose that happens to say "invalid"
    if name and _LIST_MARK.search(comment):
        return name, "is marked invalid"
    if line.startswith("#"):
        return "", ""
    if name and not layout_of(name):
        return name, "is no scene name"
    return name, ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PublicSplit:
    """One part of a world's scenes. runs: of seeds, or of Kubric-4D's scene numbers, that follow each other."""

    name: str
    world: str
    runs: tuple[range, ...]

    def __contains__(self, seed: int) -> bool:
        return any(seed in run for run in self.runs)

    def __len__(self) -> int:
        return sum(map(len, self.runs))


def public_splits() -> dict[str, PublicSplit]:
    """All there are by name, such as `driving-test`; from `splits_public`."""
    found: dict[str, PublicSplit] = {}
    for file in (files("gcd_train") / "splits_public").iterdir():
        if file.name.endswith(".json"):
            told = json.loads(file.read_bytes())
            for part, runs in told["parts"].items():  # each run: the first seed, and how many
                name = f"{file.name.removesuffix('.json')}-{part}"
                each = tuple(range(first, first + count) for first, count in runs)
                found[name] = PublicSplit(name=name, world=told["world"], runs=each)
    return dict(sorted(found.items()))


def public_split(name: str) -> PublicSplit:
    """The part of that name. Raises RecipeError for another."""
    every = public_splits()
    if name not in every:
        near = difflib.get_close_matches(name, every, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(f"no split is called {name!r}, and it is no file; {meant}there are {', '.join(every)}")
    return every[name]


class _Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """Others' file: what else stands in it only informs."""

    frame_start: Annotated[int, msgspec.Meta(ge=0)]
    frame_skip: Annotated[int, msgspec.Meta(ge=1)]
    fps: float | None = None
    spherical_start: tuple[float, float, float] | None = None
    spherical_end: tuple[float, float, float] | None = None


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


_SWEPT_ELEVATION_DEG, _SWEPT_RADIUS_M = 10.0, 15.0


def write_sweep(path: Path, scenes: Sequence[str], *, step_deg: float, seed: int = 0) -> int:
    """The control list of the paper's study of angles; gives how many clips a scene has.

    Each scene is seen from an elevation of 10 degrees, 15 m away and an azimuth that follows from seed and scene, and
    the camera goes 0, `step_deg` and so on to 180 degrees to its right, for which `read_controls` has a sample each.
    Source: Van Hoorick et al. 2024 (GCD), appendix B.2.
    """
    turns = np.append(np.arange(0.0, 180.0, step_deg), 180.0)
    listed: dict[str, tuple[Control, ...]] = {}
    for scene in scenes:
        azimuth_deg = float(generator(seed, scene_number(scene)).uniform(0.0, 360.0))
        start = Spherical(azimuth_deg=azimuth_deg, elevation_deg=_SWEPT_ELEVATION_DEG, radius_m=_SWEPT_RADIUS_M)
        listed[scene] = tuple(
            Control(
                name=f"sample_{place:02d}",
                frame_start=_RELEASED_START,
                frame_skip=_RELEASED_SKIP,
                start=start,
                goal=replace(start, azimuth_deg=azimuth_deg + turn),
            )
            for place, turn in enumerate(turns.tolist())
        )
    write_controls(path, listed)
    return len(turns)


def write_controls(path: Path, controls: Controls) -> None:
    """What `read_controls` reads. Raises RunError."""

    def numbers(camera: Spherical | None) -> tuple[float, float, float] | None:
        return None if camera is None else (camera.azimuth_deg, camera.elevation_deg, camera.radius_m)

    def entry(each: Control) -> _Entry:
        return _Entry(each.frame_start, each.frame_skip, None, numbers(each.start), numbers(each.goal))

    listed = {scene: {each.name: entry(each) for each in samples} for scene, samples in controls.items()}
    write_whole(path, msgspec.json.format(msgspec.json.encode(listed)))


PAPER_ELEVATION_DEG = 5.0
"""How high the source camera stands in the paper's evaluation on Kubric-4D."""
RELEASED_SOURCE = Spherical(azimuth_deg=20.0, elevation_deg=10.0, radius_m=15.0)
"""Where the released script's source camera stands without controls."""
_RELEASED_CHANGE = SphericalDelta(azimuth_deg=30.0, elevation_deg=15.0, radius_m=0.0)  # where it goes from there
_RELEASED_START, _RELEASED_SKIP = 0, 2  # its first frame and stride


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneControls:
    """Which clips are cut from each scene; the same for a scene whatever others there are.

    clips: of each scene, at most. sampling: how they are drawn, from the seed and the scene's number; those of an orbit
    have one source and the same frames, and differ in the goal. listed: clips by scene, instead of drawn ones. start,
    skip: first frame and stride of every clip, whatever is listed or drawn; None for those.
    """

    clips: int
    sampling: Sampling
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
