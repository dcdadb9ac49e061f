"""A run on disk: manifest.json and the pixels it speaks of; and how it comes to be there whole or not at all."""

import os
import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from gcd_node.errors import DamagedRunError, OutputError, SourceError
from gcd_node.pictures.files import make_folder
from gcd_node.replay.manifest import Manifest, WindowEntry, encode_manifest, parse_manifest
from gcd_node.replay.pixel_file import PixelReader, Pixels

MANIFEST = "manifest.json"
_NAMES = {"cls": "classes", "vis": "visibility", "depth": "depth"}
_MAX_MANIFEST = 64 * 2**20  # a day of windows


def pictures_path(folder: Path, view_id: str) -> Path:
    """Where the pixels of a view are."""
    return folder / f"{view_id}.mkv"


def map_path(folder: Path, view_id: str, kind: str) -> Path:
    """Where the maps of a kind of a view are, if the model makes any; of depth the two bytes of each value."""
    return folder / f"{view_id}.{_NAMES[kind]}.mkv"


@dataclass(frozen=True, kw_only=True, slots=True)
class RunFolder:
    """A run that lies in `path`; nothing but its manifest was looked at."""

    path: Path
    manifest: Manifest


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WindowPixels:
    """A window with its pixels by view: u8 [T, H, W, 3] RGB. maps: of each view by kind: class numbers and visibility
    u8 [T, H, W]; inverse depth u8 [T, H, 2 W], the bytes of its values."""

    entry: WindowEntry
    pictures: dict[str, Pixels]
    maps: dict[str, dict[str, Pixels]]


def open_run(path: Path) -> RunFolder:
    """Read the manifest of a run.

    Raises:
        SourceError: there is no such folder.
        DamagedRunError: the folder has no manifest (a replay that was cut short leaves none), or a damaged one.
    """
    if not path.is_dir():
        raise SourceError(f"no such folder: {path}; give one that `gcd-node replay --out` wrote")
    file = path / MANIFEST
    try:
        text = _text(file)
    except FileNotFoundError as error:
        raise DamagedRunError(
            f"{path} has no {MANIFEST}: it is no run, or one that did not finish; replay again"
        ) from error
    except OSError as error:
        raise DamagedRunError(f"cannot read {file}: {error.strerror}; check its permissions") from error
    return RunFolder(path=path, manifest=parse_manifest(text, str(file)))


def _text(file: Path) -> bytes:
    """Raises OSError, DamagedRunError."""
    size = file.stat().st_size
    if size > _MAX_MANIFEST or not file.is_file():
        raise DamagedRunError(
            f"{file} has {size} bytes, more than {_MAX_MANIFEST}, or is no file; replay a shorter part of the recording"
        )
    return file.read_bytes()


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a run. Raises OutputError."""
    try:
        (folder / MANIFEST).write_bytes(encode_manifest(manifest))
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}; name another folder") from error


def read_windows(run: RunFolder) -> Iterator[WindowPixels]:
    """Every window with its pixels, in order; each is checked against its digest.

    Raises:
        DamagedRunError: see PixelReader.
    """
    size = run.manifest.size
    readers: dict[Path, PixelReader] = {}
    with ExitStack() as stack:

        def reader(path: Path, *, grey: bool, scale: int = 1) -> PixelReader:
            if path not in readers:
                shape = size.frames, size.height, scale * size.width
                readers[path] = PixelReader(path, shape=shape, grey=grey)
                stack.callback(readers[path].close)
            return readers[path]

        for window in run.manifest.windows:
            pictures: dict[str, Pixels] = {}
            maps: dict[str, dict[str, Pixels]] = {}
            for view_id, view in window.views.items():
                source = reader(pictures_path(run.path, view_id), grey=False)
                pictures[view_id] = source.read(window.window_id, view.sha256)
                maps[view_id] = {}
                for kind, digest in view.digests.items():
                    source = reader(map_path(run.path, view_id, kind), grey=True, scale=2 if kind == "depth" else 1)
                    maps[view_id][kind] = source.read(window.window_id, digest)
            yield WindowPixels(entry=window, pictures=pictures, maps=maps)
        for each in readers.values():
            each.require_end()


def check_pixels(run: RunFolder) -> None:
    """Read everything once. Raises DamagedRunError if the pixels are not those the manifest speaks of."""
    for _ in read_windows(run):
        pass


@contextmanager
def new_folder(path: Path) -> Generator[Path]:
    """A folder to fill; at the end of the block it becomes `path`, after an error nothing is left.

    Until then its name ends in .part. What is killed leaves that behind.
    Raises:
        OutputError: there is something at `path`, other than an empty folder; or it cannot be written.
    """
    path = path.expanduser().absolute()
    _require_free(path)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a process that had our number and was killed
    make_folder(part)
    try:
        yield part
        _rename(part, path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def _require_free(path: Path) -> None:
    if path.is_dir() and any(path.iterdir()):
        raise OutputError(f"{path} is there already and not empty; name another folder, or remove it first")
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file; name a folder")


def _rename(part: Path, path: Path) -> None:
    try:
        part.replace(path)
    except OSError as error:
        raise OutputError(f"cannot create {path}: {error.strerror}; name another folder") from error
