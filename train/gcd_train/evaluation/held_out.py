"""The clips that predictors are measured on."""

from collections.abc import Sequence
from typing import Protocol

from gcd_model.config import SemanticClass
from gcd_model.geometry import CameraMount, Trajectory
from gcd_train.baselines import CameraPair, SourceClip
from gcd_train.datasets.clip_source import ClipSource
from gcd_train.datasets.paired import PairedClip
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import ClipFacts


class HeldOutClips(ClipSource, ClipFacts, Protocol):
    """Clips to be measured on; `PairedClips` is one.

    hfov_deg: across the pictures, of orbits both cameras' own.
    scene: world and seed of the scene that a clip was cut from. trajectory: of a clip, from source to target.
    name: of a clip in its world, its number in digits.
    """

    def __getitem__(self, number: int, /) -> PairedClip: ...
    def scene(self, number: int, /) -> tuple[str, int]: ...
    def trajectory(self, number: int, /) -> Trajectory: ...
    def name(self, number: int, /) -> str: ...
    @property
    def mount(self) -> CameraMount | None: ...
    @property
    def hfov_deg(self) -> float: ...


class SizedClips(Protocol):
    """Clips of one size."""

    @property
    def height(self) -> int: ...
    @property
    def width(self) -> int: ...


def cameras_of(clips: HeldOutClips, number: int, declared: CameraMount | None = None) -> CameraPair:
    """Both cameras of a clip.

    Args:
        declared: mount that is declared for the source camera of driving clips; None for the true one.
    """
    if clips.camera == "none":
        mount = declared or clips.mount or CameraMount()
        reached = clips.trajectory(number).at_goal.index(True)
        return CameraPair.driving(mount, frames=clips.frames, height=clips.height, width=clips.width, move_time=reached)
    return CameraPair.orbit(clips.trajectory(number), hfov_deg=clips.hfov_deg, height=clips.height, width=clips.width)


def source_side(clips: HeldOutClips, number: int, clip: PairedClip, declared: CameraMount | None) -> SourceClip:
    """What predictors may see of a clip. declared: see `cameras_of`."""
    return SourceClip(
        source=clip.source,
        source_depth=clip.source_depth,
        source_classes=clip.source_classes if clips.classes else None,
        cameras=cameras_of(clips, number, declared),
        fps=clips.fps,
    )


def class_grid(clips: SizedClips) -> tuple[int, int]:
    """Height and width at which class maps are compared: half the pictures'."""
    return clips.height // 2, clips.width // 2


def require_same_kind(training: HeldOutClips, clips: HeldOutClips) -> None:
    """Raises DataError unless means over the training clips fit the held-out ones."""
    sizes = [(each.frames, each.height, each.width) for each in (training, clips)]
    if sizes[0] != sizes[1] or names_of(training.classes) != names_of(clips.classes):
        raise DataError(
            f"training and held-out clips must be of one kind, got T, H, W = {sizes[0]} and {sizes[1]}, "
            f"classes {names_of(training.classes)} and {names_of(clips.classes)}; generate both alike"
        )
    if training.camera != clips.camera:
        raise DataError(
            f"training and held-out clips must be of one kind, got camera control {training.camera!r} and "
            f"{clips.camera!r}; generate both alike"
        )


def names_of(classes: Sequence[SemanticClass]) -> str:
    """An ontology in one line."""
    return ", ".join(each.name for each in classes) or "none"
