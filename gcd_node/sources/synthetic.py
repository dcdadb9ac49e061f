"""A moving pattern: frames without a camera or a file, for tests and for trying the plumbing."""

from collections.abc import Iterator
from itertools import count

import numpy as np

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_FPS, Frame, SourceInfo
from gcd_node.sources.pace import Pace, Pacer

_COLOURS = ((200, 60, 40), (60, 160, 60), (40, 80, 200), (220, 220, 210))


class MovingPattern:
    """Eight coloured stripes that move to the left, brighter below; endless unless `frames` is given."""

    corrupt = 0

    def __init__(
        self,
        *,
        fps: float = 10.0,
        frames: int | None = None,
        pace: Pace = "lockstep",
        size: tuple[int, int] = (640, 480),
    ) -> None:
        """size: width and height. Raises SourceError for an impossible rate."""
        if not 0 < fps <= MAX_FPS:
            raise SourceError(f"the fps of a moving pattern must lie between 0 and {MAX_FPS:g}, got {fps:g}")
        self._frames, self._pacer, (width, height) = frames, Pacer(pace), size
        self.info = SourceInfo(
            kind="synthetic", id="pattern", width=width, height=height, fps_nominal=fps, clock="replay", hfov_deg=85.0
        )
        stripes = np.array(_COLOURS)[np.arange(2 * width) * 8 // width % len(_COLOURS)]
        self._pattern = (stripes * np.linspace(0.4, 1.0, height)[:, None, None]).astype(np.uint8)

    def frames(self) -> Iterator[Frame]:
        """Every frame, from the first. See FrameSource.frames."""
        offset_ns = self._pacer.start(0)
        width = self.info.width
        for seq in count() if self._frames is None else range(self._frames):
            stamp_ns, left = round(seq * 1e9 / self.info.fps_nominal), seq * width // 128 % width
            if not self._pacer.wait(stamp_ns, offset_ns):
                return
            yield Frame(image=self._pattern[:, left : left + width].copy(), stamp_ns=stamp_ns, seq=seq)

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._pacer.stop()
