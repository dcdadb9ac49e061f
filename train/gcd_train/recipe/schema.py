"""A whole recipe."""

from typing import Annotated

import msgspec
from msgspec import Meta

from gcd_train.recipe.compute import ComputeRecipe, LogRecipe
from gcd_train.recipe.data import DataRecipe
from gcd_train.recipe.export import ExportRecipe
from gcd_train.recipe.model import ModelRecipe
from gcd_train.recipe.small_stages import LatentsRecipe, VAERecipe
from gcd_train.recipe.unet import UNetRecipe
from gcd_train.recipe.values import StageName


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole recipe file; a table that is left out leaves its stage out.

    seed: every random draw follows from it, the stage and the update.
    """

    name: Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9-]{0,40}$")]
    seed: int = 0
    data: DataRecipe = DataRecipe()
    model: ModelRecipe = ModelRecipe()
    compute: ComputeRecipe = ComputeRecipe()
    log: LogRecipe = LogRecipe()
    vae: VAERecipe | None = None
    latents: LatentsRecipe | None = None
    unet: UNetRecipe
    export: ExportRecipe = ExportRecipe()

    def __post_init__(self) -> None:
        if self.unet.source == "latents" and self.latents is None:
            raise ValueError('unet.source "latents" needs a [latents] table')
        if self.unet.source == "latents" and self.latents is not None:
            given, told = self.latents.augmentation, self.unet.augmentation
            if given != told:
                raise ValueError(f"latents.augmentation is {given:g}, but unet.augmentation tells the network {told:g}")
        if self.vae is None and self.model.weights is None:
            raise ValueError("a random autoencoder teaches nothing: give a [vae] table, or model.weights to start from")
        if self.vae is not None and self.model.train != "all":
            raise ValueError(
                f'model.train "{self.model.train}" builds on given weights, whose autoencoder must stay: leave [vae] '
                'out (without = ["vae"])'
            )
        if (self.data.kind == "cache") != (self.unet.source == "cache"):
            raise ValueError('a latent cache is read with both data.kind "cache" and unet.source "cache"')

    @property
    def stages(self) -> tuple[StageName, ...]:
        """The steps of a run, in their order."""
        there: dict[StageName, bool] = {
            "vae": self.vae is not None,
            "latents": self.latents is not None,
            "unet": True,
            "export": True,
        }
        return tuple(name for name, wanted in there.items() if wanted)
