"""A run on disk: what it was made from, a digest of every view of every window, and the pixels without loss.

    RUN/manifest.json   RUN/VIEW.mkv   RUN/VIEW.classes.mkv   RUN/VIEW.visibility.mkv   RUN/VIEW.depth.mkv

All windows of a view follow each other in an FFV1 video. The folder appears when all of it is there.
"""

import hashlib
import os
import shutil
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gcd_client.protocol import ClassRecord
from gcd_model import FileError, decode_json, printable, read_small
from gcd_node.config import Count, ViewId
from gcd_node.errors import DamagedRunError, OutputError, SourceError
from gcd_node.frame import MAX_PIXELS
from gcd_node.pictures.files import make_folder, video_writer
from gcd_node.sources.opencv import quiet_opencv

FORMAT = "gcd-run/2"
"""Of the folder and its manifest; another number is another layout."""
MANIFEST = "manifest.json"
_MAX_MANIFEST, _MAX_WINDOW = 64 * 2**20, 2**28  # bytes: a day of windows; 6 times the largest model's pixels
_MATROSKA = b"\x1a\x45\xdf\xa3"
_SECOND_NS = 1_000_000_000

Pixels = NDArray[np.uint8]
Digest: TypeAlias = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$(?!\n)")]
"""SHA-256, 64 hex digits."""
Stamp: TypeAlias = tuple[int, Annotated[int, Meta(ge=0, lt=_SECOND_NS)]]
"""[sec, nanosec]: one number of nanoseconds would be changed by readers that hold numbers as doubles."""
KeptKind: TypeAlias = Literal["win", "cls", "vis", "depth"]
"""What a run keeps of a view, named as in the wire protocol."""
_SUFFIXES: dict[KeptKind, str] = {"win": "", "cls": ".classes", "vis": ".visibility", "depth": ".depth"}


class _Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class SizeEntry(_Entry, frozen=True, kw_only=True):
    """Of every view: T frames of H x W pixels."""

    frames: Count
    height: Count
    width: Count

    def __post_init__(self) -> None:
        if 3 * self.frames * self.height * self.width > _MAX_WINDOW:
            raise ValueError(
                f"a window of {self.frames} x {self.height} x {self.width} takes more than {_MAX_WINDOW} bytes"
            )


class TroubleEntry(_Entry, frozen=True, kw_only=True):
    """What the model could not do: MODEL_NAN, the window is missing; GPU_OOM, less was asked of it from here on."""

    code: str
    window_id: int
    detail: str


class TotalsEntry(_Entry, frozen=True, kw_only=True):
    """frames: read. windows: rendered. rejected: what spoilt windows, and how many. nan_windows: missing for that."""

    frames: int
    windows: int
    rejected: dict[str, int]
    nan_windows: int


class ViewEntry(_Entry, frozen=True, kw_only=True):
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


class WindowEntry(_Entry, frozen=True, kw_only=True):
    """One window.

    stamps, seqs: of its T frames, as the source gave them; stamps of different epochs cannot be compared.
    input_sha256: of the pictures the model was given, u8 [T, H, W, 3]. render_ms: of all its views together.
    """

    window_id: Annotated[int, Meta(ge=0)]
    epoch: int
    stamps: tuple[Stamp, ...]
    seqs: tuple[int, ...]
    input_sha256: Digest
    render_ms: float
    views: Annotated[dict[ViewId, ViewEntry], Meta(min_length=1)]

    def __post_init__(self) -> None:
        if len(self.stamps) != len(self.seqs):
            raise ValueError(f"window {self.window_id} has {len(self.stamps)} stamps and {len(self.seqs)} seqs")


class Manifest(_Entry, frozen=True, kw_only=True):
    """A whole run.

    made_from: all that decides its pixels beside the configuration, such as "weights sha256_12" or "version torch".
    config: TOML, without secrets. cfg_digest: see config_digest(). fps: of a window. classes: the ontology of the class
    maps, empty without. windows: by rising id.
    """

    format: Literal["gcd-run/2"] = FORMAT
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
        wrong = [window.window_id for window in self.windows if len(window.stamps) != self.size.frames]
        if wrong:
            raise ValueError(f"window {wrong[0]} must have {self.size.frames} stamps")

    @property
    def views(self) -> tuple[str, ...]:
        """Ids of all views, in the order they first occur."""
        return tuple(dict.fromkeys(view_id for window in self.windows for view_id in window.views))


def to_stamp(stamp_ns: int) -> Stamp:
    """Nanoseconds as [sec, nanosec]."""
    return divmod(stamp_ns, _SECOND_NS)


def encode_manifest(manifest: Manifest) -> bytes:
    """JSON with one line for each window, so that two manifests can be read side by side in a code review."""
    table: dict[str, Any] = msgspec.to_builtins(manifest)
    windows = [msgspec.json.encode(window).decode() for window in table.pop("windows")]
    head = msgspec.json.format(msgspec.json.encode(table), indent=2).decode().removesuffix("\n}")
    lines = ",\n    ".join(windows)
    return f'{head},\n  "windows": [\n    {lines}\n  ]\n}}\n'.encode()


class _Stated(msgspec.Struct, frozen=True):
    format: object = None


def parse_manifest(text: str | bytes, name: str) -> Manifest:
    """Inverse of encode_manifest(); `name` is for the message.

    Raises:
        DamagedRunError: no JSON, of another format, or not what a manifest holds; names the place.
    """
    try:
        found = decode_json(text, _Stated).format
        if found != FORMAT:
            raise DamagedRunError(
                f"{name} must be of format {FORMAT}, got {printable(found)}; replay the recording again with this "
                "version of gcd-node"
            )
        return decode_json(text, Manifest)
    except FileError as error:
        raise DamagedRunError(f"{name} is no manifest of a run: it {error}; replay the recording again") from error


# Pixels.


def pixel_digest(pixels: Pixels) -> str:
    """SHA-256 of the bytes of an array in C order, 64 hex digits."""
    return hashlib.sha256(np.ascontiguousarray(pixels).data).hexdigest()


def pixels_path(folder: Path, view_id: str, kind: KeptKind) -> Path:
    """Where the pixels of a kind of a view are."""
    return folder / f"{view_id}{_SUFFIXES[kind]}.mkv"


class PixelWriter:
    """Appends windows to a video: u8 [T, H, W, 3] RGB, or u8 [T, H, W], stored as grey pictures.

    A full disk does not show here, because OpenCV does not tell: read the video again to be sure.
    """

    def __init__(self, path: Path, *, height: int, width: int, fps: float) -> None:
        """Raises OutputError if the video cannot be begun."""
        self._video = video_writer(path, width, height, fps)

    def write(self, pixels: Pixels) -> None:
        """Append a window."""
        conversion = cv2.COLOR_RGB2BGR if pixels.ndim == 4 else cv2.COLOR_GRAY2BGR
        for frame in pixels:
            self._video.write(cv2.cvtColor(frame, conversion))

    def close(self) -> None:
        """Finish the video; until then it may lack its end."""
        self._video.release()


class PixelReader:
    """Takes windows from a video that PixelWriter wrote."""

    def __init__(self, path: Path, *, shape: tuple[int, int, int], grey: bool) -> None:
        """shape: T, H, W. grey: it holds maps. Raises DamagedRunError if it cannot be opened."""
        if not path.is_file():
            raise DamagedRunError(f"{path} is missing; copy the whole folder of the run, or replay it again")
        try:
            with path.open("rb") as file:
                head = file.read(len(_MATROSKA))
        except OSError as error:
            raise DamagedRunError(f"cannot read {path}: {error.strerror}; check its permissions") from error
        if head != _MATROSKA:  # FFmpeg goes by the content: it would follow a play list to addresses nobody named
            raise DamagedRunError(
                f"{path} cannot be opened: it is no Matroska video, its first bytes are {head!r}; replay again"
            )
        self._path, self._shape, self._grey = path, shape, grey
        with quiet_opencv():
            self._video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._video.isOpened():
            raise DamagedRunError(f"{path} cannot be opened as a video: truncated or damaged; replay it again")
        width, height = self._video.get(cv2.CAP_PROP_FRAME_WIDTH), self._video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if width * height > MAX_PIXELS:  # before a picture of it is decoded
            self.close()
            raise DamagedRunError(f"{path} states {width:.0f} x {height:.0f} pixels; it was changed: replay again")

    def read(self, window_id: int, sha256: str) -> Pixels:
        """The next window, u8 [T, H, W, 3], or [T, H, W] if grey.

        Raises:
            DamagedRunError: the video ends too early, its pictures have another size, or these are not the pixels
                with that digest.
        """
        frames: list[Pixels] = []
        count, height, width = self._shape
        for index in range(count):
            good, frame = self._video.read()
            if not good:
                raise DamagedRunError(
                    f"{self._path} ends at frame {index} of {count} of window {window_id}: it is shorter than "
                    "manifest.json says; copy it again, or replay again"
                )
            if frame.shape[:2] != (height, width):
                raise DamagedRunError(
                    f"{self._path} has pictures of {frame.shape[1]} x {frame.shape[0]} pixels, manifest.json says "
                    f"{width} x {height}; one of the two was changed or damaged: replay again"
                )
            plain = frame[..., 0] if self._grey else cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            frames.append(np.asarray(plain, np.uint8))
        pixels = np.stack(frames)
        if pixel_digest(pixels) != sha256:
            raise DamagedRunError(
                f"{self._path}: the pixels of window {window_id} do not have the SHA-256 that manifest.json states; "
                "one of the two was changed or damaged: replay again"
            )
        return pixels

    def require_end(self) -> None:
        """Raises DamagedRunError if more frames follow."""
        if self._video.read()[0]:
            raise DamagedRunError(f"{self._path} has more frames than manifest.json says; replay again")

    def close(self) -> None:
        """Let the file go."""
        self._video.release()


# The folder.


@dataclass(frozen=True, kw_only=True, slots=True)
class RunFolder:
    """A run that lies in `path`; nothing but its manifest was looked at."""

    path: Path
    manifest: Manifest


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WindowPixels:
    """A window with its pixels by view and kind: of "win" u8 [T, H, W, 3] RGB; of "cls" and "vis" u8 [T, H, W]; of
    "depth" u8 [T, H, 2 W], the bytes of its values."""

    entry: WindowEntry
    views: dict[str, dict[str, Pixels]]


def open_run(path: Path) -> RunFolder:
    """Read the manifest of a run.

    Raises:
        SourceError: there is no such folder.
        DamagedRunError: the folder has no manifest (a replay that was cut short leaves none), or a damaged one.
    """
    if not path.is_dir():
        raise SourceError(f"no such folder: {path}; give one that `gcd-node replay --out` wrote")
    file = path / MANIFEST
    if not file.exists():
        raise DamagedRunError(f"{path} has no {MANIFEST}: it is no run, or one that did not finish; replay again")
    try:
        return RunFolder(path=path, manifest=parse_manifest(read_small(file, _MAX_MANIFEST), str(file)))
    except FileError as error:
        raise DamagedRunError(f"{file} {error}; replay again, or a shorter part of the recording") from error


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

        def reader(view_id: str, kind: KeptKind) -> PixelReader:
            path = pixels_path(run.path, view_id, kind)
            if path not in readers:
                shape = size.frames, size.height, (2 if kind == "depth" else 1) * size.width
                readers[path] = stack.enter_context(closing(PixelReader(path, shape=shape, grey=kind != "win")))
            return readers[path]

        for window in run.manifest.windows:
            views = {
                view_id: {kind: reader(view_id, kind).read(window.window_id, sha) for kind, sha in view.sha256.items()}
                for view_id, view in window.views.items()
            }
            yield WindowPixels(entry=window, views=views)
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
    if path.is_dir() and any(path.iterdir()):
        raise OutputError(f"{path} is there already and not empty; name another folder, or remove it first")
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file; name a folder")
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    shutil.rmtree(part, ignore_errors=True)  # of a process that had our number and was killed
    make_folder(part)
    try:
        yield part
        try:
            part.replace(path)
        except OSError as error:
            raise OutputError(f"cannot create {path}: {error.strerror}; name another folder") from error
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
