"""What the cache asks of a driving set."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class MomentPictures:
    """One moment. source: u8 [H, W, 3]. targets: u8 [P, H, W, 3], one for each position that was asked for."""

    source: Bytes
    targets: Bytes


class PathPictures(Protocol):
    """Pictures along a fixed path, at the size the model takes. Has to survive pickling: workers get a copy."""

    @property
    def scenes(self) -> Sequence[str]:
        """Names."""
        ...

    @property
    def origin(self) -> str:
        """Names the set and how its pictures are made, wherever it lies."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second of the scenes."""
        ...

    @property
    def semantic(self) -> bool:
        """Whether targets are class maps in the colours of the palette."""
        ...

    def frames(self, scene: str, /) -> int:
        """Time steps of a scene, those that are missing counted in."""
        ...

    def moment(self, scene: str, time: int, positions: Sequence[int], /) -> MomentPictures:
        """Source and targets of a frame. Raises DataError where it is missing or damaged."""
        ...
