"""Compiling networks region by region: blocks of one shape share their code, and what was compiled is kept on disk."""

import copy
import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from gcd_model.image_encoder import ImageTransformerLayer
from gcd_model.layers import Downsample, ResBlock, Upsample
from gcd_model.temporal import VideoResBlock
from gcd_model.unet import Stage
from gcd_model.vae import PixelAttention

Model = TypeVar("Model", bound=nn.Module)

_REGIONS = (Stage, VideoResBlock, ResBlock, PixelAttention, ImageTransformerLayer, Downsample, Upsample)
_SHAPES = 256  # of one kind of region: the U-Net has about 20, with and without the unconditional branch


def twin(model: Model) -> Model:
    """The same network with the same weights in memory, to be compiled without touching the first.

    To move or to convert one of the two would do so to both.
    """
    memo: dict[int, object] = {id(each): each for each in chain(model.parameters(), model.buffers())}
    return copy.deepcopy(model, memo).eval()


def regions(model: nn.Module) -> Iterator[nn.Module]:
    """The parts that are compiled, outermost first found."""
    if isinstance(model, _REGIONS):
        yield model
        return
    for child in model.children():
        yield from regions(child)


def compile_regions(model: nn.Module, backend: str) -> int:
    """Compile every region, in place, when it is first called; how many there are. backend: of torch.compile."""
    _allow_shapes()
    found = list(regions(model))
    for region in found:
        region.compile(backend=backend, fullgraph=True, dynamic=False)
    return len(found)


def _allow_shapes() -> None:
    """All blocks of a kind share one piece of code, which torch compiles for eight shapes unless told otherwise."""
    from torch._dynamo import config  # takes seconds

    name = "recompile_limit" if hasattr(config, "recompile_limit") else "cache_size_limit"  # before torch 2.7
    setattr(config, name, max(_SHAPES, getattr(config, name)))


def channels_last(model: nn.Module) -> None:
    """Lay convolution weights out as tensor cores read them; what they make is then laid out so, too."""
    for module in model.modules():
        if isinstance(module, nn.Conv2d):
            module.weight = _laid_out(module.weight, torch.channels_last)
        elif isinstance(module, nn.Conv3d):
            module.weight = _laid_out(module.weight, torch.channels_last_3d)


def _laid_out(weight: Tensor, order: torch.memory_format) -> nn.Parameter:
    return nn.Parameter(weight.contiguous(memory_format=order), requires_grad=False)


def cache_folder() -> Path:
    """Where compiled code lies unless TORCHINDUCTOR_CACHE_DIR says otherwise; GCD_CACHE_DIR names another."""
    own = os.environ.get("GCD_CACHE_DIR")
    root = Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gcd-node"
    return root / "compiled" / torch.__version__


def keep_compiled(folder: Path) -> None:
    """Have all that is compiled in this process kept in a folder, so that the next one finds it.

    What TORCHINDUCTOR_CACHE_DIR and TRITON_CACHE_DIR say already stands.
    """
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))
    os.environ.setdefault("TRITON_CACHE_DIR", str(folder / "triton"))
