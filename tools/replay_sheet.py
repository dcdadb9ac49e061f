"""Frames of a replay in one picture: the recording above, each view below.

python tools/replay_sheet.py RUN VIDEO --picture sheet.png --frames 6
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def video_frames(video: Path) -> list[Picture]:
    """All of them, BGR."""
    capture, frames = cv2.VideoCapture(str(video)), list[Picture]()
    while (read := capture.read())[0]:
        frames.append(np.asarray(read[1], np.uint8))
    capture.release()
    return frames


def view_frames(view: Path) -> list[Picture]:
    """The frame of each window that a replay wrote of a view, BGR."""
    return [np.asarray(cv2.imread(str(path)), np.uint8) for path in sorted(view.glob("*.win.png"))]


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Frames of a replay in one picture.")
    parser.add_argument("run", type=Path, help="what gcd-node replay --out wrote, windows of one frame")
    parser.add_argument("video", type=Path, help="the recording")
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--picture", type=Path, required=True)
    options = parser.parse_args()
    views = [view_frames(path) for path in sorted(options.run.glob("*/"), reverse=True)]
    count = min(map(len, views))
    chosen = np.linspace(count * 0.1, count - 1, options.frames).round().astype(int)
    height, width = views[0][0].shape[:2]
    source = [cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA) for frame in video_frames(options.video)]
    rows = [np.concatenate([frames[i] for i in chosen], axis=1) for frames in (source, *views)]
    cv2.imwrite(str(options.picture), np.concatenate(rows))


if __name__ == "__main__":
    main()
