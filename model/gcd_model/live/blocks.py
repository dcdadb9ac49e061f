"""What the depth and the paint network are built of: residual blocks in a U of patches, and a head of pixels."""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.layers import Layers, zeroed
from gcd_model.live.config import Widths

_GROUPS, _HEADS = 8, 4
_MIXER_RATIO = 3


def layout(device: torch.device) -> torch.memory_format:
    """Of pictures and weights. A CPU convolves faster with channels last; on a GPU every group norm would undo it."""
    return torch.contiguous_format if device.type == "cuda" else torch.channels_last


def convolved(weight: Tensor, bias: Tensor | None, pictures: Tensor, patch: int) -> Tensor:
    """What a convolution of odd width makes of patches, `conv2d(pixel_unshuffle(pictures, patch), weight, bias)`.

    A CPU takes less time for one with larger steps over the pixels themselves than for unshuffling them.
    """
    out, _, *kernel = weight.shape
    if pictures.device.type == "cuda":
        return F.conv2d(F.pixel_unshuffle(pictures, patch), weight, bias, padding=kernel[0] // 2)
    wide = weight.reshape(out, -1, patch, patch, *kernel).permute(0, 1, 4, 2, 5, 3)
    wide = wide.reshape(out, -1, kernel[0] * patch, kernel[1] * patch)
    return F.conv2d(pictures, wide, bias, patch, kernel[0] // 2 * patch)


def in_planes(convolution: nn.Conv2d, x: Tensor) -> Tensor:
    """A convolution of single pixels; its channels are planes in memory, which all that reads them is faster with."""
    weight, bias = convolution.weight.flatten(1), convolution.bias
    assert bias is not None
    made = torch.baddbmm(bias[:, None], weight.expand(len(x), -1, -1), x.flatten(2))
    return made.view(len(x), -1, *x.shape[2:])


def likeliest(chances: Tensor, dim: int = 0) -> Tensor:
    """Which of K choices along an axis, at most 256, is the largest, the first of equals: uint8.

    (`argmax`, and `max` with its indices, take two to four times as long on a CPU.)
    """
    last = chances.shape[dim] - 1
    number = torch.arange(last, -1, -1, dtype=torch.uint8, device=chances.device)
    number = number.view([-1 if each == dim % chances.ndim else 1 for each in range(chances.ndim)])
    return last - ((chances == chances.amax(dim, keepdim=True)) * number).amax(dim)


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


class Mixer(nn.Module):
    """A transformer layer of the coarsest level: attention, then two layers on every patch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.attention = Attention(channels)
        self.norm = nn.GroupNorm(_GROUPS, channels)
        self.widen = nn.Conv2d(channels, _MIXER_RATIO * channels, 1)
        self.narrow = zeroed(nn.Conv2d(_MIXER_RATIO * channels, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, h, w]."""
        x = self.attention(x)
        return x + self.narrow(F.silu(self.widen(self.norm(x))))


class Trunk(nn.Module):
    """A U of several levels, each of half the size of the one before: patches in, features of every patch out.

    patch: side in pixels of what the first level calls a pixel. widths: channels of the levels. mixers: transformer
    layers on the coarsest. beside: channels a patch of what is given beside the pictures.
    """

    def __init__(
        self,
        in_channels: int,
        widths: Widths,
        patch: int,
        *,
        mixers: int = 0,
        embedding_width: int = 0,
        stem_kernel: int = 3,
        beside: int = 0,
    ) -> None:
        super().__init__()
        e, last = embedding_width, widths[-1]
        self.patch = patch
        self.stem = nn.Conv2d(in_channels * patch**2 + beside, widths[0], stem_kernel, padding=stem_kernel // 2)
        self.down = Layers[Block]([Block(width, width, e) for width in (*widths, last)])
        self.shrink = Layers[nn.Conv2d](
            [nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairwise(widths)]
        )
        self.attention = Attention(last)
        self.mixers = Layers[Mixer]([Mixer(last) for _ in range(mixers)])
        self.middle = Block(last, last, e)
        ways = [(coarse, fine) for fine, coarse in reversed(list(pairwise(widths)))]
        self.up = Layers[Block](
            [block for coarse, fine in ways for block in (Block(coarse + fine, fine, e), Block(fine, fine, e))]
        )

    def forward(self, pictures: Tensor, embedding: Tensor | None = None, beside: Tensor | None = None) -> Tensor:
        """pictures: [N, C, H, W] -> features [N, widths[0], H / patch, W / patch].

        beside: [N, B, H / s, W / s], pictures at a size that patches divide, too.
        """
        own = pictures.shape[1] * self.patch**2
        x = convolved(self.stem.weight[:, :own], self.stem.bias, pictures, self.patch)
        if beside is not None:
            patch = beside.shape[-1] * self.patch // pictures.shape[-1]
            x = x + convolved(self.stem.weight[:, own:], None, beside, patch)
        x = self.down[0](x, embedding)
        kept: list[Tensor] = []
        for shrink, block in zip(self.shrink, list(self.down)[1:-1], strict=True):
            kept.append(x)
            x = block(shrink(x), embedding)
        x = self.attention(self.down[-1](x, embedding))
        for mixer in self.mixers:
            x = mixer(x)
        x = self.middle(x, embedding)
        blocks = list(self.up)
        for joining, after, fine in zip(blocks[::2], blocks[1::2], reversed(kept), strict=True):
            x = torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), fine], dim=1)
            x = after(joining(x, embedding), embedding)
        return x


class FineHead(nn.Module):
    """From patches back to pixels: the trunk's features beside features of the picture, at half and at full size.

    half_width: channels at half the size, where edges within a patch are worked out; 0 leaves that out. It begins as
    nothing added.
    """

    def __init__(
        self,
        in_channels: int,
        trunk_width: int,
        fine_width: int,
        out_channels: int,
        patch: int,
        *,
        half_width: int = 0,
        zero: bool = False,
    ) -> None:
        super().__init__()
        self.patch = patch
        self.fine = nn.Conv2d(in_channels, fine_width // 2, 3, padding=1)
        self.spread = nn.Conv2d(trunk_width, fine_width * patch**2, 1)
        self.half_size = _HalfSize(in_channels, trunk_width, half_width, fine_width, patch // 2) if half_width else None
        self.mix = nn.Conv2d(fine_width + fine_width // 2, fine_width, 3, padding=1)
        self.out = nn.Conv2d(fine_width, out_channels, 1)
        if zero:
            zeroed(self.out)

    def forward(self, pictures: Tensor, features: Tensor, pixels: Tensor | None = None) -> Tensor:
        """pictures: [N, C, H, W], features: [N, trunk_width, H / patch, W / patch] -> [N, out_channels, H, W].

        pixels: int64 [N, M], flat numbers of the only pixels that are computed: -> [N, out_channels, M, 1].
        """
        features = F.silu(features)
        spread = F.pixel_shuffle(self.spread(features), self.patch)
        if self.half_size is not None:
            spread = spread + self.half_size(pictures, features)
        x = self.mix(F.silu(torch.cat([spread, self.fine(pictures)], dim=1)))
        if pixels is not None:
            x = x.flatten(2).gather(2, pixels[:, None].expand(-1, x.shape[1], -1))[..., None]
        return in_planes(self.out, F.silu(x))


class _HalfSize(nn.Module):
    """A block at half the size between a head's patches and its pixels."""

    def __init__(self, in_channels: int, trunk_width: int, width: int, out_channels: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.spread = nn.Conv2d(trunk_width, width * patch**2, 1)
        self.picture = nn.Conv2d(in_channels * 4, width, 3, padding=1)
        self.block = Block(2 * width, width)
        self.out = zeroed(nn.Conv2d(width, out_channels * 4, 1))

    def forward(self, pictures: Tensor, features: Tensor) -> Tensor:
        """pictures: [N, C, H, W], features: [N, trunk_width, h, w] -> [N, out_channels, H, W]."""
        spread = F.pixel_shuffle(self.spread(features), self.patch)
        beside = convolved(self.picture.weight, self.picture.bias, pictures, 2)
        return F.pixel_shuffle(self.out(F.silu(self.block(torch.cat([spread, beside], dim=1), None))), 2)
