"""Push what OpenCV reads into a node that runs launch/push.toml: `python push_opencv.py 0`, an address or a video file.

A file plays at its own rate. Needs opencv-python-headless and gcd-client.
"""

import argparse
import time
from pathlib import Path

import cv2

from gcd_client import FramePusher


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", help="a camera's number, a stream's address or a video file")
    parser.add_argument("--endpoint", default="ipc", help="of the node: ipc, ipc:///some/path or tcp://HOST:PORT")
    arguments = parser.parse_args()
    source: str = arguments.source
    capture = cv2.VideoCapture(int(source)) if source.isdigit() else cv2.VideoCapture(source)
    period_s = 1 / capture.get(cv2.CAP_PROP_FPS) if Path(source).is_file() else 0.0
    due_s = time.monotonic()
    with FramePusher(arguments.endpoint) as pusher:
        while capture.grab():
            stamp_ns = time.time_ns()
            good, picture = capture.retrieve()
            if good:
                pusher.push(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), stamp_ns)
            due_s += period_s
            time.sleep(max(0.0, due_s - time.monotonic()) if period_s else 0.0)
        print(f"pushed, of which {pusher.skipped} were skipped: no node was there, or it was busy")


if __name__ == "__main__":
    main()
