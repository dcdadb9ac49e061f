"""A recorder in its own process that never stops by itself.

recording_process.py FOLDER COUNT
Prints `written` once COUNT frames are in the file for everybody to read, and goes on recording.
"""

import sys
import time
from pathlib import Path

import numpy as np
from fakes import HEIGHT, WIDTH, Box
from recordings import files, recorder_config, salvaged

from gcd_node.frame import Frame, SourceInfo
from gcd_node.recorder import Recorder

FPS = 100.0


def main() -> None:
    folder, count = Path(sys.argv[1]), int(sys.argv[2])
    config = recorder_config(folder, source='kind = "v4l2"')
    recorder = Recorder(config, "0" * 32, lambda: config, lambda *_: None, Box())
    info = SourceInfo(kind="v4l2", id="test", width=WIDTH, height=HEIGHT, fps_nominal=FPS, clock="realtime")
    recorder.source(info, None)
    recorder.start()
    draw, seq, told = np.random.default_rng(0), 0, False
    while True:
        image = draw.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
        recorder.frame(Frame(image=image, stamp_ns=time.monotonic_ns(), seq=seq))
        seq += 1
        time.sleep(1 / FPS)
        if not told and seq % 20 == 0 and (found := files(folder)):
            told = len(salvaged(found[0], "/src/image")) >= count
            if told:
                print("written", flush=True)


main()
