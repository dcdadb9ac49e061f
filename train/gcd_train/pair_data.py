"""Pairs of clips as what a run learns from: as they are, painted by class, or as videos without a camera's way."""

from pathlib import Path

from gcd_model import ModelConfig
from gcd_train.datasets.clip_source import PaintedClips
from gcd_train.datasets.paired import PairedClips, data_folders, require_apart
from gcd_train.datasets.videos import VideoClips
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import Recipe
from gcd_train.run_data import RunData

_VIDEO_FAMILY = "svd"


def open_pairs(recipe: Recipe, config: ModelConfig, data: Path, valid: Path) -> RunData:
    """The pairs of two folders, or of the folders in them.

    Raises:
        DataError: no such data there, both share scenes, or their cameras go another way than the recipe says.
        RecipeError: the recipe's task does not go together with its model or its latents.
    """
    if recipe.data.task == "image-to-video":
        return _videos(recipe, config, data, valid)
    clips, held_out = PairedClips.open(data), PairedClips.open(valid)
    require_apart(clips, held_out)
    for each, folder in ((clips, data), (held_out, valid)):
        _require_path(each, folder, recipe)
    if recipe.data.modality == "semantic":
        return RunData(clips=PaintedClips(clips), valid=PaintedClips(held_out))
    return RunData(clips=clips, valid=held_out)


def require_image_to_video(recipe: Recipe, config: ModelConfig) -> None:
    """Raises RecipeError if the recipe's model is made for something else than a video out of its first frame."""
    model = recipe.model
    if model.family != _VIDEO_FAMILY:
        raise RecipeError(
            f'data.task "image-to-video" makes a model without views, model.family is {model.family!r}: give '
            f'model.family "{_VIDEO_FAMILY}"'
        )


def _videos(recipe: Recipe, config: ModelConfig, data: Path, valid: Path) -> RunData:
    """Both sides of all pairs; the folders in one need not go the same way."""
    _require_plain_latents(recipe, config)
    learned, held_out = (tuple(map(PairedClips.open, data_folders(place))) for place in (data, valid))
    for one in learned:
        for other in held_out:
            require_apart(one, other)
    return RunData(clips=VideoClips(learned), valid=VideoClips(held_out), parts=learned)


def _require_plain_latents(recipe: Recipe, config: ModelConfig) -> None:
    """Encoded pairs serve as videos where both sides were encoded alike."""
    latents = recipe.latents
    if recipe.unet.source != "latents" or latents is None:
        return
    if latents.augmentation or latents.sample or not config.vae.shared:
        raise RecipeError(
            'data.task "image-to-video" takes both sides of the encoded pairs as videos: it wants one shared '
            'autoencoder, latents.augmentation 0 and latents.sample false; or give unet.source "pixels"'
        )


def _require_path(clips: PairedClips, folder: Path, recipe: Recipe) -> None:
    goal, reached = recipe.data.goal_frame(clips.frames), clips.trajectory(0).at_goal.index(True)
    if goal != reached:
        raise DataError(
            f"the cameras in {folder} are at their goal in frame {reached}, the recipe's data.path says frame {goal}; "
            "change data.path, or make the clips with `gcd-train generate driving --path direct` or gradual"
        )
