"""Pictures and videos as files, and figures by matplotlib, an extra."""

import io
import os
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import DataError, RenderError, RunError
from gcd_train.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110
_BOXES = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
_QUIET = ("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened; the decoder prints its own lines else


def png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file of an RGB picture, uint8 [H, W, 3]."""
    done, data = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    return data.tobytes()


def write_mp4(frames: Iterable[NDArray[np.uint8]], fps: float, out: Path) -> None:
    """One picture or more of one even size, as MPEG-4 part 2. Raises RunError if it cannot be written."""
    out.parent.mkdir(parents=True, exist_ok=True)
    each = iter(frames)
    first = next(each)
    video = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), fps, (first.shape[1], first.shape[0]))
    if not video.isOpened():
        raise RunError(f"{out} cannot be written; give a folder that takes files with --out")
    for frame in chain([first], each):
        video.write(frame[..., ::-1])
    video.release()


@contextmanager
def opened_video(path: Path) -> Generator[cv2.VideoCapture]:
    """A video file to read, told by its first bytes: the decoder would also play a text, or follow a play list.

    Raises: DataError for what is no video, or cannot be decoded.
    """
    try:
        if not path.is_file():
            raise DataError(f"{path} is no regular file; give a video")
        with path.open("rb") as file:
            head = file.read(12)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; check the path and its rights") from error
    known = head[4:8] in _BOXES or head[:4] == b"\x1a\x45\xdf\xa3" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
    if not known:
        raise DataError(f"{path} is no whole video file; wanted is an MP4, MOV, MKV, WebM or AVI file")
    os.environ.setdefault(*_QUIET)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    try:
        if not capture.isOpened():
            raise DataError(f"{path} cannot be decoded: truncated or damaged; copy or record it again")
        yield capture
    finally:
        capture.release()


def video_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Every frame of a video as RGB, uint8 [H, W, 3]. Raises DataError as `opened_video`."""
    with opened_video(path) as capture:
        while (found := capture.read())[0]:
            yield np.asarray(cv2.cvtColor(found[1], cv2.COLOR_BGR2RGB), np.uint8)


def require_matplotlib() -> None:
    """Raises RenderError, naming the extra, where matplotlib is not installed."""
    try:
        import_module("matplotlib.figure")
    except ImportError as error:
        raise RenderError(
            f"figures need matplotlib ({error}); install it with pip install 'gcd-node[train]'"
        ) from error


def new_figure(width_in: float, height_in: float) -> "Figure":
    """An empty white figure, drawn by Agg, sizes in inches at 110 pixels. Raises RenderError without matplotlib."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG, in one piece. Raises RunError if it cannot be written."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    write_whole(out, drawn.getvalue())
