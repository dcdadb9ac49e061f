"""The published U-Net written down plainly: functions over a dict of published weight names, nothing shared or saved.

It exists for the tests alone, as the yardstick for both results and operations: cross-attention with query, key and
softmax, up-sampling before the convolution, frame positions and embeddings computed in every pass, blends written
out. It shares no code with `gcd_model`.
Source: Blattmann et al. 2023 (SVD); the camera vector as in Van Hoorick et al. 2024 (GCD), section 3.2.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count

import torch
import torch.nn.functional as F
from torch import Tensor

Weights = Mapping[str, Tensor]

_GROUPS = 32


@dataclass(frozen=True, slots=True)
class _Pass:
    """What every block of one pass needs besides the pixels."""

    weights: Weights
    embedding: Tensor  # [B*T, E]
    tokens: Tensor  # [B*T, 1, D]
    frames: int
    head_width: int

    def has(self, name: str) -> bool:
        return f"{name}.weight" in self.weights

    def linear(self, name: str, x: Tensor) -> Tensor:
        return F.linear(x, self.weights[f"{name}.weight"], self.weights.get(f"{name}.bias"))

    def conv(self, name: str, x: Tensor, stride: int = 1) -> Tensor:
        weight, bias = self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]
        padding = [size // 2 for size in weight.shape[2:]]
        return F.conv2d(x, weight, bias, stride, padding) if x.ndim == 4 else F.conv3d(x, weight, bias, stride, padding)

    def group_norm(self, name: str, x: Tensor, eps: float) -> Tensor:
        return F.group_norm(x, _GROUPS, self.weights[f"{name}.weight"], self.weights[f"{name}.bias"], eps)

    def layer_norm(self, name: str, x: Tensor) -> Tensor:
        return F.layer_norm(x, x.shape[-1:], self.weights[f"{name}.weight"], self.weights[f"{name}.bias"], 1e-5)

    def mlp(self, name: str, x: Tensor) -> Tensor:
        return self.linear(f"{name}.2", F.silu(self.linear(f"{name}.0", x)))

    def share_of_space(self, name: str) -> Tensor:
        return torch.sigmoid(self.weights[f"{name}.time_mixer.mix_factor"])


def plain_unet(
    weights: Weights, x: Tensor, *, noise_label: Tensor, vector: Tensor, tokens: Tensor, frames: int, head_width: int
) -> Tensor:
    """One evaluation of the network F, frames flattened into the batch with time fastest.

    Args:
        weights: published names without prefix, `input_blocks.1.0.in_layers.0.weight` and so on.
        x: [B*T, C, h, w], scaled noisy latents, then source latents.
        noise_label: [B*T], a quarter of the logarithm of sigma.
        vector: [B*T, V], micro-conditioning, then the camera vector if the weights have a place for one.
        tokens: [B*T, D], image tokens.
    Returns:
        [B*T, C', h, w].
    """
    embedding = _embedding(weights, noise_label, vector)
    now = _Pass(weights, embedding, tokens[:, None], frames, head_width)
    x = now.conv("input_blocks.0.0", x)
    skips = [x]
    for n in count(1):
        name = f"input_blocks.{n}"
        if now.has(f"{name}.0.op"):
            x = now.conv(f"{name}.0.op", x, stride=2)
        elif now.has(f"{name}.0.in_layers.0"):
            x = _stage(now, name, x)
        else:
            break
        skips.append(x)
    x = _res(now, "middle_block.0", x)
    x = _transformer(now, "middle_block.1", x)
    x = _res(now, "middle_block.2", x)
    for n in range(len(skips)):
        x = _stage(now, f"output_blocks.{n}", torch.cat([x, skips.pop()], dim=1))
    return now.conv("out.2", F.silu(now.group_norm("out.0", x, eps=1e-5)))


def _sinusoid(t: Tensor, width: int, like: Tensor) -> Tensor:
    half = width // 2
    frequencies = torch.exp(-math.log(10000) * torch.arange(half, dtype=torch.float32, device=t.device) / half)
    angles = t[:, None].float() * frequencies
    return torch.cat([torch.cos(angles), torch.sin(angles)], dim=1).to(like.dtype)


def _embedding(weights: Weights, noise_label: Tensor, vector: Tensor) -> Tensor:
    """[B*T, E]: noise level, micro-conditioning and camera, each through its own MLP."""
    now = _Pass(weights, vector, vector, 0, 0)
    like, label_width = weights["time_embed.0.weight"], weights["label_emb.0.0.weight"].shape[1]
    embedding = now.mlp("time_embed", _sinusoid(noise_label, like.shape[1], like))
    embedding = embedding + now.mlp("label_emb.0", vector[:, :label_width])
    if now.has("aux_label_emb.0"):
        embedding = embedding + now.mlp("aux_label_emb", vector[:, label_width:])
    return embedding


def _stage(now: _Pass, name: str, x: Tensor) -> Tensor:
    """A residual block, a transformer if there is one, an up-sampling if there is one."""
    x = _res(now, f"{name}.0", x)
    for position in (1, 2):
        part = f"{name}.{position}"
        if now.has(f"{part}.proj_in"):
            x = _transformer(now, part, x)
        elif now.has(f"{part}.conv"):
            x = now.conv(f"{part}.conv", F.interpolate(x, scale_factor=2.0, mode="nearest"))
    return x


def _res(now: _Pass, name: str, x: Tensor) -> Tensor:
    """A residual block over space, one over frames, and their blend. x: [B*T, C, h, w]."""
    shift = _projected(now, name, now.embedding)  # [B*T, C']
    space = _res_half(now, name, x, shift[:, :, None, None])
    video = space.unflatten(0, (-1, now.frames)).transpose(1, 2)  # [B, C', T, h, w]
    shift = _projected(now, f"{name}.time_stack", now.embedding).unflatten(0, (-1, now.frames))
    time = _res_half(now, f"{name}.time_stack", video, shift.transpose(1, 2)[..., None, None])
    share = now.share_of_space(name)
    return (share * video + (1 - share) * time).transpose(1, 2).flatten(0, 1)


def _projected(now: _Pass, name: str, embedding: Tensor) -> Tensor:
    return now.linear(f"{name}.emb_layers.1", F.silu(embedding))


def _res_half(now: _Pass, name: str, x: Tensor, shift: Tensor) -> Tensor:
    h = now.conv(f"{name}.in_layers.2", F.silu(now.group_norm(f"{name}.in_layers.0", x, eps=1e-5)))
    h = h + shift
    h = now.conv(f"{name}.out_layers.3", F.silu(now.group_norm(f"{name}.out_layers.0", h, eps=1e-5)))
    skip = now.conv(f"{name}.skip_connection", x) if now.has(f"{name}.skip_connection") else x
    return skip + h


def _transformer(now: _Pass, name: str, x: Tensor) -> Tensor:
    """Attention in space, then over frames, blended. x: [B*T, C, h, w]."""
    height, width = x.shape[2:]
    h = now.group_norm(f"{name}.norm", x, eps=1e-6).flatten(2).transpose(1, 2)  # [B*T, h*w, C]
    h = now.linear(f"{name}.proj_in", h)
    space = _spatial_block(now, f"{name}.transformer_blocks.0", h)
    positions = torch.arange(now.frames, device=x.device).repeat(x.shape[0] // now.frames)  # [B*T]
    embedded = now.mlp(f"{name}.time_pos_embed", _sinusoid(positions, x.shape[1], x))
    time = _temporal_block(now, f"{name}.time_stack.0", space + embedded[:, None])
    share = now.share_of_space(name)
    h = now.linear(f"{name}.proj_out", share * space + (1 - share) * time)
    return x + h.transpose(1, 2).unflatten(2, (height, width))


def _spatial_block(now: _Pass, name: str, x: Tensor) -> Tensor:
    """x: [B*T, h*w, C]."""
    normed = now.layer_norm(f"{name}.norm1", x)
    x = x + _attention(now, f"{name}.attn1", normed, normed)
    x = x + _attention(now, f"{name}.attn2", now.layer_norm(f"{name}.norm2", x), now.tokens)
    return x + _feed_forward(now, f"{name}.ff", now.layer_norm(f"{name}.norm3", x))


def _temporal_block(now: _Pass, name: str, x: Tensor) -> Tensor:
    """x: [B*T, h*w, C]; the context is the first frame's token, repeated for every pixel of the clip."""
    pixels = x.shape[1]
    tokens = now.tokens[:: now.frames].repeat_interleave(pixels, dim=0)  # [B*h*w, 1, D]
    x = x.unflatten(0, (-1, now.frames)).transpose(1, 2).flatten(0, 1)  # [B*h*w, T, C]
    x = x + _feed_forward(now, f"{name}.ff_in", now.layer_norm(f"{name}.norm_in", x))
    normed = now.layer_norm(f"{name}.norm1", x)
    x = x + _attention(now, f"{name}.attn1", normed, normed)
    x = x + _attention(now, f"{name}.attn2", now.layer_norm(f"{name}.norm2", x), tokens)
    x = x + _feed_forward(now, f"{name}.ff", now.layer_norm(f"{name}.norm3", x))
    return x.unflatten(0, (-1, pixels)).transpose(1, 2).flatten(0, 1)


def _attention(now: _Pass, name: str, x: Tensor, context: Tensor) -> Tensor:
    query, key, value = (
        now.linear(f"{name}.{part}", source).unflatten(-1, (-1, now.head_width)).transpose(1, 2)
        for part, source in (("to_q", x), ("to_k", context), ("to_v", context))
    )
    mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
    return now.linear(f"{name}.to_out.0", mixed)


def _feed_forward(now: _Pass, name: str, x: Tensor) -> Tensor:
    value, gate = now.linear(f"{name}.net.0.proj", x).chunk(2, dim=-1)
    return now.linear(f"{name}.net.2", value * F.gelu(gate))
