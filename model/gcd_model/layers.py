"""The parts every network here is built of: residual block, attention, feed-forward, up-sampling."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Generic, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Kept = TypeVar("Kept")
Layer = TypeVar("Layer", bound=nn.Module)


class Layers(nn.ModuleList, Generic[Layer]):
    """A ModuleList that knows what it holds."""

    def __iter__(self) -> Iterator[Layer]:
        return cast("Iterator[Layer]", super().__iter__())


class Derived(nn.Module, Generic[Kept]):
    """A module that needs something computed from its own parameters.

    `derived()` gives it: recomputed with gradient as long as the parameters may change, kept after `prepare()`.
    What is kept is dropped whenever weights, device, dtype or mode change.
    """

    _kept: Kept | None = None

    def derive(self) -> Kept:
        """The value, as a pure function of the parameters."""
        raise NotImplementedError

    def derived(self) -> Kept:
        """The value, kept or computed."""
        return self.derive() if self._kept is None else self._kept

    def keep(self) -> None:
        """Compute the value once."""
        with torch.no_grad():
            self._kept = self.derive()

    def train(self, mode: bool = True) -> "Derived[Kept]":
        """As in torch; forgets what was kept."""
        self._kept = None
        return super().train(mode)

    # torch's hooks behind .to(), .half() and load_state_dict() are untyped
    def _apply(self, *args, **kwargs):  # pyright: ignore
        self._kept = None
        return super()._apply(*args, **kwargs)  # pyright: ignore

    def _load_from_state_dict(self, *args, **kwargs) -> None:  # pyright: ignore
        self._kept = None
        super()._load_from_state_dict(*args, **kwargs)  # pyright: ignore


def prepare(model: nn.Module) -> None:
    """Put a model in eval mode and compute once all that its weights determine."""
    model.eval()
    for module in model.modules():
        if isinstance(module, Derived):
            module.keep()


class Dormant(nn.Module):
    """Published weights that cannot influence the output: kept for round trips, never moved off the host.

    With one context token the softmax of cross-attention is 1, so queries, keys and the norm before them drop out.
    """

    def __init__(self, channels: int, context_width: int) -> None:
        super().__init__()
        self.query = nn.Parameter(torch.empty(channels, channels), requires_grad=False)
        self.key = nn.Parameter(torch.empty(channels, context_width), requires_grad=False)
        self.norm_weight = nn.Parameter(torch.ones(channels), requires_grad=False)
        self.norm_bias = nn.Parameter(torch.zeros(channels), requires_grad=False)
        nn.init.xavier_uniform_(self.query)
        nn.init.xavier_uniform_(self.key)

    def _apply(self, *_args, **_kwargs):  # pyright: ignore  the untyped hook behind .to()
        return self


def sinusoid(positions: Tensor, width: int) -> Tensor:
    """Cosines, then sines, at width/2 frequencies 10000^(-i / (width/2)): [...] -> [..., width], float32.

    Source: Vaswani et al. 2017, section 3.5, in the order of Stable Video Diffusion.
    """
    half = width // 2
    steps = torch.arange(half, dtype=torch.float32, device=positions.device)
    angles = positions.float()[..., None] * torch.exp(-math.log(10000.0) / half * steps)
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def embedding_mlp(in_width: int, hidden: int, out_width: int) -> nn.Sequential:
    """Linear, SiLU, Linear."""
    return nn.Sequential(nn.Linear(in_width, hidden), nn.SiLU(), nn.Linear(hidden, out_width))


def zeroed(module: nn.Module) -> nn.Module:
    """The module with all parameters zero: a fresh block starts as the identity."""
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    return module


class ResBlock(nn.Module):
    """Norm, SiLU, convolution, twice, around a skip connection; over space or, with `temporal`, over frames.

    The embedding is added between the convolutions. It comes already projected (see `project`), because it does
    not depend on the pixels.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        groups: int,
        eps: float,
        embedding_width: int | None = None,
        temporal: bool = False,
    ) -> None:
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, in_channels, eps)
        conv = FrameConv if temporal else partial(nn.Conv2d, kernel_size=3, padding=1)
        self.conv1 = conv(in_channels, out_channels)
        self.embed = None if embedding_width is None else nn.Linear(embedding_width, out_channels)
        self.norm2 = nn.GroupNorm(groups, out_channels, eps)
        self.conv2 = conv(out_channels, out_channels)
        self.skip = None if in_channels == out_channels else nn.Conv2d(in_channels, out_channels, 1)

    def project(self, embedding: Tensor) -> Tensor:
        """[..., E] -> [..., C]: what `forward` adds."""
        assert self.embed is not None, "this block was built without embedding"
        return self.embed(F.silu(embedding))

    def residual(self, x: Tensor, embedding: Tensor | None) -> Tensor:
        """The branch beside the skip connection. embedding broadcasts over x after the first convolution."""
        h = self.conv1(F.silu(self.norm1(x)))
        if embedding is not None:
            h = h + embedding
        return self.conv2(F.silu(self.norm2(h)))

    def forward(self, x: Tensor, embedding: Tensor | None = None) -> Tensor:
        """x: [N, C, H, W] -> [N, C', H, W]. embedding: [N, C', 1, 1]."""
        skip = x if self.skip is None else self.skip(x)
        return self.residual(x, embedding) + skip


class FrameConv(nn.Conv3d):
    """A convolution over three frames at each pixel, computed as a 2D one over frames and flattened pixels.

    The same weights and the same function; on the CPU the 3D kernels of torch take three times as long.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, (3, 1, 1), padding=(1, 0, 0))

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  the name in torch
        """[B, C, T, H, W] -> [B, C', T, H, W]."""
        rows = F.conv2d(input.flatten(3), self.weight.squeeze(-1), self.bias, padding=(1, 0))
        return rows.unflatten(3, input.shape[-2:])


class Attention(nn.Module):
    """Multi-head self-attention, [N, L, C] -> the same shape."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(channels, channels, bias=False)
        self.key = nn.Linear(channels, channels, bias=False)
        self.value = nn.Linear(channels, channels, bias=False)
        self.out = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, L, C]."""
        query, key, value = (self._split(layer(x)) for layer in (self.query, self.key, self.value))
        mixed = F.scaled_dot_product_attention(query, key, value)  # [N, heads, L, C/heads]
        return self.out(mixed.transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class TokenAttention(nn.Module):
    """Cross-attention to a single token: a linear map of that token, the same for every position."""

    def __init__(self, channels: int, context_width: int) -> None:
        super().__init__()
        self.value = nn.Linear(context_width, channels, bias=False)
        self.out = nn.Linear(channels, channels)
        self.dormant = Dormant(channels, context_width)

    def forward(self, token: Tensor) -> Tensor:
        """token: [N, D] -> [N, C], what cross-attention adds to every position."""
        return self.out(self.value(token))


class FeedForward(nn.Module):
    """Gated linear unit with exact GELU, [..., C] -> the same shape. Source: Shazeer 2020."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.expand = nn.Linear(channels, 8 * channels)
        self.contract = nn.Linear(4 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: [..., C]."""
        value, gate = self.expand(x).chunk(2, dim=-1)
        return self.contract(value * F.gelu(gate))


class Downsample(nn.Module):
    """Halves height and width with a strided convolution.

    pad: "both" pads every side by one (U-Net), "end" only right and bottom (VAE).
    """

    def __init__(self, channels: int, *, pad: str) -> None:
        super().__init__()
        self.pad_end = pad == "end"
        self.conv = nn.Conv2d(channels, channels, 3, stride=2, padding=0 if self.pad_end else 1)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, H, W] -> [N, C, H/2, W/2]."""
        return self.conv(F.pad(x, (0, 1, 0, 1)) if self.pad_end else x)


class Upsample(Derived[Tensor]):
    """Nearest 2x up-sampling and a 3x3 convolution, as four 2x2 convolutions of the small map.

    An output pixel at even/odd position sees only two distinct rows and columns of the input, so taps that meet
    the same input pixel add up: 4 instead of 9 products, the same function.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def derive(self) -> Tensor:
        """Kernels by output phase: [2, 2, C, C, 2, 2].

        Phase 0 sees input rows (i-1, i) through taps (0, 1+2), phase 1 rows (i, i+1) through taps (0+1, 2).
        """
        weight = self.conv.weight
        precise = weight.to(torch.promote_types(weight.dtype, torch.float32))  # taps are added before they are rounded
        fold = precise.new_tensor([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]])  # [phase, row, tap]
        return torch.einsum("ayk,bxl,oikl->aboiyx", fold, fold, precise).contiguous().to(weight.dtype)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, H, W] -> [N, C, 2H, 2W]."""
        return F.pixel_shuffle(torch.stack([phase for _, phase in self.phases(x)], dim=2).flatten(1, 2), 2)

    def phases(self, x: Tensor) -> Iterator[tuple[tuple[int, int], Tensor]]:
        """Even and odd rows and columns of the result, [N, C, H, W] each, and which they are."""
        height, width = x.shape[-2:]
        kernels, padded = self.derived(), F.pad(x, (1, 1, 1, 1))
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            window = padded[..., a : a + height + 1, b : b + width + 1]
            yield (a, b), F.conv2d(window, kernels[a, b], self.conv.bias)


# --- space and time: frames are flattened into the batch, time fastest: row b*T + t is frame t of clip b --------------


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

    def project(self, embedding: Tensor) -> Tensor:
        """[..., E] -> [..., 2C']: what `forward` adds over space and over frames."""
        return torch.cat([self.spatial.project(embedding), self.temporal.project(embedding)], dim=-1)

    def forward(self, x: Tensor, frames: int | None, embedding: Tensor | None = None) -> Tensor:
        """x: [B*T, C, H, W] -> [B*T, C', H, W]. embedding: [B*T, 2C'], already projected.

        frames: T; None for unrelated frames, which stay apart.
        """
        within, between = (None, None) if embedding is None else embedding[..., None, None].chunk(2, dim=1)
        x = self.spatial(x, within)
        if frames is None:
            return x
        if between is not None:
            between = between.unflatten(0, (-1, frames)).transpose(1, 2)
        video = x.unflatten(0, (-1, frames))  # [B, T, C', H, W]
        change = self.temporal.residual(video.transpose(1, 2), between)
        return self.share.add(video, change.transpose(1, 2)).flatten(0, 1)
