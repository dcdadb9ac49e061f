"""Networks rewritten for a GPU: convolutions laid out anew, attention in one product, 8 bits, half precision."""

import copy
import math
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.diffusion import unit_noise
from gcd_model.layers import Attention, FeedForward
from gcd_model.networks import Networks
from gcd_model.vae import TemporalDecoder, to_pixels


def channels_last(model: nn.Module) -> None:
    """Lay convolution weights out as tensor cores read them; what they make is then laid out so, too."""
    orders = {4: torch.channels_last, 5: torch.channels_last_3d}
    for module in model.modules():
        if isinstance(module, nn.Conv2d | nn.Conv3d):
            weight = module.weight.contiguous(memory_format=orders[module.weight.ndim])
            module.weight = nn.Parameter(weight, requires_grad=False)


class Float8(NamedTuple):
    """A matrix [N, M] in 8 bits: values float8_e4m3fn [N, M], scales float32 [N, 1], one a row, so that its largest
    number is the largest there is."""

    values: Tensor
    scales: Tensor

    @classmethod
    def of(cls, matrix: Tensor) -> Self:
        """The nearest to it."""
        largest = torch.finfo(torch.float8_e4m3fn).max
        scales = matrix.abs().amax(-1, keepdim=True).float().clamp(min=1e-12) / largest
        return cls((matrix / scales).clamp(-largest, largest).to(torch.float8_e4m3fn), scales)


def linear(x: Tensor, weight: Tensor | Float8, bias: Tensor | None = None) -> Tensor:
    """As F.linear; by a weight in 8 bits, x [..., M] is rounded to 8 bits, too, row by row."""
    if isinstance(weight, Tensor):
        return F.linear(x, weight, bias)
    rows, matrix = Float8.of(x.flatten(0, -2)), weight.values.t()
    made = torch._scaled_mm(  # pyright: ignore[reportPrivateUsage, reportPrivateImportUsage]  there is no other door to it
        rows.values, matrix, scale_a=rows.scales, scale_b=weight.scales.t(), out_dtype=torch.bfloat16
    )
    made = made.to(x.dtype).unflatten(0, x.shape[:-1])
    return made if bias is None else made + bias


class Float8Linear(nn.Linear):
    """A linear layer by `float8`, its weight in 8 bits."""

    float8: Float8

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  torch's name
        """input: [..., M]."""
        return linear(input, self.float8, self.bias)


def multiply_in_float8(model: nn.Module) -> None:
    """Have attention and feed-forward multiply in 8 bits, in place; not what an adapter changes, nor sides that are no
    multiple of 16, which no GPU multiplies so."""
    for module in model.modules():
        layers = list(module.children()) if isinstance(module, Attention | FeedForward) else []
        if isinstance(module, JoinedAttention) and isinstance(module.joint, Tensor):
            layers = [module.out]  # query, key and value are parts of the joint product
            module.joint = module.joint if module.joint.shape[1] % 16 else Float8.of(module.joint)
        for layer in layers:
            if type(layer) is nn.Linear and not (layer.in_features % 16 or layer.out_features % 16):
                vars(layer)["float8"], layer.__class__ = Float8.of(layer.weight), Float8Linear


class JoinedAttention(Attention):
    """Attention whose query, key and value are one product. joint: their weights, of which theirs are now parts."""

    joint: Tensor | Float8

    def forward(self, x: Tensor) -> Tensor:
        """x: [N, L, C]."""
        query, key, value = map(self._split, linear(x, self.joint).chunk(3, dim=-1))
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.out(mixed.transpose(1, 2).flatten(2))


def join_attention(model: nn.Module) -> None:
    """Make every attention a JoinedAttention, in place and in no more memory; not one that an adapter changes."""
    for module in model.modules():
        layers = (module.query, module.key, module.value) if type(module) is Attention else ()
        if layers and all(type(layer) is nn.Linear for layer in layers):
            joint = torch.cat([layer.weight for layer in layers])
            for layer, part in zip(layers, joint.chunk(3), strict=True):
                layer.weight.data = part
            module.__class__ = JoinedAttention
            module.joint = joint


# --- whether the decoder may compute in half precision ---------------------------------------------------------------


WANTED_DB = 50.0
"""PSNR against float32 from which half precision is used: less than one level of 8 bits, on average."""

_COARSE = 16
_SEED = 11
_FRAMES = 4  # decoding all of a clip in float32 without graphs takes more memory than anything else does


@torch.inference_mode()
def checked_decoder(networks: Networks) -> tuple[TemporalDecoder, float]:
    """The decoder in float16, which has three bits more, or else in bfloat16, which no activation is too large for, if
    its pictures of a test clip are good enough for that; and their PSNR, infinite for float32."""
    config, full = networks.config, networks.decoder
    height, width = config.height, config.width  # a smooth random picture with a fine pattern, a pixel on each frame
    coarse = unit_noise((1, 3, max(2, height // _COARSE), max(2, width // _COARSE)), _SEED)
    picture = F.interpolate(coarse, size=(height, width), mode="bilinear")[0] + 0.2 * unit_noise(
        (3, height, width), _SEED, 1
    )
    frames = torch.stack([picture.roll(t, dims=-1) for t in range(min(config.frames, _FRAMES))]).clamp(-1, 1)
    encoder = networks.condition_encoder
    latents = torch.cat([encoder(each[None].to(encoder.stem.weight)).mean for each in frames]).float()
    truth = to_pixels(full(latents.to(full.stem.weight), len(latents)))
    for precision in (torch.float16, torch.bfloat16):
        half = copy.deepcopy(full).to(precision)
        if (psnr := psnr_db(to_pixels(half(latents.to(precision), len(latents))), truth)) > WANTED_DB:
            return half, psnr
    return full, math.inf


def psnr_db(ours: Tensor, truth: Tensor) -> float:
    """Peak signal to noise ratio of pictures in [0, 1]; infinite for equal ones, 0 if there is NaN or Inf."""
    error = F.mse_loss(ours.float(), truth.float()).item()
    if not math.isfinite(error):
        return 0.0
    return math.inf if error == 0 else -10 * math.log10(error)
