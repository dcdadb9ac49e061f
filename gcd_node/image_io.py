"""Pictures, videos, arrays and received views to files, arrays back, and pictures side by side. Images are u8 RGB
[H, W, 3]."""

import math
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_client.protocol import ClassRecord, ViewHeader, kind_of
from gcd_client.subscriber import ReceivedView
from gcd_model import hatched
from gcd_node.errors import OutputError, SourceError
from gcd_node.frame import Image

_LEGEND_WIDTH = 384  # pixels, of saved class maps
_MOST_BYTES = 2**30  # of all arrays in a file, unfolded
_COLUMN_WIDTH = 320  # pixels; smaller pictures are enlarged by a whole factor to at least this
_FONT, _SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.45
_LINE, _SWATCH, _GAP, _RULE = 22, 14, 6, 4
_INK, _PAPER = (30, 30, 30), 255


def to_u8(video: NDArray[np.float32] | NDArray[np.uint8]) -> Image:
    """[T, 3, H, W] in [0, 1], or in levels already -> u8 [T, H, W, 3], rounded to the nearest level."""
    if video.dtype == np.uint8:
        return np.ascontiguousarray(video.transpose(0, 2, 3, 1), np.uint8)
    frames, _, height, width = video.shape
    pixels = np.empty((frames, height, width, 3), np.uint8)
    for picture, frame in zip(pixels, np.ascontiguousarray(video), strict=True):
        rows = frame.reshape(-1, width)  # of all three planes; what is out of range becomes 0 or 255
        levels = cv2.addWeighted(rows, 255.0, rows, 0.0, 0.0, dtype=cv2.CV_8U).reshape(3, height, width)
        cv2.merge(list(levels), picture)
    return pixels


# Files.


def make_folder(folder: Path) -> None:
    """Create a folder and those above it. Raises OutputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create {folder}: {error.strerror}; name another folder") from error


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write one picture, [H, W, 3] RGB or [H, W] grey. Raises OutputError."""
    coded = cv2.imencode(".png", image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    write_whole(path, lambda file: file.write(coded.tobytes()))


class VideoWriter:
    """A video: .mp4 is small and lossy, .mkv without loss (FFV1). It begins with the first frame, and has its end after
    `close`. A full disk does not show: OpenCV does not tell."""

    def __init__(self, path: Path, fps: float) -> None:
        self._path, self._fps = path, max(fps, 1.0)
        self._video, self._size = cv2.VideoWriter(), (0, 0)

    def add(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Append pictures, [H, W, 3] RGB. Raises OutputError: it cannot be written, or the size is another than
        before."""
        for frame in frames:
            size = (frame.shape[1], frame.shape[0])
            if not self._video.isOpened():
                make_folder(self._path.parent)
                code = cv2.VideoWriter.fourcc(*("FFV1" if self._path.suffix == ".mkv" else "mp4v"))
                self._size = size
                if not self._video.open(str(self._path), code, self._fps, size):
                    raise OutputError(f"cannot write {self._path}; is there space, and may this user write there?")
            if size != self._size:
                raise OutputError(f"{self._path} holds pictures of {self._size}, now {size}; write to a new folder")
            self._video.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """Finish the file."""
        self._video.release()


def write_video(path: Path, frames: Iterable[Image], fps: float) -> None:
    """Write a whole video, see VideoWriter. Raises OutputError."""
    writer = VideoWriter(path, fps)
    writer.add(frames)
    writer.close()


def read_npy(path: Path, wanted: str) -> NDArray[Any]:
    """The array of a .npy file, never a pickle. wanted: what it should hold, for the message. Raises SourceError."""
    try:
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        if zipfile.is_zipfile(path):
            raise ValueError("it is an archive of arrays")
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it holds more than {_MOST_BYTES} bytes")
        return np.load(path, allow_pickle=False)
    except Exception as error:  # numpy raises many kinds for a damaged file
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).split("\n")[0]
        raise SourceError(f"cannot read {path}: {reason or type(error).__name__}; give {wanted}") from error


def write_arrays(path: Path, arrays: NDArray[Any] | Mapping[str, NDArray[Any]]) -> None:
    """Write one array to .npy, several by name to .npz; the file appears whole or not at all. Raises OutputError."""
    if isinstance(arrays, np.ndarray):
        write_whole(path, lambda file: np.save(file, arrays, allow_pickle=False))
    else:
        write_whole(path, lambda file: np.savez(file, allow_pickle=False, **arrays))


def write_whole(path: Path, save: Callable[[BinaryIO], object]) -> None:
    """Write a file that is there once all of it is. Raises OutputError."""
    part = path.with_name(path.name + ".part")
    make_folder(path.parent)
    try:
        with part.open("wb") as file:
            save(file)
        part.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; name another file or folder") from error


# Views of a running node.


class ViewSaver:
    """Writes each window's frames as `<view>/<window>_<frame>.png`, and all of a view as lossless `<view>.mkv`.

    Other kinds go to a folder of their own: `<view>/<kind>/<window>_<frame>.png`, `<view>/<kind>.mkv`. Single frames,
    of which a window may give many, are numbered as the source did. Class maps and visibility are shown in colour, with
    a `legend.png`; their numbers are in `<window>.npy`, u8 [T, H, W]; of depth float32 [T, H, W], 1/m.

    hatch: also write windows whose visibility comes with lines over their painted pixels, to `<view>/hatched`.

    Raises:
        OutputError: a file cannot be written, or a view changes its size.
    """

    def __init__(self, folder: Path, *, hatch: bool = False) -> None:
        self._folder, self._hatch = folder, hatch
        self._windows: dict[str, ReceivedView] = {}  # the newest of each view, whose visibility is next
        self._videos: dict[Path, VideoWriter] = {}
        self._legends: set[Path] = set()
        self.files = 0

    def add(self, view: ReceivedView) -> None:
        """Write one message's frames."""
        view_id, kind = view.header.view_id, kind_of(view.message.topic)
        folder = self._folder / view_id / ("" if kind == "win" else kind)
        self._write(view, view.colours, folder)
        if kind == "win" and self._hatch:
            self._windows[view_id] = view
        elif kind == "vis" and view_id in self._windows:
            window = self._windows.pop(view_id)
            if _moment(window.header) == _moment(view.header):
                shown = hatched(window.colours, view.images[..., 0])
                self._write(window, shown, self._folder / view_id / "hatched")

    def close(self) -> None:
        """Finish the videos; until then they may lack their end."""
        for video in self._videos.values():
            video.close()

    def _write(self, view: ReceivedView, frames: Image, folder: Path) -> None:
        header, kind = view.header, kind_of(view.message.topic)
        for index, frame in enumerate(frames):
            number = f"{header.src.seq[0]:06d}" if kind == "frm" else f"{index:02d}"  # many of these share a window
            write_png(folder / f"{header.window_id:06d}_{number}.png", frame)
        self.files += len(frames)
        if kind == "depth" or header.classes is not None:
            numbers = view.inverse_depth if kind == "depth" else view.images[..., 0]
            write_arrays(folder / f"{header.window_id:06d}.npy", numbers)
            self.files += 1
        if header.classes is not None and folder not in self._legends:
            write_png(folder / "legend.png", legend(header.classes, _LEGEND_WIDTH))
            self._legends.add(folder)
            self.files += 1
        path = folder.with_suffix(".mkv")
        if path not in self._videos:
            self._videos[path] = VideoWriter(path, header.src.fps_cond)
            self.files += 1
        self._videos[path].add(frames)


def _moment(header: ViewHeader) -> tuple[object, ...]:
    return header.boot_id, header.view_rev, header.window_id, header.shape[:3]


# Side by side.


def strip(rows: Sequence[Sequence[Image]]) -> Image:
    """Rows of pictures under each other, a thin white line between all; every row has as many."""
    white = (_PAPER,) * 3
    framed = [
        [cv2.copyMakeBorder(each, 0, _RULE, 0, _RULE, cv2.BORDER_CONSTANT, value=white) for each in row] for row in rows
    ]
    joined = np.concatenate([np.concatenate(row, axis=1) for row in framed])
    return np.ascontiguousarray(joined[:-_RULE, :-_RULE], np.uint8)


def spread(count: int, most: int) -> list[int]:
    """Up to `most` indices from 0 to count-1, first and last included, evenly spread."""
    most = min(most, count)
    return [math.floor(i * (count - 1) / max(most - 1, 1) + 0.5) for i in range(most)]


def enlarged(image: Image, *, smooth: bool = False) -> Image:
    """A picture whose columns can be told apart on a screen. smooth: a photograph; else there are no new levels."""
    factor = max(1, -(-_COLUMN_WIDTH // image.shape[1]))
    if smooth:
        size = (factor * image.shape[1], factor * image.shape[0])
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    return np.repeat(np.repeat(image, factor, axis=0), factor, axis=1)


def sheet(body: Image, headings: Sequence[str], classes: Sequence[ClassRecord]) -> Image:
    """A heading above each of as many equal columns, and below what the colours of class maps mean."""
    width = body.shape[1]
    line = np.full((_LINE, width, 3), _PAPER, np.uint8)
    for index, heading in enumerate(headings):
        _write(line, heading, _GAP + index * width // len(headings), 0)
    return np.concatenate([line, body, *([legend(classes, width)] if classes else [])])


def legend(classes: Sequence[ClassRecord], width: int) -> Image:
    """Each class's colour and name in columns, in as many lines of `width` pixels as needed: [lines * 22, width, 3]."""
    names = [each.name.replace("_", " ") for each in classes]
    wide = max(cv2.getTextSize(name, _FONT, _SCALE, 1)[0][0] for name in names) + _SWATCH + 3 * _GAP
    columns = max(1, width // wide)
    picture = np.full((-(-len(names) // columns) * _LINE, width, 3), _PAPER, np.uint8)
    for index, (each, name) in enumerate(zip(classes, names, strict=True)):
        line, left = index // columns, index % columns * wide + _GAP
        top = line * _LINE + (_LINE - _SWATCH) // 2
        picture[top : top + _SWATCH, left : left + _SWATCH] = each.colour
        _write(picture, name, left + _SWATCH + _GAP, line)
    return picture


def _write(picture: Image, text: str, left: int, line: int) -> None:
    baseline = (left, line * _LINE + _LINE - 7)
    cv2.putText(picture, text, baseline, _FONT, _SCALE, _INK, 1, cv2.LINE_AA)
