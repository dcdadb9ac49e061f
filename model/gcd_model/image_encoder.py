"""The CLIP image tower: one token per frame that says what is in it."""

import torch
import torch.nn.functional as F
from kornia.enhance import normalize
from kornia.geometry.transform import resize
from torch import Tensor, nn

from gcd_model.config import ImageEncoderConfig

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


def clip_pixels(frames: Tensor, size: int) -> Tensor:
    """Frames as the image tower expects them: [N, 3, H, W] in [-1, 1] -> [N, 3, size, size], normalised.

    The picture is squeezed to a square, not cropped. Bicubic with corners aligned, after kornia's Gaussian
    antialiasing, before the range changes: torch's own antialiasing is another filter.
    Source: the conditioner of Stable Video Diffusion; mean and deviation of CLIP (Radford et al. 2021).
    """
    squeezed = resize(frames, (size, size), interpolation="bicubic", align_corners=True, antialias=True)
    return normalize((squeezed + 1) / 2, frames.new_tensor(CLIP_MEAN), frames.new_tensor(CLIP_STD))


class ImageTransformerLayer(nn.Module):
    """Pre-norm self-attention and feed-forward; query, key and value come from one matrix, as published."""

    def __init__(self, config: ImageEncoderConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm_attention = nn.LayerNorm(config.width)
        self.query_key_value = nn.Linear(config.width, 3 * config.width)
        self.out = nn.Linear(config.width, config.width)
        self.norm_feed = nn.LayerNorm(config.width)
        self.expand = nn.Linear(config.width, config.hidden_width)
        self.contract = nn.Linear(config.hidden_width, config.width)

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, L, C] -> the same shape."""
        joint = self.query_key_value(self.norm_attention(x)).unflatten(-1, (3, self.heads, -1))
        query, key, value = joint.permute(2, 0, 3, 1, 4)  # [N, heads, L, C/heads] each
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        x = x + self.out(mixed)
        return x + self.contract(F.gelu(self.expand(self.norm_feed(x))))


class ImageEncoder(nn.Module):
    """Vision transformer; gives the projected class token, not normalised to unit length.

    Source: Radford et al. 2021; ViT-H/14 of OpenCLIP in the published configuration.
    """

    def __init__(self, config: ImageEncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.patches = nn.Conv2d(3, config.width, config.patch, stride=config.patch, bias=False)
        self.class_token = nn.Parameter(torch.randn(config.width) * config.width**-0.5)
        self.positions = nn.Parameter(torch.randn(config.tokens, config.width) * config.width**-0.5)
        self.norm_in = nn.LayerNorm(config.width)
        self.layers = nn.Sequential(*(ImageTransformerLayer(config) for _ in range(config.layers)))
        self.norm_out = nn.LayerNorm(config.width)
        self.projection = nn.Parameter(torch.randn(config.width, config.output_width) * config.width**-0.5)

    def forward(self, pixels: Tensor) -> Tensor:
        """pixels: [N, 3, size, size] from `clip_pixels` -> [N, D]."""
        patches = self.patches(pixels).flatten(2).transpose(1, 2)  # [N, L-1, C]
        tokens = torch.cat([self.class_token.expand(patches.shape[0], 1, -1), patches], dim=1) + self.positions
        tokens = self.layers(self.norm_in(tokens))
        return self.norm_out(tokens[:, 0]) @ self.projection
