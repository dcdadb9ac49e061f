"""What the network is told of a clip, as the synthesizer would tell it: condition channels, vector, camera features."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gcd_model import Family, ModelConfig
from gcd_model.networks import Networks
from gcd_train.data.batches import encode_frames
from gcd_train.data.latents import EncodedClips, LatentRows
from gcd_train.data.sample import ClipSource, to_network
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import UNetRecipe
from gcd_train.training.conditioner import Conditioner
from gcd_train.training.draws import Draws
from gcd_train.training.objective import Batch, drop_streams
from gcd_train.training.setup import Precision


class EncodedBatches:
    """Batches of what the latents stage wrote."""

    def __init__(self, clips: EncodedClips, config: ModelConfig, recipe: UNetRecipe, precision: Precision) -> None:
        self._clips, self._recipe, self._precision = clips, recipe, precision
        self._conditioner = Conditioner(config, recipe, precision)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        return self._batch(
            draws, draws.below(self._clips.meta.clips, count), draws.below(self._clips.meta.frames, count), 1
        )

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource."""
        frames = self._clips.meta.frames
        return self._batch(
            draws, draws.below(self._clips.meta.clips, count), torch.arange(frames).repeat(count), frames
        )

    def _batch(self, draws: Draws, clips: Tensor, frames: Tensor, per_clip: int) -> Batch:
        flip = draws.below(self._clips.meta.flips, clips.shape[0]).bool()
        rows = self._clips.rows(
            clips.repeat_interleave(per_clip), frames, flip.repeat_interleave(per_clip), self._precision.device
        )
        condition, _ = drop_streams(self.condition(rows), None, per_clip, draws, self._recipe)
        return Batch(
            target=self._precision.frames(rows.target),
            condition=condition,
            vector=self.vector(rows),
            tokens=None,
            emphasis=rows.emphasis,
            frames=per_clip,
            camera=rows.control,
            ids=self._clips.names(clips),
        )

    def vector(self, rows: LatentRows) -> Tensor:
        """Micro-conditioning of some frames, [N, V]."""
        return self._conditioner.vector(rows.motion, rows.target.shape[0])

    def condition(self, rows: LatentRows) -> Tensor:
        """Condition channels [N, C', h, w] of some frames."""
        return self._conditioner.channels(rows.source)


class PixelBatches:
    """Whole clips encoded anew each time: fresh augmentation noise, targets drawn from the posterior, image tokens.

    family: says what the network is told of a camera's way; None for the recipe's motion number.
    Raises RecipeError for single frames.
    """

    def __init__(
        self,
        clips: ClipSource,
        networks: Networks,
        recipe: UNetRecipe,
        precision: Precision,
        family: Family | None = None,
    ) -> None:
        if recipe.image_share:
            raise RecipeError('unet.source "pixels" takes whole clips only; set image_share to 0')
        self._clips, self._networks, self._recipe, self._precision = clips, networks, recipe, precision
        self._conditioner = Conditioner(networks.config, recipe, precision, family)

    def single_frames(self, draws: Draws, count: int) -> Batch:
        """Not offered; refused when this was made."""
        raise RecipeError('unet.source "pixels" takes whole clips only; set image_share to 0')

    def whole_clips(self, draws: Draws, count: int) -> Batch:
        """See BatchSource. Raises DataError for clips of another length or size than the model takes."""
        return self.batch(draws.below(len(self._clips), count).tolist(), draws)

    @torch.no_grad()
    def batch(self, numbers: Sequence[int], draws: Draws) -> Batch:
        """The batch of these clips."""
        source, target = self._pictures(numbers)
        encoded = encode_frames(self._networks, self._recipe, source, target, draws)
        frames = self._networks.config.frames
        condition = self._conditioner.channels(encoded.source)
        condition, tokens = drop_streams(condition, encoded.tokens, frames, draws, self._recipe)
        motion, camera = self._told(numbers)
        return Batch(
            target=self._precision.frames(encoded.target),
            condition=condition,
            vector=self._conditioner.vector(motion.repeat_interleave(frames), source.shape[0]),
            tokens=tokens,
            emphasis=encoded.emphasis,
            frames=frames,
            camera=camera,
            ids=tuple(f"clip {self._clips.seed(number)}" for number in numbers),
        )

    def _pictures(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Source and target frames, [N, 3, H, W] in [-1, 1] each."""
        pairs = [self._clips.rgb(number) for number in numbers]
        config = self._networks.config
        wanted = (config.frames, config.height, config.width)
        for given in {pair[0].shape[:3] for pair in pairs} - {wanted}:
            raise DataError(f"clips must be T, H, W = {wanted} for this model, got {given}; generate them anew")
        source, target = (torch.cat([to_network(pair[side]) for pair in pairs]) for side in (0, 1))
        return self._precision.frames(source), self._precision.frames(target)

    def _told(self, numbers: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """Motion number of each clip, [B], and camera features of each frame, [N, K], if the model is steered."""
        paths = [self._clips.trajectory(number) for number in numbers]
        motion = torch.tensor([self._conditioner.motion(path) for path in paths])
        cameras = [camera for path in paths if (camera := self._conditioner.camera(path)) is not None]
        return motion, torch.cat(cameras).to(self._precision.device) if cameras else None
