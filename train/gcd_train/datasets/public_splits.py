"""Fixed parts of the generated worlds and of Kubric-4D, shipped with the package and used by name: `driving-test`."""

import difflib
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable

import msgspec

from gcd_train.errors import RecipeError


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
    worlds = {
        file.name.removesuffix(".json"): _read(file) for file in _folder().iterdir() if file.name.endswith(".json")
    }
    return tuple(sorted(f"{stem}-{part}" for stem, world in worlds.items() for part in world.parts))


def public_split(name: str) -> PublicSplit:
    """The part of that name. Raises RecipeError for another."""
    if name not in public_split_names():
        near = difflib.get_close_matches(name, public_split_names(), n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        raise RecipeError(
            f"no split is called {name!r}, and it is no file; {meant}there are {', '.join(public_split_names())}"
        )
    stem, _, part = name.rpartition("-")
    world = _read(_folder() / f"{stem}.json")
    runs = tuple(range(first, first + count) for first, count in world.parts[part])
    return PublicSplit(name=name, world=world.world, runs=runs)


def _folder() -> Traversable:
    return files("gcd_train") / "splits_public"


def _read(file: Traversable) -> _World:
    return msgspec.json.decode(file.read_bytes(), type=_World)
