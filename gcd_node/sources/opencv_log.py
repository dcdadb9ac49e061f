"""OpenCV's and FFmpeg's own messages, kept off the terminal: they are no use to a user, and may hold an address with a
password in it."""

import os
import threading
from collections.abc import Generator
from contextlib import contextmanager

from cv2.utils import logging as cv2_logging

_LOCK = threading.Lock()
_LEVELS: list[int] = []  # one for every block that is being kept quiet; the first is the level to go back to


@contextmanager
def quiet_opencv() -> Generator[None]:
    """Silence for the length of a block; blocks of several threads may overlap."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first video is opened
    with _LOCK:
        _LEVELS.append(_LEVELS[0] if _LEVELS else cv2_logging.getLogLevel())
        cv2_logging.setLogLevel(cv2_logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        with _LOCK:
            level = _LEVELS.pop()
            if not _LEVELS:
                cv2_logging.setLogLevel(level)
