"""Random draws that follow from seed, stage and update alone, so that a resumed run draws what it would have drawn."""

import hashlib

import torch
from torch import Tensor


class Draws:
    """The randomness of one update.

    Whole numbers are drawn on the CPU, noise on the device that uses it; on the CPU both come from one generator.
    number: of the update, or of the batch where an update takes several; what comes in a fixed order goes by it.
    """

    def __init__(self, seed: int, stage: str, update: int, device: torch.device) -> None:
        digest = hashlib.sha256(f"{seed}/{stage}/{update}".encode()).digest()
        mixed = int.from_bytes(digest[:8], "little") >> 1
        self.number, self._device = update, device
        self._host = torch.Generator().manual_seed(mixed)
        on_host = device.type == "cpu"
        self._there = self._host if on_host else torch.Generator(device).manual_seed(mixed)

    def below(self, limit: int, count: int) -> Tensor:
        """`count` whole numbers 0 <= n < limit, int64 on the CPU."""
        return torch.randint(limit, (count,), generator=self._host)

    def order(self, count: int) -> list[int]:
        """The numbers 0 <= n < count in random order."""
        return torch.randperm(count, generator=self._host).tolist()

    def normal(self, *shape: int) -> Tensor:
        """Standard normal float32 on the device."""
        return torch.randn(shape, generator=self._there, device=self._device)

    def chance(self, probability: float, count: int) -> Tensor:
        """`count` flags on the device, each true with the given probability."""
        return torch.rand(count, generator=self._there, device=self._device) < probability
