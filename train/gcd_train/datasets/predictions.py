"""What the trained U-Net makes of some clips, kept on disk for the decoder stage.

meta.json (written last), latents.npy float16 [M, T, C, h, w], decoded.npy float16 [M, T, 3, H, W] and, with a class
head, logits.npy float16 [M, T, K, h', w'].
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_train.errors import RunError


class PredictionsMeta(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is in a folder of predictions. identity: the weights they were made with. clips: numbers of the clips."""

    identity: str
    clips: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Predicted:
    """One clip, or some frames of several.

    latents: [N, C, h, w], scaled. decoded: [N, 3, H, W], about [-1, 1]. logits: [N, K, h', w'] or None.
    """

    latents: Tensor
    decoded: Tensor
    logits: Tensor | None

    @property
    def arrays(self) -> dict[str, Tensor]:
        """By the name of their file."""
        both = {"latents": self.latents, "decoded": self.decoded}
        return both if self.logits is None else {**both, "logits": self.logits}


class Predictions:
    """An opened folder of predictions; clip i of it is clip `meta.clips[i]` of the encoded ones."""

    def __init__(self, meta: PredictionsMeta, arrays: dict[str, Tensor]) -> None:
        self.meta, self._arrays = meta, arrays

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Map the arrays. Raises RunError if the folder is unfinished or damaged."""
        try:
            meta = msgspec.json.decode((folder / "meta.json").read_bytes(), type=PredictionsMeta)
            arrays = {path.stem: torch.from_numpy(np.load(path, mmap_mode="c")) for path in folder.glob("*.npy")}
        except (OSError, ValueError, msgspec.DecodeError) as error:
            raise RunError(f"{folder} holds no finished predictions ({error}); delete it to make them anew") from error
        if "latents" not in arrays or any(len(array) != len(meta.clips) for array in arrays.values()):
            raise RunError(f"{folder} holds other arrays than meta.json says; delete it to make them anew")
        return cls(meta, arrays)

    def rows(self, clips: Tensor, frames: Tensor, device: torch.device) -> Predicted:
        """The frames (clips[i], frames[i]); int64 [N] on the CPU."""
        rows = {name: array[clips, frames].to(device).float() for name, array in self._arrays.items()}
        return Predicted(rows["latents"], rows["decoded"], rows.get("logits"))


def write_predictions(folder: Path, meta: PredictionsMeta, predict: Callable[[int], Predicted]) -> None:
    """Write what `predict` says of each clip of `meta`. Raises RunError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        files: dict[str, np.memmap[tuple[int, ...], np.dtype[np.float16]]] = {}
        for place, number in enumerate(meta.clips):
            for name, rows in predict(number).arrays.items():
                if name not in files:
                    shape = (len(meta.clips), *rows.shape)
                    files[name] = np.lib.format.open_memmap(folder / f"{name}.npy", "w+", np.float16, shape)
                files[name][place] = rows.half().cpu().numpy()
        for file in files.values():
            file.flush()
        unfinished = folder / "meta.json.part"
        unfinished.write_bytes(msgspec.json.encode(meta))
        unfinished.replace(folder / "meta.json")
    except OSError as error:
        raise RunError(f"cannot write predictions in {folder}: {error.strerror}; free some space") from error
