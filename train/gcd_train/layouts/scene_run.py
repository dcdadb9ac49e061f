"""Makes many scenes: which were written, which were there, which failed and why."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from gcd_train.errors import TrainError
from gcd_train.layouts.scene_folder import remove_leftovers
from gcd_train.layouts.scene_writer import SceneFormat, SceneMade, write_scene
from gcd_train.map_items import Outcome, map_items, one_thread_each
from gcd_train.scenes.worlds import SceneWorld

GIVE_UP_AFTER = 5
"""Failures in a row after which a run stops: the disk is full, or nothing can be drawn."""


@dataclass(slots=True)
class SceneRun:
    """An account of a run so far. failures: seed -> error. gave_up: stopped before its end, see `GIVE_UP_AFTER`."""

    written: int = 0
    there: int = 0
    size: int = 0
    cpu_s: float = 0.0
    failures: dict[int, str] = field(default_factory=dict[int, str])
    gave_up: bool = False
    exit_code: int = 0
    _in_a_row: int = 0

    @property
    def done(self) -> int:
        """Scenes with an outcome."""
        return self.written + self.there + len(self.failures)

    def add(self, outcome: Outcome[int, SceneMade]) -> None:
        """Count one scene."""
        try:
            made = outcome.unwrap()
        except TrainError as error:
            self.failures[outcome.item] = str(error)
            self.exit_code = error.exit_code
            self._in_a_row += 1
            self.gave_up = self._in_a_row >= GIVE_UP_AFTER
            return
        self._in_a_row = 0
        self.written += made.made
        self.there += not made.made
        self.size += made.size
        self.cpu_s += made.cpu_s

    def lines(self) -> list[str]:
        """What to tell at the end: a summary, and one line for each failure."""
        size = f", {self.size / 1e6:.1f} MB, {self.cpu_s:.1f} CPU s" if self.written else ""
        counts = f"{self.written} written{size}; {self.there} there already; {len(self.failures)} failed"
        reasons = [f"  seed {seed}: {why}" for seed, why in self.failures.items()]
        if self.gave_up:
            reasons.append(f"  gave up after {GIVE_UP_AFTER} failures in a row; run the same line again to go on")
        return [f"scenes: {counts}", *reasons]


def generate_scenes(
    root: Path,
    world: SceneWorld,
    form: SceneFormat,
    seeds: range,
    *,
    workers: int = 1,
    ray_address: str | None = None,
) -> Iterator[SceneRun]:
    """Make the scenes of `seeds` in the folder `root`; gives the account after every scene, the same object each time.

    Scenes that are there are kept, what a killed run left half done is removed. workers, ray_address: see `map_items`.
    Raises: RunError as `map_items`.
    """
    root = root.resolve()
    remove_leftovers(root)
    one_thread_each()
    run = SceneRun()
    for outcome in map_items(partial(write_scene, root, world, form), seeds, workers=workers, ray_address=ray_address):
        run.add(outcome)
        yield run
        if run.gave_up:
            return
