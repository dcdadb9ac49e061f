"""The fixed driving path through a set in ParallelDomain-4D's layout: pictures for the cache."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gcd_model.geometry import Intrinsics, driving_trajectory
from gcd_train.datasets.dataset4d import Dataset4D
from gcd_train.datasets.pictures_of_draws import trained_picture
from gcd_train.datasets.trajectories import DRIVING, Draw
from gcd_train.errors import DataError, RenderError
from gcd_train.latent_cache.pictures import Bytes, MomentPictures
from gcd_train.pointcloud import published_picture
from gcd_train.scene_view import SceneView

if TYPE_CHECKING:
    from gcd_train.datasets.exact_pictures import ExactPictures


@dataclass(frozen=True, kw_only=True, slots=True)
class DrivingPictures:
    """Source: the forward camera's own picture, cropped and resized. Targets: the point clouds of all cameras.

    data: the scenes. clip_frames: T, which sets where on the path the positions lie. width, height: of the model.
    semantic: targets show the classes in the palette's colours. exact: draws targets from the geometry that our own
    scenes keep, instead; see `exact_targets`.
    Source: Generative Camera Dolly, ParallelDomain-4D, as released.
    """

    data: Dataset4D
    clip_frames: int
    width: int
    height: int
    semantic: bool = False
    exact: "ExactPictures | None" = None

    def __post_init__(self) -> None:
        if self.semantic and self.data.palette is None:
            raise DataError("class maps are wanted and the set was opened without classes; open it with its ontology")

    @property
    def origin(self) -> str:
        """See PathPictures."""
        kind = "classes" if self.semantic else "colour"
        return f"parallel-domain-4d, {kind}, {'points' if self.exact is None else 'exact'}"

    @property
    def scenes(self) -> Sequence[str]:
        """Names."""
        return self.data.scenes

    @property
    def fps(self) -> float:
        """Frames per second of the scenes."""
        return self.data.fps

    def frames(self, scene: str, /) -> int:
        """Time steps of a scene. Raises FileFault."""
        return self.data.frames(scene)

    def moment(self, scene: str, time: int, positions: Sequence[int], /) -> MomentPictures:
        """See PathPictures; a file of the frame is read once. Raises FileFault."""
        cameras = self.data.cameras if self.exact is None else [self.data.source_camera]
        views = self.data.views(scene, time, cameras)
        source = views[list(cameras).index(self.data.source_camera)]
        poses = self._poses(source, positions)
        return MomentPictures(
            source=trained_picture(source.rgb, self.width, self.height),
            targets=self._splatted(views, source.lens, poses)
            if self.exact is None
            else self.exact.make(scene, self._draw(time, source, poses)).target,
        )

    def _splatted(self, views: Sequence[SceneView], lens: Intrinsics, poses: NDArray[np.float64]) -> Bytes:
        values = [self._coloured(view) for view in views] if self.semantic else None
        across, along = self.width, self.height
        return np.stack(
            [published_picture(views, pose, lens, width=across, height=along, values=values) for pose in poses]
        )

    def _draw(self, time: int, source: SceneView, poses: NDArray[np.float64]) -> Draw:
        return Draw(
            frame_numbers=(time,) * len(poses),
            fps=self.data.fps,
            reversed=False,
            world_from_source=source.world_from_camera,
            world_from_target=poses,
            start=None,
            deltas=None,
            motion=DRIVING.motion,
        )

    def _poses(self, source: SceneView, positions: Sequence[int]) -> NDArray[np.float64]:
        path = driving_trajectory(frames=self.clip_frames, move_time=self.clip_frames - 1)
        return source.world_from_camera @ path.source_from_target.numpy()[list(positions)]

    def _coloured(self, view: SceneView) -> Bytes:
        palette = self.data.palette
        if palette is None or view.classes is None:
            raise DataError("class maps are wanted and a view has none; leave out --semantic, or download that layer")
        return palette[view.classes]


def exact_targets(data: Dataset4D, width: int, height: int, *, semantic: bool) -> "ExactPictures":
    """Draws the geometry of our own scenes. Raises RenderError where the extra `scenes` is not installed."""
    try:
        from gcd_train.datasets.exact_pictures import ExactPictures
    except ImportError as error:
        raise RenderError(f"--exact draws and needs pip install 'gcd-node[scenes]' ({error})") from error
    return ExactPictures(data, (width, height), modality="classes" if semantic else "rgb")
