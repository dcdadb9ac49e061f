"""Where a run keeps its things, and its metrics file."""

import json
import time
from dataclasses import dataclass
from pathlib import Path

from gcd_train.errors import RunError
from gcd_train.monitor.board import Board
from gcd_train.recipe import AnyStageName


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The folder of one run: `STAGE/state.pt`, `STAGE/samples/`, `metrics.jsonl`, and the weights at the end.

    board: gets every figure, too.
    """

    path: Path
    board: Board | None = None

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
