"""The autoencoders: an image encoder, and a decoder that also mixes across frames."""

from dataclasses import dataclass
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import VAEConfig
from gcd_model.layers import (
    Downsample,
    FrameConv,
    Layers,
    ResBlock,
    TemporalShare,
    Upsample,
    VideoResBlock,
    zeroed,
)


@dataclass(frozen=True, slots=True)
class Posterior:
    """A diagonal Gaussian over latents, [N, C, h, w] each."""

    mean: Tensor
    log_variance: Tensor

    @classmethod
    def of_moments(cls, moments: Tensor) -> Self:
        """moments: [N, 2C, h, w]; the log-variance is clamped to [-30, 20]."""
        mean, log_variance = moments.chunk(2, dim=1)
        return cls(mean, log_variance.clamp(-30.0, 20.0))

    def sample(self, noise: Tensor) -> Tensor:
        """mean + standard deviation * noise."""
        return self.mean + (0.5 * self.log_variance).exp() * noise


class PixelAttention(nn.Module):
    """Single-head attention over all positions of a frame, with 1x1 convolutions."""

    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(groups, channels, eps=1e-6)
        self.query, self.key, self.value, self.out = (nn.Conv2d(channels, channels, 1) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, H, W] -> the same shape."""
        normed = self.norm(x)
        query, key, value = (
            layer(normed).flatten(2).transpose(1, 2)[:, None] for layer in (self.query, self.key, self.value)
        )
        mixed = F.scaled_dot_product_attention(query, key, value)[:, 0]  # [N, H*W, C]
        return x + self.out(mixed.transpose(1, 2).unflatten(2, x.shape[-2:]))


class EncoderLevel(nn.Module):
    """Residual blocks at one resolution, then half of it."""

    def __init__(self, in_channels: int, level: int, config: VAEConfig) -> None:
        super().__init__()
        width = config.widths[level]
        self.blocks = nn.Sequential(
            *(
                ResBlock(in_channels if i == 0 else width, width, groups=config.norm_groups, eps=1e-6)
                for i in range(config.blocks_per_level)
            )
        )
        self.down = Downsample(width, pad="end") if level + 1 < len(config.widths) else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, H, W] -> [N, C', H/2, W/2]."""
        return self.down(self.blocks(x))


class Encoder(nn.Module):
    """Frames to a posterior over latents, each frame alone.

    quant: with the 1x1 convolution of image autoencoders after the encoder.
    """

    def __init__(self, config: VAEConfig, *, quant: bool) -> None:
        super().__init__()
        widths, moments = config.widths, 2 * config.latent_channels
        self.patch = config.patch
        self.stem = nn.Conv2d(3 * config.patch**2, widths[0], 3, padding=1)
        self.levels = nn.Sequential(
            *(EncoderLevel(widths[max(level - 1, 0)], level, config) for level in range(len(widths)))
        )
        width, groups = widths[-1], config.norm_groups
        self.middle = nn.Sequential(
            ResBlock(width, width, groups=groups, eps=1e-6),
            PixelAttention(width, groups),
            ResBlock(width, width, groups=groups, eps=1e-6),
        )
        self.norm_out = nn.GroupNorm(config.norm_groups, widths[-1], eps=1e-6)
        self.conv_out = nn.Conv2d(widths[-1], moments, 3, padding=1)
        self.quant = nn.Conv2d(moments, moments, 1) if quant else None
        block = config.down_factor
        self.linear = nn.Conv2d(3, config.latent_channels, block, stride=block) if config.linear else None

    def forward(self, frames: Tensor) -> Posterior:
        """frames: [N, 3, H, W] in [-1, 1]."""
        x = frames if self.patch == 1 else F.pixel_unshuffle(frames, self.patch)
        x = self.middle(self.levels(self.stem(x)))
        moments = self.conv_out(F.silu(self.norm_out(x)))
        if self.linear is not None:
            straight = self.linear(frames)  # [N, C, h, w], of the mean; the log-variance gets none
            moments = moments + F.pad(straight, (0, 0, 0, 0, 0, straight.shape[1]))
        return Posterior.of_moments(moments if self.quant is None else self.quant(moments))


def _video_block(in_channels: int, out_channels: int, config: VAEConfig) -> VideoResBlock:
    share = TemporalShare(of_sigmoid="time", initial=0.0)
    block = VideoResBlock(
        in_channels, out_channels, groups=config.norm_groups, embedding_width=None, eps=1e-6, share=share
    )
    zeroed(block.temporal.conv2)
    return block


class DecoderLevel(nn.Module):
    """Residual blocks at one resolution, then twice that, but for the last level."""

    def __init__(self, in_channels: int, level: int, config: VAEConfig) -> None:
        super().__init__()
        width = config.widths[level]
        self.blocks = Layers[VideoResBlock](
            _video_block(in_channels if i == 0 else width, width, config) for i in range(config.blocks_per_level + 1)
        )
        self.up = Upsample(width) if level > 0 else nn.Identity()

    def forward(self, x: Tensor, frames: int | None) -> Tensor:
        """x: [B*T, C, h, w] -> [B*T, C', 2h, 2w]. frames: None for unrelated frames."""
        for block in self.blocks:
            x = block(x, frames)
        return self.up(x)


class TemporalDecoder(nn.Module):
    """Latents to frames; every residual block also looks at the neighbouring frames.

    Source: Blattmann et al. 2023 (SVD), the finetuned decoder.
    """

    def __init__(self, config: VAEConfig) -> None:
        super().__init__()
        widths = config.widths
        self.stem = nn.Conv2d(config.latent_channels, widths[-1], 3, padding=1)
        self.middle_in = _video_block(widths[-1], widths[-1], config)
        self.middle_attention = PixelAttention(widths[-1], config.norm_groups)
        self.middle_out = _video_block(widths[-1], widths[-1], config)
        above = [*widths[1:], widths[-1]]
        self.levels = Layers[DecoderLevel](DecoderLevel(above[i], i, config) for i in reversed(range(len(widths))))
        self.norm_out = nn.GroupNorm(config.norm_groups, widths[0], eps=1e-6)
        self.patch = config.patch
        colours = 3 * self.patch**2
        self.conv_out = nn.Conv2d(widths[0], colours, 3, padding=1)
        self.mix_frames = FrameConv(colours, colours)
        assert self.mix_frames.bias is not None
        nn.init.dirac_(self.mix_frames.weight)  # the identity, so that what decodes single frames decodes clips alike
        nn.init.zeros_(self.mix_frames.bias)
        self.block = config.down_factor
        self.linear = nn.Conv2d(config.latent_channels, 3 * self.block**2, 1) if config.linear else None

    def forward(self, latents: Tensor, frames: int | None) -> Tensor:
        """latents: [B*T, C, h, w], unscaled -> [B*T, 3, H, W], about [-1, 1].

        frames: T; None for unrelated frames: every layer across frames is then left out.
        """
        x = self.middle_in(self.stem(latents), frames)
        x = self.middle_out(self.middle_attention(x), frames)
        for level in self.levels:
            x = level(x, frames)
        x = self.conv_out(F.silu(self.norm_out(x)))
        if frames is not None:
            video = x.unflatten(0, (-1, frames)).transpose(1, 2)  # [B, 3 * patch^2, T, H / patch, W / patch]
            x = self.mix_frames(video).transpose(1, 2).flatten(0, 1)
        x = x if self.patch == 1 else F.pixel_shuffle(x, self.patch)
        return x if self.linear is None else x + F.pixel_shuffle(self.linear(latents), self.block)


def to_pixels(decoded: Tensor) -> Tensor:
    """Decoder output in [-1, 1] to RGB in [0, 1], clamped; float32."""
    return torch.clamp((decoded.float() + 1) / 2, 0.0, 1.0)
