"""From the folders and options of a user to the clips that are measured.

Of whole scenes as in the paper, or as its released test script does:
Paper: one part of each scene's video, in Kubric-4D seen on the way to four goals. The source stands at an elevation of
5 degrees, all else is drawn, goals up to 90 degrees away whatever the model; a control list fixes all of it. Source:
Van Hoorick et al. 2024 (GCD), appendix.
Release: the first clip of each scene's controls, or the script's own angles; frames of the command line win.
AnyViewBench: the first frames of each episode, at its own grid; see `anyview`.
"""

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias, get_args

from typer import Option

from gcd_model import Traits
from gcd_model.small_files import read_small
from gcd_train.data import kubric4d, parallel_domain4d
from gcd_train.data.anyview import SPLITS
from gcd_train.data.dataset4d import Dataset4D, LayoutName, layout_in, layout_of, scene_number
from gcd_train.data.files import MANIFEST, Skips, read_manifest
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.data.pairs import PairedClips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import (
    CLIP,
    DRIVING_FRAMES,
    KUBRIC_FRAMES,
    MAX90,
    MAX180,
    Controls,
    DrivingSampling,
    FrameSampling,
    OrbitSampling,
    Sampling,
)
from gcd_train.data.pictures import PictureOptions, ViewPairs
from gcd_train.data.splits import (
    MOST_BYTES,
    Part,
    PublicSplit,
    SceneControls,
    present,
    public_split,
    read_controls,
    read_scene_list,
    read_split,
    released_controls,
)
from gcd_train.errors import DataError, RecipeError
from gcd_train.evaluation.anyview import EpisodeSet
from gcd_train.evaluation.clips import FURTHER_CAMERAS, EvaluationSet, PairedSet, SceneSet, chosen

ProtocolName: TypeAlias = Literal["paper", "release", "anyviewbench"]
SAMPLES: dict[ProtocolName, int] = {"paper": 4, "release": 2, "anyviewbench": 1}
"""Draws of each clip of a scene; of pairs, which no protocol cuts, there is one."""
Size: TypeAlias = tuple[int, int, int]
"""T, H and W of clips."""

_PARTS: dict[str, Part] = {part: part for part in get_args(Part)}
_OF_SCENES = ("controls", "trajectories", "frame_start", "frame_skip", "angles", "path", "modality", "exact", "camera")
_SMALL_BYTES = 4 << 20


@dataclass(frozen=True, kw_only=True, slots=True)
class ClipOptions:
    """Which clips are measured: options of `gcd-train evaluate`. None: left out."""

    data: Annotated[
        list[Path], Option(help="Folder of pairs (several may be given), one of whole scenes, or AnyViewBench.")
    ]
    protocol: Annotated[ProtocolName, Option(help="How clips are cut from scenes, or from AnyViewBench.")] = "paper"
    frames: Annotated[
        int | None, Option(min=3, help="AnyViewBench: of each clip; by default as the weights, else 1 + 4 k up to 41.")
    ] = None
    controls: Annotated[Path | None, Option(help="Scenes: control list, JSON.")] = None
    split: Annotated[str | None, Option(help="Only scenes of a split: a name as driving-test, or FILE:test.")] = None
    listed: Annotated[Path | None, Option("--list", help="Scenes: only those of a list, one a line.")] = None
    limit: Annotated[int | None, Option(min=1, help="Only the first so many scenes, or episodes of a split.")] = None
    trajectories: Annotated[int | None, Option(min=1, help="Scenes: clips of each; by default the protocol's.")] = None
    frame_start: Annotated[int | None, Option(min=0, help="Scenes: first frame of every clip.")] = None
    frame_skip: Annotated[int | None, Option(min=1, help="Scenes: frames from one of the clip to the next.")] = None
    angles: Annotated[Literal["max90", "max180"] | None, Option(help="Scenes: reach of goals; else max90.")] = None
    path: Annotated[Literal["gradual", "direct"] | None, Option(help="Scenes: as the weights by default.")] = None
    modality: Annotated[Literal["rgb", "semantic"] | None, Option(help="Scenes: targets; else as the weights.")] = None
    exact: Annotated[bool, Option("--exact", help="Our scenes: targets from geometry instead of points.")] = False
    camera: Annotated[
        list[str] | None,
        Option(help="Scenes: a camera to read; may be repeated. By default all. Episodes: the input, then the target."),
    ] = None
    seed: Annotated[int, Option(min=0, help="Of drawn clips and of all noise.")] = 0


def wanted_scenes(folder: Path, there: Sequence[str], options: ClipOptions, notes: Skips) -> tuple[str, ...]:
    """Whole scenes of a folder that are chosen, whatever the limit. notes: gets what is missing.

    Args:
        there: names of the scenes in the folder.
    Raises:
        RecipeError: a list and a split, or no such split. DataError: a list cannot be read, or the split is of another
            world than the scenes.
    """
    if options.listed is not None and options.split is not None:
        raise RecipeError("give --list or --split, not both")
    if options.listed is not None:
        return present(read_scene_list(options.listed, notes), there, notes, options.listed)
    if options.split is None:
        return tuple(there)
    place, _, part = options.split.rpartition(":")
    file = Path(place if part in _PARTS and place else options.split)
    if file.is_file():
        return present(read_split(file, _PARTS.get(part, "test")), there, notes, file)
    split = public_split(options.split)
    scenes = tuple(scene for scene in there if scene_number(scene) in split)
    for scene in scenes or there[:1]:
        made_here = (folder / scene / MANIFEST).is_file()  # else it was published, and counts as its layout
        world = read_manifest(folder / scene).world if made_here else layout_of(scene)
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


def scene_layout(folders: Sequence[Path]) -> LayoutName | None:
    """The layout of the scenes in a folder; None for pairs. Raises DataError for several folders of scenes."""
    layout = layout_in(folders[0])
    if layout is not None and len(folders) > 1:
        raise DataError(f"scenes are taken from one folder, got {len(folders)}; give one --data, or pairs")
    return layout


def open_clips(
    options: ClipOptions, model: Traits | None = None, *, size: Size = (CLIP, 256, 384)
) -> tuple[EvaluationSet, tuple[str, ...]]:
    """The clips; and what of a split or list is not there, line by line.

    Args:
        model: clips of whole scenes are of its size, path and modality where the options say nothing. size: of those
            without a model.
    Raises:
        DataError: data cannot be read, are of another world than the split, or no clip is left; or a list or a control
            list cannot be read. RecipeError: options that contradict each other or the data, or no such split.
    """
    if options.protocol == "anyviewbench":
        return _open_episodes(options, model)
    if options.frames is not None:
        raise RecipeError("--frames is for --protocol anyviewbench; other clips are as long as the weights make them")
    layout = scene_layout(options.data)
    if layout is None and (options.data[0] / SPLITS).is_file():
        raise DataError(f"{options.data[0]} is in the layout of AnyViewBench; give --protocol anyviewbench")
    return _open_pairs(options) if layout is None else _open_scenes(options, layout, model, size)


def _open_episodes(options: ClipOptions, model: Traits | None) -> tuple[EvaluationSet, tuple[str, ...]]:
    """Episodes of AnyViewBench, or of our scenes in its layout."""
    others = [getattr(options, name) for name in (*_OF_SCENES, "listed") if name != "camera"]
    stated, pair = any(each is not None and each is not False for each in others), tuple(options.camera or ())
    if stated or len(options.data) > 1 or len(pair) not in (0, 2):
        raise RecipeError(
            "AnyViewBench is one --data with --split, --limit, --frames and, for other cameras than its own, --camera "
            "INPUT --camera TARGET; leave out all other choices"
        )
    frames, root = options.frames, options.data[0].resolve()  # processes may stand elsewhere
    if model is not None and not model.live:
        raise DataError(
            f"{model.name} goes a path of its own or over a sphere, and AnyViewBench's cameras are anywhere: give a "
            "live model, which takes any pose, or frames with --predictions"
        )
    if model is not None and frames not in (None, model.config.frames):
        raise RecipeError(f"{model.name} makes clips of {model.config.frames} frames, not {frames}; leave out --frames")
    frames = frames if model is None else model.config.frames
    wanted = (pair[0], pair[1]) if pair else None
    clips, notes = EpisodeSet.open(root, frames=frames, split=options.split, limit=options.limit, pair=wanted)
    folders = [each.folder.relative_to(root).as_posix() for each, _ in clips.episodes.values()]
    cuts = [options.protocol, frames, clips.groups, clips.pair]
    return replace(clips, identity=_identity(root, folders, cuts, None)), notes


def _open_pairs(options: ClipOptions) -> tuple[EvaluationSet, tuple[str, ...]]:
    if options.listed is not None:
        raise RecipeError("--list names whole scenes, and these are pairs; give --split NAME, or leave it out")
    if any(getattr(options, name) for name in _OF_SCENES) or options.frame_start == 0 or options.protocol != "paper":
        raise RecipeError(
            "these are pairs, cut when they were made: leave out --protocol, --"
            + ", --".join(name.replace("_", "-") for name in _OF_SCENES)
        )
    clips = PairedClips.open([folder.resolve() for folder in options.data])  # processes may stand elsewhere
    notes, wanted = Skips(logged=False), None
    if options.split is not None:
        split, scenes = public_split(options.split), {clips.scene(number) for number in range(len(clips))}
        worlds = sorted({world for world, _ in scenes})
        if split.world not in worlds:
            raise _of_another_world(split, f"these pairs are of {', '.join(worlds) or 'none'}")
        wanted = {(world, seed) for world, seed in scenes if world == split.world and seed in split}
        _note_missing(split, {seed for _, seed in wanted}, notes)
    return PairedSet.of(chosen(clips, scenes=wanted, limit=options.limit)), tuple(notes.lines())


def _open_scenes(
    options: ClipOptions, layout: LayoutName, model: Traits | None, size: Size
) -> tuple[EvaluationSet, tuple[str, ...]]:
    """Whole scenes, in either layout."""
    folder = options.data[0].resolve()  # processes may stand elsewhere
    orbits, notes = layout == "kubric4d", Skips(logged=False)
    painted, gradual, released = options.modality == "semantic", options.path != "direct", options.protocol == "release"
    if model is not None:
        size = (model.config.frames, model.config.height, model.config.width)
        painted = painted or (
            options.modality is None and model.family is not None and model.family.output == "semantic"
        )
        gradual = gradual and (options.path is not None or model.move_time > 0)
    if orbits and painted:
        raise RecipeError("Kubric-4D has no classes: leave out --modality semantic")
    cameras = tuple(options.camera or (kubric4d.CAMERAS if orbits else parallel_domain4d.CAMERAS))
    whole = (
        Kubric4D(folder, cameras=cameras, published=released)
        if orbits
        else ParallelDomain4D(folder, cameras=cameras, classes=painted)
    )
    sampling = _sampling(options, size[0], orbits=orbits, gradual=gradual)
    controls = _controls(options, whole.scenes, sampling)
    scenes = wanted_scenes(folder, whole.scenes, options, notes)
    scenes = controlled(scenes, controls, options.controls, folder, notes)[: options.limit]
    data = whole.only(scenes)
    require_cameras(data)
    pictures = PictureOptions(
        size=(size[2], size[1]),
        modality="classes" if painted else "rgb",
        class_ids=painted,
        visible=True,
        depth=options.exact,
        exact=options.exact,
        published=released,
    )
    drawn = (controls.clips, controls.seed, controls.start, controls.skip)
    cuts = (options.protocol, data.cameras, sampling, pictures, drawn)
    clips = SceneSet(
        pairs=ViewPairs(data, sampling, options.seed, pictures),
        controls=controls,
        frames=size[0],
        height=size[1],
        width=size[2],
        kind="kubric" if orbits else "driving",
        identity=_identity(folder, scenes, cuts, options.controls),
        classes=tuple(data.ontology.classes) if painted and data.ontology is not None else (),
        painted=painted,
        cameras=len(data.cameras) + (FURTHER_CAMERAS if orbits and options.exact else 0),
    )
    told = notes.lines()
    with suppress(DataError):  # told when it is measured
        if (own := data.lens(scenes[0])).width < size[2] and not options.exact:
            of = f"{folder} has pictures of {own.width} x {own.height}, measured at {size[2]} x {size[1]}"
            told.append(f"{of}: targets made of so few points have holes; give larger ones, or --exact for our scenes")
    return clips, tuple(told)


def _controls(options: ClipOptions, scenes: Sequence[str], sampling: Sampling) -> SceneControls:
    orbits, bound, listed = isinstance(sampling, OrbitSampling), (options.frame_start, options.frame_skip), None
    if options.controls is not None:
        if options.protocol == "paper" and bound != (None, None):
            raise RecipeError(
                "the paper's protocol takes frames from the controls; leave out --frame-start and --frame-skip, or "
                "give --protocol release"
            )
        listed = read_controls(options.controls)
    elif options.protocol == "release":
        listed = released_controls(scenes, orbit=orbits)
    return SceneControls(
        clips=options.trajectories or _clips_of(options.protocol, listed, orbits=orbits),
        sampling=sampling,
        seed=options.seed,
        listed=listed,
        start=options.frame_start,
        skip=options.frame_skip,
    )


def _clips_of(protocol: ProtocolName, listed: Controls | None, *, orbits: bool) -> int:
    """How many clips of a scene there are by default: in the paper's protocol all that are listed."""
    if protocol == "release" or (listed is None and not orbits):
        return 1
    return 4 if listed is None else max(map(len, listed.values()))


def _sampling(options: ClipOptions, clip: int, *, orbits: bool, gradual: bool) -> Sampling:
    """How goals, first frames and strides are drawn. clip: T."""
    usual = KUBRIC_FRAMES if orbits else DRIVING_FRAMES
    frames = FrameSampling(clip=clip, strides=usual.strides, latest_start=usual.latest_start)
    move_time = None if gradual else 0
    if not orbits:
        return DrivingSampling(move_time=move_time, frames=frames)
    return replace(MAX180 if options.angles == "max180" else MAX90, move_time=move_time, frames=frames)


def _identity(folder: Path, scenes: Sequence[str], cuts: Sequence[object], controls: Path | None) -> str:
    """Digest of how clips are cut, and of the names and sizes of all files of the scenes and what small JSON files say.

    Pictures are not read, and times do not count: a copy has the same identity. What begins with a dot is left out, as
    file browsers leave such things.

    Raises:
        DataError: a folder or a file cannot be read.
    """
    digest = hashlib.sha256(repr(cuts).encode())
    if controls is not None:
        digest.update(read_small(controls, MOST_BYTES).encode())

    def passed_on(error: OSError) -> None:
        raise error

    for scene in scenes:
        of_scene, found = hashlib.sha256(), dict[str, Path]()
        try:
            for place, folders, names in os.walk(folder / scene, onerror=passed_on, followlinks=True):
                folders[:] = [name for name in folders if not name.startswith(".")]
                paths = [Path(place) / name for name in names if not name.startswith(".")]
                found |= {path.relative_to(folder / scene).as_posix(): path for path in paths}
            for name, size in sorted((name, path.stat().st_size) for name, path in found.items()):
                of_scene.update(f"{name} {size}\n".encode())
                if name.endswith(".json") and size <= _SMALL_BYTES and found[name].is_file():
                    of_scene.update(hashlib.sha256(found[name].read_bytes()).digest())
        except OSError as error:
            raise DataError(
                f"{folder / scene} cannot be read ({error}); look at the scene, or leave it out with --list"
            ) from error
        digest.update(scene.encode() + of_scene.digest())
    return digest.hexdigest()[:12]


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
