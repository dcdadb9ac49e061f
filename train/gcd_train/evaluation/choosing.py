"""Which scenes of a folder are measured: of a split, of a list, or the first few."""

import difflib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import get_args

import msgspec

from gcd_train.datasets.skips import Skips
from gcd_train.datasets.splits import Part, present, read_scene_list, read_split
from gcd_train.errors import DataError, RecipeError
from gcd_train.layouts import kubric4d_names, parallel_domain4d_names
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


def public_split_names() -> tuple[str, ...]:
    """All there are, by name."""
    return tuple(sorted(f"{stem}-{part}" for stem, world in _worlds().items() for part in world.parts))


def _worlds() -> dict[str, _World]:
    """By the name of their file."""
    found = [file for file in (files("gcd_train") / "splits_public").iterdir() if file.name.endswith(".json")]
    return {file.name.removesuffix(".json"): msgspec.json.decode(file.read_bytes(), type=_World) for file in found}


def public_split(name: str) -> PublicSplit:
    """The part of that name. Raises RecipeError for another."""
    if name not in public_split_names():
        near = difflib.get_close_matches(name, public_split_names(), n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(
            f"no split is called {name!r}, and it is no file; {meant}there are {', '.join(public_split_names())}"
        )
    stem, _, part = name.rpartition("-")
    world = _worlds()[stem]
    runs = tuple(range(first, first + count) for first, count in world.parts[part])
    return PublicSplit(name=name, world=world.world, runs=runs)


_PARTS: dict[str, Part] = {part: part for part in get_args(Part)}


@dataclass(frozen=True, kw_only=True, slots=True)
class Choice:
    """Which scenes of a folder. split: a public one's name, or a split file with `:train`, `:val` or `:test` after it.

    listed: a file with a scene a line. limit: only the first so many.
    """

    split: str | None = None
    listed: Path | None = None
    limit: int | None = None


def pairs_of_split(name: str, scenes: Collection[tuple[str, int]], notes: Skips) -> set[tuple[str, int]]:
    """Scenes of pairs, each a world and a seed, that are of a public split. notes: gets what is missing.

    Raises: RecipeError for no such split, DataError where none of the scenes is of its world.
    """
    split = public_split(name)
    worlds = sorted({world for world, _ in scenes})
    if split.world not in worlds:
        raise _of_another_world(split, f"these pairs are of {', '.join(worlds) or 'none'}")
    wanted = {(world, seed) for world, seed in scenes if world == split.world and seed in split}
    _note_missing(split, {seed for _, seed in wanted}, notes)
    return wanted


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
        return present(read_scene_list(choice.listed, notes).scenes, there, notes, choice.listed)
    if choice.split is None:
        return tuple(there)
    place, _, part = choice.split.rpartition(":")
    file = Path(place if part in _PARTS and place else choice.split)
    if file.is_file():
        return present(read_split(file, _PARTS.get(part, "test")), there, notes, file)
    return _of_public_split(folder, there, public_split(choice.split), notes)


def _of_public_split(folder: Path, there: Sequence[str], split: PublicSplit, notes: Skips) -> tuple[str, ...]:
    scenes = tuple(scene for scene in there if _seed(scene) in split)
    for scene in scenes or there[:1]:
        world = _world(folder / scene)
        if world != split.world:
            raise _of_another_world(split, f"{folder / scene} is of {world}")
    _note_missing(split, {_seed(scene) for scene in scenes}, notes)
    return scenes


def _of_another_world(split: PublicSplit, came: str) -> DataError:
    return DataError(f"--split {split.name} is for the world {split.world}, but {came}; give another --split or --data")


def _world(scene: Path) -> str:
    """As its manifest says; a scene without one was published, and counts as its layout."""
    if (scene / MANIFEST).is_file():
        return read_manifest(scene).world
    return "kubric4d" if kubric4d_names.scene_number(scene.name) is not None else "parallel_domain4d"


def _note_missing(split: PublicSplit, there: set[int], notes: Skips) -> None:
    """A part that is open-ended in practice, as `train`, is not missed."""
    if there and len(there) < len(split) and not split.name.endswith("-train"):
        notes.add(split.name, "--data", f"has {len(there)} of its {len(split)} scenes")


def _seed(scene: str) -> int:
    number = kubric4d_names.scene_number(scene)
    return (parallel_domain4d_names.scene_number(scene) or 0) if number is None else number
