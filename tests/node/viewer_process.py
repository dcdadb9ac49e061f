"""A node in a process of its own, steered by angles; says when it is there and runs until it is killed. Not a test:
started by test_viewer_browser.py."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from fakes import FakeSynthesizer, traits
from rig import rig_config

from gcd_node.frame import Frame, SourceInfo
from gcd_node.lifecycle import Parts
from gcd_node.session import open_session

VIEWS = "[view.left]\nazimuth_deg = -30.0\n[view.swing]\nkind = 'orbit'\nrate_deg_s = 10.0\namplitude_deg = 20.0"
SOURCE = 'kind = "synthetic"\npace = "realtime"'
WIDTH, HEIGHT, FPS = 192, 128, 24.0


class Bar:
    """A bright bar that wanders across the picture, in real time and for ever."""

    def __init__(self) -> None:
        self.info = SourceInfo(
            kind="synthetic", id="bar", width=WIDTH, height=HEIGHT, fps_nominal=FPS, clock="replay", hfov_deg=53.1
        )
        self.corrupt = 0
        self._closed = False

    def frames(self) -> Iterator[Frame]:
        """At 24 FPS."""
        began_s, seq = time.monotonic(), 0
        while not self._closed:
            image = np.full((HEIGHT, WIDTH, 3), (40, 60, 90), np.uint8)
            at = 4 * seq % WIDTH
            image[:, at : at + 24] = (250, 180, 40)
            yield Frame(image=image, stamp_ns=round(seq * 1e9 / FPS), seq=seq)
            seq += 1
            time.sleep(max(0.0, began_s + seq / FPS - time.monotonic()))

    def close(self) -> None:
        """End `frames`."""
        self._closed = True


def main(folder: Path) -> None:
    """Run the node on sockets in `folder`."""
    config = rig_config(folder, SOURCE, VIEWS, "")
    model = FakeSynthesizer(traits())
    parts = Parts(open_source=lambda _: Bar(), load_model=lambda _: model)
    with open_session(config, parts=parts, once=False) as (node, *_):
        print("there", flush=True)
        node.run()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
