"""Which GPU each process of an evaluation works on, where there are several of both."""

import os
from collections.abc import Mapping

_VISIBLE = "CUDA_VISIBLE_DEVICES"


def gpu_seats(device: str, count: int) -> tuple[Mapping[str, str], ...]:
    """What the environment of worker k says: it sees GPU k alone, and whatever asks for CUDA finds that one.

    Workers beyond the last GPU begin again with the first; see `environments` of `map_items`.

    Args:
        device: as asked for; one that is named, as `cuda:1` or `cpu`, is everybody's. count: of GPUs of this process.
    Returns:
        One environment for each GPU; nothing where there is no choice.
    """
    if device not in ("auto", "cuda") or count < 2:
        return ()
    told = [name.strip() for name in os.environ.get(_VISIBLE, "").split(",") if name.strip()]
    names = told[:count] if len(told) >= count else [str(number) for number in range(count)]
    return tuple({_VISIBLE: name} for name in names)
