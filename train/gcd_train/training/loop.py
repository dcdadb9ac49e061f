"""The training loop of every stage: updates, moving average, log, state, measurements; resumable to the update."""

import logging
import resource
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from threading import Event

import torch
from torch import Tensor, nn

from gcd_train.errors import Interrupted
from gcd_train.recipe import StageRecipe
from gcd_train.recipe_data import AnyStageName, LogRecipe
from gcd_train.training.checkpoint import States, Trained
from gcd_train.training.distributed import Engine, held_back, whole
from gcd_train.training.monitor import FiniteGuard, RunFolder
from gcd_train.training.optimiser import Ema, ParameterGroup, build_optimiser, set_rate

_log = logging.getLogger(__name__)
_TOLD_APART = ("frames_per_s", "peak_memory_gb")


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a stage is before an update. share: of the budget, 0 to 1. part: of an update made of several batches."""

    updates: int
    share: float
    part: int = 0


@dataclass(frozen=True, slots=True)
class StepLoss:
    """The loss of one update, its named parts for the log, and how many frames of which clips it was computed from."""

    total: Tensor
    parts: dict[str, Tensor]
    frames: int
    ids: tuple[str, ...] = ()


class Task:
    """What a stage trains. module: all that is saved. network: the module as the engine wraps it, to compute losses."""

    def __init__(self, module: nn.Module) -> None:
        self.module, self.network = module, module

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """All that is trained."""
        return [ParameterGroup(parameters=[each for each in self.module.parameters() if each.requires_grad])]

    def step_loss(self, progress: Progress) -> StepLoss:
        """The loss of the next update; a function of the weights and of the progress."""
        raise NotImplementedError

    def after_update(self, progress: Progress) -> bool:
        """Called with the progress after each update; True if it rewrote weights, so that averages start anew."""
        return False

    def measure(self, picture: Path) -> dict[str, float]:
        """Metrics with the weights as they are; writes a sample picture there. Called in the first process alone."""
        raise NotImplementedError

    def gather(self) -> None:
        """Take part where the first process gathers weights of which each has a share, to measure them."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LoopOptions:
    """How a stage runs. identity: see StateNote. frames_per_clip: for the log. parts: batches
    whose gradients make one update, shared by the engine's processes. clock: seconds, for tests."""

    stage: AnyStageName
    identity: str
    table: StageRecipe
    log: LogRecipe
    stop: Event
    frames_per_clip: int
    parts: int = 1
    engine: Engine = field(default_factory=Engine)
    clock: Callable[[], float] = time.perf_counter


@dataclass(slots=True)
class _Window:
    """What was seen since the last line of the log."""

    losses: list[StepLoss] = field(default_factory=list[StepLoss])
    norms: list[Tensor] = field(default_factory=list[Tensor])
    seconds: float = 0.0

    def values(self) -> dict[str, tuple[float, int]]:
        """Means and of how many values: of the gradient's norm, frames per second, the loss and its parts."""
        frames = sum(loss.frames for loss in self.losses) / max(self.seconds, 1e-9)
        parts: dict[str, list[Tensor]] = {"loss": [loss.total for loss in self.losses]} if self.losses else {}
        for loss in self.losses:
            for name, value in loss.parts.items():
                parts.setdefault(name, []).append(value)
        means = {name: (_mean(values), len(values)) for name, values in parts.items()}
        return means | {"gradient_norm": (_mean(self.norms), 1), "frames_per_s": (frames, 1)}


def _mean(values: list[Tensor]) -> float:
    return float(torch.stack(values).float().mean())


class Loop:
    """One stage, from its saved state to the end of its budget."""

    def __init__(self, task: Task, folder: RunFolder, options: LoopOptions) -> None:
        self._task, self._folder, self._options = task, folder, options
        self._updates, self._seconds = 0, 0.0
        engine, stage = options.engine, options.stage
        self._processes, self._mine = engine.processes, engine.processes.batches(options.parts)
        task.network = engine.prepare(task.module)
        self._optimiser = build_optimiser(task.parameter_groups(), options.table.optimiser, engine.compute.weights)
        self._ema = None if options.table.ema is None else Ema(task.module, options.table.ema)
        trained = Trained(task.module, self._optimiser, self._ema)
        self._states = States(folder.stage(stage), trained, stage, options.identity, options.log, engine.processes)
        self._window = _Window()
        self._guard = FiniteGuard(options.stage, folder.stage(options.stage) / "not_finite.json")
        note = self._states.restore()
        if note is not None:
            self._updates, self._seconds = note.updates, note.seconds

    @property
    def progress(self) -> Progress:
        """Updates done, and share of the budget."""
        return Progress(self._updates, self._options.table.budget.share(self._updates, self._seconds))

    def run(self) -> None:
        """Train to the end of the budget.

        Raises:
            Interrupted: the stop signal was set; the state is saved. TrainError: the loss is no number any more.
        """
        options = self._options
        saved = measured = logged = self._agreed()[0]
        if self.progress.share >= 1:
            if not self._processes.told(self._folder.sample(options.stage, self._updates).exists()):
                self._measure()  # killed at the very end
            return
        while self.progress.share < 1:
            with self._processes.others_gone():
                self._update()
            now, stop = self._agreed()
            if now - logged >= options.log.log_s:
                self._speak()
                logged = now
            if stop:
                self._save()
                self._states.finish()
                raise Interrupted(f"stopped at update {self._updates} of {options.stage}; run again to go on")
            if self._due(options.log.measure_every, now - measured >= options.log.measure_s):
                self._measure()
                measured = saved = self._agreed()[0]
            elif now - saved >= options.log.save_s or self._due(options.log.keep_every, False):
                self._save()
                saved = self._agreed()[0]
        self._measure()
        self._states.finish()

    def adopt_average(self) -> None:
        """Give the module the averaged weights for good; it is not trained any more after this."""
        if self._ema is not None:
            self._task.module.load_state_dict(self._ema.state_dict(), strict=False)

    def _agreed(self) -> tuple[float, bool]:
        """The time, and whether to stop: the same in every process, and so is the time spent on training."""
        options = self._options
        now, self._seconds, stop = self._processes.agreed(options.clock(), self._seconds, options.stop.is_set())
        return now, stop

    def _due(self, every: int | None, otherwise: bool) -> bool:
        """Whether something that is done after every so many updates is; without their number, `otherwise`."""
        return otherwise if every is None else self._updates % every == 0

    def _update(self) -> None:
        started, recipe = self._options.clock(), self._options.table.optimiser
        progress = self.progress
        set_rate(self._optimiser, progress.updates, progress.share, recipe)
        self._optimiser.zero_grad(set_to_none=True)
        processes, parts = self._processes, self._options.parts
        for turn, (part, share) in enumerate(self._mine, 1):
            with held_back(self._task.network, last=turn == len(self._mine)):
                loss = self._task.step_loss(replace(progress, part=part))
                # the gradient is the mean over the parts, and that of the processes is averaged
                (loss.total * (share * (processes.count / parts))).backward()
            kept = {name: value.detach() for name, value in loss.parts.items()}
            self._guard.saw(progress.updates, "loss", loss.total, loss.ids)
            if share:  # and not one that only keeps the others company
                self._window.losses.append(StepLoss(loss.total.detach(), kept, loss.frames, loss.ids))
        norm = self._clipped()
        self._window.norms.append(norm)
        self._guard.saw(progress.updates, "gradient", norm)
        if self._options.engine.compute.weights == "bfloat16":
            # stochastic rounding follows from the number of the update: the same in every copy, and when resumed
            torch.manual_seed(progress.updates)
        self._optimiser.step()
        self._updates += 1
        if self._ema is not None:
            self._ema.update(self._updates)
        spent = self._options.clock() - started
        self._seconds += spent
        self._window.seconds += spent
        if self._task.after_update(self.progress) and self._ema is not None:
            self._ema.restart()

    def _clipped(self) -> Tensor:
        """The norm of the whole gradient, which is then no longer than the recipe allows."""
        trained = [p for group in self._optimiser.param_groups for p in group["params"]]
        limit = self._options.table.optimiser.clip
        if limit is not None:
            return whole(nn.utils.clip_grad_norm_(trained, limit))
        return whole(nn.utils.get_total_norm([p.grad for p in trained if p.grad is not None]))

    def _speak(self) -> None:
        """One line of the log and of the metrics file. Raises TrainError if a loss or gradient was no number."""
        self._guard.check()
        if not self._window.norms:
            return
        memory = (peak_memory_gb(self._window.norms[-1].device), 1)
        values = self._processes.averaged(self._window.values() | {"peak_memory_gb": memory})
        self._window = _Window()
        values["frames_per_s"] *= self._processes.count
        if self._processes.first:
            self._tell(values)

    def _tell(self, values: dict[str, float]) -> None:
        progress = self.progress
        left_s = self._seconds * (1 - progress.share) / max(progress.share, 1e-9)
        _log.info(
            "%s %3.0f %%  update %d  %s  %.1f frames/s (%.2f clips/s)  %.2f GB  %s left",
            self._options.stage,
            100 * progress.share,
            progress.updates,
            "  ".join(f"{name} {value:.4g}" for name, value in values.items() if name not in _TOLD_APART),
            values["frames_per_s"],
            values["frames_per_s"] / self._options.frames_per_clip,
            values["peak_memory_gb"],
            timedelta(seconds=round(left_s)),
        )
        self._folder.record(self._options.stage, "loss", {**self._when(), **values})

    def _measure(self) -> None:
        """Save, then measure in the first process; the others hand over what they hold of the weights, and wait."""
        self._save()
        with torch.no_grad(), nullcontext() if self._ema is None else self._ema.applied():
            if not self._processes.first:
                self._task.gather()
            self._processes.by_the_first(self._measured, Event())  # a stop is agreed on after this

    def _measured(self) -> None:
        picture = self._folder.sample(self._options.stage, self._updates)
        picture.parent.mkdir(parents=True, exist_ok=True)
        values = self._task.measure(picture)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        _log.info("%s update %d measured: %s", self._options.stage, self._updates, shown)
        self._folder.record(self._options.stage, "measured", {**self._when(), **values}, picture)

    def _when(self) -> dict[str, float | int | str]:
        share = self.progress.share
        return {"updates": self._updates, "seconds": round(self._seconds, 3), "share": round(share, 6)}

    def _save(self) -> None:
        self._speak()  # a loss that is no number must not be saved
        self._states.save(self._updates, self._seconds)


_KIB = 1 if sys.platform == "darwin" else 1024  # what getrusage counts in


def peak_memory_gb(device: torch.device) -> float:
    """Largest so far, 1e9 bytes: of the device's allocator on CUDA, else of the whole process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIB / 1e9
