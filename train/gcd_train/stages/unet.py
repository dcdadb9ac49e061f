"""The U-Net: single frames first if the recipe says so, then whole clips."""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor, nn

from gcd_model.networks import Networks
from gcd_train.batches import BatchSource
from gcd_train.draws import Draws
from gcd_train.loop import Progress, StepLoss
from gcd_train.lora import plain_weights
from gcd_train.objective import denoiser_of, diffusion_loss
from gcd_train.precision import Precision
from gcd_train.recipe import UNetRecipe
from gcd_train.schedule import ParameterGroup
from gcd_train.trained_part import keep_trained_alone
from gcd_train.validation import Validation


class UNetTask:
    """See `Task`."""

    def __init__(
        self,
        networks: Networks,
        batches: BatchSource,
        validation: Validation,
        recipe: UNetRecipe,
        channel_weights: Tensor | None,
        precision: Precision,
        seed: int,
    ) -> None:
        self._networks, self._batches, self._validation = networks, batches, validation
        self._recipe, self._weights, self._precision, self._seed = recipe, channel_weights, precision, seed
        self._denoiser = precision.placed(denoiser_of(networks))
        self._network: nn.Module = self._denoiser
        keep_trained_alone(self._denoiser)

    @property
    def module(self) -> nn.Module:
        """U-Net and camera embedder."""
        return self._denoiser

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """Everything that can be trained."""
        trained = [parameter for parameter in self._denoiser.parameters() if parameter.requires_grad]
        return [ParameterGroup(parameters=trained)]

    def compute_through(self, network: nn.Module) -> None:
        """See `SharedTask`."""
        self._network = network

    def step_loss(self, progress: Progress) -> StepLoss:
        """The diffusion loss on single frames or on whole clips."""
        recipe = self._recipe
        draws = Draws(self._seed, "unet", progress.updates * recipe.parts + progress.part, self._precision.device)
        if progress.share < recipe.image_share:
            batch = self._batches.single_frames(draws, recipe.image_batch)
        else:
            batch = self._batches.whole_clips(draws, recipe.clip_batch)
        return diffusion_loss(
            self._network,
            batch,
            draws,
            self._precision,
            noise=recipe.noise_at(progress.share),
            loss=recipe.loss,
            channel_weights=self._weights,
            step=progress.updates,
        )

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        """Held-out clips through the shipped synthesizer."""
        return self._validation.measure(self._networks, picture)

    def gather(self) -> None:
        """See `ShardedTask`."""
        plain_weights(self._networks)
