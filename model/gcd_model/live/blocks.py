"""What the depth and the paint network are built of: residual blocks in a short U, a quarter of the picture's size."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.layers import Layers, zeroed
from gcd_model.live.config import Widths

PATCH = 4
"""The trunk's pixels are patches of this side; what is finer is added at the end, at full size."""
_GROUPS, _HEADS = 8, 4


class Block(nn.Module):
    """Norm, SiLU, convolution, twice, around a skip; the embedding is added between the two."""

    def __init__(self, in_channels: int, out_channels: int, embedding_width: int = 0) -> None:
        super().__init__()
        self.norm_in = nn.GroupNorm(_GROUPS, in_channels)
        self.conv_in = nn.Conv2d(in_channels, out_channels, 3, padding=1)
        self.embed = nn.Linear(embedding_width, out_channels) if embedding_width else None
        self.norm_out = nn.GroupNorm(_GROUPS, out_channels)
        self.conv_out = zeroed(nn.Conv2d(out_channels, out_channels, 3, padding=1))
        self.skip = nn.Identity() if in_channels == out_channels else nn.Conv2d(in_channels, out_channels, 1)

    def forward(self, x: Tensor, embedding: Tensor | None) -> Tensor:
        """x: [N, C, h, w]; embedding: [N, E], or None without."""
        y = self.conv_in(F.silu(self.norm_in(x)))
        if self.embed is not None and embedding is not None:
            y = y + self.embed(embedding)[:, :, None, None]
        return self.skip(x) + self.conv_out(F.silu(self.norm_out(y)))


class Attention(nn.Module):
    """Every patch of the coarsest level looks at all others."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(_GROUPS, channels)
        self.query_key_value = nn.Conv2d(channels, 3 * channels, 1)
        self.out = zeroed(nn.Conv2d(channels, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, h, w]."""
        n, channels, height, width = x.shape
        heads = self.query_key_value(self.norm(x)).view(n, 3, _HEADS, channels // _HEADS, height * width)
        query, key, value = heads.transpose(-1, -2).unbind(1)  # [N, heads, h*w, C/heads]
        mixed = F.scaled_dot_product_attention(query, key, value)
        return x + self.out(mixed.transpose(-1, -2).reshape(n, channels, height, width))


class Trunk(nn.Module):
    """A U of three levels: patches in, features of every patch out."""

    def __init__(self, in_channels: int, widths: Widths, embedding_width: int = 0, stem_kernel: int = 3) -> None:
        super().__init__()
        first, second, third = widths
        e = embedding_width
        self.stem = nn.Conv2d(in_channels * PATCH**2, first, stem_kernel, padding=stem_kernel // 2)
        self.down = Layers[Block](
            [Block(first, first, e), Block(second, second, e), Block(third, third, e), Block(third, third, e)]
        )
        self.shrink = Layers[nn.Conv2d](
            [nn.Conv2d(first, second, 3, stride=2, padding=1), nn.Conv2d(second, third, 3, stride=2, padding=1)]
        )
        self.attention = Attention(third)
        self.middle = Block(third, third, e)
        self.up = Layers[Block](
            [Block(third + second, second, e), Block(second, second, e), Block(second + first, first, e)]
        )
        self.last = Block(first, first, e)

    def forward(self, pictures: Tensor, embedding: Tensor | None = None) -> Tensor:
        """pictures: [N, C, H, W] -> features [N, widths[0], H/4, W/4]."""
        to_second, to_third = self.shrink
        at_first, at_second, at_third, at_third_again = self.down
        up_second, up_second_again, up_first = self.up
        a = at_first(self.stem(F.pixel_unshuffle(pictures, PATCH)), embedding)
        b = at_second(to_second(a), embedding)
        c = at_third_again(at_third(to_third(b), embedding), embedding)
        c = self.middle(self.attention(c), embedding)
        b = up_second_again(up_second(torch.cat([_doubled(c), b], dim=1), embedding), embedding)
        a = up_first(torch.cat([_doubled(b), a], dim=1), embedding)
        return self.last(a, embedding)


def _doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


class FineHead(nn.Module):
    """From patches back to pixels: the trunk's features beside a few features of the full picture."""

    def __init__(
        self, in_channels: int, trunk_width: int, fine_width: int, out_channels: int, *, zero: bool = False
    ) -> None:
        super().__init__()
        self.fine = nn.Conv2d(in_channels, fine_width // 2, 3, padding=1)
        self.spread = nn.Conv2d(trunk_width, fine_width * PATCH**2, 1)
        self.mix = nn.Conv2d(fine_width + fine_width // 2, fine_width, 3, padding=1)
        out = nn.Conv2d(fine_width, out_channels, 1)
        self.out = zeroed(out) if zero else out

    def forward(self, pictures: Tensor, features: Tensor, pixels: Tensor | None = None) -> Tensor:
        """pictures: [N, C, H, W], features: [N, trunk_width, H/4, W/4] -> [N, out_channels, H, W].

        pixels: int64 [N, M], flat numbers of the only pixels that are computed: -> [N, out_channels, M, 1].
        """
        spread = F.pixel_shuffle(self.spread(F.silu(features)), PATCH)
        x = self.mix(F.silu(torch.cat([spread, self.fine(pictures)], dim=1)))
        if pixels is not None:
            x = x.flatten(2).gather(2, pixels[:, None].expand(-1, x.shape[1], -1))[..., None]
        return self.out(F.silu(x))
