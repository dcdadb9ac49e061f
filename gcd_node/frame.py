"""One picture with its capture stamp, and what every source of such pictures promises."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gcd_node.calibration import LensModel
from gcd_node.errors import SourceError
from gcd_node.sources import LIVE_KINDS, SourceKind

Image: TypeAlias = NDArray[np.uint8]
"""u8 [H, W, 3], RGB."""

Clock: TypeAlias = Literal["realtime", "replay"]
"""Domain of a stamp. "realtime": a live source; its stamps are on this host's monotonic clock, and are converted to
UTC when they are published. "replay": of a recording, from its start or from its own clock."""


MAX_FPS = 1000.0
"""Frame rates above this are taken for a mistake."""

MAX_PIXELS = 64_000_000
"""Larger pictures are refused before they are decoded: so many pixels are 192 MB."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frame:
    """A picture as the camera took it.

    image: u8 [H, W, 3], RGB. The frame takes the array over: it is read-only from here on.
    stamp_ns: when it was captured, on the source's clock.
    seq: the source's own sequence number, gaps included.
    depth: float32 [H, W], metres along the camera's axis at the picture's pixels, 0 where unknown; None without.
    odometry: float64 [4, 4], world_from_camera, rigid, metres, camera axes x right, y down, z ahead, of any world that
        stays the same from frame to frame; None without.
    Raises SourceError for an array of another type or shape.
    """

    image: Image
    stamp_ns: int
    seq: int
    depth: NDArray[np.float32] | None = None
    odometry: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.size == 0:
            raise SourceError(
                f"frame {self.seq} must be u8 [H, W, 3], got {self.image.dtype} {list(self.image.shape)}: "
                "convert it in the source"
            )
        self._require(self.depth, "depth", np.float32, self.image.shape[:2])
        self._require(self.odometry, "odometry", np.float64, (4, 4))
        self.image.setflags(write=False)

    def _require(self, array: NDArray[Any] | None, name: str, kind: type, shape: tuple[int, ...]) -> None:
        if array is not None and (array.dtype != kind or array.shape != shape):
            raise SourceError(
                f"{name} of frame {self.seq} must be {kind.__name__} {list(shape)}, got {array.dtype} "
                f"{list(array.shape)}: convert it in the source"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class SourceInfo:
    """What is known of a source once it is open.

    kind: as a launch file names it. id: a short name, no folder in it.
    width, height: of the first frame, pixels.
    fps_nominal: the rate the source states; stamps are what counts.
    clock: domain of the stamps.
    codec: of a recording, four characters or a picture format; None if there is none.
    hfov_deg: horizontal field of view, if the source itself knows it.
    lens: calibration the source itself knows, for pictures of the size above.
    stamp_uncertainty_us: how far a stamp may be from mid-exposure.
    """

    kind: SourceKind
    id: str
    width: int
    height: int
    fps_nominal: float
    clock: Clock
    codec: str | None = None
    hfov_deg: float | None = None
    lens: LensModel | None = None
    stamp_uncertainty_us: int = 500

    @property
    def live(self) -> bool:
        """Whether it cannot be played again, and may fall silent and come back."""
        return self.kind in LIVE_KINDS

    def hfov_in_use(self, stated_deg: float | None) -> float | None:
        """The field of view a launch file states, else what the source itself knows, degrees."""
        return self.hfov_deg if stated_deg is None else stated_deg


class FrameSource(Protocol):
    """Where frames come from. It is open once it is made; what cannot be opened raises SourceError there, within its
    open time-out.

    A live source that falls silent only blocks in `frames`: whoever watches it (stall timer) closes it and makes a new
    one. Its stamps may repeat or step back if the device does; the window builder sorts that out.
    """

    @property
    def corrupt(self) -> int:
        """Frames so far that arrived damaged and were not yielded."""
        ...

    @property
    def info(self) -> SourceInfo:
        """What is known of the source; does not change."""
        ...

    def frames(self) -> Iterator[Frame]:
        """Yield frames with rising `stamp_ns`; return at the end; raise SourceLostError if the device is lost.

        Of a recording, every call starts at its beginning. Of a live source, frames the caller was too slow for are
        skipped (their sequence numbers show it): at most the latest four wait.
        """
        ...

    def close(self) -> None:
        """End `frames` within a second, from any thread, for good, even if the device never answers again."""
        ...
