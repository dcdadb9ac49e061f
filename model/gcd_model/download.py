"""Tensors on their way from a GPU to the host, beside whatever the GPU does next."""

import torch
from torch import Tensor


class Download:
    """A copy of a tensor on the host that may still be arriving.

    From a GPU it goes through pinned memory on a stream of its own; on a CPU it is the tensor itself.
    """

    def __init__(self, source: Tensor) -> None:
        """Begin, as soon as the device has made the tensor. It must not be written to any more."""
        self._held, self._arrived = source, None
        if source.is_cuda:
            self._held, self._arrived = _begun(source)

    def result(self) -> Tensor:
        """The copy, once it is there."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._held


def _begun(source: Tensor) -> tuple[Tensor, torch.cuda.Event]:
    side = torch.cuda.Stream(source.device)
    side.wait_stream(torch.cuda.current_stream(source.device))
    with torch.cuda.stream(side):
        held = torch.empty(source.shape, dtype=source.dtype, pin_memory=True)
        held.copy_(source, non_blocking=True)
        source.record_stream(side)  # or its memory could be given away before it is read
        arrived = torch.cuda.Event(blocking=True)
        arrived.record(side)
    return held, arrived
