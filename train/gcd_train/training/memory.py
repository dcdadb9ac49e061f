"""What one update of the full model needs in memory, counted without any weights or pictures.

The forward pass runs on fake tensors, which have sizes but no content; whatever the graph keeps for the way back is
alive afterwards and is counted. Weights, gradients and the optimiser's state follow from the number of parameters.
"""

import weakref
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from gcd_model import ModelConfig
from gcd_model.networks import empty_networks
from gcd_model.unet import Stage, VideoUNet

_FLOAT32_MORE = 2  # bytes more than in bfloat16
_PASSING = 4  # gradients of a block's largest tensor that are alive at once while it is gone back through
_CPU_ATTENTION = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu  # which torch's counter does not know


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """How weights are kept and updated.

    weights: bytes of each parameter of the U-Net. gradient, state: bytes of each trained one. adapter: parameters that
    are trained instead of the U-Net's, in float32, beside it. copies: autocast computes with bfloat16 copies of a
    block's float32 weights.
    """

    name: str
    weights: float
    gradient: float
    state: float
    adapter: int = 0
    copies: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Kept:
    """Bytes of one clip's update, all in bfloat16.

    everything: what the graph keeps. blocks: of it, if of the U-Net's blocks only the inputs are kept. working: the
    most that going back through one block takes beside. norms: what `working` grows by as norms compute and keep in
    float32, which autocast lets them do. weights: of the block that has most of them.
    flops: of forward, backward and, again, forward.
    """

    everything: int
    blocks: int
    working: int
    norms: int
    weights: int
    flops: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Account:
    """Gigabytes (1e9 bytes). encoders: frozen image tower and VAE encoders in bfloat16; 0 with a latent cache."""

    plan: Plan
    weights: float
    gradients: float
    state: float
    activations: float
    encoders: float

    @property
    def total(self) -> float:
        """All at once. Not in it: the driver's own, workspaces of libraries, fragments of the allocator."""
        return self.weights + self.gradients + self.state + self.activations + self.encoders


PLANS = (
    Plan(name="Adam, float32 weights", weights=4, gradient=4, state=8, copies=True),
    Plan(name="8-bit Adam, float32 weights", weights=4, gradient=4, state=2, copies=True),
    Plan(name="8-bit Adam, bfloat16 weights", weights=2, gradient=2, state=2),
)
"""Full fine-tunes."""


class LiveBytes(TorchDispatchMode):
    """Bytes of all storages made inside that are still alive."""

    def __init__(self) -> None:
        super().__init__()
        self.live = self.largest = 0
        self._known: dict[int, weakref.ref[Any]] = {}

    def leave_out(self, tensors: Iterable[Tensor]) -> None:
        """Do not count these, such as weights, when views of them are made."""
        for tensor in tensors:
            storage = tensor.untyped_storage()
            self._known[storage._cdata] = weakref.ref(storage)  # pyright: ignore[reportPrivateUsage]  as in _watch

    def __torch_dispatch__(
        self,
        func: Callable[..., object],
        types: object,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> object:
        made = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(made):
            if isinstance(leaf, Tensor):
                self._watch(leaf)
        return made

    def _watch(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        key = storage._cdata  # pyright: ignore[reportPrivateUsage]  the storage's address, as torch's own trackers use it
        size = storage.nbytes()
        if key in self._known:
            return
        self.live += size
        self.largest = max(self.largest, size)
        self._known[key] = weakref.ref(storage, lambda _: self._gone(key, size))

    def _gone(self, key: int, size: int) -> None:
        self.live -= size
        del self._known[key]


@dataclass(slots=True)
class _Block:
    before: int = 0
    input: int = 0
    kept: int = 0
    largest: int = 0
    norms: int = 0
    weights: int = 0


def kept_by_update(config: ModelConfig) -> Kept:
    """Count what one clip's forward pass keeps, in bfloat16, at the config's size."""
    height, width = config.height // config.vae.down_factor, config.width // config.vae.down_factor
    frames, unet_config = config.frames, config.unet
    with FakeTensorMode(), _half_weights():
        unet = VideoUNet(unet_config, frames).train()
        rows = torch.zeros(frames, unet_config.latent_channels, height, width)
        condition = torch.zeros(frames, unet_config.condition_channels, height, width)
        vector = torch.zeros(frames, unet_config.vector_width)
        camera = torch.zeros(frames, unet_config.camera_width) if unet_config.camera_width else None
        tokens = None if unet_config.context_width is None else torch.zeros(frames, unet_config.context_width)
        live, blocks = LiveBytes(), list[_Block]()
        live.leave_out(unet.parameters())
        flops = FlopCounterMode(display=False, custom_mapping={_CPU_ATTENTION: _attention_flops})
        with flops, live, _watched(unet, live, blocks):
            plan = unet.plan(torch.zeros(1, frames), vector, camera, tokens)
            made = unet(rows, condition, plan.step(0))
            held = live.live
        del made, plan
    inside = sum(block.kept for block in blocks)
    return Kept(
        everything=held,
        blocks=held - inside + sum(block.input for block in blocks),
        working=max(block.kept + _PASSING * block.largest for block in blocks),
        norms=max(block.norms for block in blocks),
        weights=max(block.weights for block in blocks),
        flops=4 * flops.get_total_flops(),
    )


def _attention_flops(
    query: tuple[int, ...], key: tuple[int, ...], value: tuple[int, ...], *_rest: object, **_named: object
) -> int:
    """Of shapes, as torch's counter calls it."""
    return sdpa_flop_count(query, key, value)


@contextmanager
def _half_weights() -> Generator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.bfloat16)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def _watched(unet: VideoUNet, live: LiveBytes, blocks: list[_Block]) -> Generator[None]:
    """Fill in `blocks` while the network runs, one for each of its stages."""
    open_blocks: list[_Block] = []

    def enter(module: nn.Module, inputs: tuple[Any, ...]) -> None:
        x: Tensor = inputs[0]
        weights = sum(weight.numel() * weight.element_size() for weight in module.parameters())
        open_blocks.append(_Block(before=live.live, input=x.numel() * x.element_size(), weights=weights))
        live.largest = 0

    def leave(_module: nn.Module, _inputs: tuple[Any, ...], _made: Tensor) -> None:
        block = open_blocks.pop()
        block.kept, block.largest = live.live - block.before, live.largest
        blocks.append(block)

    def normed(module: nn.Module, _inputs: tuple[Any, ...], made: Tensor) -> None:
        copied = 2 * _FLOAT32_MORE * made.numel()  # what came in, in float32
        kept = _FLOAT32_MORE * made.numel() if isinstance(module, nn.GroupNorm) else 0  # for the activation after it
        for block in open_blocks:
            block.norms += copied + kept

    stages = [part for part in unet.modules() if isinstance(part, Stage)]
    norms = [part for part in unet.modules() if isinstance(part, nn.GroupNorm | nn.LayerNorm)]
    handles = [part.register_forward_pre_hook(enter) for part in stages]
    handles += [part.register_forward_hook(leave) for part in stages]
    handles += [part.register_forward_hook(normed) for part in norms]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


@cache
def parameters_of(config: ModelConfig) -> tuple[int, int]:
    """Parameters that are trained (U-Net and camera embedder), and those of the frozen encoders."""
    networks = empty_networks(config)
    trained: list[nn.Module] = [networks.unet, *([] if networks.camera is None else [networks.camera])]
    frozen: list[nn.Module] = [networks.target_encoder, networks.condition_encoder]
    if networks.image_encoder is not None:
        frozen.append(networks.image_encoder)
    return _count(*trained), _count(*frozen)


def account(config: ModelConfig, plan: Plan, kept: Kept, *, cached: bool) -> Account:
    """The memory of one update of one clip, the blocks' inputs kept and their insides recomputed.

    cached: latents and tokens come from a cache, so that no encoder is in memory.
    """
    parameters, frozen = parameters_of(config)
    trained = plan.adapter or parameters
    return Account(
        plan=plan,
        weights=(plan.weights * parameters + 4 * plan.adapter) / 1e9,
        gradients=plan.gradient * trained / 1e9,
        state=plan.state * trained / 1e9,
        activations=(kept.blocks + kept.working + kept.norms + plan.copies * kept.weights) / 1e9,
        encoders=0.0 if cached else 2 * frozen / 1e9,
    )


def _count(*modules: nn.Module) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())
