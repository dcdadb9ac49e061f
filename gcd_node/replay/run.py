"""A run on disk: what it was made from, a digest of every view of every window, and the pixels without loss.

    RUN/manifest.json   RUN/VIEW.mkv   RUN/VIEW.classes.mkv   RUN/VIEW.visibility.mkv   RUN/VIEW.depth.mkv

All windows of a view follow each other in an FFV1 video. The folder appears when all of it is there.
"""

import hashlib
import os
import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gcd_client.protocol import ClassRecord
from gcd_model import FileError, read_json
from gcd_node.config import Count, ViewId
from gcd_node.errors import DamagedRunError, OutputError, SourceError
from gcd_node.image_io import make_folder
from gcd_node.sources.files import open_video

MANIFEST = "manifest.json"
_MAX_MANIFEST, _MAX_WINDOW = 64 * 2**20, 2**28  # bytes: a day of windows; 6 times the largest model's pixels
_MATROSKA = b"\x1a\x45\xdf\xa3"

Pixels = NDArray[np.uint8]
Digest: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$(?!\n)")]
"""SHA-256, 64 hex digits."""
KeptKind: TypeAlias = Literal["win", "cls", "vis", "depth"]
"""What a run keeps of a view, named as in the wire protocol."""
_SUFFIXES: dict[KeptKind, str] = {"win": "", "cls": ".classes", "vis": ".visibility", "depth": ".depth"}


class SizeEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of every view: T frames of H x W pixels."""

    frames: Count
    height: Count
    width: Count

    def __post_init__(self) -> None:
        if 3 * self.frames * self.height * self.width > _MAX_WINDOW:
            raise ValueError(
                f"a window of {self.frames} x {self.height} x {self.width} takes more than {_MAX_WINDOW} bytes"
            )


class TroubleEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the model could not do: MODEL_NAN, the window is missing; GPU_OOM, less was asked of it from here on."""

    code: str
    window_id: int
    detail: str


class TotalsEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """frames: read. windows: rendered. rejected: what spoilt windows, and how many. nan_windows: missing for that."""

    frames: int
    windows: int
    rejected: dict[str, int]
    nan_windows: int


class ViewEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One view of one window.

    sha256: of its pixels by kind: of "win" u8 [T, H, W, 3] RGB, before any JPEG; of "cls" and "vis" u8 [T, H, W]; of
    "depth" f16 [T, H, W]. seed, steps: of the sampler. ood: what lay outside the trained domain. nan_frames: frames
    with non-finite values; always 0 of a view that came out.
    """

    view_rev: int
    sha256: dict[KeptKind, Digest]
    seed: int
    steps: int
    ood: tuple[str, ...]
    nan_frames: int

    def __post_init__(self) -> None:
        if "win" not in self.sha256:
            raise ValueError("a view needs the digest of its pixels")


class WindowEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One window.

    stamps: [sec, nanosec] of its T frames as the source gave them (one number would be changed by readers that hold
    numbers as doubles); those of different epochs cannot be compared. seqs: the source's numbers of the frames.
    input_sha256: of the pictures the model was given, u8 [T, H, W, 3]. render_ms: of all its views together.
    """

    window_id: Annotated[int, Meta(ge=0)]
    epoch: int
    stamps: tuple[tuple[int, int], ...]
    seqs: tuple[int, ...]
    input_sha256: Digest
    render_ms: float
    views: Annotated[dict[ViewId, ViewEntry], Meta(min_length=1)]


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole run.

    format: another number is another layout.
    made_from: all that decides its pixels beside the configuration, such as "weights sha256_12" or "version torch".
    config: TOML, without secrets. cfg_digest: see config_digest(). fps: of a window. classes: the ontology of the class
    maps, empty without. windows: by rising id.
    """

    format: Literal["gcd-run/2"] = "gcd-run/2"
    made_from: dict[str, str]
    config: str
    cfg_digest: str
    size: SizeEntry
    fps: float
    classes: tuple[ClassRecord, ...]
    totals: TotalsEntry
    troubles: tuple[TroubleEntry, ...]
    windows: Annotated[tuple[WindowEntry, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        ids = [window.window_id for window in self.windows]
        if ids != sorted(set(ids)):
            raise ValueError("the window_id of each window must be higher than the one before")

    @property
    def views(self) -> tuple[str, ...]:
        """Ids of all views, in the order they first occur."""
        return tuple(dict.fromkeys(view_id for window in self.windows for view_id in window.views))


def encode_manifest(manifest: Manifest) -> bytes:
    """JSON with one line for each window, so that two manifests can be read side by side in a code review."""
    table: dict[str, Any] = msgspec.to_builtins(manifest)
    windows = [msgspec.json.encode(window).decode() for window in table.pop("windows")]
    head = msgspec.json.format(msgspec.json.encode(table), indent=2).decode().removesuffix("\n}")
    lines = ",\n    ".join(windows)
    return f'{head},\n  "windows": [\n    {lines}\n  ]\n}}\n'.encode()


@dataclass(frozen=True, kw_only=True, slots=True)
class RunFolder:
    """A run that lies in `path`; nothing but its manifest was looked at."""

    path: Path
    manifest: Manifest


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
        manifest = read_json(file, Manifest, _MAX_MANIFEST)
    except FileError as error:
        raise DamagedRunError(
            f"{file} is no manifest of a run as this version writes it: it {error}; replay the recording again"
        ) from error
    return RunFolder(path=path, manifest=manifest)


# Pixels.


ViewPixels: TypeAlias = dict[KeptKind, Pixels]
"""Of a view of a window, by kind: of "win" u8 [T, H, W, 3] RGB; of "cls" and "vis" u8 [T, H, W]; of "depth"
u8 [T, H, 2 W], the bytes of its values."""


def pixel_digest(pixels: Pixels) -> str:
    """SHA-256 of the bytes of an array in C order, 64 hex digits."""
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def pixels_path(folder: Path, view_id: str, kind: KeptKind) -> Path:
    """Where the pixels of a kind of a view are."""
    return folder / f"{view_id}{_SUFFIXES[kind]}.mkv"


def read_windows(run: RunFolder) -> Iterator[tuple[WindowEntry, dict[str, ViewPixels]]]:
    """Every window with its pixels by view, in order; each is checked against its digest.

    Raises:
        DamagedRunError: a video is missing, no video, shorter or longer than the manifest says, has pictures of another
            size, or other pixels than those with that digest.
    """
    videos: dict[Path, cv2.VideoCapture] = {}
    with ExitStack() as stack:
        for window in run.manifest.windows:
            views: dict[str, ViewPixels] = {view_id: {} for view_id in window.views}
            for view_id, view in window.views.items():
                for kind, sha256 in view.sha256.items():
                    path = pixels_path(run.path, view_id, kind)
                    video = videos[path] = videos[path] if path in videos else _open_video(path, stack)
                    pixels = views[view_id][kind] = _next_window(video, path, run.manifest.size, kind)
                    if pixel_digest(pixels) != sha256:
                        raise DamagedRunError(
                            f"{path}: the pixels of window {window.window_id} do not have the SHA-256 that "
                            "manifest.json states; one of the two was changed or damaged: replay again"
                        )
            yield window, views
        for path, video in videos.items():
            if video.read()[0]:
                raise DamagedRunError(f"{path} has more frames than {MANIFEST} says; replay again")


def _open_video(path: Path, stack: ExitStack) -> cv2.VideoCapture:
    try:
        with path.open("rb") as file:
            if file.read(len(_MATROSKA)) != _MATROSKA:  # FFmpeg would follow a play list to addresses nobody named
                raise SourceError(f"{path} is no Matroska video")
        return stack.enter_context(open_video(path))
    except (OSError, SourceError) as error:
        raise DamagedRunError(f"{error}; copy the whole folder of the run, or replay it again") from error


def _next_window(video: cv2.VideoCapture, path: Path, size: SizeEntry, kind: KeptKind) -> Pixels:
    """u8 [T, H, W, 3] RGB, or of maps [T, H, W]."""
    height, width = size.height, (2 if kind == "depth" else 1) * size.width
    frames: list[Pixels] = []
    for index in range(size.frames):
        good, frame = video.read()
        if not good:
            raise DamagedRunError(
                f"{path} ends at frame {index} of {size.frames} of a window: it is shorter than {MANIFEST} says; copy "
                "it again, or replay again"
            )
        if frame.shape[:2] != (height, width):
            raise DamagedRunError(
                f"{path} has pictures of {frame.shape[1]} x {frame.shape[0]} pixels, {MANIFEST} says {width} x "
                f"{height}; one of the two was changed or damaged: replay again"
            )
        plain = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) if kind == "win" else frame[..., 0]
        frames.append(np.asarray(plain, np.uint8))
    return np.stack(frames)


@contextmanager
def new_folder(path: Path) -> Generator[Path]:
    """A folder to fill; at the end of the block it becomes `path`, after an error nothing is left.

    Until then its name ends in .part. What is killed leaves that behind.
    Raises:
        OutputError: there is something at `path`, other than an empty folder; or it cannot be written.
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
            raise OutputError(f"cannot create {path}: {error.strerror}; name another folder") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
