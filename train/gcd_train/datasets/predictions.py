"""What the trained U-Net makes of some clips, kept on disk for the decoder stage.

meta.json (written last), latents.npy float16 [M, T, C, h, w], decoded.npy float16 [M, T, 3, H, W] and, with a class
head, logits.npy float16 [M, T, K, h', w'].
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_train.errors import Interrupted, RunError
from gcd_train.stop import StopSignal

_log = logging.getLogger(__name__)
_PROGRESS = "begun.json"
_SAVE_EVERY = 16  # clips
_LOG_S = 15.0
Kind = TypeVar("Kind", bound=msgspec.Struct)


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


def write_predictions(
    folder: Path, meta: PredictionsMeta, predict: Callable[[int], Predicted], stop: StopSignal
) -> None:
    """Write what `predict` says of each clip of `meta`; goes on where it stopped, does nothing if all is there.

    Raises:
        Interrupted: the stop signal was set; run again to go on.
        RunError: the folder holds predictions of something else, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "meta.json").exists():
            _require_same(folder, meta, _read(folder / "meta.json", PredictionsMeta))
            return
        _write_missing(folder, meta, predict, stop)
        (folder / _PROGRESS).unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise RunError(f"cannot write predictions in {folder} ({error}); free some space, or delete it") from error


class _Begun(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An unfinished folder. done: clips already in the arrays."""

    meta: PredictionsMeta
    done: int


def _write_missing(folder: Path, meta: PredictionsMeta, predict: Callable[[int], Predicted], stop: StopSignal) -> None:
    begun = folder / _PROGRESS
    done = 0
    if begun.exists():
        kept = _read(begun, _Begun)
        _require_same(folder, meta, kept.meta)
        done = kept.done
    files: dict[str, np.memmap[tuple[int, ...], np.dtype[np.float16]]] = {}
    logged = started = time.perf_counter()
    for place in range(done, len(meta.clips)):
        for name, rows in predict(meta.clips[place]).arrays.items():
            if name not in files:
                shape = (len(meta.clips), *rows.shape)
                mode = "r+" if done else "w+"
                files[name] = np.lib.format.open_memmap(folder / f"{name}.npy", mode, np.float16, shape)
            files[name][place] = rows.half().cpu().numpy()
        now, made = time.perf_counter(), place + 1 - done
        if now - logged > _LOG_S:
            logged, left_s = now, (len(meta.clips) - place - 1) * (now - started) / made
            _log.info("predicting  clip %d of %d  %.0f s left", place + 1, len(meta.clips), left_s)
        if stop.is_set() or made % _SAVE_EVERY == 0:
            for file in files.values():
                file.flush()
            _replace(begun, msgspec.json.encode(_Begun(meta=meta, done=place + 1)))
        if stop.is_set():
            raise Interrupted(f"stopped after predicting {place + 1} of {len(meta.clips)} clips; run again to go on")
    for file in files.values():
        file.flush()
    _replace(folder / "meta.json", msgspec.json.encode(meta))


def _require_same(folder: Path, meta: PredictionsMeta, found: PredictionsMeta) -> None:
    if found != meta:
        raise RunError(f"{folder} was made by another U-Net or of other clips; delete it and run again")


def _read(path: Path, kind: type[Kind]) -> Kind:
    return msgspec.json.decode(path.read_bytes(), type=kind)


def _replace(path: Path, content: bytes) -> None:
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_bytes(content)
    unfinished.replace(path)
