"""A field learnt from one clip's own videos, and drawn from the target's cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_train.baselines.predictor import Prediction, SourceClip, to_pictures
from gcd_train.errors import DataError
from gcd_train.hexplane import Camera, HexPlaneSettings, PosedPicture, SceneBounds, draw, learn
from gcd_train.scene_view import SceneView

DEFAULT = HexPlaneSettings()
"""What is learnt of a clip where nobody says otherwise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class HexPlane:
    """HexPlane with so many input views: the source clip, and further cameras of the scene from two on.

    views: K. settings: what is learnt of each clip, and how long. seed, device: of the learning, see `learn`.
    With two views or more it is told more than the others, so `privileged`. It makes no class maps.
    Source: Cao and Johnson 2023 (HexPlane); as a baseline, Van Hoorick et al. 2024 (GCD), section 5.
    """

    views: int = 1
    settings: HexPlaneSettings = DEFAULT
    seed: int = 0
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.views < 1:
            raise DataError(f"HexPlane learns from 1 view or more, got {self.views}")

    @property
    def name(self) -> str:
        """`hexplane_K`."""
        return f"hexplane_{self.views}"

    @property
    def privileged(self) -> bool:
        """True from two views on."""
        return self.views > 1

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. Raises DataError where the clip's scene has fewer cameras."""
        cameras, frames = clip.cameras, len(clip.source)
        world_from_target = cameras.ground_from_source @ cameras.source_from_target  # [T, 4, 4]
        pictures = [*_of_source(clip), *self._of_others(clip)]
        known = torch.stack([picture.camera.world_from_camera for picture in pictures])
        bounds = SceneBounds.around(torch.cat([known, world_from_target]))
        field = learn(pictures, bounds, self.settings, frames=frames, seed=self.seed, device=self.device)
        wanted = [
            Camera(lens=cameras.target, world_from_camera=pose, time=_time(number, frames))
            for number, pose in enumerate(world_from_target)
        ]
        return Prediction(video=torch.stack([draw(field, camera, self.settings) for camera in wanted]))

    def _of_others(self, clip: SourceClip) -> list[PosedPicture]:
        """Pictures of the further cameras; their world is the one the source's pose is told in."""
        if self.views == 1:
            return []
        if clip.others is None:
            raise DataError(
                f"{self.name} wants {self.views} cameras of a scene, but clip {clip.key or 'without a key'} has one; "
                "give a 4D data set, or ask for hexplane_1"
            )
        frames = len(clip.source)
        return [
            _of_view(view, _time(number, frames))
            for video in clip.others(self.views - 1)
            for number, view in enumerate(_whole(video, frames))
        ]


def _whole(video: Sequence[SceneView], frames: int) -> Sequence[SceneView]:
    if len(video) != frames:
        raise DataError(f"each camera of a scene must show {frames} frames as the source does, got {len(video)}")
    return video


def _of_source(clip: SourceClip) -> list[PosedPicture]:
    frames = len(clip.source)
    return [_posed(colours, clip, _time(number, frames)) for number, colours in enumerate(to_pictures(clip.source))]


def _posed(colours: Tensor, clip: SourceClip, time: float) -> PosedPicture:
    camera = Camera(lens=clip.cameras.source, world_from_camera=clip.cameras.ground_from_source, time=time)
    return PosedPicture(colours=colours, camera=camera)


def _of_view(view: SceneView, time: float) -> PosedPicture:
    camera = Camera(lens=view.lens, world_from_camera=torch.from_numpy(view.world_from_camera), time=time)
    return PosedPicture(colours=to_pictures(view.rgb[None])[0], camera=camera)


def _time(number: int, frames: int) -> float:
    """-1 for the first frame, 1 for the last."""
    return 2.0 * number / max(frames - 1, 1) - 1.0
