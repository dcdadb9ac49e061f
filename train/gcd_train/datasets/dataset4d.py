"""What training asks of a data set that sees scenes with several cameras at once, and what it gives back."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, Spherical
from gcd_train.datasets.ontology import Ontology
from gcd_train.datasets.skips import Skipped
from gcd_train.scene_view import SceneView

Bytes = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class PairSample:
    """One clip of T frames of H x W.

    source, target: u8 [T, H, W, 3] RGB; the target is palette-coloured where the modality is classes.
    target_classes: u8 [T, H, W] class ids, None where not asked for. source_from_target: f64 [T, 4, 4], metres.
    start: the source camera on the sphere, and deltas: f64 [T, 3] azimuth and elevation in degrees and radius in
    metres, target minus source; None for paths that are not on the sphere. motion: the number that tells the network
    how far the camera moves. fps: of the clip, after the stride.
    scene: its name. frame_numbers: of the scene, T. reversed: the clip runs backwards in time. visible: bool
    [T, H, W], target pixels that the source camera saw, None where not asked for. skipped: what was tried before
    and left out. bytes_read: of files.
    """

    source: Bytes
    target: Bytes
    target_classes: Bytes | None
    source_from_target: NDArray[np.float64]
    start: Spherical | None
    deltas: NDArray[np.float64] | None
    motion: int
    fps: float
    scene: str
    frame_numbers: tuple[int, ...]
    reversed: bool
    visible: NDArray[np.bool_] | None
    skipped: tuple[Skipped, ...] = ()
    bytes_read: int = 0


class Dataset4D(Protocol):
    """Scenes seen by several cameras at once. `Kubric4D` and `ParallelDomain4D` are two."""

    @property
    def scenes(self) -> Sequence[str]:
        """Names, in order."""
        ...

    @property
    def cameras(self) -> Sequence[str]:
        """Names, in published order."""
        ...

    @property
    def source_camera(self) -> str:
        """The camera whose own video is the input in evaluation (and in driving always)."""
        ...

    @property
    def fps(self) -> float:
        """Frames per second of the scenes."""
        ...

    @property
    def ontology(self) -> Ontology | None:
        """The classes; None where the set has none."""
        ...

    @property
    def palette(self) -> Bytes | None:
        """u8 [256, 3], RGB colour by class id; None where the set has no classes."""
        ...

    def folder(self, scene: str) -> Path:
        """Where the scene lies."""
        ...

    def frames(self, scene: str) -> int:
        """Time steps of a scene, whether or not each of them can be read. Raises FileFault (a DataError)."""
        ...

    def lens(self, scene: str) -> Intrinsics:
        """The lens of the source camera, in pixels of its picture. Raises FileFault (a DataError)."""
        ...

    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """What the cameras (all, if None) saw at a time step, in the order asked for.

        Raises FileFault (a DataError) that names the file which is missing, damaged or does not fit.
        """
        ...
