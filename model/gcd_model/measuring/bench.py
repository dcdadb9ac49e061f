"""Ours and others on the same window, in turns, in one process."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import torch

from gcd_model.clip import View
from gcd_model.errors import OptionError
from gcd_model.measuring.implementations import ImplementationName, comparable, counted_flops, engine_named, is_peer
from gcd_model.measuring.report import STAGES, Difference, Implementation, ModelBench, StageFigures, StageName
from gcd_model.measuring.stopwatch import Spent, Stopwatch
from gcd_model.measuring.subject import Subject, Work, relative_difference
from gcd_model.synthesizer import Synthesizer


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelBenchOptions:
    """What to measure. height, width: pixels; steps, guidance: see RenderOptions; None as the checkpoint was made for.

    repeats: measured windows of each implementation, after `warm` others. stages: those asked for; what belongs to none
    of them is not computed. implementations: the first is what the others are compared with.
    without_camera: leave the camera's embedding out even where no peer asks for that. count: also count arithmetic;
    without, `tflop` is 0.
    """

    height: int | None = None
    width: int | None = None
    steps: int | None = None
    guidance: tuple[float, float] | None = None
    repeats: int = 3
    warm: int = 1
    stages: tuple[StageName, ...] = STAGES
    implementations: tuple[ImplementationName, ...] = ("ours",)
    without_camera: bool = False
    count: bool = True

    def __post_init__(self) -> None:
        if self.repeats < 1 or self.warm < 0 or not self.stages or not self.implementations:
            raise OptionError(
                "a bench takes at least one window, one stage and one implementation, got "
                f"{self.repeats} windows, {len(self.stages)} stages and {len(self.implementations)} implementations"
            )


def _nobody(_: str) -> None:
    """Nobody wants to know."""


def bench_model(
    synthesizer: Synthesizer, options: ModelBenchOptions, on_part: Callable[[str], None] = _nobody
) -> ModelBench:
    """Measure a checkpoint; `on_part` is told what comes next.

    Beside a peer the camera's embedding is left out on all sides: diffusers has none.
    Raises: OptionError: diffusers has no such network or is not installed, or cannot take this size.
    """
    names = options.implementations
    bare = options.without_camera or any(is_peer(name) for name in names)
    networks, traits = comparable(synthesizer, bare=bare)
    work = Work.of(
        traits.diffusion, height=options.height, width=options.width, steps=options.steps, guidance=options.guidance
    )
    subjects = [Subject(name, engine_named(name, networks), traits, work, options.stages) for name in names]
    rounds = _Rounds(subjects, options.stages, networks.unet.stem.weight.device)
    for number in range(options.warm + options.repeats):
        rounds.run(number + 1, keep=number >= options.warm, on_part=on_part)
    on_part("counting the arithmetic")
    counted = {name: counted_flops(name, traits, work) if options.count else {} for name in names}
    return ModelBench(
        model=traits.name,
        parameters=sum(value.numel() for value in networks.state_dict().values()) / 1e6,
        frames=traits.config.frames,
        height=work.height,
        width=work.width,
        steps=work.steps,
        guidance=work.guidance,
        precision=traits.precision,
        device=traits.device,
        threads=torch.get_num_threads(),
        implementations=tuple(Implementation(name=name, stages=rounds.figures(name, counted[name])) for name in names),
        differences=rounds.differences(decoded=bool({"decode", "window"} & set(options.stages))),
    )


class _Rounds:
    """Windows of all subjects in turns, and what they took."""

    def __init__(self, subjects: Sequence[Subject], stages: Sequence[StageName], device: torch.device) -> None:
        self._subjects, self._stages, self._watch = subjects, stages, Stopwatch(device)
        self._alone = device.type == "cuda" and "window" in stages  # watching stages makes the host wait between them
        self._spent: dict[tuple[str, StageName], list[Spent]] = {}
        self._views: dict[str, View] = {}

    def run(self, number: int, *, keep: bool, on_part: Callable[[str], None]) -> None:
        """One window of each; the other way round every second time, so that nobody always comes first."""
        for subject in self._subjects if number % 2 else reversed(self._subjects):
            on_part(f"window {number}: {subject.name}")
            self._watch.lap()
            self._views[subject.name] = subject.window()
            spent, whole = subject.probe.spent, self._watch.lap()
            if self._alone:
                subject.window(watched=False)
                whole = self._watch.lap()
            if keep:
                self._keep(subject.name, spent, whole)

    def figures(self, name: str, flops: dict[StageName, int]) -> tuple[StageFigures, ...]:
        """Of the stages that were asked for and that this model has."""
        return tuple(
            _figures(stage, self._spent[name, stage], flops.get(stage, 0))
            for stage in self._stages
            if (name, stage) in self._spent
        )

    def differences(self, *, decoded: bool) -> tuple[Difference, ...]:
        """Of the last windows, against the first subject's. decoded: whether the pictures are real."""
        first, *others = (subject.name for subject in self._subjects)
        ours = self._views[first]
        return tuple(
            Difference(
                name=name,
                latents=relative_difference(ours.latents, self._views[name].latents),
                pictures=relative_difference(ours.samples, self._views[name].samples) if decoded else None,
            )
            for name in others
        )

    def _keep(self, name: str, spent: dict[StageName, list[Spent]], whole: Spent) -> None:
        for stage, each in spent.items():
            self._spent.setdefault((name, stage), []).extend(each)
        self._spent.setdefault((name, "window"), []).append(whole)


def _figures(stage: StageName, spent: Sequence[Spent], flops: int) -> StageFigures:
    walls = sorted(each.wall_s for each in spent)
    return StageFigures(
        stage=stage,
        runs=len(walls),
        median_s=median(walls),
        p95_s=walls[math.ceil(0.95 * (len(walls) - 1))],
        cpu_s=median(each.cpu_s for each in spent),
        tflop=flops / 1e12,
    )
