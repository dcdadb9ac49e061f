"""A run on disk: what it was made from, a digest of every view of every window, and the pixels without loss.

    RUN/manifest.json   RUN/VIEW/000000.win.png   RUN/VIEW/000000.cls.png   .vis.png   .depth.png

A picture holds the T frames of one window under each other. The folder appears when all of it is there.
"""

import hashlib
import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gcd_model import FileError, read_json
from gcd_node.config import ViewId
from gcd_node.errors import DamagedRunError, OutputError, SourceError
from gcd_node.image_io import make_folder, write_png
from gcd_node.sources.files import read_picture

MANIFEST = "manifest.json"
_MAX_MANIFEST = 64 * 2**20  # bytes: a day of windows

Pixels = NDArray[np.uint8]
"""Of a view of a window: "win" [T, H, W, 3] RGB; "cls" and "vis" [T, H, W]; "depth" [T, H, 2 W], the bytes of its
float16 values."""
Digest: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$(?!\n)")]
"""SHA-256 of the bytes of an array in C order, 64 hex digits."""
KeptKind: TypeAlias = Literal["win", "cls", "vis", "depth"]
"""What a run keeps of a view, named as in the wire protocol."""


class WindowEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One window.

    stamps_ns: of its T frames as the source gave them; those of different epochs cannot be compared. seqs: the source's
    numbers of the frames. input_sha256: of the pictures the model was given, u8 [T, H, W, 3]. seed: of the sampler.
    ood: what lay outside the trained domain. views: digests of the pixels of each, before any JPEG.
    """

    window_id: Annotated[int, Meta(ge=0)]
    epoch: int
    stamps_ns: Annotated[tuple[int, ...], Meta(min_length=1)]
    seqs: tuple[int, ...]
    input_sha256: Digest
    seed: int
    ood: tuple[str, ...]
    views: Annotated[dict[ViewId, dict[KeptKind, Digest]], Meta(min_length=1)]

    def __post_init__(self) -> None:
        if any("win" not in kinds for kinds in self.views.values()):
            raise ValueError("a view needs the digest of its pixels")


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole run.

    format: another number is another layout.
    made_from: all that decides its pixels beside the configuration, such as "weights sha256_12" or "version torch".
    config: the launch file as it was replayed. cfg_digest: see config_digest().
    frames: read. rejected: what spoilt windows, and how many. nan_windows: missing because of NaN. troubles: what the
        model could not do, such as "MODEL_NAN in window 3", with its detail. windows: by rising id.
    """

    format: Literal["gcd-run/3"] = "gcd-run/3"
    made_from: dict[str, str]
    config: dict[str, Any]
    cfg_digest: str
    frames: int
    rejected: dict[str, int]
    nan_windows: int
    troubles: dict[str, str]
    windows: Annotated[tuple[WindowEntry, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        ids = [window.window_id for window in self.windows]
        if ids != sorted(set(ids)):
            raise ValueError("the window_id of each window must be higher than the one before")


def encode_manifest(manifest: Manifest) -> bytes:
    """JSON with one line for each window, so that two manifests can be read side by side in a code review."""
    table: dict[str, Any] = msgspec.to_builtins(manifest)
    windows = [msgspec.json.encode(window).decode() for window in table.pop("windows")]
    head = msgspec.json.format(msgspec.json.encode(table), indent=2).decode().removesuffix("\n}")
    lines = ",\n    ".join(windows)
    return f'{head},\n  "windows": [\n    {lines}\n  ]\n}}\n'.encode()


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run that lies in `path`; nothing but its manifest was looked at."""

    path: Path
    manifest: Manifest

    def read_view(self, window: WindowEntry, view_id: str) -> dict[KeptKind, Pixels]:
        """The pixels of a view of a window by kind.

        Raises:
            DamagedRunError: a picture is missing, none, or has other pixels than those with its digest.
        """
        return {kind: self._read(window, view_id, kind) for kind in window.views[view_id]}

    def _read(self, window: WindowEntry, view_id: str, kind: KeptKind) -> Pixels:
        path = _place(self.path, view_id, window.window_id, kind)
        try:
            picture = read_picture(path)
        except SourceError as error:
            raise DamagedRunError(f"{error}; copy the whole folder of the run, or replay it again") from error
        pixels = picture if kind == "win" else np.ascontiguousarray(picture[..., 0])
        odd = len(pixels) % len(window.stamps_ns) or (kind == "depth" and pixels.shape[1] % 2)
        if odd or pixel_digest(pixels) != window.views[view_id][kind]:
            raise DamagedRunError(
                f"{path} does not have the pixels whose SHA-256 {MANIFEST} states; one of the two was changed or "
                "damaged: replay again"
            )
        return pixels.reshape(len(window.stamps_ns), -1, *pixels.shape[1:])


def open_run(path: Path) -> RunFolder:
    """Read the manifest of a run.

    Raises:
        SourceError: there is no such folder.
        DamagedRunError: the folder has no manifest (a replay that was cut short leaves none), or a damaged one.
    """
    file = path / MANIFEST
    if not path.is_dir():
        raise SourceError(f"no such folder: {path}; give one that `gcd-node replay --out` wrote")
    if not file.exists():
        raise DamagedRunError(f"{path} has no {MANIFEST}: it is no run, or one that did not finish; replay again")
    try:
        return RunFolder(path, read_json(file, Manifest, _MAX_MANIFEST))
    except FileError as error:
        raise DamagedRunError(
            f"{file} is no manifest of a run as this version writes it: it {error}; replay the recording again"
        ) from error


def pixel_digest(pixels: Pixels) -> str:
    """See Digest."""
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def keep_pixels(folder: Path, view_id: str, window_id: int, kind: KeptKind, pixels: Pixels) -> Digest:
    """Write the pixels of a kind of a view of a window; gives their digest. Raises OutputError."""
    write_png(_place(folder, view_id, window_id, kind), pixels.reshape(-1, *pixels.shape[2:]))
    return pixel_digest(pixels)


def _place(folder: Path, view_id: str, window_id: int, kind: KeptKind) -> Path:
    return folder / view_id / f"{window_id:06d}.{kind}.png"


@contextmanager
def new_folder(path: Path) -> Generator[Path]:
    """A folder to fill; at the end of the block it becomes `path`, after an error nothing is left.

    Until then its name ends in .part. What is killed leaves that behind.
    Raises:
        OutputError: there is something at `path`, other than an empty folder; or nothing can be there.
    """
    path = path.expanduser().absolute()
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise OutputError(f"{path} is there already and is no empty folder; name another folder, or remove it first")
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a process that had our number and was killed
    make_folder(part)
    try:
        yield part
        try:
            part.replace(path)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; name another folder") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
