"""The video U-Net of Stable Video Diffusion.

Nothing that is constant over a window or a schedule is computed in `forward`: `plan` does that once.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import UNetConfig
from gcd_model.layers import (
    Attention,
    Derived,
    Downsample,
    FeedForward,
    Layers,
    TemporalShare,
    TokenAttention,
    Upsample,
    VideoResBlock,
    embedding_mlp,
    sinusoid,
    zeroed,
)


class FramePositions(Derived[Tensor]):
    """An embedding of the frame number, [T, C]: a function of the weights alone."""

    def __init__(self, channels: int, frames: int) -> None:
        super().__init__()
        self.channels, self.frames = channels, frames
        self.mlp = embedding_mlp(channels, 4 * channels, channels)

    def derive(self) -> Tensor:
        """The table, [T, C]."""
        weight = next(self.mlp.parameters())
        numbers = torch.arange(self.frames, device=weight.device)
        return self.mlp(sinusoid(numbers, self.channels).to(weight.dtype))


class SpatialBlock(nn.Module):
    """Attention over the pixels of a frame, the image token, feed-forward."""

    def __init__(self, channels: int, heads: int, context_width: int | None) -> None:
        super().__init__()
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.token = None if context_width is None else TokenAttention(channels, context_width)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(self, x: Tensor, cross: Tensor | None) -> Tensor:
        """x: [B*T, L, C]. cross: [B*T, C], what the image token adds."""
        x = x + self.attention(self.norm_attention(x))
        if cross is not None:
            x = x + cross[:, None]
        return x + self.feed(self.norm_feed(x))


class TemporalBlock(nn.Module):
    """Feed-forward, attention over the frames of a pixel, the first frame's image token, feed-forward."""

    def __init__(self, channels: int, heads: int, context_width: int | None) -> None:
        super().__init__()
        self.norm_first = nn.LayerNorm(channels)
        self.feed_first = FeedForward(channels)
        self.norm_attention = nn.LayerNorm(channels)
        self.attention = Attention(channels, heads)
        self.token = None if context_width is None else TokenAttention(channels, context_width)
        self.norm_feed = nn.LayerNorm(channels)
        self.feed = FeedForward(channels)

    def forward(self, x: Tensor, cross: Tensor | None) -> Tensor:
        """x: [B, T, L, C]. cross: [B, C]."""
        x = x + self.feed_first(self.norm_first(x))
        by_pixel = self.norm_attention(x).transpose(1, 2).contiguous()  # [B, L, T, C]
        mixed = self.attention(by_pixel.flatten(0, 1)).view_as(by_pixel)
        x = x + mixed.transpose(1, 2)
        if cross is not None:
            x = x + cross[:, None, None]
        return x + self.feed(self.norm_feed(x))


class VideoTransformer(nn.Module):
    """Attention within frames, then across frames, blended by a learned share."""

    def __init__(self, channels: int, *, head_width: int, context_width: int | None, groups: int, frames: int) -> None:
        super().__init__()
        heads = channels // head_width
        self.norm = nn.GroupNorm(groups, channels, eps=1e-6)
        self.proj_in = nn.Linear(channels, channels)
        self.spatial = SpatialBlock(channels, heads, context_width)
        self.positions = FramePositions(channels, frames)
        self.temporal = TemporalBlock(channels, heads, context_width)
        self.share = TemporalShare(of_sigmoid="space", initial=0.5)
        self.proj_out = nn.Linear(channels, channels)

    def start_apart(self) -> None:
        """Make the part across frames the identity, so that what single frames taught holds for clips at first."""
        for layer in (self.positions.mlp[-1], self.temporal.attention.out):
            zeroed(layer)
        for feed in (self.temporal.feed_first, self.temporal.feed):
            zeroed(feed.contract)

    def cross(self, tokens: Tensor) -> Tensor | None:
        """What image tokens [B*T, D] add within frames, and across them, where only a clip's first one counts:
        [B*T, 2C]; None without cross-attention."""
        if self.spatial.token is None or self.temporal.token is None:
            return None
        frames = self.positions.frames
        across = self.temporal.token(tokens[::frames]).repeat_interleave(frames, dim=0)[: len(tokens)]
        return torch.cat([self.spatial.token(tokens), across], dim=1)

    def forward(self, x: Tensor, cross: Tensor | None, frames: int | None) -> Tensor:
        """x: [B*T, C, H, W] -> the same shape. cross: [B*T, 2C], see there.

        frames: T; None for unrelated frames, which stay apart.
        """
        within, between = (None, None) if cross is None else cross.chunk(2, dim=1)
        tokens = self.proj_in(self.norm(x).flatten(2).transpose(1, 2))  # [B*T, L, C]
        tokens = self.spatial(tokens, within)
        if frames is not None:
            across = tokens.unflatten(0, (-1, frames)) + self.positions.derived()[:frames, None]  # [B, T, L, C]
            across = self.temporal(across, None if between is None else between[::frames])
            tokens = self.share.blend(tokens, across.flatten(0, 1))
        return x + self.proj_out(tokens).transpose(1, 2).unflatten(2, x.shape[-2:])


class Stage(nn.Module):
    """A residual block and, where the level attends, a transformer."""

    def __init__(self, in_channels: int, out_channels: int, config: UNetConfig, *, attends: bool, frames: int) -> None:
        super().__init__()
        self.res = VideoResBlock(
            in_channels,
            out_channels,
            groups=config.norm_groups,
            embedding_width=config.embedding_width,
            eps=1e-5,
            share=TemporalShare(of_sigmoid="space", initial=0.5),
        )
        self.attention = (
            VideoTransformer(
                out_channels,
                head_width=config.head_width,
                context_width=config.context_width,
                groups=config.norm_groups,
                frames=frames,
            )
            if attends
            else None
        )

    def forward(self, x: Tensor, embedding: Tensor, cross: Tensor | None, frames: int | None) -> Tensor:
        """x: [N, C, h, w] -> [N, C', h, w]. embedding, cross: [N, 2C'] each. frames: None for unrelated frames."""
        x = self.res(x, frames, embedding)
        return x if self.attention is None else self.attention(x, cross, frames)


class DownLevel(nn.Module):
    """Stages at one resolution, then half of it."""

    def __init__(self, in_channels: int, level: int, config: UNetConfig, frames: int) -> None:
        super().__init__()
        width, attends = config.widths[level], config.attention[level]
        self.stages = Layers[Stage](
            Stage(in_channels if i == 0 else width, width, config, attends=attends, frames=frames)
            for i in range(config.blocks_per_level)
        )
        self.down = Downsample(width, pad="both") if level + 1 < len(config.widths) else None


class UpLevel(nn.Module):
    """Stages at one resolution, each taking one skip connection, then twice that resolution."""

    def __init__(self, in_channels: int, skips: list[int], level: int, config: UNetConfig, frames: int) -> None:
        super().__init__()
        width, attends = config.widths[level], config.attention[level]
        self.stages = Layers[Stage](
            Stage((in_channels if i == 0 else width) + skips.pop(), width, config, attends=attends, frames=frames)
            for i in range(config.blocks_per_level + 1)
        )
        self.up = Upsample(width) if level > 0 else None


class UNetPlan(NamedTuple):
    """All that the U-Net takes besides pixels, for every step of a schedule, the parts of all stages side by side.

    embeddings: [S, N, E], noise level, micro-conditioning and camera; the same for both guidance branches.
    crosses: [R*N, X], what the image token adds in both branches, the same in every step; None without tokens.
    """

    embeddings: Tensor
    crosses: Tensor | None

    def step(self, index: int, branches: int = 1) -> tuple[Tensor, Tensor | None]:
        """What `VideoUNet.forward` takes of it at one step. branches: R."""
        return self.embeddings[index].repeat(branches, 1), self.crosses


class VideoUNet(nn.Module):
    """Noisy latents and source latents in, prediction out.

    Source: Blattmann et al. 2023 (SVD); the camera vector as in Van Hoorick et al. 2024 (GCD), section 3.2.
    """

    def __init__(self, config: UNetConfig, frames: int) -> None:
        super().__init__()
        self.config, self.frames = config, frames
        width, embedding = config.width, config.embedding_width
        self.embed_noise = embedding_mlp(width, embedding, embedding)
        self.embed_vector = embedding_mlp(config.vector_width, embedding, embedding)
        self.embed_camera = embedding_mlp(config.camera_width, embedding, embedding) if config.camera_width else None
        self.stem = nn.Conv2d(config.latent_channels + config.condition_channels, width, 3, padding=1)
        before = [width, *config.widths[:-1]]
        self.down = Layers[DownLevel](DownLevel(before[i], i, config, frames) for i in range(len(config.widths)))
        self.middle = Layers[Stage](
            Stage(config.widths[-1], config.widths[-1], config, attends=attends, frames=frames)
            for attends in (True, False)
        )
        above, skips = [*config.widths[1:], config.widths[-1]], [width]  # of the stem, every stage and down-sampling
        for level, channels in enumerate(config.widths):
            skips += [channels] * (config.blocks_per_level + (level + 1 < len(config.widths)))
        self.up = Layers[UpLevel](
            UpLevel(above[i], skips, i, config, frames) for i in reversed(range(len(config.widths)))
        )
        self.norm_out = nn.GroupNorm(config.norm_groups, width, eps=1e-5)
        self.conv_out = nn.Conv2d(width, config.latent_channels, 3, padding=1)
        for stage in self.all_stages():  # so that it starts as the identity
            zeroed(stage.res.spatial.conv2)
            zeroed(stage.res.temporal.conv2)
            if stage.attention is not None:
                zeroed(stage.attention.proj_out)
        zeroed(self.conv_out)

    def plan(self, noise_labels: Tensor, vector: Tensor, camera: Tensor | None, tokens: Tensor | None) -> UNetPlan:
        """Compute all that does not depend on the pixels.

        Args:
            noise_labels: [S] one per step (or [S, N]), c_noise. vector: [N, V], micro-conditioning.
            camera: [N, camera_width] or None. tokens: [R*N, D] image tokens of the whole batch, or None.
        """
        labels = noise_labels if noise_labels.ndim == 2 else noise_labels[:, None]
        embedding = self.embed_noise(sinusoid(labels, self.config.width).to(vector.dtype)) + self.embed_vector(vector)
        if self.embed_camera is not None:
            assert camera is not None, "this U-Net wants a camera vector"
            embedding = embedding + self.embed_camera(camera)  # [S, N, E]
        embeddings = torch.cat([stage.res.project(embedding) for stage in self.all_stages()], dim=-1)
        return UNetPlan(embeddings, None if tokens is None else self.crosses(tokens))

    def crosses(self, tokens: Tensor) -> Tensor | None:
        """What image tokens [R*N, D] add in every transformer, side by side; None without cross-attention."""
        attending = [stage.attention for stage in self.all_stages() if stage.attention is not None]
        found = [cross for cross in (each.cross(tokens) for each in attending) if cross is not None]
        return torch.cat(found, dim=1) if found else None

    def all_stages(self) -> Iterator[Stage]:
        """Every stage in the order of the forward pass."""
        for level in self.down:
            yield from level.stages
        yield from self.middle
        for level in self.up:
            yield from level.stages

    def forward(
        self,
        latents: Tensor,
        condition: Tensor,
        embeddings: Tensor,
        crosses: Tensor | None = None,
        *,
        image_mode: bool = False,
    ) -> Tensor:
        """One evaluation of the network F.

        Args:
            latents: [B*T, C, h, w], scaled noisy latents. condition: [B*T, C', h, w], source latents, unscaled.
            embeddings, crosses: [B*T, ...], of one step of a plan that was made for this batch.
            image_mode: leave out every layer across frames; the rows are then unrelated frames, any number of them.
        Returns:
            [B*T, C, h, w].
        """
        frames = None if image_mode else self.frames
        inputs = self._by_stage(embeddings, crosses)
        x = self.stem(torch.cat([latents, condition], dim=1))
        skips = [x]
        for level in self.down:
            for stage in level.stages:
                x = stage(x, *next(inputs), frames)
                skips.append(x)
            if level.down is not None:
                x = level.down(x)
                skips.append(x)
        for stage in self.middle:
            x = stage(x, *next(inputs), frames)
        for level in self.up:
            for stage in level.stages:
                x = stage(torch.cat([x, skips.pop()], dim=1), *next(inputs), frames)
            if level.up is not None:
                x = level.up(x)
        return self.conv_out(F.silu(self.norm_out(x)))

    def _by_stage(self, embeddings: Tensor, crosses: Tensor | None) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Every stage's own part, in the order of the forward pass."""
        taken = 0
        for stage, embedding in zip(self.all_stages(), embeddings.split(self.embedding_widths, 1), strict=True):
            cross, width = None, embedding.shape[1]
            if stage.attention is not None and crosses is not None:
                cross, taken = crosses[:, taken : taken + width], taken + width
            yield embedding, cross

    @property
    def embedding_widths(self) -> list[int]:
        """How many numbers of an embedding are each stage's."""
        return [2 * stage.res.spatial.norm2.num_channels for stage in self.all_stages()]

    def start_apart(self) -> None:
        """Make all transformers across frames the identity too: for learning from single frames first, then clips."""
        for stage in self.all_stages():
            if stage.attention is not None:
                stage.attention.start_apart()
