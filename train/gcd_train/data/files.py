"""Files of data sets and archives: nothing is unpickled or unfolds without limit, and a fault names its file.

What could not be read and was left out is counted and named, so that no fault in the data is silent or fatal. Folders
of our own scenes keep a checksum of every file in their `gcd-manifest.json`.
"""

import hashlib
import io
import logging
import zipfile
import zlib
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from gcd_model.errors import FileError
from gcd_model.small_files import read_json
from gcd_train.errors import DataError

Key = TypeVar("Key")
Value = TypeVar("Value")

_LOG = logging.getLogger(__name__)
_DISTINCT, _SHOWN = 10_000, 20
ZIP_FAULTS = (OSError, KeyError, ValueError, NotImplementedError, EOFError, zlib.error, zipfile.BadZipFile)
"""What zipfile raises for a damaged or hostile file, and `read_member`."""
MOST_TEXT, MOST_PICTURE = 1 << 24, 1 << 28
"""Bytes of a data set's JSON, and of a picture's file."""
_MOST_ARRAYS, _MOST_MEMBER = 1 << 30, 1 << 28
MANIFEST = "gcd-manifest.json"
GEOMETRY = "geometry.npz"
"""A scene ready to draw (`FrozenScene`), beside the manifest."""
Matrix = tuple[tuple[float, float, float, float], ...]


class FileFault(DataError):  # noqa: N818  a fault of the data, which readers of it name
    """A file of a data set is missing, damaged or does not fit the others. path: which; reason: what is wrong."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} {reason}")
        self.path, self.reason = path, reason

    def __reduce__(self) -> tuple[type["FileFault"], tuple[Path, str]]:
        return FileFault, (self.path, self.reason)  # a fault crosses from loader workers to the main process


@dataclass(frozen=True, kw_only=True, slots=True)
class Skipped:
    """One thing left out. scene: its name. file: the file at fault, or the scene's folder. reason: what is wrong."""

    scene: str
    file: str
    reason: str

    def __str__(self) -> str:
        return f"{self.scene}: {self.file} {self.reason}"


_OTHERS = Skipped(scene="others", file="", reason=f"beyond {_DISTINCT} distinct faults")


class Skips:
    """Everything left out so far. Each distinct one is logged once, as a warning, unless `logged` is false.

    A loader worker has its own; `Sample.skipped` carries what it left out, for `extend` in the main process.
    """

    def __init__(self, *, logged: bool = True) -> None:
        self._logged = logged
        self._counts: Counter[Skipped] = Counter()

    def add(self, scene: str, file: Path | str, reason: str) -> Skipped:
        """Count one and return it."""
        skipped = Skipped(scene=scene, file=str(file), reason=reason)
        self.extend([skipped])
        return skipped

    def extend(self, others: Iterable[Skipped]) -> None:
        """Count what was left out elsewhere."""
        for skipped in others:
            is_known = skipped in self._counts or len(self._counts) < _DISTINCT
            kind = skipped if is_known else _OTHERS  # a set in which everything is wrong must not fill the memory
            self._counts[kind] += 1
            if self._logged and self._counts[kind] == 1:
                _LOG.warning("left out %s", kind)

    @property
    def total(self) -> int:
        """How often something was left out."""
        return self._counts.total()

    def lines(self, most: int = _SHOWN) -> list[str]:
        """The first ones, a line each, and how many more there are."""
        rest = len(self._counts) - most
        return [*map(str, list(self._counts)[:most]), *([f"and {rest} more"] if rest > 0 else [])]


class Recent(Generic[Key, Value]):
    """The last `most` values that were made, by key."""

    def __init__(self, make: Callable[[Key], Value], most: int) -> None:
        self._make, self._most = make, most
        self._kept: OrderedDict[Key, Value] = OrderedDict()

    def __call__(self, key: Key) -> Value:
        """The value of a key, made where it is not kept. Raises what `make` raises."""
        if key not in self._kept:
            self._kept[key] = self._make(key)
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


def read(path: Path, most: int = MOST_PICTURE) -> bytes:
    """A whole file of at most so many bytes. Raises FileFault if it is not there, empty, larger or no regular file."""
    try:
        if path.exists() and not path.is_file():
            raise FileFault(path, "is no regular file")
        with path.open("rb") as file:
            content = file.read(most + 1)
    except FileNotFoundError as error:
        raise FileFault(path, "is missing: download or generate the scene again") from error
    except OSError as error:
        raise FileFault(path, f"cannot be read ({error})") from error
    if len(content) > most:
        raise FileFault(path, f"is larger than {most} bytes: it is something else")
    if not content:
        raise FileFault(path, "is empty: download or generate the scene again")
    return content


def one_of(*paths: Path) -> Path:
    """The first of several spellings of a file that is there. Raises FileFault naming the first if none is."""
    for path in paths:
        if path.exists():
            return path
    raise FileFault(paths[0], "is missing: download or generate the scene again")


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of an npz by name. Raises FileFault if it is damaged, no regular file, or unfolds to over a GiB."""
    content = read(path, _MOST_ARRAYS)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST_ARRAYS:
                raise ValueError(f"it unfolds to more than {_MOST_ARRAYS} bytes")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise FileFault(path, f"is damaged ({error}); make or download it again") from error


def read_member(archive: zipfile.ZipFile, name: str) -> bytes:
    """One file of an archive. Raises one of ZIP_FAULTS; ValueError for one that unfolds to over 256 MiB."""
    if archive.getinfo(name).file_size > _MOST_MEMBER:
        raise ValueError(f"{name} unfolds to more than {_MOST_MEMBER} bytes")
    return archive.read(name)


class SceneManifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Written last, so that a scene that has one is whole.

    layout: which names and encodings. world, seed, edition: what was drawn; the edition rises whenever a world draws
    another scene for the same seed. version: of this package. compact: WebP and depth codes in place of the
    published encodings. cameras: their names, in order. hfov_deg: of every camera. world_from_vehicle: [T][4][4],
    where the vehicle is in the frame of `geometry.npz`; None where poses are told in the world itself. facts: what the
    world tells of the whole scene. files: relative path -> SHA-256, without the manifest.
    """

    layout: Literal["kubric4d", "parallel_domain4d"]
    world: str
    seed: int
    version: str
    edition: int
    frames: int
    fps: float
    width: int
    height: int
    oversample: int
    compact: bool
    hfov_deg: float
    cameras: tuple[str, ...]
    files: dict[str, str]
    world_from_vehicle: tuple[Matrix, ...] | None = None
    facts: dict[str, float | str] = {}
    format: Literal[1] = 1


class SceneFiles:
    """Writes into one scene folder and keeps the SHA-256 of every file for its manifest."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.checksums: dict[str, str] = {}
        self.size = 0

    def write(self, path: Path, data: bytes) -> None:
        """One file; its folder is made when needed. Raises OSError, which names it, for one if the disk is full."""
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.write_bytes(data)
        except OSError as error:  # a full disk does not say for which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        self.checksums[path.relative_to(self.folder).as_posix()] = hashlib.sha256(data).hexdigest()
        self.size += len(data)


def package_version() -> str:
    """Of this package; `unknown` in a tree that was never installed."""
    try:
        return version("gcd-node")
    except PackageNotFoundError:
        return "unknown"


def read_manifest(scene: Path) -> SceneManifest:
    """Of a scene folder. Raises DataError if it has none, or one that cannot be read."""
    path = scene / MANIFEST
    if not path.exists():
        raise DataError(f"{scene} has no {MANIFEST}: it was not made by `gcd-train generate`")
    try:
        return read_json(path, SceneManifest, MOST_TEXT)
    except FileError as error:
        raise DataError(f"{path} {error}; delete the scene and generate it again") from error
