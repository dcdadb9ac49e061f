"""The autoencoder, on crops of source and target frames."""

from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.clip import nearest_classes
from gcd_model.layers import zeroed
from gcd_model.networks import Networks
from gcd_model.vae import Encoder, Posterior, TemporalDecoder
from gcd_train.data.sample import Bytes, Clips, to_network
from gcd_train.errors import RecipeError
from gcd_train.evaluation.metrics import mean_iou, named_confusion, psnr
from gcd_train.recipe import VAERecipe
from gcd_train.training.loop import Progress, StepLoss, Task
from gcd_train.training.losses import gradient_l1, kl_to_normal, ssim
from gcd_train.training.monitor import write_sheet
from gcd_train.training.setup import Draws, Precision

_STATISTICS_CLIPS, _MEASURED_CLIPS = 16, 4
_START_LOG_VARIANCE = -5.0


class Autoencoder(nn.Module):
    """Encoder and decoder under the names they have in `Networks`, and whether the latents were normalised."""

    normalised: Tensor

    def __init__(self, networks: Networks) -> None:
        super().__init__()
        self.target_encoder, self.decoder = networks.target_encoder, networks.decoder
        self.register_buffer("normalised", torch.zeros((), dtype=torch.bool))


class VAETask(Task):
    """Trains encoder and decoder; `normalise_at` of the budget on, their latents have zero mean and unit spread."""

    module: Autoencoder

    def __init__(
        self,
        networks: Networks,
        clips: Clips,
        valid: Clips,
        recipe: VAERecipe,
        precision: Precision,
        seed: int,
    ) -> None:
        config = networks.config
        if not config.vae.shared:
            raise RecipeError("the VAE stage trains models with one shared autoencoder; this one has two: leave it out")
        self._precision, self._seed, self._recipe, self._valid = precision, seed, recipe, valid
        self._painted = config.semantic_classes
        order = Draws(seed, "vae-pool", 0, torch.device("cpu")).order(len(clips))
        self._pool, self._sample = order[: recipe.pool], cache(clips.sample)  # decoded once
        if config.vae.linear:
            start_from_components(networks.target_encoder, networks.decoder, self._some_frames(_STATISTICS_CLIPS))
        super().__init__(precision.placed(Autoencoder(networks)))

    def step_loss(self, progress: Progress) -> StepLoss:
        """L1, gradients, structural similarity and the Kullback-Leibler term on one batch of crops."""
        draws = Draws(self._seed, "vae", progress.updates, self._precision.device)
        recipe, apart = self._recipe, progress.share < self._recipe.image_share
        run = 1 if apart else recipe.frames
        crops = self._crops(draws, recipe.clips * recipe.frames // run, run)
        with self._precision.arithmetic():
            posterior = self.module.target_encoder(crops)
            noise = draws.normal(*posterior.mean.shape)
            decoded = self.module.decoder(posterior.sample(noise), None if apart else run)
        return self._loss(crops, decoded.float(), Posterior(posterior.mean.float(), posterior.log_variance.float()))

    def after_update(self, progress: Progress) -> bool:
        """Normalises the latents once, when the time has come."""
        if self.module.normalised or progress.share < self._recipe.normalise_at:
            return False
        mean, std = self._statistics()
        normalise_latents(self.module.target_encoder, self.module.decoder, mean, std)
        self.module.normalised.fill_(True)
        return True

    def measure(self, picture: Path) -> dict[str, float]:
        """PSNR of held-out targets, encoded and decoded, mean IoU of painted ones; the latents' own spread."""
        shown: list[list[Tensor]] = []
        scores: list[Tensor] = []
        means: list[Tensor] = []
        counts: list[Tensor] = []
        for number in range(min(len(self._valid), _MEASURED_CLIPS)):
            sample = self._valid.sample(number)
            frames = to_network(sample.target).to(self._precision.device)
            latents = self.module.target_encoder(frames).mean
            decoded = self.module.decoder(latents, frames.shape[0]).clamp(-1, 1)
            scores.append(psnr((decoded + 1) / 2, (frames + 1) / 2).mean())
            means.append(latents)
            if self._painted:
                truth = torch.from_numpy(np.array(sample.target_classes))
                classes = nearest_classes(((decoded + 1) / 2).cpu(), self._painted)
                counts.append(named_confusion(classes, truth, [kind.name for kind in self._painted]))
            shown += [[decoded[0], decoded[-1]], [frames[0], frames[-1]]]
        write_sheet(picture, shown)
        spread = torch.cat(means).transpose(0, 1).flatten(1).std(1)
        values = {
            "psnr": float(torch.stack(scores).mean()),
            "latent_std_least": float(spread.min()),
            "latent_std_most": float(spread.max()),
        }
        return {**values, "miou_full": mean_iou(torch.stack(counts).sum(0))} if counts else values

    def _loss(self, crops: Tensor, decoded: Tensor, posterior: Posterior) -> StepLoss:
        recipe = self._recipe
        parts = {
            "l1": (decoded - crops).abs().mean(),
            "gradient": gradient_l1(decoded, crops),
            "ssim": ssim(decoded, crops),
            "kl": kl_to_normal(posterior),
        }
        total = parts["l1"] + recipe.gradient * parts["gradient"]
        total = total + recipe.ssim * (1 - parts["ssim"]) + recipe.kl * parts["kl"]
        return StepLoss(total, parts, crops.shape[0])

    def _crops(self, draws: Draws, count: int, run: int) -> Tensor:
        """[count * run, 3, crop, crop] in [-1, 1]: runs of source or target frames, half of them mirrored."""
        numbers = draws.below(len(self._pool), count).tolist()
        sides, flips = draws.below(2, count).tolist(), draws.below(2, count).tolist()
        crops: list[Tensor] = []
        for number, side, flip in zip(numbers, sides, flips, strict=True):
            crop = self._crop(self._sides(number)[side], draws, run)
            crops.append(to_network(crop[:, :, ::-1] if flip else crop))
        return self._precision.frames(torch.cat(crops))

    def _crop(self, clip: Bytes, draws: Draws, run: int) -> Bytes:
        sizes = (run, self._recipe.crop, self._recipe.crop)
        first, top, left = (
            int(draws.below(whole - part + 1, 1)) for whole, part in zip(clip.shape[:3], sizes, strict=True)
        )
        return clip[first : first + run, top : top + sizes[1], left : left + sizes[2]]

    def _some_frames(self, count: int) -> Tensor:
        """Every third frame of both sides of `count` clips, [N, 3, H, W] in [-1, 1]."""
        numbers = Draws(self._seed, "vae-statistics", 0, torch.device("cpu")).below(len(self._pool), count)
        return torch.cat([to_network(side[::3]) for number in numbers.tolist() for side in self._sides(number)])

    def _sides(self, number: int) -> tuple[Bytes, Bytes]:
        """Source and target of a clip of the pool."""
        sample = self._sample(self._pool[number])
        return sample.source, sample.target

    @torch.no_grad()
    def _statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of each latent channel, [C], over whole frames of some clips."""
        frames = self._some_frames(_STATISTICS_CLIPS)
        rows = [self.module.target_encoder(self._precision.frames(part)).mean for part in frames.split(8)]
        values = torch.cat(rows).transpose(0, 1).flatten(1)  # [C, everything]
        return values.mean(1), values.std(1).clamp(min=1e-4)


@torch.no_grad()
def normalise_latents(encoder: Encoder, decoder: TemporalDecoder, mean: Tensor, std: Tensor) -> None:
    """Give the latents zero mean and unit spread without changing what encoder and decoder do together.

    The encoder's last 1x1 convolution and the decoder's first take the change in; only the rim of a picture is touched,
    where the decoder pads with zeros.

    Args:
        mean, std: [C], of the latents so far.
    """
    quant, stem, channels = encoder.quant, decoder.stem, mean.shape[0]
    assert quant is not None, "a shared encoder has a quant convolution"
    quant.weight[:channels] /= std[:, None, None, None]
    _bias(quant)[:channels].sub_(mean).div_(std)
    _bias(quant)[channels:].sub_(2 * std.log())  # log-variance
    _bias(stem).add_(torch.einsum("oiyx,i->o", stem.weight, mean))
    stem.weight *= std[:, None, None]
    if decoder.linear is not None:
        _bias(decoder.linear).add_(decoder.linear.weight[:, :, 0, 0] @ mean)
        decoder.linear.weight *= std[:, None, None]


@torch.no_grad()
def start_from_components(encoder: Encoder, decoder: TemporalDecoder, frames: Tensor) -> None:
    """Set the linear paths to the principal components of pixel blocks, at unit spread, and the rest to silence.

    So training starts at the best linear code, and the convolutions learn what is missing.

    Args:
        frames: [N, 3, H, W] in [-1, 1]. encoder, decoder: with linear paths.
    """
    there, back, quant = encoder.linear, decoder.linear, encoder.quant
    assert there is not None, "the config has linear paths"
    assert back is not None, "the config has linear paths"
    assert quant is not None, "a shared encoder has a quant convolution"
    channels, block = there.out_channels, decoder.block
    pixels = F.pixel_unshuffle(frames, block).movedim(1, -1).flatten(0, 2)  # [blocks, 3 * block^2]
    mean = pixels.mean(0)
    spread, components = torch.linalg.eigh((pixels - mean).T.cov())  # ascending
    std, rows = spread[-channels:].flip(0).clamp(min=1e-8).sqrt(), components[:, -channels:].flip(1).T  # [C, pixels]
    for layer in (encoder.conv_out, decoder.conv_out, quant, there, back):
        zeroed(layer)
    quant.weight[:, :, 0, 0] = torch.eye(2 * channels)
    _bias(encoder.conv_out)[channels:] = _START_LOG_VARIANCE
    there.weight.copy_((rows / std[:, None]).unflatten(1, (3, block, block)))
    _bias(there).copy_(-(rows / std[:, None]) @ mean)
    back.weight[:, :, 0, 0] = rows.T * std
    _bias(back).copy_(mean)


def _bias(layer: nn.Conv2d) -> Tensor:
    assert layer.bias is not None
    return layer.bias
