"""Two processes that train a tiny U-Net together, and what one process makes of the same; writes JSON for the tests.

One start of Python, then a fork: an import of torch is most of what this costs. `python two_processes.py FOLDER
[more]`; with `killed` one process, to be killed.
"""

import json
import os
import socket
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from threading import Event

import msgspec
import torch
from tiny_world import FRAMES, After, noise_batch, saved, tiny_recipe
from torch import Tensor

from gcd_model.networks import random_networks
from gcd_train.errors import Interrupted, TrainError
from gcd_train.recipe import Recipe
from gcd_train.recipe_data import Budget, ComputeRecipe, LogRecipe
from gcd_train.training.checkpoint import SavedWeights
from gcd_train.training.distributed import ALONE, Engine, Processes, processes_of, whole
from gcd_train.training.loop import Loop, LoopOptions, Progress, StepLoss
from gcd_train.training.monitor import RunFolder
from gcd_train.training.objective import Batch, UNetTask, diffusion_loss
from gcd_train.training.setup import Draws, Precision, model_config

CPU = torch.device("cpu")
PRECISION = Precision(CPU, half=False, channels_last=False)  # one layout, so that all use the same kernels
KILLED_UPDATES = 120
UPDATES = 3  # the first two on single frames, which leave out the layers across frames


class Noise:
    """Batches of nothing but noise. See BatchSource."""

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        rows, frames = (count, 1) if single else (count * FRAMES, FRAMES)
        return noise_batch(model_config(tiny_recipe().model), draws, rows, frames)


class Task(UNetTask):
    """The U-Net's own task, on noise, with nothing to measure on. dies_at: the update in which the process ends."""

    def __init__(self, recipe: Recipe, dies_at: int | None = None) -> None:
        networks = random_networks(model_config(recipe.model), seed=1)
        super().__init__(networks, Noise(), None, recipe.unet, None, PRECISION, recipe.seed)  # pyright: ignore
        self._dies_at, self.measured = dies_at, 0

    def step_loss(self, progress: Progress) -> StepLoss:
        if progress.updates == self._dies_at:
            os._exit(9)
        return super().step_loss(progress)

    def measure(self, picture: Path) -> dict[str, float]:
        self.measured += 1
        self.gather()
        return {"weight": 0.0}


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


def to_be_killed(folder: Path) -> None:
    """A run that appends the loss of every update to a file, and saves after each."""
    log = msgspec.structs.replace(LOG, save_s=1e-9)
    longer = msgspec.structs.replace(recipe_of().unet, budget=Budget(updates=KILLED_UPDATES))
    chosen = replace(options(ALONE, Event(), log), table=longer)
    Loop(Told(folder / "losses.jsonl"), RunFolder(folder), chosen).run()


class BothDraws:
    """The draws of two batches, one after the other: those of one batch twice as large."""

    def __init__(self, two: Sequence[Draws]) -> None:
        self._two = two

    def normal(self, rows: int, *shape: int) -> Tensor:
        return torch.cat([draws.normal(rows // 2, *shape) for draws in self._two])

    def chance(self, probability: float, count: int) -> Tensor:
        return torch.cat([draws.chance(probability, count // 2) for draws in self._two])


class TwiceTheBatch(Task):
    """One batch an update, of the rows that two batches would have."""

    def step_loss(self, progress: Progress) -> StepLoss:
        recipe = self._recipe
        draws = BothDraws([Draws(self._seed, "unet", 2 * progress.updates + part, CPU) for part in (0, 1)])
        single = progress.share < recipe.image_share
        count = 2 * (recipe.image_batch if single else recipe.clip_batch)
        batch = self._batches.batch(draws, count, single=single)  # pyright: ignore
        return diffusion_loss(
            self.network, batch, draws, PRECISION,  # pyright: ignore
            noise=recipe.noise, loss=recipe.loss, channel_weights=None, step=progress.updates,
        )  # fmt: skip


def recipe_of(batch: int = 2) -> Recipe:
    recipe = tiny_recipe()
    loss = msgspec.structs.replace(recipe.unet.loss, sensitivity=False)
    # half the published rate: where a gradient is next to nothing, Adam makes a whole step of its rounding
    optimiser = msgspec.structs.replace(recipe.unet.optimiser, kind="adam", rate=1e-5)
    budget = Budget(updates=UPDATES)
    return tiny_recipe(
        unet=msgspec.structs.replace(recipe.unet, batch=batch, loss=loss, budget=budget, optimiser=optimiser)
    )


def options(processes: Processes, stop: Event, log: LogRecipe, **compute: object) -> LoopOptions:
    return LoopOptions(
        stage="unet",
        identity="tiny",
        table=recipe_of().unet,
        log=log,
        stop=stop,
        frames_per_clip=FRAMES,
        parts=2,
        engine=Engine(processes=processes, compute=ComputeRecipe(device="cpu", **compute)),  # pyright: ignore
    )


LOG = LogRecipe(log_s=1000.0, save_s=1000.0, measure_s=1000.0)


def trained(path: Path, task: Task, chosen: LoopOptions, stop_at: int | None = None) -> dict[str, Tensor]:
    """The weights after a run; or after it was stopped."""
    loop = Loop(task, RunFolder(path), chosen if stop_at is None else replace(chosen, stop=After(stop_at + 1)))
    try:
        loop.run()
    except Interrupted:
        assert stop_at is not None
    return {name: whole(value).clone() for name, value in task.module.state_dict().items()}


def in_three(chosen: LoopOptions) -> LoopOptions:
    """Three batches an update, by a clock that says one second for each."""
    return replace(chosen, parts=3, clock=map(float, count()).__next__)


def frames_per_s(path: Path) -> float:
    return next(told["frames_per_s"] for told in map(json.loads, (path / "metrics.jsonl").open()) if "loss" in told)


def furthest(first: dict[str, Tensor], second: dict[str, Tensor]) -> float:
    assert first.keys() == second.keys()
    return max(float((first[name] - second[name]).abs().max()) for name in first)


def distance(first: dict[str, Tensor], second: dict[str, Tensor]) -> float:
    return sum(float((first[name] - second[name]).square().sum()) for name in first) ** 0.5


def alone(folder: Path) -> dict[str, dict[str, Tensor]]:
    """What one process makes of it, in an update of two batches, and in one of a batch twice as large."""
    recipe = recipe_of()
    once = replace(options(ALONE, Event(), LOG), parts=1)
    return {
        "two batches": trained(folder / "two", Task(recipe), options(ALONE, Event(), LOG)),
        "twice the batch": trained(folder / "twice", TwiceTheBatch(recipe), once),
        "three batches": trained(folder / "three", Task(recipe_of(3)), in_three(options(ALONE, Event(), LOG))),
        "start": Task(recipe).module.state_dict(),
    }


class Together:
    """Runs of two processes, compared with those of one."""

    def __init__(self, folder: Path, processes: Processes, single: dict[str, dict[str, Tensor]]) -> None:
        self.folder, self.processes, self.single = folder, processes, single

    def run(self, name: str, stop_at: int | None = None, log: LogRecipe = LOG, **compute: object) -> dict[str, Tensor]:
        """The weights that such a run ends with, in a folder of that name."""
        chosen = options(self.processes, Event(), log, **compute)
        return trained(self.folder / name, Task(recipe_of()), chosen, stop_at)

    def equal_one(self, *kinds: str) -> dict[str, object]:
        """How far the weights of two are from those of one."""
        found: dict[str, object] = {}
        for parallel in kinds:
            task = Task(recipe_of())
            weights = trained(self.folder / parallel, task, options(self.processes, Event(), LOG, parallel=parallel))
            rank = self.processes.rank
            mine = {"measured": (task.measured, 1), f"rank {rank}": (1.0, 1), "weighed": (float(rank), 1 + 2 * rank)}
            both = self.processes.averaged(mine)
            found |= {f"{parallel} {name}": value for name, value in both.items()}
            found[f"{parallel} against two batches"] = furthest(weights, self.single["two batches"])
            found[f"{parallel} against twice the batch"] = furthest(weights, self.single["twice the batch"])
            found[f"{parallel} moved"] = furthest(weights, self.single["start"])
            off = distance(weights, self.single["twice the batch"])
            found[f"{parallel} share of the way"] = off / distance(weights, self.single["start"])
        return found

    def uneven(self) -> dict[str, object]:
        """Three batches an update, of which one process computes two."""
        chosen = in_three(options(self.processes, Event(), LOG, parallel="ddp"))
        weights = trained(self.folder / "uneven", Task(recipe_of(3)), chosen)
        speeds = [frames_per_s(self.folder / name) for name in ("uneven", "alone/three")]
        return {"uneven": furthest(weights, self.single["three batches"]), "uneven speeds": speeds}

    def stopped_and_resumed(self, parallel: str) -> dict[str, object]:
        """Only the second process hears the signal; both stop, and go on to the bits of an undisturbed run."""
        weights, name = self.run(f"{parallel}-whole", parallel=parallel), f"{parallel}-stopped"
        self.run(name, 2 if self.processes.rank == 1 else 1000, parallel=parallel)
        found: dict[str, object] = {f"{parallel} stopped at": self.newest(name).note.updates}
        self.processes.told(None)
        found[f"{parallel} resumed"] = furthest(self.run(name, parallel=parallel), weights)
        found[f"{parallel} read by one"] = furthest(self.newest(name).module, weights)
        self.processes.told(None)
        return found

    def damaged(self) -> dict[str, object]:
        """States written beside training, every update; then the newest loses a bit of truth."""
        every = msgspec.structs.replace(LOG, save="async", keep=2, keep_every=1)
        weights = self.run("beside", log=every, parallel="fsdp")
        states = self.folder / "beside" / "unet" / "states"
        names = sorted(path.name for path in states.iterdir())
        self.processes.told(None)
        if self.processes.first:
            part = next((states / f"{UPDATES:07d}").glob("*.safetensors"))
            data = bytearray(part.read_bytes())
            data[len(data) // 2] ^= 1
            part.write_bytes(data)
        self.processes.told(None)
        again = self.run("beside", log=every, parallel="fsdp")
        put_aside = sorted(path.name for path in states.iterdir() if path.name.endswith(".damaged"))
        return {"beside": names, "repaired": furthest(again, weights), "put aside": put_aside}

    def handed_on(self) -> dict[str, object]:
        """What one process began, two go on with for an update, and then one again."""
        if self.processes.first:
            trained(self.folder / "handed", Task(recipe_of()), options(ALONE, Event(), LOG), 1)
        self.processes.told(None)
        self.run("handed", 1, parallel="fsdp")
        found: dict[str, object] = {
            "handed on after": sorted(path.name for path in (self.folder / "handed/unet/states").iterdir())
        }
        self.processes.told(None)
        if self.processes.first:
            back = trained(self.folder / "handed", Task(recipe_of()), options(ALONE, Event(), LOG))
            found["handed back"] = furthest(back, self.single["two batches"])
        self.processes.told(None)
        return found

    def recomputed(self) -> dict[str, object]:
        """With every second block computed twice."""
        weights = self.run("recomputed", parallel="fsdp", checkpoint_activations=2)
        return {"recomputed": furthest(weights, self.single["two batches"])}

    def lost(self) -> dict[str, object]:
        """What the first process says when the second one ends in the middle of its work. Must come last."""
        task = Task(recipe_of(), dies_at=1 if self.processes.rank == 1 else None)
        try:
            trained(self.folder / "lost", task, options(self.processes, Event(), LOG, parallel="ddp"))
        except TrainError as error:
            return {"lost": str(error)}
        return {"lost": "nothing happened"}

    def newest(self, name: str) -> SavedWeights:
        return saved(self.folder / name / "unet", "unet")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def main(folder: Path, what: Sequence[str]) -> None:
    torch.set_num_threads(1)
    if "killed" in what:
        to_be_killed(folder)
        return
    warnings.filterwarnings("ignore", message="FSDP2-wrapped module")
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "WORLD_SIZE": "2"}
    os.environ["RANK"] = os.environ["LOCAL_RANK"] = "1" if os.fork() == 0 else "0"
    with processes_of(ComputeRecipe(device="cpu", parallel="ddp", timeout_s=240.0)) as processes:
        single = processes.told(alone(folder / "alone") if processes.first else None)
        both = Together(folder, processes, single)
        found = both.equal_one("ddp") | both.uneven()
        if "more" in what:
            found |= both.equal_one("fsdp")
            for parallel in ("ddp", "fsdp"):
                found |= both.stopped_and_resumed(parallel)
            found |= both.damaged() | both.handed_on() | both.recomputed()
        found |= both.lost() | {"seconds": time.process_time()}
        (folder / "found.json").write_text(json.dumps(found))
        sys.stdout.flush()
        os._exit(0)  # the other one is gone: nobody to say good-bye to


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
