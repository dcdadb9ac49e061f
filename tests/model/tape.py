"""A stand-in for a CUDA graph on the CPU: what was done once is done again, on the very same memory."""

from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gcd_model.engines.cuda import Recorder, Replay

_ATEN = torch.ops.aten
_HOST = {_ATEN._local_scalar_dense, _ATEN.nonzero, _ATEN.equal, _ATEN.is_nonzero, _ATEN.lift_fresh, _ATEN.item}
"""What asks a tensor for its value or brings one from Python: on a GPU both wait for the device."""


class HostAskedError(AssertionError):
    """Recorded work looked into a tensor, or made one of Python numbers."""


class _Tape(TorchDispatchMode):
    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # torch would import its compiler, for seconds

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket in _HOST:
            raise HostAskedError(str(func))
        made = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, made))
        return made

    def play(self) -> None:
        """Every operation again, its results where they were the first time."""
        for func, args, kwargs, made in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(made), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class TapeRecorder(Recorder):
    """Python numbers are as they were when the work was recorded, as in a CUDA graph."""

    def __init__(self) -> None:
        self.recorded, self.played, self.forgotten = 0, 0, 0

    def record(self, work: Replay) -> Replay:
        self.recorded += 1
        work()
        with _Tape() as tape:
            work()

        def play() -> None:
            self.played += 1
            tape.play()

        return play

    def forget(self) -> None:
        self.forgotten += 1
