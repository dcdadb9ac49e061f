"""The plane mix, on what the frozen U-Net predicts of some clips."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from gcd_model.clip import RenderOptions
from gcd_model.conditioning import Conditioning
from gcd_model.denoiser import Denoiser, TorchBackbone
from gcd_model.networks import Networks
from gcd_model.plane_mix import PlaneMix
from gcd_model.sampler import sample
from gcd_model.schedule import Schedule
from gcd_model.vae import TemporalDecoder
from gcd_train.batches import EncodedBatches
from gcd_train.clip_warps import ClipWarps
from gcd_train.datasets.clip_source import ClipSource, to_network
from gcd_train.datasets.latents import LatentClips, LatentRows
from gcd_train.datasets.predictions import Predicted, Predictions
from gcd_train.draws import Draws
from gcd_train.errors import RecipeError
from gcd_train.loop import Progress, StepLoss
from gcd_train.objective import class_map_loss
from gcd_train.picture_losses import energy_l1, gradient_l1, ssim
from gcd_train.precision import Precision
from gcd_train.recipe import DecoderRecipe
from gcd_train.schedule import ParameterGroup
from gcd_train.validation import Validation


class PictureMaker(nn.Module):
    """What is trained, under the names it has in `Networks`. decoder: only if it is finetuned."""

    def __init__(self, plane_mix: PlaneMix, decoder: TemporalDecoder | None) -> None:
        super().__init__()
        self.plane_mix, self.decoder = plane_mix, decoder


@dataclass(frozen=True, kw_only=True, slots=True)
class DecoderData:
    """What the stage learns from. clips: the ones of `latents`, in its order. class_weights: [K] or None."""

    clips: ClipSource
    latents: LatentClips
    predictions: Predictions
    class_weights: Tensor | None


class Predictor:
    """The frozen networks as they are shipped, up to the decoded picture."""

    def __init__(
        self, networks: Networks, latents: LatentClips, batches: EncodedBatches, precision: Precision, seed: int
    ) -> None:
        self._networks, self._latents, self._batches = networks, latents, batches
        self._precision, self._seed = precision, seed

    @torch.no_grad()
    def predict(self, number: int) -> Predicted:
        """One clip from fresh noise by the shipped sampler; its frames as rows."""
        networks, device = self._networks, self._precision.device
        config, frames = networks.config, networks.config.frames
        clip, numbers = torch.full((frames,), number), torch.arange(frames)
        rows: LatentRows = self._latents.rows(clip, numbers, torch.zeros(frames, dtype=torch.bool), device)
        steered = None if networks.camera is None or rows.control is None else networks.camera.proj(rows.control)
        given = Conditioning(
            vector=self._batches.vector(rows),
            camera=steered,
            tokens=None,
            latents=self._batches.condition(rows),
            branches=1,
        )
        schedule = Schedule.of(config, RenderOptions(guidance=(1.0, 1.0)))
        denoiser = Denoiser(TorchBackbone(networks.unet, networks.class_head), given, schedule)
        draws = Draws(self._seed, "predictions", number, device)
        noise = draws.normal(1 if config.sampling.shared_noise else frames, *rows.target.shape[1:])
        start = schedule.start(noise.expand(rows.target.shape)[None], 1)
        latents = sample(denoiser, start, schedule.steps)[0].float()
        decoded = networks.decoder(self._precision.frames(latents / config.vae.scale), frames)
        return Predicted(latents, decoded, denoiser.class_logits)


class DecoderTask:
    """See `Task`."""

    def __init__(
        self,
        networks: Networks,
        data: DecoderData,
        validation: Validation,
        recipe: DecoderRecipe,
        precision: Precision,
        seed: int,
    ) -> None:
        """Raises RecipeError for a model without plane mix."""
        if networks.plane_mix is None:
            raise RecipeError("the decoder stage trains the plane mix, which this model has not; leave [decoder] out")
        self._networks, self._data, self._validation = networks, data, validation
        self._recipe, self._precision, self._seed = recipe, precision, seed
        self._warps = ClipWarps(data.clips, networks.config, precision.device)
        decoder = networks.decoder if recipe.finetune_vae else None
        self._maker = precision.placed(PictureMaker(networks.plane_mix, decoder)).requires_grad_(True)

    @property
    def module(self) -> nn.Module:
        """The plane mix and, if it is finetuned, the autoencoder's decoder."""
        return self._maker

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """The plane mix at the recipe's rate, the autoencoder's decoder slower."""
        groups = [ParameterGroup(parameters=list(self._maker.plane_mix.parameters()))]
        if self._maker.decoder is not None:
            slow = list(self._maker.decoder.parameters())
            groups.append(ParameterGroup(parameters=slow, factor=self._recipe.vae_rate))
        return groups

    def step_loss(self, progress: Progress) -> StepLoss:
        """Mixed pictures against the true target frames."""
        draws = Draws(self._seed, "decoder", progress.updates, self._precision.device)
        clips, frames = self._drawn(draws)
        predicted = self._data.predictions.rows(clips, frames, self._precision.device)
        source, target = self._pictures(clips, frames)
        warped, valid = self._layers(source, clips, frames)
        # in float32 throughout, as it is shipped: sums of pictures show the rounding of bfloat16
        decoded = self._decoded(predicted)
        picture, logits = self._maker.plane_mix(decoded, warped, valid, predicted.latents, predicted.logits)
        loss = self._loss(picture, target, logits, self._classes(clips, frames))
        return self._imitating(loss, decoded, predicted.decoded)

    def after_update(self, progress: Progress) -> bool:
        """Nothing to do."""
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        """Held-out clips through the shipped synthesizer."""
        return self._validation.measure(self._networks, picture)

    def _drawn(self, draws: Draws) -> tuple[Tensor, Tensor]:
        """Places in the predictions and frame numbers, [batch] each: runs of consecutive frames."""
        run, count = self._recipe.run, self._recipe.batch // self._recipe.run
        clips = draws.below(len(self._data.predictions.meta.clips), count)
        first = draws.below(self._networks.config.frames - run + 1, count)
        return clips.repeat_interleave(run), (first[:, None] + torch.arange(run)).flatten()

    def _numbers(self, clips: Tensor) -> list[int]:
        numbers = self._data.predictions.meta.clips
        return [numbers[place] for place in clips.tolist()]

    def _pictures(self, clips: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Source and target frames, [batch, 3, H, W] in [-1, 1] each."""
        pairs = [self._data.clips.rgb(number) for number in self._numbers(clips)]
        source, target = (
            torch.cat([to_network(pair[side][t : t + 1]) for pair, t in zip(pairs, frames.tolist(), strict=True)])
            for side in (0, 1)
        )
        return source.to(self._precision.device), target.to(self._precision.device)

    def _layers(self, source: Tensor, clips: Tensor, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Full-size warps [batch, L, 3, H, W] of source frames along each clip's own path, and where they are valid."""
        run, numbers = self._recipe.run, self._numbers(clips)
        made = [
            self._warps.of(numbers[first], frames[first : first + run].tolist()).layers(
                source[first : first + run], frames[first : first + run].to(source.device)
            )
            for first in range(0, len(numbers), run)
        ]
        return torch.cat([warped for warped, _ in made]), torch.cat([valid for _, valid in made])

    def _classes(self, clips: Tensor, frames: Tensor) -> Tensor | None:
        plain = torch.zeros_like(frames, dtype=torch.bool)
        return self._data.latents.classes(torch.tensor(self._numbers(clips)), frames, plain, self._precision.device)

    def _decoded(self, predicted: Predicted) -> Tensor:
        if self._maker.decoder is None:
            return predicted.decoded
        latents = predicted.latents / self._networks.config.vae.scale
        return self._maker.decoder(self._precision.frames(latents), self._recipe.run)

    def _imitating(self, loss: StepLoss, decoded: Tensor, before: Tensor) -> StepLoss:
        """The loss, and how far what is decoded now is from what was decoded beforehand."""
        if not self._recipe.imitate:
            return loss
        apart = (decoded - before).abs().mean() + self._recipe.gradient * gradient_l1(decoded, before)
        return replace(loss, total=loss.total + self._recipe.imitate * apart, parts={**loss.parts, "imitated": apart})

    def _loss(self, picture: Tensor, target: Tensor, logits: Tensor | None, classes: Tensor | None) -> StepLoss:
        recipe = self._recipe
        parts = {
            "l1": (picture - target).abs().mean(),
            "gradient": gradient_l1(picture, target),
            "ssim": ssim(picture, target),
        }
        total = parts["l1"] + recipe.gradient * parts["gradient"] + recipe.ssim * (1 - parts["ssim"])
        if recipe.energy:
            parts["energy"] = energy_l1(picture, target)
            total = total + recipe.energy * parts["energy"]
        if logits is not None and classes is not None and recipe.class_map:
            counted = torch.ones(len(classes), dtype=torch.bool, device=classes.device)
            parts["class_map"] = class_map_loss(logits, classes, counted, self._data.class_weights)
            total = total + recipe.class_map * parts["class_map"]
        return StepLoss(total, parts, picture.shape[0])
