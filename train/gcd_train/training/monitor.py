"""The folder of a run (recipe, metrics, samples), TensorBoard, and the guard against losses that are no number."""

import json
import logging
import math
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from msgspec import Struct
from torch import Tensor

from gcd_model.errors import FileError
from gcd_model.small_files import decode_toml, read_small
from gcd_train.errors import RecipeError, RunError, TrainError
from gcd_train.files import only_writer, write_whole
from gcd_train.pictures import png
from gcd_train.recipe_data import AnyStageName
from gcd_train.recipe_files import to_toml

_log = logging.getLogger(__name__)
_NAMED = 6
_GAP = 4  # pixels between the pictures of a sheet


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

    def add(self, stage: str, kind: str, values: Mapping[str, float | int | str], picture: Path | None) -> None:
        """Figures of a stage; `kind` is "loss" or "measured". picture: a PNG that belongs to them."""
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


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of one run: `recipe.toml`, `commands.txt`, `metrics.jsonl`, `STAGE/states/`, `STAGE/samples/`, and
    the weights at the end.

    board: gets every figure, too.
    """

    path: Path
    board: TensorBoard | None = None

    @contextmanager
    def begun(self, recipe: Struct, command: str) -> Generator[None]:
        """The folder for this run alone, until the block is left.

        Keeps the recipe and one more command line, and logs what differs from the last recipe. Raises RunError.
        """
        for path in (self.path / name for name in (".lock", "recipe.toml", "commands.txt", "metrics.jsonl")):
            if path.is_symlink() or (path.exists() and not path.is_file()):  # somebody else's: it leads elsewhere
                raise RunError(f"{path} is no plain file; delete it, or choose another --out")
        for path in self.path.glob("*/samples"):
            if path.is_symlink():
                raise RunError(f"{path} is a link, and pictures go there; delete it, or choose another --out")
        with only_writer(self.path):
            self._keep(recipe, command)
            yield

    def _keep(self, recipe: Struct, command: str) -> None:
        path, now = self.path / "recipe.toml", to_toml(recipe)
        try:
            was = decode_toml(read_small(path)) if path.exists() else None
            path.write_text(now)
            with (self.path / "commands.txt").open("a") as file:
                file.write(f"# {time.strftime('%Y-%m-%dT%H:%M:%S%z')}\n{command}\n")
        except OSError as error:
            raise RunError(f"cannot write in {self.path}: {error.strerror}; choose another --out") from error
        except FileError as error:
            raise RunError(f"{path} {error}; delete it to go on without a word of what changed") from error
        if was is not None:
            for line in _changes(_flat(was), _flat(decode_toml(now.encode()))):
                _log.warning("another recipe than this run's last: %s", line)

    def stage(self, name: AnyStageName) -> Path:
        """The folder of a stage."""
        return self.path / name

    def sample(self, name: AnyStageName, updates: int) -> Path:
        """A sample picture after so many updates."""
        return self.stage(name) / "samples" / f"{updates:07d}.png"

    def record(
        self, stage: AnyStageName, kind: str, values: dict[str, float | int | str], picture: Path | None = None
    ) -> None:
        """Append one line to metrics.jsonl: stage, kind, time of day, then the values. Raises RunError.

        picture: a PNG that belongs to them, for the board.
        """
        line = json.dumps({"stage": stage, "kind": kind, "time": round(time.time(), 3), **values})
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with (self.path / "metrics.jsonl").open("a") as file:
                file.write(line + "\n")
        except OSError as error:
            raise RunError(f"cannot write in {self.path}: {error.strerror}; choose another --out") from error
        if self.board is not None:
            self.board.add(stage, kind, values, picture)


def _flat(table: Mapping[str, object], place: str = "") -> dict[str, object]:
    """Values by their dotted keys."""
    found: dict[str, object] = {}
    for key, value in table.items():
        told = f"{place}{key}"
        found |= _flat(cast(Mapping[str, object], value), f"{told}.") if isinstance(value, dict) else {told: value}
    return found


def _changes(was: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    keys = [key for key in dict.fromkeys([*was, *now]) if was.get(key) != now.get(key)]
    return [f"{key} was {was.get(key, 'not given')}, is {now.get(key, 'not given')}" for key in keys]


def write_sheet(path: Path, rows: Sequence[Sequence[Tensor]]) -> None:
    """Write pictures [3, H, W] in [-1, 1], all of one size, row by row as one PNG. Raises RunError."""
    height, width = rows[0][0].shape[-2:]
    sheet = np.full((len(rows) * (height + _GAP), max(map(len, rows)) * (width + _GAP), 3), 255, np.uint8)
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            top, left = y * (height + _GAP), x * (width + _GAP)
            pixels = (picture.detach().float().cpu().clamp(-1, 1) + 1) * 127.5
            sheet[top : top + height, left : left + width] = pixels.round().byte().permute(1, 2, 0).numpy()
    write_whole(path, png(sheet))


class FiniteGuard:
    """Remembers losses and gradient norms without looking at them, so that a GPU need not wait; `check` looks.

    stage: for the message. note: a JSON file that is written when something is wrong, with all clips' names.
    at_once: look at values on the CPU right away, before anything is done with them.
    """

    def __init__(self, stage: str, note: Path, *, at_once: bool = True) -> None:
        self._stage, self._note, self._at_once = stage, note, at_once
        self._seen: list[tuple[int, str, Tensor, tuple[str, ...]]] = []

    def saw(self, update: int, what: str, value: Tensor, ids: tuple[str, ...] = ()) -> None:
        """A value that must be finite. Raises TrainError as `check`."""
        self._seen.append((update, what, value.detach(), ids))
        if self._at_once and value.device.type == "cpu":
            self.check()

    def check(self) -> None:
        """Raises TrainError for the first value since the last check that is no number, or infinite."""
        seen, self._seen = self._seen, []
        for update, what, given, _ in seen:
            if not math.isfinite(value := float(given)):
                self._stop(
                    update, what, value, [name for number, _, _, ids in seen if number == update for name in ids]
                )

    def _stop(self, update: int, what: str, value: float, ids: list[str]) -> None:
        told = {"stage": self._stage, "update": update, "what": what, "value": str(value), "clips": ids}
        with suppress(RunError):  # a full disk must not hide what is wrong
            write_whole(self._note, json.dumps(told, indent=1).encode())
        named = ", ".join(ids[:_NAMED]) + (f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else "")
        raise TrainError(
            f"the {what} of {self._stage} is {value} at update {update}"
            f"{f', on clips {named}' if ids else ''} (see {self._note}); the state saved before is untouched: look at "
            "these clips, or lower the learning rate in the recipe, and run again"
        )
