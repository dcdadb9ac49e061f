"""What a training run does, as a recipe file states it (TOML): every option is named here, with its meaning."""

from gcd_train.recipe.compute import ComputeRecipe, LogRecipe
from gcd_train.recipe.loading import PACKAGED, load_recipe, parse_recipe
from gcd_train.recipe.model import ModelRecipe, UNetChanges, VAEChanges
from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.schema import Recipe
from gcd_train.recipe.small_stages import DecoderRecipe, LatentsRecipe, VAERecipe
from gcd_train.recipe.unet import LossRecipe, NoiseRecipe, UNetRecipe
from gcd_train.recipe.values import Budget, Count, NotNegative, Positive, Share, StageName

__all__ = [
    "PACKAGED",
    "Budget",
    "ComputeRecipe",
    "Count",
    "DecoderRecipe",
    "EmaRecipe",
    "LatentsRecipe",
    "LogRecipe",
    "LossRecipe",
    "ModelRecipe",
    "NoiseRecipe",
    "NotNegative",
    "OptimiserRecipe",
    "Positive",
    "Recipe",
    "Share",
    "StageName",
    "UNetChanges",
    "UNetRecipe",
    "VAEChanges",
    "VAERecipe",
    "load_recipe",
    "parse_recipe",
]
