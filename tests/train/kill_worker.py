"""A tiny training run that appends the loss of every update to a file, to be killed. `python kill_worker.py FOLDER`"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event

import msgspec
import torch
from two_processes import LOG, Task, options, recipe_of

from gcd_train.recipe_data import Budget
from gcd_train.training.distributed import ALONE
from gcd_train.training.loop import Loop, Progress, StepLoss
from gcd_train.training.monitor import RunFolder

UPDATES = 120


class Told(Task):
    """Writes down each loss, to the bit."""

    def __init__(self, path: Path) -> None:
        super().__init__(recipe_of())
        self._path = path

    def step_loss(self, progress: Progress) -> StepLoss:
        loss = super().step_loss(progress)
        with self._path.open("a") as file:
            file.write(json.dumps([progress.updates, progress.part, loss.total.item().hex()]) + "\n")
        return loss


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    log = msgspec.structs.replace(LOG, save_s=1e-9)  # after every update
    chosen = replace(options(ALONE, Event(), log), budget=Budget(updates=UPDATES))
    Loop(Told(folder / "losses.jsonl"), RunFolder(folder), chosen).run()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
