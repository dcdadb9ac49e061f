"""A drawn drive down a street: frames without a camera, the same for the same seed."""

from collections.abc import Iterator
from itertools import count

import cv2
import numpy as np

from gcd_node.errors import SourceError
from gcd_node.frame import MAX_FPS, Frame, Image, SourceInfo
from gcd_node.sources.pace import Pace, Pacer
from gcd_node.sources.ray_cast import draw_street
from gcd_node.sources.street import Street

HFOV_DEG = 85.0
"""Horizontal field of view of the driving camera, degrees; it stands 1.6 m ahead of the car's middle, 1.55 m up."""


class SyntheticDrive:
    """A drive at 8 m/s as a FrameSource; endless unless `frames` is given."""

    def __init__(
        self,
        *,
        width: int = 640,
        height: int = 480,
        fps: float = 10.0,
        seed: int = 0,
        frames: int | None = None,
        smooth: bool = False,
        pace: Pace = "lockstep",
    ) -> None:
        """Lay out the street.

        Args:
            width, height: pixels.
            fps: frames per second.
            seed: of the street, 0 or more.
            frames: end after so many.
            smooth: draw at twice the size and average; no jagged edges, for four times the work.
            pace: "realtime" yields every frame at its time, "lockstep" as soon as it is asked for.
        Raises:
            SourceError: a number out of range.
        """
        if not 0 < fps <= MAX_FPS or width < 2 or height < 2 or seed < 0 or (frames is not None and frames < 1):
            raise SourceError(
                f"a synthetic drive needs 0 < fps <= {MAX_FPS:g}, at least 2 x 2 pixels, seed >= 0 and frames >= 1, "
                f"got fps {fps:g}, {width} x {height}, seed {seed}, frames {frames}"
            )
        self._street = Street(seed=seed)
        self._frames = frames
        self._smooth = smooth
        self._pacer = Pacer(pace)
        self._info = SourceInfo(
            kind="synthetic",
            id=f"drive-{seed}",
            width=width,
            height=height,
            fps_nominal=fps,
            clock="replay",
            hfov_deg=HFOV_DEG,
        )

    @property
    def corrupt(self) -> int:
        """Always 0."""
        return 0

    @property
    def info(self) -> SourceInfo:
        """Size, rate, field of view."""
        return self._info

    def image(self, seq: int) -> Image:
        """Frame number `seq`, u8 [H, W, 3] RGB."""
        info, scale = self._info, 2 if self._smooth else 1
        time_s = seq / info.fps_nominal
        drawn = draw_street(self._street, time_s, scale * info.width, scale * info.height, HFOV_DEG)
        if not self._smooth:
            return drawn
        return np.asarray(cv2.resize(drawn, (info.width, info.height), interpolation=cv2.INTER_AREA), np.uint8)

    def frames(self) -> Iterator[Frame]:
        """Every frame, from the first. See FrameSource.frames."""
        offset_ns = self._pacer.start(0)
        for seq in count() if self._frames is None else range(self._frames):
            stamp_ns = round(seq * 1e9 / self._info.fps_nominal)
            image = self.image(seq)
            if not self._pacer.wait(stamp_ns, offset_ns):
                return
            yield Frame(image=image, stamp_ns=stamp_ns, seq=seq)

    def close(self) -> None:
        """End `frames` soon, from any thread."""
        self._pacer.stop()
