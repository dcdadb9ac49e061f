"""Where a run keeps its things, and its metrics file."""

import json
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from msgspec import Struct

from gcd_model.errors import FileError
from gcd_model.small_files import decode_toml, read_small
from gcd_train.errors import RunError
from gcd_train.monitor.board import Board
from gcd_train.recipe import AnyStageName, to_toml

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of one run: `recipe.toml`, `commands.txt`, `metrics.jsonl`, `STAGE/state.pt`, `STAGE/samples/`, and
    the weights at the end.

    board: gets every figure, too.
    """

    path: Path
    board: Board | None = None

    def begin(self, recipe: Struct, command: str) -> None:
        """Keep the recipe and one more command line, and log what differs from the last recipe. Raises RunError."""
        path, now = self.path / "recipe.toml", to_toml(recipe)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
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

    def state(self, name: AnyStageName) -> Path:
        """A training stage's state."""
        return self.stage(name) / "state.pt"

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
