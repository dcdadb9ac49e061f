"""Choosing, pixel by pixel, between warps of the source and what the VAE decoded. Ours, not the paper's.

A small decoder blurs; a warp by the right plane is as sharp as the source. The network looks at all of them at a
quarter of the picture's size and says how much each counts.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.config import PlaneMixConfig
from gcd_model.frugal import added, frugal, silu
from gcd_model.layers import Layers, zeroed

_COARSE = 4
_CACHED_FLOATS = 4 * 2**20
"""Warps of so many values, 16 MB, are mixed at once on a CPU: with what is made of them they stay in its cache."""
_INVALID_LOGIT = -12.0
_GENERATED_LOGIT = 1.0  # before training: prefer the generated layer over any single warp
_LEAST_GENERATED = 1e-4  # so that pixels without a valid warp have something to show


class MixBlock(nn.Module):
    """Norm, SiLU, convolution, twice, around a skip connection; dilated to see far at little cost."""

    def __init__(self, width: int, dilation: int, groups: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(groups, width), nn.GroupNorm(groups, width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, C, h, w] -> the same shape."""
        return added(self.conv2(silu(self.norm2(self.conv1(silu(self.norm1(x)))))), x)


class PlaneMix(nn.Module):
    """Warps and decoded picture in, one picture out; class logits are sharpened along.

    layers: L, number of warps. classes: K, 0 without class head.
    """

    def __init__(self, config: PlaneMixConfig, layers: int, latent_channels: int, classes: int) -> None:
        super().__init__()
        width = config.width
        seen = 4 * layers + 3 * _COARSE**2 + latent_channels + classes
        self.stem = nn.Conv2d(seen, width, 3, padding=1)
        self.blocks = Layers[MixBlock](MixBlock(width, dilation, config.norm_groups) for dilation in config.dilations)
        self.norm = nn.GroupNorm(config.norm_groups, width)
        self.rise = nn.Conv2d(width, 2 * width, 3, padding=1)  # width / 2 channels at half the picture's size
        self.choice = nn.Conv2d(width // 2, layers + 1, 3, padding=1)
        self.residual = zeroed(nn.Conv2d(width // 2, 3 * 4, 3, padding=1))
        self.class_residual = zeroed(nn.Conv2d(width // 2, classes, 3, padding=1)) if classes else None
        self._prefer_generated()

    def _prefer_generated(self) -> None:
        zeroed(self.choice)
        assert self.choice.bias is not None
        with torch.no_grad():
            self.choice.bias[-1] = _GENERATED_LOGIT

    def forward(
        self, decoded: Tensor, warped: Tensor, valid: Tensor, latents: Tensor, class_logits: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Mix frames; each row stands alone.

        Args:
            decoded: [N, 3, H, W] in [-1, 1]. warped: [N, L, 3, H, W], 0 where not valid. valid: bool [N, L, H, W].
            latents: [N, C, h, w], what was decoded, scaled. class_logits: [N, K, h', w'], None without class head.
        Returns:
            The picture [N, 3, H, W], about [-1, 1], and the sharpened class logits (same shape) or None.
        """
        given = (decoded, warped, valid, latents, class_logits)
        rows = max(1, _CACHED_FLOATS // warped.shape[1:].numel()) if frugal(decoded) else len(decoded)
        if rows >= len(decoded):
            return self._mixed(*given)
        parts = [
            self._mixed(*piece) for piece in zip(*(_pieces(each, rows, len(decoded)) for each in given), strict=True)
        ]
        sharpened = [logits for _, logits in parts if logits is not None]
        return torch.cat([picture for picture, _ in parts]), torch.cat(sharpened) if sharpened else None

    def _mixed(
        self, decoded: Tensor, warped: Tensor, valid: Tensor, latents: Tensor, class_logits: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        present = valid.to(decoded.dtype)
        fine = self._look(decoded, warped, present, latents, class_logits)  # [N, width/2, H/2, W/2]
        weights = self._weights(fine, present)  # [N, L+1, H, W]
        generated = decoded + F.pixel_shuffle(self.residual(fine), 2)
        return _blended(weights, warped, generated), self._sharpened(fine, class_logits)

    def _look(
        self, decoded: Tensor, warped: Tensor, present: Tensor, latents: Tensor, class_logits: Tensor | None
    ) -> Tensor:
        coarse = F.avg_pool2d(torch.cat([warped.flatten(1, 2), present], dim=1), _COARSE)
        size = coarse.shape[-2:]
        seen = [coarse, F.pixel_unshuffle(decoded, _COARSE), _resized(latents, size)]
        if class_logits is not None:
            seen.append(_resized(class_logits.softmax(dim=1), size))
        x = self.stem(torch.cat(seen, dim=1))
        for block in self.blocks:
            x = block(x)
        return silu(F.pixel_shuffle(self.rise(silu(self.norm(x))), 2))

    def _weights(self, fine: Tensor, present: Tensor) -> Tensor:
        """Shares of the warps and, last, of the generated layer; they sum to 1 and are 0 where a warp is not valid."""
        logits = self.choice(fine)
        whole = F.avg_pool2d(present, 2) > 1 - 1e-3  # [N, L, H/2, W/2]
        warps = torch.where(whole, logits[:, :-1], _INVALID_LOGIT)
        shares = torch.cat([warps, logits[:, -1:]], dim=1).softmax(dim=1)
        shares = F.interpolate(shares, scale_factor=2.0, mode="bilinear", align_corners=False)
        shares = torch.cat([shares[:, :-1] * present, shares[:, -1:] + _LEAST_GENERATED], dim=1)
        return shares / shares.sum(dim=1, keepdim=True)

    def _sharpened(self, fine: Tensor, class_logits: Tensor | None) -> Tensor | None:
        if class_logits is None or self.class_residual is None:
            return class_logits
        return class_logits + _resized(self.class_residual(fine), class_logits.shape[-2:])


def _pieces(rows: Tensor | None, size: int, count: int) -> Sequence[Tensor | None]:
    return [None] * -(-count // size) if rows is None else rows.split(size)


def _blended(weights: Tensor, warped: Tensor, generated: Tensor) -> Tensor:
    """The layers by their weights [N, L+1, H, W], layer by layer: their product, L pictures, is never held."""
    picture = weights[:, -1:] * generated
    for number in range(warped.shape[1]):
        picture = torch.addcmul(picture, weights[:, number : number + 1], warped[:, number])
    return picture


def _resized(x: Tensor, size: torch.Size) -> Tensor:
    """Averaged where the grid gets coarser by a whole factor, else interpolated."""
    factor = x.shape[-2] // size[0]
    if factor >= 1 and x.shape[-2:] == (size[0] * factor, size[1] * factor):
        return x if factor == 1 else F.avg_pool2d(x, factor)
    return F.interpolate(x, size=(size[0], size[1]), mode="bilinear", align_corners=False)
