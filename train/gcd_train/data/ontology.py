"""Classes of a data set, read from the set itself: ids, names, colours, and the way from one to the other."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.config import SemanticClass
from gcd_model.errors import FileError
from gcd_model.small_files import decode_json
from gcd_train.data.files import MOST_TEXT, read
from gcd_train.data.skips import FileFault
from gcd_train.errors import DataError

Bytes = NDArray[np.uint8]

VOID = 255
"""Id of what belongs to no class (ParallelDomain)."""
_IDS = 256
_ROWS = 16_384


@dataclass(frozen=True, kw_only=True, slots=True)
class OntologyItem:
    """One class. id: 0..255. colour: RGB, 0..255."""

    id: int
    name: str
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class Ontology:
    """Classes by id. Raises DataError for no class, an id twice, or an id or colour outside 0..255."""

    items: tuple[OntologyItem, ...]

    def __post_init__(self) -> None:
        ids = [item.id for item in self.items]
        if not ids:
            raise DataError("an ontology needs at least one class, got none")
        if len(set(ids)) < len(ids):
            raise DataError(f"an ontology has each id once, got {sorted({i for i in ids if ids.count(i) > 1})} twice")
        if min(ids) < 0 or max(ids) >= _IDS:
            raise DataError(f"class ids lie within 0..255, got {min(ids)}..{max(ids)}")
        if not all(0 <= channel <= 255 for item in self.items for channel in item.colour):
            raise DataError("colours lie within 0..255, got others")
        object.__setattr__(self, "items", tuple(sorted(self.items, key=lambda item: item.id)))

    @cached_property
    def palette(self) -> Bytes:
        """u8 [256, 3]: colour by id, black where there is no class."""
        colours = np.zeros((_IDS, 3), np.uint8)
        for item in self.items:
            colours[item.id] = item.colour
        return colours

    @cached_property
    def duplicates(self) -> tuple[tuple[int, ...], ...]:
        """Groups of ids that share a colour and so cannot be told apart in a picture; report them to the user."""
        groups: dict[tuple[int, int, int], list[int]] = {}
        for item in self.items:
            groups.setdefault(item.colour, []).append(item.id)
        return tuple(tuple(ids) for ids in groups.values() if len(ids) > 1)

    @property
    def merged_names(self) -> tuple[str, ...]:
        """One line for each group of `duplicates`, with the names."""
        names = {item.id: item.name for item in self.items}
        return tuple(", ".join(f"{names[i]} ({i})" for i in group) for group in self.duplicates)

    @cached_property
    def classes(self) -> tuple[SemanticClass, ...]:
        """The ids without gaps, those that share a colour as the lowest of them alone; see `places`."""
        return tuple(SemanticClass(name=item.name, colour=item.colour) for item in self._told_apart)

    @cached_property
    def places(self) -> Bytes:
        """u8 [256]: the place in `classes` of each id; of an unlisted one that of void, or 255 without void."""
        places = np.full(_IDS, VOID, np.uint8)
        for place, item in enumerate(self._told_apart):
            places[item.id] = place
        places = places[self._representatives]
        listed = {item.id for item in self.items}
        if VOID in listed:
            places[[i for i in range(_IDS) if i not in listed]] = places[VOID]
        return places

    @property
    def _told_apart(self) -> list[OntologyItem]:
        return [item for item in self.items if self._representatives[item.id] == item.id]

    @cached_property
    def _representatives(self) -> Bytes:
        table = np.arange(_IDS, dtype=np.uint8)
        for group in self.duplicates:
            table[list(group)] = group[0]
        return table

    def merge(self, ids: Bytes) -> Bytes:
        """Ids with those that share a colour replaced by the lowest of them; as `decode` gives them."""
        return self._representatives[ids]

    def encode(self, ids: Bytes) -> Bytes:
        """Ids u8 [...] as colours u8 [..., 3]; an id without a class is black."""
        return self.palette[ids]

    def decode(self, colours: Bytes) -> Bytes:
        """The class with the nearest colour in RGB: u8 [..., 3] -> ids u8 [...], the lowest id where several tie."""
        ids = np.array([item.id for item in self.items], np.uint8)
        # |c - p|^2 without |c|^2, which is alike for all p; whole numbers below 2^24, so float32 is exact.
        points = self.palette[ids].astype(np.float32)
        half = (points**2).sum(-1) / 2
        flat = colours.reshape(-1, 3)
        nearest = np.empty(len(flat), np.uint8)
        for start in range(0, len(flat), _ROWS):
            rows = flat[start : start + _ROWS].astype(np.float32)
            nearest[start : start + _ROWS] = ids[(half - rows @ points.T).argmin(-1)]
        return nearest.reshape(colours.shape[:-1])


def read_ontology(folder: Path) -> Ontology:
    """The ontology in a scene's `ontology` folder: the first JSON of it that lists classes.

    Raises: FileFault if there is none, or it is damaged.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise FileFault(folder, "holds no JSON: class ids cannot be named; download or generate the scene again")
    faults: list[FileFault] = []
    for path in paths:
        try:
            return _parsed(path)
        except FileFault as fault:
            faults.append(fault)
    raise faults[0]


class _Colour(msgspec.Struct, frozen=True):
    r: int
    g: int
    b: int


class _Item(msgspec.Struct, frozen=True):
    """Others' file: what else stands in it is theirs."""

    id: int
    name: str
    color: _Colour


class _File(msgspec.Struct, frozen=True):
    items: tuple[_Item, ...]


def _parsed(path: Path) -> Ontology:
    try:
        items = decode_json(read(path, MOST_TEXT), _File).items
        return Ontology(
            tuple(
                OntologyItem(id=item.id, name=item.name, colour=(item.color.r, item.color.g, item.color.b))
                for item in items
                if 0 <= item.id < _IDS
            )
        )
    except FileError as error:
        raise FileFault(path, f"is no ontology: it {error}") from error
    except FileFault:
        raise
    except DataError as error:
        raise FileFault(path, f"is no usable ontology: {error}") from error
