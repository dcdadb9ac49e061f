"""What the U-Net is told beside latents: numbers of rate, motion and noise, and the camera."""

import torch
from torch import Tensor

from gcd_model.conditioning import micro_conditioning, relative_pose_features, spherical_features
from gcd_model.config import ModelConfig
from gcd_model.geometry import Trajectory, motion_bucket
from gcd_model.layers import sinusoid
from gcd_model.weights.families import Family
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import UNetRecipe
from gcd_train.training.setup import Precision


class Conditioner:
    """Condition channels, vectors and camera features of frames.

    family: says what motion number belongs to a camera path; None where nobody asks for one.
    Raises RecipeError for a model with condition channels that nothing here can fill.
    """

    def __init__(
        self, config: ModelConfig, recipe: UNetRecipe, precision: Precision, family: Family | None = None
    ) -> None:
        if config.extra_condition_channels:
            raise RecipeError(
                f"the model wants {config.extra_condition_channels} condition channels beside latents, which no data "
                "here has; take another base model"
            )
        self._config, self._recipe, self._precision, self._family = config, recipe, precision, family
        width = config.unet.vector_width
        told = micro_conditioning(recipe.fps, recipe.motion_bucket, recipe.augmentation, width)
        self._vector = told.to(precision.device)

    def vector(self, motion: Tensor) -> Tensor:
        """Micro-conditioning, [N, V]. motion: motion number of each row, [N]."""
        vector = self._vector.expand(len(motion), -1)
        third = vector.shape[1] // 3  # fps, motion, augmentation
        told = sinusoid(motion.to(self._precision.device).float(), third)
        return torch.cat([vector[:, :third], told, vector[:, 2 * third :]], dim=1)

    def motion(self, path: Trajectory) -> float:
        """The number that tells the network how far the camera goes: the family's for the path, else the recipe's.

        Raises DataError for a path without angles where the family works it out of those.
        """
        family = self._family
        if family is None or family.motion_bucket is not None or family.limits is None:
            return self._recipe.motion_bucket
        if path.goal_delta is None:
            raise DataError(f"family {family.name} works with angles about a centre, and these cameras have none")
        limits = family.limits
        return motion_bucket(
            path.goal_delta, max_azimuth_deg=limits.azimuth_deg, max_elevation_deg=limits.elevation_deg
        )

    def camera(self, path: Trajectory) -> Tensor | None:
        """What the network is steered by, [T, F]; None for a model with one fixed view.

        Raises DataError for a path without angles where the model is steered by those.
        """
        match self._config.camera:
            case "none":
                return None
            case "relative_pose":
                return relative_pose_features(path.source_from_target)
            case "spherical":
                if path.delta is None:
                    raise DataError("the model is steered by angles and radius, and these cameras are not on a sphere")
                return spherical_features(path.delta)


def mirrored_path(path: Trajectory) -> Trajectory:
    """The same path in the world seen in a mirror: left is right, the azimuth turns the other way."""
    sideways = torch.tensor([-1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    delta = path.delta
    return Trajectory(
        source_from_target=path.source_from_target * sideways[:, None] * sideways,
        delta=None if delta is None else delta * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64),
        at_goal=path.at_goal,
        source=path.source,
    )
