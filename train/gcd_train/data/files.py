"""Files of data sets, archives and pictures: nothing is unpickled or unfolds without limit, and a fault names its file.

What could not be read and was left out is counted and named, so that no fault in the data is silent or fatal.
"""

import io
import logging
import struct
import zipfile
import zlib
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import imagesize
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError
from gcd_train.layouts.encodings import FAR_M, stored_depth

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Key = TypeVar("Key")
Value = TypeVar("Value")

_LOG = logging.getLogger(__name__)
_DISTINCT, _SHOWN = 10_000, 20
ZIP_FAULTS = (OSError, KeyError, ValueError, NotImplementedError, EOFError, zlib.error, zipfile.BadZipFile)
"""What zipfile raises for a damaged or hostile file, and `read_member`."""
MOST_TEXT, MOST_PICTURE = 1 << 24, 1 << 28
"""Bytes of a data set's JSON, and of a picture's file."""
_MOST_ARRAYS, _MOST_MEMBER, _MOST_PIXELS = 1 << 30, 1 << 28, 1 << 27
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_PALETTE, _PNG_GREY = 3, 0


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


def read_colour(path: Path) -> Bytes:
    """RGB picture of a PNG, WebP or JPEG file, u8 [H, W, 3]; alpha is dropped. Raises FileFault."""
    picture = decoded(path, read(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def read_depth(path: Path, key: str = "data") -> Floats:
    """Metres, f32 [H, W], of a float TIFF, an npz with array `key`, or a PNG of ours (`DepthCode`).

    0 is kept as "nothing known"; beyond 30 000 m is cut there, as published.
    Raises: FileFault if it is damaged, or holds NaN, negative numbers, or nothing that is known or within those.
    """
    match path.suffix:
        case ".npz":
            metres = _npz(path, key)
        case ".png":
            metres = _depth_png(path)
        case _:
            metres = _float_tiff(path)
    if not float(metres.min()) >= 0:  # NaN is the least of all
        bad = int(np.count_nonzero(~(metres >= 0)))
        raise FileFault(path, f"has {bad} of {metres.size} depths that are NaN or negative")
    farthest = float(metres.max())
    if farthest == 0:
        raise FileFault(path, "has no depth above 0 in any pixel")
    if float(metres.min()) > FAR_M:
        raise FileFault(path, f"has depths beyond {FAR_M:g} m in every pixel: no scene is so far away")
    return np.minimum(metres, np.float32(FAR_M)) if farthest > FAR_M else metres


def read_ids(path: Path) -> NDArray[np.int32]:
    """Ids, i32 [H, W], of a PNG that stores them as R + 256 G + 65536 B. Raises FileFault."""
    content = read(path)
    _require_whole_png(path, content)
    picture = decoded(path, content, cv2.IMREAD_COLOR)
    ids = cv2.extractChannel(picture, 2).astype(np.int32)
    for channel, unit in ((1, 256), (0, 65536)):
        more = cv2.extractChannel(picture, channel)
        if cv2.countNonZero(more):  # mostly there is nothing in them
            ids += more.astype(np.int32) * unit
    return ids


def read_palette_indices(path: Path) -> Bytes:
    """Indices, u8 [H, W], of a palette PNG; of a grey one its values. Raises FileFault.

    OpenCV would give the palette's colours. A palette picture without its palette is a grey picture, though, so the
    header is rewritten to say that before it is decoded.
    """
    content = read(path)
    _require_whole_png(path, content)
    depth, kind = content[24], content[25]
    if kind == _PNG_PALETTE:
        content = _as_grey(content)
    elif kind != _PNG_GREY:
        raise FileFault(path, "holds colours, not a palette: instance numbers cannot be told from it")
    picture = decoded(path, content, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint8 or picture.ndim != 2:
        raise FileFault(path, f"should hold 8-bit indices, got {picture.dtype} {list(picture.shape)}")
    step = 255 // (2**depth - 1) if depth < 8 else 1  # fewer bits are spread over 0..255 when they are decoded
    return np.ascontiguousarray(picture // step, dtype=np.uint8)


def require_size(path: Path, picture: NDArray[np.generic], height: int, width: int, other: str) -> None:
    """Raises FileFault if a picture has another size than `other` says."""
    if picture.shape[:2] != (height, width):
        got = f"{picture.shape[1]} x {picture.shape[0]}"
        raise FileFault(path, f"is {got} where {other} says {width} x {height}: sizes are mixed")


def decoded(path: Path, content: bytes, flags: int) -> NDArray[Any]:
    """The picture in a file's content, as OpenCV decodes it with these flags. Raises FileFault."""
    try:
        width, height = imagesize.get(io.BytesIO(content), exif_rotation=False)
    except Exception as error:  # of any kind, where a header is damaged
        raise FileFault(path, f"is damaged: its size cannot be read ({error})") from error
    if width * height > _MOST_PIXELS:
        raise FileFault(path, f"states {width} x {height} pixels, more than {_MOST_PIXELS}")
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error as error:
        raise FileFault(path, f"cannot be decoded ({error.err or error})") from error
    if picture is None:  # pyright: ignore[reportUnnecessaryComparison]  the stub does not tell
        raise FileFault(path, f"is damaged: its {len(content)} bytes hold no whole picture")
    return picture  # pyright: ignore[reportReturnType]


def _float_tiff(path: Path) -> Floats:
    picture = decoded(path, read(path), cv2.IMREAD_UNCHANGED)
    if picture.dtype.kind != "f" or picture.size != picture.shape[0] * picture.shape[1]:
        raise FileFault(path, f"should hold float32 depth, got {picture.dtype} {list(picture.shape)}")
    return picture.reshape(picture.shape[:2]).astype(np.float32, copy=False)


def _npz(path: Path, key: str) -> Floats:
    array = read_npz(path).get(key)
    if array is None:
        raise FileFault(path, f"lacks its array `{key}`")
    if array.dtype.kind != "f" or array.ndim < 2 or array.size == 0 or array.size != array.shape[0] * array.shape[1]:
        raise FileFault(path, f"should hold float depth [H, W], got {array.dtype} {list(array.shape)}")
    return array.reshape(array.shape[:2]).astype(np.float32, copy=False)


def _depth_png(path: Path) -> Floats:
    content = read(path)
    _require_whole_png(path, content)
    picture = decoded(path, content, cv2.IMREAD_UNCHANGED)
    metres = stored_depth(picture)
    if metres is None:
        got = f"{picture.dtype} {list(picture.shape)}"
        raise FileFault(path, f"should hold 16-bit depth codes, or their low bytes above their high ones, got {got}")
    return metres


def _require_whole_png(path: Path, content: bytes) -> None:
    """Some versions of libpng fill what is cut off with zeros; those would be ids."""
    if not content.startswith(_PNG) or len(content) < 33:
        raise FileFault(path, "is damaged: it is no PNG")
    if content[-8:-4] != b"IEND":
        raise FileFault(path, f"is damaged: it is cut off after {len(content)} bytes")


def _as_grey(content: bytes) -> bytes:
    """A palette PNG as a grey PNG of its indices."""
    header = content[12:25] + bytes([_PNG_GREY]) + content[26:29]
    rebuilt = [content[:12], header, struct.pack(">I", zlib.crc32(header))]
    at = 33
    while at + 8 <= len(content):
        length, name = struct.unpack_from(">I4s", content, at)
        if name not in (b"PLTE", b"tRNS", b"bKGD", b"sBIT", b"hIST"):  # mean something else, or nothing, in grey
            rebuilt.append(content[at : at + 12 + length])
        at += 12 + length
    return b"".join(rebuilt)
