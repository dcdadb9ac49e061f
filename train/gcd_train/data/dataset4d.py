"""Scenes seen by several cameras at once: what both published sets have in common."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics
from gcd_train.data.ontology import Ontology
from gcd_train.data.sample import Bytes, SceneView
from gcd_train.errors import DataError
from gcd_train.scenes.description import rotations

KEPT_SCENES = 64
"""Scenes whose facts stay in memory."""
_UNIT_TOLERANCE = 0.02


class Dataset4D(ABC):
    """Scenes of a folder. Reads when asked; one object for each process or thread.

    scenes: names, in order. cameras: names, in published order; all must be there at a time step. source_camera: whose
    own video is the input in evaluation (and in driving always). fps: of the scenes. ontology: the classes; None where
    the set has none.
    """

    fps: float
    ontology: Ontology | None = None

    def __init__(self, root: Path, scenes: Sequence[str], cameras: Sequence[str], source_camera: str) -> None:
        self.root, self.scenes, self.cameras = root, tuple(scenes), tuple(cameras)
        self.source_camera = source_camera

    def only(self, scenes: Sequence[str]) -> Self:
        """The same set, reduced to these scenes and in their order. Raises DataError if none is left."""
        if not scenes:
            raise DataError(f"no scene of the list or split is in {self.root}; look at how its scenes are named")
        fewer = copy(self)
        fewer.scenes = tuple(scenes)
        return fewer

    @property
    def palette(self) -> Bytes | None:
        """u8 [256, 3], RGB colour by class id; None without classes."""
        return None if self.ontology is None else self.ontology.palette

    def folder(self, scene: str) -> Path:
        """Where the scene lies."""
        return self.root / scene

    @abstractmethod
    def frames(self, scene: str) -> int:
        """Time steps of a scene, whether or not each of them can be read. Raises FileFault (a DataError)."""

    @abstractmethod
    def lens(self, scene: str) -> Intrinsics:
        """The lens of the source camera, in pixels of its picture. Raises FileFault (a DataError)."""

    @abstractmethod
    def pose(self, scene: str, camera: str, time: int = 0) -> NDArray[np.float64]:
        """world_from_camera of a view, f64 [4, 4], metres. Raises FileFault."""

    @abstractmethod
    def views(self, scene: str, time: int, cameras: Sequence[str] | None = None) -> list[SceneView]:
        """What the cameras (all, if None) saw at a time step, in the order asked for.

        Raises FileFault (a DataError) that names the file which is missing, damaged or does not fit.
        """


def scene_names(root: Path, number: Callable[[str], int | None], example: str) -> list[str]:
    """The scenes of a folder by number. Raises DataError if there is none."""
    try:
        found = [path.name for path in root.iterdir() if number(path.name) is not None]
    except OSError as error:
        raise DataError(f"{root} cannot be read ({error}); give the folder that holds {example}") from error
    if not found:
        raise DataError(f"{root} holds no scene of this layout; give the folder that holds {example} and so on")
    return sorted(found, key=lambda name: number(name) or 0)


def pose_from_quaternion(quaternions: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations and positions as rigid matrices.

    Args:
        quaternions: f64 [..., 4], w x y z; of length 1 but for rounding, which is taken out.
        positions: f64 [..., 3], metres.
    Returns:
        a_from_b: f64 [..., 4, 4].
    Raises:
        DataError: a number is not finite, or a quaternion is not of length 1.
    """
    lengths = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if not (np.isfinite(positions).all() and np.isfinite(lengths).all()):
        raise DataError("a pose must be finite, got NaN or infinite numbers")
    if float(np.abs(lengths - 1.0).max()) > _UNIT_TOLERANCE:
        raise DataError(f"a rotation must be a quaternion of length 1, got one of {float(lengths.min()):.3g}")
    poses = np.zeros((*positions.shape[:-1], 4, 4))
    poses[..., :3, :3] = rotations(quaternions / lengths)
    poses[..., :3, 3] = positions
    poses[..., 3, 3] = 1.0
    return poses
