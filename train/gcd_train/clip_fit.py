"""Whether clips are what a model takes them for."""

from gcd_model import ModelConfig
from gcd_train.datasets.clip_source import ClipSource
from gcd_train.errors import DataError


def require_fit(clips: ClipSource, config: ModelConfig, fps: float) -> None:
    """Raises DataError if the clips are not what the model and its recipe take them for."""
    if clips.fps != fps:
        raise DataError(f"the recipe's unet.fps is {fps:g}, the clips have {clips.fps:g}; change one of them")
    if config.camera == "spherical" and clips.camera != "spherical":
        raise DataError("the model is steered by angles and radius, and these clips have no orbits; take drop clips")
    if config.camera == "none" and clips.camera != "none":
        raise DataError("the model has one fixed view, and each of these clips has its own; take driving clips")
    classes = config.semantic_classes
    if classes and [kind.name for kind in classes] != [kind.name for kind in clips.classes]:
        raise DataError("the clips' classes are not the model's; generate them with this version")
