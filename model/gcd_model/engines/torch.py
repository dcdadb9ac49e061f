"""What computes the networks of a checkpoint, behind one interface: plain torch here, faster ones beside it."""

from collections.abc import Callable
from functools import partial
from itertools import repeat
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.conditioning import Conditioning, clip_pixels
from gcd_model.diffusion import Backbone, GuidedDenoiser, RenderOptions, Schedule, sample
from gcd_model.geometry import Trajectory
from gcd_model.layers import Attention, FeedForward, ResBlock, Upsample
from gcd_model.networks import Networks
from gcd_model.unet import UNetPlan, VideoUNet

NetworkName = Literal["image_encoder", "condition_encoder", "decoder"]


class Engine(Backbone):
    """Computes networks as torch runs them; what they are given and what becomes of it is the synthesizer's.

    Tensors may come from any device and are float32 unless `like` says otherwise; results lie where `like` does.
    """

    def __init__(self, networks: Networks) -> None:
        self._networks = networks

    @property
    def like(self) -> Tensor:
        """A tensor of the device and precision that conditioning is wanted in."""
        return self._networks.unet.stem.weight

    def tokens(self, frames: Tensor) -> Tensor | None:
        """Image tokens of frames [N, 3, H, W] in [-1, 1]: [N, D]; None without an image tower."""
        tower = self._networks.config.image_encoder
        if tower is None:
            return None
        return self.compute("image_encoder", clip_pixels(frames.to(self.like.device), tower.image_size).to(self.like))

    def condition_mean(self, frames: Tensor) -> Tensor:
        """Unscaled latents of frames [N, 3, H, W] in [-1, 1]: [N, C, h, w]."""
        return self.compute("condition_encoder", frames.to(self.like))

    def camera(self, path: Trajectory) -> Tensor | None:
        """What the U-Net is told of a camera path, [T, W]; None for a model without camera control."""
        embedder = self._networks.camera
        return None if embedder is None else embedder(path)

    def sample(self, start: Tensor, given: Conditioning, schedule: Schedule, options: RenderOptions) -> Tensor:
        """From noise [K, T, C, h, w] to clean latents; reports to `options.progress`, stops for `options.cancel`.

        Raises Cancelled.
        """
        start = start.to(self.like.device)
        return sample(GuidedDenoiser(self, given, schedule, start), start, schedule.steps, options)

    def decode(self, latents: Tensor) -> Tensor:
        """Unscaled latents of one clip [T, C, h, w] -> pictures float32 [T, 3, H, W], about [-1, 1]."""
        return self.compute("decoder", latents.to(self._networks.decoder.stem.weight)).float()

    def compute(self, name: NetworkName, given: Tensor) -> Tensor:
        """A network but for the U-Net, on its device and in its precision: token, mean of latents, or pictures."""
        if name == "decoder":
            return self._networks.decoder(given, len(given))
        if name == "condition_encoder":
            return self._networks.condition_encoder(given).mean
        assert self._networks.image_encoder is not None, "only models with an image tower have tokens"
        return self._networks.image_encoder(given)

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        return self._networks.unet.plan(labels.to(self.like.device), given.vector, given.camera, given.tokens)

    def predict(self, rows: Tensor, condition: Tensor, embeddings: Tensor, crosses: Tensor | None) -> Tensor:
        return self._networks.unet(rows.to(self.like), condition, embeddings, crosses).float()


# --- a CPU: working sets that fit its caches and the memory it has at hand -------------------------------------------

# A buffer above 32 MB is fetched from the system afresh each time, page by page; writing it then costs more than what
# is computed for it. Smaller ones are used again. The networks know nothing of this: `arrange` wraps their parts. What
# they compute stays the same; on other devices, with gradient and in a compiler a wrapped part is as it was.

REUSED_FLOATS = 7 * 2**20
"""The largest buffer that is used again instead of being fetched anew, in float32 values."""


def arrange(model: nn.Module) -> None:
    """Wrap the parts of a model for a CPU, in place; a part that is wrapped already stays so."""
    computed: dict[type[nn.Module], Callable[..., Tensor]] = {
        ResBlock: _res_block,
        Attention: _attention,
        FeedForward: _feed_forward,
        Upsample: _upsample,
    }
    for module in model.modules():
        compute = computed.get(type(module))
        if compute is not None:
            _wrap(module, compute)
        if isinstance(module, ResBlock):
            _wrap(module, _residual, "residual")
        if isinstance(module, VideoUNet) and "forward" not in vars(module):
            _wrap(module, _clip_by_clip)
            for layer in (module.stem, *(level.down for level in module.down), *(level.up for level in module.up)):
                if layer is not None:
                    layer.register_forward_hook(_laid_out)


def _wrap(module: nn.Module, compute: Callable[..., Tensor], name: str = "forward") -> None:
    if name not in vars(module):
        setattr(module, name, partial(_chosen, compute, getattr(module, name), module))  # copies with its module


def _chosen(
    compute: Callable[..., Tensor],
    plain: Callable[..., Tensor],
    module: nn.Module,
    x: Tensor,
    *more: object,
    **named: bool,
) -> Tensor:
    return compute(module, x, *more, **named) if frugal(x) and not any(named.values()) else plain(x, *more, **named)


def frugal(x: Tensor) -> bool:
    """Whether to work in pieces: on a CPU, without gradient, and while nothing records a graph of the network."""
    return x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def _rows_at_once(floats_per_row: int) -> int:
    return max(1, REUSED_FLOATS // max(1, floats_per_row))


def _by_rows(compute: Callable[[Tensor], Tensor], x: Tensor, floats_per_row: int) -> Tensor:
    """compute(x), which gives every row of x for itself and in its shape, a few rows at a time."""
    at_once = _rows_at_once(floats_per_row)
    if at_once >= len(x):
        return compute(x)
    result = torch.empty_like(x)
    for few, into in zip(x.split(at_once), result.split(at_once), strict=True):
        into.copy_(compute(few))
    return result


def _residual(block: ResBlock, x: Tensor, embedding: Tensor | None = None) -> Tensor:
    h = block.conv1(F.silu(block.norm1(x), inplace=True))
    h = h if embedding is None else h.add_(embedding)
    return block.conv2(F.silu(block.norm2(h), inplace=True))


def _res_block(block: ResBlock, x: Tensor, embedding: Tensor | None = None) -> Tensor:
    def few(x: Tensor, embedding: Tensor | None) -> Tensor:
        skip = x if block.skip is None else block.skip(x)
        return block.residual(x, embedding).add_(skip)

    at_once = _rows_at_once(x.shape[1:].numel())
    if at_once >= len(x):
        return few(x, embedding)
    embeddings = repeat(None) if embedding is None else embedding.expand(len(x), -1, -1, -1).split(at_once)
    return torch.cat([few(*each) for each in zip(x.split(at_once), embeddings, strict=False)])


def _attention(attention: Attention, x: Tensor) -> Tensor:
    return _by_rows(partial(Attention.forward, attention), x, 3 * x.shape[1:].numel())


def _feed_forward(feed: FeedForward, x: Tensor) -> Tensor:
    def few(rows: Tensor) -> Tensor:
        if type(feed.expand) is not nn.Linear:  # an adapter computes more than its weight says
            return FeedForward.forward(feed, rows)
        halves = zip(feed.expand.weight.chunk(2), feed.expand.bias.chunk(2), strict=True)
        value, gate = (F.linear(rows, weight, bias) for weight, bias in halves)
        return feed.contract(F.gelu(gate).mul_(value))

    return _by_rows(few, x.reshape(-1, x.shape[-1]), feed.contract.in_features).view_as(x)


def _upsample(up: Upsample, x: Tensor) -> Tensor:
    """One phase at a time, written where it belongs."""
    whole: Tensor | None = None
    for (row, column), phase in up.phases(x):
        if whole is None:
            whole = phase.new_empty(*phase.shape[:2], 2 * phase.shape[2], 2 * phase.shape[3])
        whole[..., row::2, column::2] = phase
    assert whole is not None
    return whole


def _laid_out(_module: nn.Module, _given: object, x: Tensor) -> Tensor:
    """x: [N, C, H, W], in the order of memory in which a CPU convolves it fastest.

    Channels last is faster, and makes tokens of pixels without a copy, but re-orders the 9 C^2 weights in each
    call: it pays where there are many more pixels than channels.
    """
    if not frugal(x):
        return x
    last = x.numel() // x.shape[1] >= 4 * x.shape[1]
    return x.contiguous(memory_format=torch.channels_last if last else torch.contiguous_format)


def _clip_by_clip(
    unet: VideoUNet, latents: Tensor, condition: Tensor, embeddings: Tensor, crosses: Tensor | None = None
) -> Tensor:
    """Clips that are large together go through it one after the other: nothing of one is held for the next."""
    clips, widest = len(latents) // unet.frames, unet.stem.out_channels * latents.shape[-2:].numel()
    if clips == 1 or _rows_at_once(widest) >= len(latents):
        return VideoUNet.forward(unet, latents, condition, embeddings, crosses).contiguous()
    inputs = [[None] * clips if each is None else each.chunk(clips) for each in (embeddings, crosses)]
    parts = zip(latents.chunk(clips), condition.chunk(clips), *inputs, strict=True)
    return torch.cat([VideoUNet.forward(unet, *part).contiguous() for part in parts])
