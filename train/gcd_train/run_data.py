"""What a run learns from and is measured on, and the folders that a user names for it."""

from dataclasses import dataclass
from pathlib import Path

from gcd_train.datasets.clip_source import ClipSource
from gcd_train.training.objective import BatchMaker


@dataclass(frozen=True, kw_only=True, slots=True)
class RunData:
    """clips: to learn from, for stages that take them one by one, all at the recipe's fps. valid: held out.

    batches: how the U-Net's batches are made where they come neither from encoded clips nor from `clips`.
    parts: the pairs that `clips` are videos of, encoded in their stead, each by itself; empty where `clips` are pairs.
    """

    clips: ClipSource
    valid: ClipSource
    batches: BatchMaker | None = None
    parts: tuple[ClipSource, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class DataPlaces:
    """The folders a user names. data: to learn from. valid: held out; None to hold out a part of `data`."""

    data: Path
    valid: Path | None = None
