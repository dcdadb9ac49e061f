"""Lets a rendering be abandoned in mid-step: a sampler asks between two steps alone, and one may take seconds."""

import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from torch import nn
from torch.nn.modules.module import register_module_forward_pre_hook

from gcd_model import Cancelled


@contextmanager
def interruptible(cancel: threading.Event) -> Generator[None]:
    """Within the block, once `cancel` is set, the next layer of any network that this thread calls raises Cancelled:
    in an encoder, a denoising step or a decoder alike. Changes no result; costs a microsecond a layer."""
    thread = threading.get_ident()

    def look(module: nn.Module, _: Any) -> None:
        if cancel.is_set() and threading.get_ident() == thread:
            raise Cancelled(f"told to stop, before a layer ({type(module).__name__})")

    hook = register_module_forward_pre_hook(look)
    try:
        yield
    finally:
        hook.remove()
