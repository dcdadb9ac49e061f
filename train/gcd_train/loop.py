"""The training loop of every stage: updates, moving average, log, state, measurements; resumable to the update."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from gcd_train.checkpoint import StageState, load_state, require_identity, save_state
from gcd_train.ema import Ema
from gcd_train.errors import Interrupted, RunError, TrainError
from gcd_train.recipe import Budget, EmaRecipe, LogRecipe, OptimiserRecipe, StageName
from gcd_train.run_folder import RunFolder
from gcd_train.schedule import ParameterGroup, build_optimiser, set_rate
from gcd_train.stop import StopSignal

_log = logging.getLogger(__name__)


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


class Task(Protocol):
    """What a stage trains."""

    @property
    def module(self) -> nn.Module:
        """All that is saved."""
        ...

    def parameter_groups(self) -> Sequence[ParameterGroup]:
        """All that is trained."""
        ...

    def step_loss(self, progress: Progress) -> StepLoss:
        """The loss of the next update; a function of the weights and of the progress."""
        ...

    def after_update(self, progress: Progress) -> bool:
        """Called with the progress after each update; True if it rewrote weights, so that averages start anew."""
        ...

    def measure(self, picture: Path) -> dict[str, float]:
        """Metrics with the weights as they are; writes a sample picture there."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class LoopOptions:
    """How a stage runs. identity: see StageState. frames_per_clip: for the log. parts: batches
    whose gradients make one update. clock: seconds, for tests."""

    stage: StageName
    identity: str
    budget: Budget
    optimiser: OptimiserRecipe
    ema: EmaRecipe | None
    log: LogRecipe
    stop: StopSignal
    frames_per_clip: int
    parts: int = 1
    clock: Callable[[], float] = time.perf_counter


@dataclass(slots=True)
class _Window:
    """What was seen since the last line of the log."""

    losses: list[StepLoss] = field(default_factory=list[StepLoss])
    seconds: float = 0.0

    def values(self) -> dict[str, float]:
        """Mean of the loss and of its parts, and frames per second."""
        names = self.losses[-1].parts
        parts = {name: [loss.parts[name] for loss in self.losses if name in loss.parts] for name in names}
        means = {name: float(torch.stack(values).float().mean()) for name, values in parts.items()}
        total = float(torch.stack([loss.total for loss in self.losses]).float().mean())
        frames = sum(loss.frames for loss in self.losses)
        return {"loss": total, **means, "frames_per_s": frames / max(self.seconds, 1e-9)}


class Loop:
    """One stage, from its saved state to the end of its budget."""

    def __init__(self, task: Task, folder: RunFolder, options: LoopOptions) -> None:
        self._task, self._folder, self._options = task, folder, options
        self._updates, self._seconds = 0, 0.0
        self._optimiser = build_optimiser(task.parameter_groups(), options.optimiser)
        self._ema = None if options.ema is None else Ema(task.module, options.ema)
        self._window = _Window()
        self._restore()

    @property
    def progress(self) -> Progress:
        """Updates done, and share of the budget."""
        return Progress(self._updates, self._options.budget.share(self._updates, self._seconds))

    def run(self) -> None:
        """Train to the end of the budget.

        Raises:
            Interrupted: the stop signal was set; the state is saved. TrainError: the loss is no number any more.
        """
        options = self._options
        saved = measured = logged = options.clock()
        if self.progress.share >= 1:
            if not self._folder.sample(options.stage, self._updates).exists():
                self._measure()  # killed at the very end
            return
        while self.progress.share < 1:
            self._update()
            now = options.clock()
            if now - logged >= options.log.log_s:
                self._speak()
                logged = now
            if options.stop.is_set():
                self._save()
                raise Interrupted(f"stopped at update {self._updates} of {options.stage}; run again to go on")
            if now - measured >= options.log.measure_s:
                self._measure()
                measured = saved = options.clock()
            elif now - saved >= options.log.save_s:
                self._save()
                saved = options.clock()
        self._measure()

    def _update(self) -> None:
        started, recipe = self._options.clock(), self._options.optimiser
        progress = self.progress
        set_rate(self._optimiser, progress.updates, progress.share, recipe)
        self._optimiser.zero_grad(set_to_none=True)
        for part in range(self._options.parts):
            loss = self._task.step_loss(replace(progress, part=part))
            (loss.total / self._options.parts).backward()
            kept = {name: value.detach() for name, value in loss.parts.items()}
            self._window.losses.append(StepLoss(loss.total.detach(), kept, loss.frames, loss.ids))
        if recipe.clip is not None:
            trained = [p for group in self._optimiser.param_groups for p in group["params"]]
            nn.utils.clip_grad_norm_(trained, recipe.clip)
        self._optimiser.step()
        self._updates += 1
        if self._ema is not None:
            self._ema.update(self._updates)
        spent = self._options.clock() - started
        self._seconds += spent
        self._window.seconds += spent
        if self._task.after_update(self.progress) and self._ema is not None:
            self._ema.restart()

    def _speak(self) -> None:
        """One line of the log and of the metrics file. Raises TrainError if the loss is no number."""
        if not self._window.losses:
            return
        values, progress = self._window.values(), self.progress
        self._window = _Window()
        if not math.isfinite(values["loss"]):
            raise TrainError(
                f"the loss of {self._options.stage} is {values['loss']} at update {progress.updates}; the state saved "
                "before is untouched: lower the learning rate in the recipe and run again"
            )
        left_s = self._seconds * (1 - progress.share) / max(progress.share, 1e-9)
        _log.info(
            "%s %3.0f %%  update %d  %s  %.1f frames/s (%.2f clips/s)  %s left",
            self._options.stage,
            100 * progress.share,
            progress.updates,
            "  ".join(f"{name} {value:.4g}" for name, value in values.items() if name != "frames_per_s"),
            values["frames_per_s"],
            values["frames_per_s"] / self._options.frames_per_clip,
            _duration(left_s),
        )
        self._folder.record(self._options.stage, "loss", {**self._when(), **values})

    def _measure(self) -> None:
        self._save()
        picture = self._folder.sample(self._options.stage, self._updates)
        picture.parent.mkdir(parents=True, exist_ok=True)
        with torch.no_grad():
            if self._ema is None:
                values = self._task.measure(picture)
            else:
                with self._ema.applied():
                    values = self._task.measure(picture)
        shown = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        _log.info("%s update %d measured: %s", self._options.stage, self._updates, shown)
        self._folder.record(self._options.stage, "measured", {**self._when(), **values})

    def _when(self) -> dict[str, float | int | str]:
        share = self.progress.share
        return {"updates": self._updates, "seconds": round(self._seconds, 3), "share": round(share, 6)}

    def _save(self) -> None:
        self._speak()  # a loss that is no number must not be saved
        options = self._options
        state = StageState(
            stage=options.stage,
            identity=options.identity,
            updates=self._updates,
            seconds=self._seconds,
            module=self._task.module.state_dict(),
            optimiser=self._optimiser.state_dict(),
            average=None if self._ema is None else self._ema.state_dict(),
        )
        save_state(self._folder.state(options.stage), state)

    def _restore(self) -> None:
        path = self._folder.state(self._options.stage)
        if not path.exists():
            return
        state = load_state(path, self._options.stage)
        require_identity(path, state, self._options.identity)
        if (state.average is None) != (self._ema is None):
            raise RunError(f"{path} and the recipe disagree about a moving average; delete the state to start anew")
        self._task.module.load_state_dict(state.module)
        self._optimiser.load_state_dict(state.optimiser)
        if self._ema is not None and state.average is not None:
            self._ema.load_state_dict(state.average)
        self._updates, self._seconds = state.updates, state.seconds


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"
