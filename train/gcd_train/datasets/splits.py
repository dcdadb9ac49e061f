"""Which scenes are for training, validation and test: by number, by split file, by list."""

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import msgspec

from gcd_model.errors import FileError
from gcd_model.small_files import read_json, read_small
from gcd_train.datasets.skips import Skips
from gcd_train.errors import DataError
from gcd_train.layouts import kubric4d, parallel_domain4d

Part = Literal["train", "val", "test"]

_KUBRIC_RANGES: dict[Part, range] = {"train": range(2800), "val": range(2800, 2900), "test": range(2900, 3000)}
_NAMED = 5  # scenes in a message
_LIST_MARK = re.compile(r"\binvalid\b", re.IGNORECASE)


class SplitFile(msgspec.Struct, frozen=True, kw_only=True):
    """ParallelDomain-4D's split. Others' file: counts and seed that stand in it are not needed."""

    train: tuple[str, ...]
    val: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class SceneList:
    """Scenes of a list in its order, each once, and how many of its lines were left out."""

    scenes: tuple[str, ...]
    left_out: int


def kubric_split(scenes: Iterable[str], part: Part) -> tuple[str, ...]:
    """The scenes of one part of Kubric-4D, by number: 0-2799 train, 2800-2899 val, 2900-2999 test.

    Raises: DataError for another part.
    """
    wanted = _KUBRIC_RANGES[_require_part(part)]
    return tuple(scene for scene in scenes if kubric4d.scene_number(scene) in wanted)


def read_split(path: Path, part: Part) -> tuple[str, ...]:
    """The scenes of one part of a ParallelDomain-4D split file, in its order.

    Raises: DataError if it cannot be read, or a scene is in two parts.
    """
    _require_part(part)
    try:
        split = read_json(path, SplitFile)
    except FileError as error:
        raise DataError(f"{path} is no split file with lists train, val and test: it {error}") from error
    scenes = [Path(name).name for name in (*split.train, *split.val, *split.test)]
    if len(set(scenes)) < len(scenes):
        twice = sorted({name for name in scenes if scenes.count(name) > 1})
        raise DataError(f"{path} has {len(twice)} scenes in more than one part, first: {twice[0]}")
    chosen: dict[Part, tuple[str, ...]] = {"train": split.train, "val": split.val, "test": split.test}
    return tuple(Path(name).name for name in chosen[part])


def read_scene_list(path: Path, skips: Skips) -> SceneList:
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
    left_out = 0
    for number, line in enumerate(lines, 1):
        name, reason = _entry(line)
        if name and not reason and name in scenes:
            reason = "stands there twice"
        if reason:
            skips.add(name, path, f"line {number}: {reason}")
            left_out += 1
        elif name:
            scenes.append(name)
    if not scenes:
        raise DataError(f"{path} lists no scene; it wants one path like data/scene_000048 a line")
    return SceneList(scenes=tuple(scenes), left_out=left_out)


def present(wanted: Sequence[str], available: Sequence[str], skips: Skips, origin: Path | str) -> tuple[str, ...]:
    """Those of the wanted scenes that there are; the others are counted in `skips` as told by `origin`."""
    known = set(available)
    for scene in wanted:
        if scene not in known:
            skips.add(scene, str(origin), "names a scene that is not in the data folder")
    return tuple(scene for scene in wanted if scene in known)


def require_none_shared(scenes: Collection[str]) -> None:
    """Raises DataError naming the scenes or episodes that are to learn from and held out, if there are any: what was
    learned from them says nothing about others."""
    if scenes:
        named = ", ".join(sorted(scenes)[:_NAMED]) + ", ..." * (len(scenes) > _NAMED)
        raise DataError(
            f"training and held-out data share {len(scenes)} scenes or episodes, {named}; hold out others, or leave "
            "out --valid where a part of --data can be held out"
        )


def _require_part(part: Part) -> Part:
    if part not in get_args(Part):
        raise DataError(f"a split has the parts train, val and test, got {part!r}")
    return part


def _entry(line: str) -> tuple[str, str]:
    """Scene name (or "") of a line, and why it is left out (or "")."""
    line = line.strip()
    if line.startswith("#") and not _LIST_MARK.search(line):
        return "", ""
    place, _, comment = line.lstrip("# \t").partition("#")
    name = Path(place.strip()).name
    if line.startswith("#") and not _is_scene(name):
        return "", ""  # prose that happens to say "invalid"
    if name and _LIST_MARK.search(comment):
        return name, "is marked invalid"
    if line.startswith("#"):
        return "", ""
    if name and not _is_scene(name):
        return name, "is no scene name"
    return name, ""


def _is_scene(name: str) -> bool:
    numbers: tuple[Callable[[str], int | None], ...] = (
        kubric4d.scene_number,
        parallel_domain4d.scene_number,
    )
    return any(number(name) is not None for number in numbers)
