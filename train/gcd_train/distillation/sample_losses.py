"""What a student's sample is compared with its pair in: latents, decoded pictures, classes."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.networks import Networks
from gcd_train.distillation.recipe import SampleLossRecipe
from gcd_train.draws import Draws
from gcd_train.errors import RecipeError
from gcd_train.losses import frame_losses
from gcd_train.objective import Batch
from gcd_train.picture_losses import energy_l1, gradient_l1, ssim
from gcd_train.precision import Precision


@dataclass(frozen=True, slots=True)
class Compared:
    """total: the weighted sum, a scalar. parts: what it is made of, for the log, without weights."""

    total: Tensor
    parts: dict[str, Tensor]


class SampleLoss:
    """The paired loss of one stage.

    Pictures are compared with what the autoencoder makes of the true latents, so what it cannot draw is no fault of
    the student's, and no pictures have to be read. Raises RecipeError for losses the model has nothing to put in.
    """

    def __init__(
        self, networks: Networks, recipe: SampleLossRecipe, channel_weights: Tensor | None, precision: Precision
    ) -> None:
        if recipe.colours and not networks.config.semantic_classes:
            raise RecipeError("loss.colours is for models that paint classes, which this one does not; leave it out")
        self._networks, self._recipe, self._weights, self._precision = networks, recipe, channel_weights, precision
        colours = [kind.colour for kind in networks.config.semantic_classes]
        self._colours = torch.tensor(colours, device=precision.device).float() / 255
        if recipe.of_pictures:
            precision.placed(networks.decoder)

    def of(self, made: Tensor, batch: Batch, draws: Draws) -> Compared:
        """How far samples are from their pairs, mean over frames."""
        recipe, parts = self._recipe, dict[str, Tensor]()
        if recipe.latent:
            parts["latent"] = self._latent(made, batch)
        if recipe.of_pictures:
            parts |= self._pictures(made, batch, draws)
        if not parts:
            raise RecipeError("a paired loss that weighs nothing teaches nothing: give loss.latent, or another")
        total = torch.stack([getattr(recipe, name) * value for name, value in parts.items()]).sum()
        return Compared(total, {name: value.detach() for name, value in parts.items()})

    def _latent(self, made: Tensor, batch: Batch) -> Tensor:
        weights, emphasis = self._weights, batch.emphasis
        return frame_losses(made, batch.target, fraction=1.0, emphasis=emphasis, channel_weights=weights).mean()

    def _pictures(self, latents: Tensor, batch: Batch, draws: Draws) -> dict[str, Tensor]:
        recipe, run = self._recipe, min(self._recipe.frames, batch.frames)
        first = int(draws.below(batch.frames - run + 1, 1))
        made, true = (
            clips.unflatten(0, (-1, batch.frames))[:, first : first + run].flatten(0, 1)
            for clips in (latents, batch.target)
        )
        picture = self._decoded(made, run)
        with torch.no_grad():
            target = self._decoded(true, run)
        parts = dict[str, Tensor]()
        if recipe.l1:
            parts["l1"] = (picture - target).abs().mean()
        if recipe.gradient:
            parts["gradient"] = gradient_l1(picture, target)
        if recipe.ssim:
            parts["ssim"] = 1 - ssim(picture, target)
        if recipe.energy:
            parts["energy"] = energy_l1(picture, target)
        if recipe.colours:
            parts["colours"] = colour_loss(picture, target, self._colours, recipe.softness)
        return parts

    def _decoded(self, latents: Tensor, run: int) -> Tensor:
        with self._precision.arithmetic():
            rows = self._precision.frames(latents / self._networks.config.vae.scale)
            return self._networks.decoder(rows, run).float()


def colour_loss(pictures: Tensor, targets: Tensor, colours: Tensor, softness: float) -> Tensor:
    """Cross-entropy of the classes that colours stand for, mean over pixels.

        logits[k] = -|pixel - colour[k]|^2 / softness^2;  truth: the class whose colour is nearest in the target

    So a pixel between two colours, which stands for a third class or for none, costs more than its error in colour.
    Ours; the classes of a painted picture are those of the nearest colours, see `nearest_classes`.

    Args:
        pictures, targets: [N, 3, H, W] in [-1, 1]. colours: [K, 3] in [0, 1].
    """
    return F.cross_entropy(
        -_distances(pictures, colours) / softness**2, _distances(targets, colours).argmin(1), reduction="mean"
    )


def _distances(pictures: Tensor, colours: Tensor) -> Tensor:
    """Squared distance of each pixel to each colour, [N, K, H, W]."""
    pixels = (pictures + 1) / 2
    across = torch.einsum("nchw,kc->nkhw", pixels, colours)
    return (pixels**2).sum(1, keepdim=True) - 2 * across + (colours**2).sum(1)[:, None, None]
