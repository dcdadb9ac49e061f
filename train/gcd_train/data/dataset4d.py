"""Scenes seen by several cameras at once: what both published sets have in common, and the classes of one."""

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, Self

import msgspec
import numpy as np
from msgspec.structs import astuple
from numpy.typing import NDArray

from gcd_model.config import SemanticClass
from gcd_model.errors import FileError
from gcd_model.geometry import Intrinsics
from gcd_model.small_files import decode_json
from gcd_train.data.files import MOST_TEXT, FileFault, read
from gcd_train.data.sample import Bytes, SceneView
from gcd_train.errors import DataError
from gcd_train.scenes.description import rotations

KEPT_SCENES = 64
"""Scenes whose facts stay in memory."""
_UNIT_TOLERANCE = 0.02
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
    """Classes by id, 0..255. Raises DataError for no class, an id twice, or a colour outside 0..255."""

    items: tuple[OntologyItem, ...]

    def __post_init__(self) -> None:
        ids = [item.id for item in self.items]
        if not ids:
            raise DataError("an ontology needs at least one class, got none")
        if len(set(ids)) < len(ids):
            raise DataError(f"an ontology has each id once, got {sorted({i for i in ids if ids.count(i) > 1})} twice")
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
    """Others' file: what else stands in it is not needed."""

    id: int
    name: str
    color: _Colour


class _File(msgspec.Struct, frozen=True):
    items: tuple[_Item, ...]


def _parsed(path: Path) -> Ontology:
    try:
        told = [item for item in decode_json(read(path, MOST_TEXT), _File).items if 0 <= item.id < _IDS]
        return Ontology(tuple(OntologyItem(id=each.id, name=each.name, colour=astuple(each.color)) for each in told))
    except FileError as error:
        raise FileFault(path, f"is no ontology: it {error}") from error
    except FileFault:
        raise
    except DataError as error:
        raise FileFault(path, f"is no usable ontology: {error}") from error


class Dataset4D(ABC):
    """Scenes of a folder. Reads when asked; one object for each process or thread.

    scenes: names, in order. cameras: names, in published order; all must be there at a time step. source_camera: whose
    own video is the input in evaluation (and in driving always). fps: of the scenes. ontology: the classes; None where
    the set has none.
    """

    fps: float
    ontology: Ontology | None = None

    def __init__(self, root: Path, scenes: Sequence[str], cameras: Sequence[str], source_camera: str) -> None:
        self.root, self.scenes, self.cameras = root, tuple(scenes), tuple(cameras)
        self.source_camera = source_camera

    def only(self, scenes: Sequence[str]) -> Self:
        """The same set, reduced to these scenes and in their order. Raises DataError if none is left."""
        if not scenes:
            raise DataError(f"no scene of the list or split is in {self.root}; look at how its scenes are named")
        fewer = copy(self)
        fewer.scenes = tuple(scenes)
        return fewer

    def folder(self, scene: str) -> Path:
        """Where the scene lies."""
        return self.root / scene

    @abstractmethod
    def frames(self, scene: str) -> int:
        """Time steps of a scene, whether or not each of them can be read. Raises FileFault (a DataError)."""

    @abstractmethod
    def lens(self, scene: str) -> Intrinsics:
        """The lens of the source camera, in pixels of its picture. Raises FileFault (a DataError)."""

    @abstractmethod
    def pose(self, scene: str, camera: str, time: int = 0) -> NDArray[np.float64]:
        """world_from_camera of a view, f64 [4, 4], metres. Raises FileFault."""

    @abstractmethod
    def view(self, scene: str, camera: str, time: int) -> SceneView:
        """What a camera saw at a time step.

        Raises FileFault (a DataError) that names the file which is missing, damaged or does not fit.
        """

    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """What the cameras (all, if None) saw at a time step, in the order asked for. Raises FileFault."""
        return [self.view(scene, camera, time) for camera in cameras or self.cameras]


LayoutName = Literal["kubric4d", "parallel_domain4d"]
_NAMES: dict[LayoutName, tuple[str, str]] = {
    "kubric4d": (r"scn(\d{5,})", "scn00000"),
    "parallel_domain4d": (r"scene_(\d{6,})", "scene_000000"),
}
"""Folders of scenes by their layout, and the first of them."""


def layout_of(name: str) -> LayoutName | None:
    """The layout of a scene whose folder has this name; None for another folder."""
    return next((layout for layout, (named, _) in _NAMES.items() if re.fullmatch(named, name)), None)


def scene_number(name: str) -> int:
    """The number in the name of a scene's folder, in either layout. Raises DataError for another name."""
    layout = layout_of(name)
    if layout is None:
        raise DataError(f"{name} is no scene's name; wanted scn00042 or scene_000042")
    return int(re.sub(r"\D", "", name))


def layout_in(root: Path) -> LayoutName | None:
    """The layout of the scenes in a folder; None if there is none. Raises DataError if it cannot be read."""
    try:
        found = {layout_of(path.name) for path in root.iterdir()}
    except OSError as error:
        raise DataError(f"{root} cannot be read ({error}); give the folder that holds the scenes, or pairs") from error
    return next((layout for layout in _NAMES if layout in found), None)


def scene_names(root: Path, layout: LayoutName) -> list[str]:
    """The scenes of a folder by number. Raises DataError if there is none."""
    layout_in(root)
    found = [path.name for path in root.iterdir() if layout_of(path.name) == layout]
    if not found:
        example = _NAMES[layout][1]
        raise DataError(f"{root} holds no scene of this layout; give the folder that holds {example} and so on")
    return sorted(found, key=scene_number)


def pose_from_quaternion(quaternions: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations and positions as rigid matrices.

    Args:
        quaternions: f64 [..., 4], w x y z; of length 1 but for rounding, which is taken out.
        positions: f64 [..., 3], metres.
    Returns:
        a_from_b: f64 [..., 4, 4].
    Raises:
        DataError: a number is not finite, or a quaternion is not of length 1.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (np.isfinite(positions).all() and np.isfinite(lengths).all()):
        raise DataError("a pose must be finite, got NaN or infinite numbers")
    if float(np.abs(lengths - 1.0).max()) > _UNIT_TOLERANCE:
        raise DataError(f"a rotation must be a quaternion of length 1, got one of {float(lengths.min()):.3g}")
    poses = np.zeros((*positions.shape[:-1], 4, 4))
    poses[..., :3, :3] = rotations(quaternions / lengths)
    poses[..., :3, 3] = positions
    poses[..., 3, 3] = 1.0
    return poses
