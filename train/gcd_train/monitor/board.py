"""A run's figures and sample pictures for TensorBoard (extra `train`)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import cv2

from gcd_train.errors import RecipeError, RunError

Values = Mapping[str, float | int | str]


class Board(Protocol):
    """Where figures go besides metrics.jsonl."""

    def add(self, stage: str, kind: str, values: Values, picture: Path | None) -> None:
        """Figures of a stage; `kind` is "loss" or "measured". picture: a PNG that belongs to them."""
        ...


class TensorBoard:
    """Event files in a folder, tags STAGE/KIND/NAME, steps are updates; a resumed run goes on in a further file.

    Raises RecipeError if TensorBoard is not installed, RunError if the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise RecipeError(
                "log.tensorboard is on, but TensorBoard is not installed; `pip install 'gcd-node[train]'`, or turn "
                "it off"
            ) from error
        try:
            self._writer = SummaryWriter(str(folder), flush_secs=30)
        except OSError as error:
            raise RunError(f"cannot write in {folder}: {error.strerror}; choose another --out") from error

    def add(self, stage: str, kind: str, values: Values, picture: Path | None) -> None:
        """See Board."""
        step = int(values.get("updates", 0))
        for name, value in values.items():
            if isinstance(value, float | int) and name != "updates":
                self._writer.add_scalar(f"{stage}/{kind}/{name}", value, step)
        pixels = None if picture is None else cv2.imread(str(picture))
        if pixels is not None:
            self._writer.add_image(f"{stage}/samples", pixels[..., ::-1].copy(), step, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()
