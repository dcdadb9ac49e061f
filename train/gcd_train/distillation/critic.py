"""The network that tells a student's samples from true latents.

The encoder half of the teacher's U-Net looks at noised latents together with the condition, and small heads on each of
its blocks say, place by place, how true they look: in pictures and across frames.

Source: Sauer et al. 2024, "Fast High-Resolution Image Synthesis with Latent Adversarial Diffusion Distillation" (the
teacher's own features on noised latents, hinge losses); Zhang et al. 2024, "SF-V: Single Forward Video Generation
Model" (the same for Stable Video Diffusion, heads in space and time). Hinge losses: Lim and Ye 2017, "Geometric GAN".
"""

from collections.abc import Sequence
from copy import deepcopy

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.func import functional_call  # pyright: ignore[reportPrivateImportUsage]

from gcd_model.conditioning import CameraEmbedder
from gcd_model.config import Prediction
from gcd_model.layers import Layers
from gcd_model.networks import Networks
from gcd_model.noise import preconditioning
from gcd_model.unet import UpLevel, VideoUNet
from gcd_train.distillation.recipe import CriticRecipe
from gcd_train.draws import Draws
from gcd_train.objective import Batch, draw_noise

_DORMANT = ".dormant."


class Head(nn.Module):
    """Says of one block's features, place by place, how true they look."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(1, channels, affine=False)  # the convolution after it has weights enough
        self.across_space = nn.Conv3d(channels, width, (1, 3, 3), padding=(0, 1, 1))
        self.across_time = nn.Conv3d(width, width, (3, 1, 1), padding=(1, 0, 0))
        self.word = nn.Conv3d(width, 1, 1)

    def forward(self, features: Tensor, frames: int) -> Tensor:
        """features: [B*T, C, h, w] -> [B, T*h*w]."""
        clips = self.norm(features.float()).unflatten(0, (-1, frames)).transpose(1, 2)  # [B, C, T, h, w]
        seen = F.silu(self.across_space(clips))
        return self.word(F.silu(seen + self.across_time(seen))).flatten(1)


class Critic(nn.Module):
    """The encoder half of a teacher, and heads.

    Weights are its own: nothing it learns changes the teacher. Unless `trained`, only the heads learn.
    """

    def __init__(self, teacher: Networks, width: int, *, trained: bool) -> None:
        super().__init__()
        config = teacher.config
        self.prediction: Prediction = config.prediction
        self.unet: VideoUNet = _encoder_half(teacher.unet)
        self.camera: CameraEmbedder | None = deepcopy(teacher.camera)
        for name, parameter in self.named_parameters():
            parameter.requires_grad_(trained and _DORMANT not in name)
        levels = [wide for wide in config.unet.widths for _ in range(config.unet.blocks_per_level)]
        self.heads = Layers[Head](Head(channels, width) for channels in (*levels, *levels[-1:], *levels[-1:]))

    def forward(self, latents: Tensor, noise: Tensor, sigma: Tensor, batch: Batch) -> Tensor:
        """How true latents look, the higher the truer: [B, all places of all blocks].

        Args:
            latents: [N, C, h, w], scaled. noise: unit, the same shape. sigma: [N].
        """
        levels = preconditioning(sigma, self.prediction)
        noised = _column(levels.c_in) * (latents + _column(sigma) * noise)
        camera = None if self.camera is None or batch.camera is None else self.camera.proj(batch.camera)
        plan = self.unet.plan(levels.c_noise[None], batch.vector, camera, batch.tokens).step(0)
        x = self.unet.stem(torch.cat([noised, batch.condition], dim=1))
        inputs, words = iter(plan), list[Tensor]()
        heads = iter(self.heads)
        for level in self.unet.down:
            for stage in level.stages:
                x = stage(x, next(inputs), batch.frames)
                words.append(next(heads)(x, batch.frames))
            x = x if level.down is None else level.down(x)
        for stage in self.unet.middle:
            x = stage(x, next(inputs), batch.frames)
            words.append(next(heads)(x, batch.frames))
        return torch.cat(words, dim=1)


def heard(critic: Critic, latents: Tensor, noise: Tensor, sigma: Tensor, batch: Batch) -> Tensor:
    """As `critic(...)`, with gradients to the latents but none to the critic's weights."""
    frozen = {name: value.detach() for name, value in critic.named_parameters()}
    return functional_call(critic, frozen, (latents, noise, sigma, batch))


def fooling_loss(words: Tensor) -> Tensor:
    """What the student wants: to be taken for true. Source: Lim and Ye 2017, Eq. 13."""
    return -words.mean()


def telling_loss(true: Tensor, made: Tensor) -> Tensor:
    """What the critic wants: true latents above 1, samples below -1. Source: Lim and Ye 2017, Eq. 12."""
    return F.relu(1 - true).mean() + F.relu(1 + made).mean()


def looked_at(batch: Batch, recipe: CriticRecipe, draws: Draws) -> tuple[Tensor, Tensor]:
    """At which noise the critic looks: unit noise [N, C, h, w] and one level a clip, [N]."""
    clips = batch.target.shape[0] // batch.frames
    sigma = torch.exp(recipe.log_mean + recipe.log_std * draws.normal(clips))
    return draw_noise(draws, batch.target.shape, batch.frames, 0.0), sigma.repeat_interleave(batch.frames)


def _encoder_half(unet: VideoUNet) -> VideoUNet:
    """A copy without what comes after the middle."""
    kept, unet.up = unet.up, Layers[UpLevel]([])
    try:
        half = deepcopy(unet)
    finally:
        unet.up = kept
    return half


def _column(values: Tensor) -> Tensor:
    return values.view(-1, 1, 1, 1)


def trained_of(critic: Critic) -> Sequence[nn.Parameter]:
    """What of a critic learns."""
    return [parameter for parameter in critic.parameters() if parameter.requires_grad]
