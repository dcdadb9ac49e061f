"""What a training run does, as a recipe file states it (TOML): every option is named here, with its meaning."""

from gcd_train.recipe.compute import ComputeRecipe, LogRecipe
from gcd_train.recipe.data import DataKind, DataRecipe, DataTask, FramesRecipe, LoaderRecipe, Modality, OrbitRecipe
from gcd_train.recipe.export import ExportRecipe
from gcd_train.recipe.loading import load_recipe, parse_recipe
from gcd_train.recipe.merging import PACKAGED, packaged_recipes
from gcd_train.recipe.model import LoraRecipe, ModelRecipe, TrainedPart, UNetChanges, VAEChanges
from gcd_train.recipe.optimiser import EmaRecipe, OptimiserRecipe
from gcd_train.recipe.schema import Recipe
from gcd_train.recipe.small_stages import LatentsRecipe, VAERecipe
from gcd_train.recipe.unet import ClassWeightsName, FocalBlendName, LossRecipe, NoiseRecipe, UNetRecipe
from gcd_train.recipe.values import (
    AnyStageName,
    Budget,
    Count,
    DistillStageName,
    NotNegative,
    Positive,
    Share,
    StageName,
)
from gcd_train.recipe.writing import to_toml

__all__ = [
    "PACKAGED",
    "AnyStageName",
    "Budget",
    "ClassWeightsName",
    "ComputeRecipe",
    "Count",
    "DataKind",
    "DataRecipe",
    "DataTask",
    "DistillStageName",
    "EmaRecipe",
    "ExportRecipe",
    "FocalBlendName",
    "FramesRecipe",
    "LatentsRecipe",
    "LoaderRecipe",
    "LogRecipe",
    "LoraRecipe",
    "LossRecipe",
    "Modality",
    "ModelRecipe",
    "NoiseRecipe",
    "NotNegative",
    "OptimiserRecipe",
    "OrbitRecipe",
    "Positive",
    "Recipe",
    "Share",
    "StageName",
    "TrainedPart",
    "UNetChanges",
    "UNetRecipe",
    "VAEChanges",
    "VAERecipe",
    "load_recipe",
    "packaged_recipes",
    "parse_recipe",
    "to_toml",
]
