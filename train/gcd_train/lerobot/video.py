"""Pictures of a video at wanted times."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gcd_train.data.files import FileFault
from gcd_train.lerobot.extra import load_av

_EARLY_S = 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class VideoClip:
    """pictures: u8 [T, H, W, 3], RGB. bytes_read: of packets."""

    pictures: NDArray[np.uint8]
    bytes_read: int


def read_pictures(path: Path, times_s: Sequence[float], tolerance_s: float) -> VideoClip:
    """The picture nearest to each time.

    Args:
        times_s: rising, seconds in the file.
        tolerance_s: a picture farther away in time is none.
    Raises: FileFault: the video is missing, damaged, too short, or has no picture near enough. DataError: no PyAV.
    """
    av = load_av()
    if not path.is_file():
        raise FileFault(path, "is missing: download or export the data set again")
    counted = _Counted()
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise FileFault(path, "holds no video")
            shown = _pictures_since(container, times_s[0], counted)
            chosen = list(_nearest(path, shown, times_s, tolerance_s))
    except (av.FFmpegError, ValueError, IndexError) as error:
        raise FileFault(path, f"is damaged ({error})") from error
    return VideoClip(pictures=np.stack(chosen), bytes_read=counted.bytes)


@dataclass(slots=True)
class _Counted:
    bytes: int = 0


def _pictures_since(container: Any, first_s: float, counted: _Counted) -> Iterator[tuple[float, Any]]:
    """Time and frame of every picture, from a little before `first_s`."""
    stream = container.streams.video[0]
    stream.thread_type = "NONE"  # loader workers share the cores
    begin = max(0.0, first_s - _EARLY_S)
    container.seek(int(begin / stream.time_base), stream=stream, backward=True)
    for packet in container.demux(stream):
        counted.bytes += packet.size
        for frame in packet.decode():
            if frame.pts is not None:
                yield float(frame.pts * frame.time_base), frame


def _nearest(
    path: Path, shown: Iterator[tuple[float, Any]], times_s: Sequence[float], tolerance_s: float
) -> Iterator[NDArray[np.uint8]]:
    """One picture a wanted time; a picture may serve two."""
    before: tuple[float, Any] | None = None
    after = next(shown, None)
    for wanted in times_s:
        while after is not None and after[0] < wanted:
            before, after = after, next(shown, None)
        there = [pair for pair in (before, after) if pair is not None]
        if not there:
            raise FileFault(path, "holds no picture that can be decoded")
        time, frame = there[0] if abs(there[0][0] - wanted) <= abs(there[-1][0] - wanted) else there[-1]
        if abs(time - wanted) > tolerance_s:
            end = f"it ends at {time:.3f} s" if after is None else f"the nearest is at {time:.3f} s"
            raise FileFault(path, f"has no picture within {1000 * tolerance_s:.1f} ms of {wanted:.3f} s: {end}")
        yield frame.to_ndarray(format="rgb24")
