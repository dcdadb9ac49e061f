"""How much memory a run takes."""

import resource
import sys

import torch

_KIB = 1 if sys.platform == "darwin" else 1024  # what getrusage counts in


def peak_memory_gb(device: torch.device) -> float:
    """Largest so far, 1e9 bytes: of the device's allocator on CUDA, else of the whole process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIB / 1e9
