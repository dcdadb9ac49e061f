"""The same parts across frames, and the learned blend of space and time.

Frames are flattened into the batch, time fastest: row b*T + t is frame t of clip b.
"""

import torch
from torch import Tensor, nn

from gcd_model.layers import Attention, Derived, FeedForward, ResBlock, TokenAttention, embedding_mlp, sinusoid, zeroed


class TemporalShare(Derived[Tensor]):
    """How much the temporal branch counts, a learned scalar in (0, 1).

    of_sigmoid: "space" (U-Net: the sigmoid weighs the spatial branch) or "time" (VAE decoder: the temporal one).
    Since both branches share the spatial result x, `(1-s)*x + s*(x+h)` is `x + s*h`: one pass, no folded copies.
    """

    def __init__(self, *, of_sigmoid: str, initial: float) -> None:
        super().__init__()
        self.of_space = of_sigmoid == "space"
        self.mix = nn.Parameter(torch.full((1,), initial))

    def derive(self) -> Tensor:
        """The share, [1]."""
        return (-self.mix if self.of_space else self.mix).sigmoid()

    def add(self, x: Tensor, h: Tensor) -> Tensor:
        """x + share * h."""
        return torch.addcmul(x, h, self.derived().to(x.dtype))

    def blend(self, space: Tensor, time: Tensor) -> Tensor:
        """space + share * (time - space)."""
        return torch.lerp(space, time, self.derived().to(space.dtype))


class VideoResBlock(nn.Module):
    """A spatial residual block, then one over frames, blended by a learned share."""

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        groups: int,
        embedding_width: int | None,
        eps: float,
        share: TemporalShare,
    ) -> None:
        super().__init__()
        self.spatial = ResBlock(in_channels, out_channels, groups=groups, eps=eps, embedding_width=embedding_width)
        self.temporal = ResBlock(
            out_channels, out_channels, groups=groups, eps=1e-5, embedding_width=embedding_width, temporal=True
        )
        self.share = share

    def forward(
        self,
        x: Tensor,
        frames: int | None,
        spatial_embedding: Tensor | None = None,
        temporal_embedding: Tensor | None = None,
    ) -> Tensor:
        """x: [B*T, C, H, W] -> [B*T, C', H, W]. embeddings: [B*T, C'], already projected.

        frames: T; None for unrelated frames, which stay apart.
        """
        x = self.spatial(x, None if spatial_embedding is None else spatial_embedding[..., None, None])
        if frames is None:
            return x
        if temporal_embedding is not None:
            temporal_embedding = temporal_embedding.unflatten(0, (-1, frames)).transpose(1, 2)[..., None, None]
        video = x.unflatten(0, (-1, frames)).transpose(1, 2)  # [B, C', T, H, W]
        change = self.temporal.residual(video, temporal_embedding)
        return self.share.add(x.unflatten(0, (-1, frames)), change.transpose(1, 2)).flatten(0, 1)


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

    def forward(
        self, x: Tensor, frames: int | None, spatial_cross: Tensor | None, temporal_cross: Tensor | None
    ) -> Tensor:
        """x: [B*T, C, H, W] -> the same shape. spatial_cross: [B*T, C]. temporal_cross: [B, C].

        frames: T; None for unrelated frames, which stay apart.
        """
        tokens = self.proj_in(self.norm(x).flatten(2).transpose(1, 2))  # [B*T, L, C]
        tokens = self.spatial(tokens, spatial_cross)
        if frames is not None:
            tokens = self._across(tokens, frames, temporal_cross)
        return x + self.proj_out(tokens).transpose(1, 2).unflatten(2, x.shape[-2:])

    def _across(self, tokens: Tensor, frames: int, cross: Tensor | None) -> Tensor:
        across = tokens.unflatten(0, (-1, frames)) + self.positions.derived()[:frames, None]  # [B, T, L, C]
        return self.share.blend(tokens, self.temporal(across, cross).flatten(0, 1))
