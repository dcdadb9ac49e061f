"""From the folders and options of a user to the clips that are measured."""

import difflib
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import msgspec

from gcd_model import Traits
from gcd_model.geometry import CameraMount
from gcd_model.small_files import read_small
from gcd_train.data.files import Skips
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.pairs import PairedClips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import CLIP, DRIVING_FRAMES, KUBRIC_FRAMES, DrivingSampling, FrameSampling, OrbitSampling
from gcd_train.data.pictures import PictureOptions, ViewPairs
from gcd_train.data.splits import MOST_BYTES, Part, present, read_controls, read_scene_list, read_split
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.clips import EvaluationSet, PairedSet, SceneSet, chosen
from gcd_train.evaluation.protocol import (
    AS_PLANNED,
    SAMPLES,
    ClipControls,
    DrawnControls,
    FrameBounds,
    ListedControls,
    ProtocolName,
    controlled,
    orbit_notes,
    released_controls,
    require_cameras,
    scene_number,
)
from gcd_train.layouts import kubric4d, parallel_domain4d
from gcd_train.layouts.manifest import MANIFEST, read_manifest


class _World(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file of `splits_public`. parts: name to runs of scenes, each the first seed and how many."""

    about: str
    world: str
    parts: dict[str, tuple[tuple[int, int], ...]]


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
    """All there are by name, such as `driving-test`."""
    found: dict[str, PublicSplit] = {}
    for file in (files("gcd_train") / "splits_public").iterdir():
        if file.name.endswith(".json"):
            told = msgspec.json.decode(file.read_bytes(), type=_World)
            for part, runs in told.parts.items():
                name = f"{file.name.removesuffix('.json')}-{part}"
                each = tuple(range(first, first + count) for first, count in runs)
                found[name] = PublicSplit(name=name, world=told.world, runs=each)
    return dict(sorted(found.items()))


def public_split(name: str) -> PublicSplit:
    """The part of that name. Raises RecipeError for another."""
    every = public_splits()
    if name not in every:
        near = difflib.get_close_matches(name, every, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(f"no split is called {name!r}, and it is no file; {meant}there are {', '.join(every)}")
    return every[name]


_PARTS: dict[str, Part] = {part: part for part in get_args(Part)}


@dataclass(frozen=True, kw_only=True, slots=True)
class Choice:
    """Which scenes of a folder. split: a public one's name, or a split file with `:train`, `:val` or `:test` after it.

    listed: a file with a scene a line. limit: only the first so many.
    """

    split: str | None = None
    listed: Path | None = None
    limit: int | None = None


def wanted_scenes(folder: Path, there: Sequence[str], choice: Choice, notes: Skips) -> tuple[str, ...]:
    """Whole scenes of a folder that are chosen, whatever the limit. notes: gets what is missing.

    Args:
        there: names of the scenes in the folder.
    Raises:
        RecipeError: a list and a split, or no such split. DataError: a list cannot be read, or the split is of another
            world than the scenes.
    """
    if choice.listed is not None and choice.split is not None:
        raise RecipeError("give --list or --split, not both")
    if choice.listed is not None:
        return present(read_scene_list(choice.listed, notes), there, notes, choice.listed)
    if choice.split is None:
        return tuple(there)
    place, _, part = choice.split.rpartition(":")
    file = Path(place if part in _PARTS and place else choice.split)
    if file.is_file():
        return present(read_split(file, _PARTS.get(part, "test")), there, notes, file)
    split = public_split(choice.split)
    scenes = tuple(scene for scene in there if scene_number(scene) in split)
    for scene in scenes or there[:1]:
        if (folder / scene / MANIFEST).is_file():
            world = read_manifest(folder / scene).world
        else:  # it was published, and counts as its layout
            world = "kubric4d" if kubric4d.scene_number(scene) is not None else "parallel_domain4d"
        if world != split.world:
            raise _of_another_world(split, f"{folder / scene} is of {world}")
    _note_missing(split, {scene_number(scene) for scene in scenes}, notes)
    return scenes


def _of_another_world(split: PublicSplit, came: str) -> DataError:
    return DataError(f"--split {split.name} is for the world {split.world}, but {came}; give another --split or --data")


def _note_missing(split: PublicSplit, there: set[int], notes: Skips) -> None:
    """A part that is open-ended in practice, as `train`, is not missed."""
    if there and len(there) < len(split) and not split.name.endswith("-train"):
        notes.add(split.name, "--data", f"has {len(there)} of its {len(split)} scenes")


DataKind: TypeAlias = Literal["pairs", "kubric4d", "parallel_domain4d"]
"""What a folder holds."""

_SMALL_BYTES = 4 << 20


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneCuts:
    """How clips are cut from whole scenes.

    controls: a control list, None for the protocol's own. clips: of each scene, None for the protocol's number.
    bounds: first frame and stride of the command line. far: up to 180 degrees of azimuth and 60 of elevation, not 90
    and 30. gradual: the camera moves through the clip; otherwise it is at the goal from the first frame on.
    semantic: targets are painted in the colours of their classes. exact: drawn from the geometry of our own scenes.
    cameras: that a scene must have, None for the published ones. frames, height, width: T, H and W.
    """

    protocol: ProtocolName = "paper"
    controls: Path | None = None
    clips: int | None = None
    seed: int = 0
    bounds: FrameBounds = AS_PLANNED
    far: bool = False
    gradual: bool = True
    semantic: bool = False
    exact: bool = False
    cameras: tuple[str, ...] | None = None
    frames: int = CLIP
    height: int = 256
    width: int = 384

    @classmethod
    def suiting(cls, model: Traits | None) -> "SceneCuts":
        """As the weights were trained; the usual ones without weights."""
        if model is None:
            return cls()
        family, config = model.family, model.config
        return cls(
            gradual=model.move_time > 0,
            semantic=family is not None and family.output == "semantic",
            frames=config.frames,
            height=config.height,
            width=config.width,
        )


def data_kind(folders: Sequence[Path]) -> DataKind:
    """What the folders hold. Raises DataError for nothing that is known, or several folders of scenes."""
    try:
        names = [path.name for path in folders[0].iterdir()]
    except OSError as error:
        raise DataError(f"{folders[0]} cannot be read ({error}); give a folder with pairs or with scenes") from error
    if any(kubric4d.scene_number(name) is not None for name in names):
        found: DataKind = "kubric4d"
    elif any(parallel_domain4d.scene_number(name) is not None for name in names):
        found = "parallel_domain4d"
    else:
        return "pairs"
    if len(folders) > 1:
        raise DataError(f"scenes are taken from one folder, got {len(folders)}; give one --data, or pairs")
    return found


def usual_samples(folders: Sequence[Path], protocol: ProtocolName) -> int:
    """Draws of each view by default. Raises DataError as `data_kind`."""
    return 1 if data_kind(folders) == "pairs" else SAMPLES[protocol]


def open_pairs(
    folders: Sequence[Path], choice: Choice, mount: CameraMount | None
) -> tuple[EvaluationSet, tuple[str, ...]]:
    """Pairs of the folders; and what of the split is not there, line by line.

    Args:
        mount: what everybody is told of the source camera of driving clips; None for the usual one.
    Raises:
        DataError: see `PairedClips.open`; or the split is of another world. RecipeError: a list, no such split, or a
            mount where there is no vehicle.
    """
    if choice.listed is not None:
        raise RecipeError("--list names whole scenes, and these are pairs; give --split NAME, or leave it out")
    clips = PairedClips.open([folder.resolve() for folder in folders])  # processes may stand elsewhere
    notes, wanted = Skips(logged=False), None
    if choice.split is not None:
        split, scenes = public_split(choice.split), {clips.scene(number) for number in range(len(clips))}
        worlds = sorted({world for world, _ in scenes})
        if split.world not in worlds:
            raise _of_another_world(split, f"these pairs are of {', '.join(worlds) or 'none'}")
        wanted = {(world, seed) for world, seed in scenes if world == split.world and seed in split}
        _note_missing(split, {seed for _, seed in wanted}, notes)
    if clips.camera != "none" and mount is not None:
        raise RecipeError("these clips have no vehicle to mount a camera on: leave out --declared-height and -tilt")
    declared = mount or CameraMount() if clips.camera == "none" else None
    some = chosen(clips, scenes=wanted, limit=choice.limit)
    return PairedSet.of(some, declared=declared), tuple(notes.lines())


def open_scenes(folder: Path, choice: Choice, cuts: SceneCuts) -> tuple[EvaluationSet, tuple[str, ...]]:
    """Whole scenes, in either layout; and what of the list is not there or is odd, line by line.

    Raises:
        DataError: no scene is left, or a list or a control list cannot be read. RecipeError: options that contradict
            each other, or no such split.
    """
    folder = folder.resolve()  # processes may stand elsewhere
    orbits, notes = data_kind([folder]) == "kubric4d", Skips(logged=False)
    whole = _dataset(folder, cuts, orbits=orbits)
    controls = _controls(cuts, whole.scenes, orbits=orbits)
    scenes = wanted_scenes(folder, whole.scenes, choice, notes)
    scenes = controlled(scenes, controls, cuts.controls, folder, notes)[: choice.limit]
    data = whole.only(scenes)
    odd: tuple[str, ...] = ()
    if orbits and cuts.controls is not None and isinstance(controls, ListedControls):
        odd = orbit_notes(controls, scenes, cuts.controls)
    require_cameras(data)
    pairs = ViewPairs(
        data,
        _sampling(cuts, orbits=orbits),
        cuts.seed,
        PictureOptions(
            size=(cuts.width, cuts.height),
            modality="classes" if cuts.semantic else "rgb",
            class_ids=cuts.semantic,
            visible=True,
            exact=cuts.exact,
            published=cuts.protocol == "release",
        ),
    )
    clips = SceneSet(
        pairs=pairs,
        controls=controls,
        frames=cuts.frames,
        height=cuts.height,
        width=cuts.width,
        kind="kubric" if orbits else "driving",
        identity=_identity(folder, scenes, cuts),
        semantic=cuts.semantic,
    )
    return clips, (*notes.lines(), *odd)


def _dataset(folder: Path, cuts: SceneCuts, *, orbits: bool) -> Kubric4D | ParallelDomain4D:
    names = kubric4d.CAMERAS if orbits else parallel_domain4d.CAMERAS
    if not orbits:
        return ParallelDomain4D.open(folder, cameras=cuts.cameras or names, classes=cuts.semantic)
    if cuts.semantic:
        raise RecipeError("Kubric-4D has no classes: leave out --modality semantic")
    return Kubric4D.open(folder, cameras=cuts.cameras or names, published=cuts.protocol == "release")


def _controls(cuts: SceneCuts, scenes: Sequence[str], *, orbits: bool) -> ClipControls:
    clips = cuts.clips or (4 if cuts.protocol == "paper" and orbits else 1)
    if cuts.controls is not None:
        if cuts.protocol == "paper" and cuts.bounds != AS_PLANNED:
            raise RecipeError(
                "the paper's protocol takes frames from the controls; leave out --frame-start and --frame-skip, or "
                "give --protocol release"
            )
        return ListedControls(controls=read_controls(cuts.controls), clips=clips, bounds=cuts.bounds)
    if cuts.protocol == "release":
        return ListedControls(controls=released_controls(scenes, orbit=orbits), clips=clips, bounds=cuts.bounds)
    sampling = _sampling(cuts, orbits=orbits)
    orbit = sampling if isinstance(sampling, OrbitSampling) else None
    return DrawnControls(seed=cuts.seed, clips=clips, frames=sampling.frames, orbit=orbit, bounds=cuts.bounds)


def _sampling(cuts: SceneCuts, *, orbits: bool) -> OrbitSampling | DrivingSampling:
    """How goals, first frames and strides are drawn."""
    usual = KUBRIC_FRAMES if orbits else DRIVING_FRAMES
    frames = FrameSampling(clip=cuts.frames, strides=usual.strides, latest_start=usual.latest_start)
    move_time = None if cuts.gradual else 0
    if not orbits:
        return DrivingSampling(move_time=move_time, frames=frames)
    azimuth_deg, elevation_deg = (180.0, 60.0) if cuts.far else (90.0, 30.0)
    return OrbitSampling(
        max_azimuth_deg=azimuth_deg,
        max_elevation_deg=elevation_deg,
        move_time=None if cuts.gradual else 0,
        frames=frames,
    )


def _identity(folder: Path, scenes: Sequence[str], cuts: SceneCuts) -> str:
    """Of the scenes by name and files, and how clips are cut."""
    digest = hashlib.sha256(msgspec.json.encode(replace(cuts, controls=None), order="sorted"))
    if cuts.controls is not None:
        digest.update(read_small(cuts.controls, MOST_BYTES).encode())
    for scene in scenes:
        digest.update(scene.encode() + fingerprint(folder / scene))
    return digest.hexdigest()[:12]


def fingerprint(folder: Path) -> bytes:
    """Digest of the names and sizes of all files below, and of what small JSON files say.

    Pictures are not read, and times do not count: a copy has the same fingerprint. What begins with a dot is left out,
    as file browsers leave such things.

    Raises:
        DataError: the folder or a file cannot be read.
    """
    digest, found = hashlib.sha256(), dict[str, Path]()

    def passed_on(error: OSError) -> None:
        raise error

    try:
        for place, folders, names in os.walk(folder, onerror=passed_on, followlinks=True):
            folders[:] = [name for name in folders if not name.startswith(".")]
            paths = [Path(place) / name for name in names if not name.startswith(".")]
            found |= {path.relative_to(folder).as_posix(): path for path in paths}
        for name, size in sorted((name, path.stat().st_size) for name, path in found.items()):
            digest.update(f"{name} {size}\n".encode())
            if name.endswith(".json") and size <= _SMALL_BYTES and found[name].is_file():
                digest.update(hashlib.sha256(found[name].read_bytes()).digest())
    except OSError as error:
        raise DataError(f"{folder} cannot be read ({error}); look at the scene, or leave it out with --list") from error
    return digest.digest()
