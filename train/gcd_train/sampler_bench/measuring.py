"""Every clip encoded once and drawn in every way, from the same noise."""

import datetime
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from gcd_model import RenderOptions, Sampler, Schedule, SolverName, View, sampler_of
from gcd_model.clip import SOLVERS, Guidance, NoiseInterval
from gcd_model.config import SamplingConfig
from gcd_train.baselines import Prediction, SourceClip
from gcd_train.evaluation import Evaluation, EvaluationSet, Figures, SynthesizedViews, lead, summed_up
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.run import predicted_and_measured
from gcd_train.metrics import psnr
from gcd_train.sampler_bench.figures import Apart, SamplerBench, WayFigures

PUBLISHED_STEPS = 25
"""Of the paper's sampler."""
UNGUIDED: Guidance = (1.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Grid:
    """What is combined: each of these numbers of steps with each solver, each guidance, each interval and with none.

    guidances: None for the checkpoint's own, and none at all where it has some.
    """

    steps: Sequence[int] = (1, 2, 4, 6, 8, 12, 16, 25)
    solvers: Sequence[SolverName] = SOLVERS
    guidances: Sequence[Guidance] | None = None
    intervals: Sequence[NoiseInterval] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Measured:
    """What was found. apart: [way][reference], means over clips. evaluations: of each way."""

    ways: tuple[Sampler, ...]
    references: tuple[Sampler, ...]
    apart: tuple[tuple[Apart, ...], ...]
    truth: tuple[Evaluation, ...]


def ways_of(sampling: SamplingConfig, grid: Grid) -> tuple[Sampler, ...]:
    """The checkpoint's own way, then all of the grid that differ. Raises OptionError for an interval that is none."""
    own = sampler_of(sampling, RenderOptions())
    guidances = tuple(dict.fromkeys((own.guidance, UNGUIDED))) if grid.guidances is None else grid.guidances
    combined = [
        Sampler(steps=steps, solver=solver, guidance=guidance, guidance_interval=interval)
        for guidance in guidances
        for interval in (None, *grid.intervals)
        for solver in grid.solvers
        for steps in grid.steps
    ]
    ways = tuple(dict.fromkeys(map(_plainest, [own, *combined])))
    for way in ways:
        _options(way, 0)  # to refuse at once
    return ways


def references_of(sampling: SamplingConfig, fine_steps: int) -> tuple[Sampler, ...]:
    """25 steps as published, and so many of second order that more would change little; both with its own guidance."""
    own = sampler_of(sampling, RenderOptions())
    return replace(own, steps=PUBLISHED_STEPS), replace(own, steps=fine_steps, solver="dpmpp_2m")


def measure_ways(
    views: SynthesizedViews,
    clips: EvaluationSet,
    ways: Sequence[Sampler],
    references: Sequence[Sampler],
    on_clip: Callable[[int], None] = lambda _: None,
) -> Measured:
    """Draw and measure. on_clip: called with the clips done.

    Raises: DataError: a clip cannot be read, or is not one the model is for. NonFiniteError: see `render`.
    """
    records: list[list[ClipRecord]] = [[] for _ in ways]
    apart: list[list[tuple[Apart, ...]]] = [[] for _ in ways]
    for done, key in enumerate(clips.keys, start=1):
        clip = clips.clip(key)
        drawn = _drawn(views, clip.seen, [*references, *ways])
        for number, way in enumerate(ways):
            apart[number].append(tuple(_apart(drawn[way], drawn[each]) for each in references))
            shown = _Shown(name=told(way), prediction=views.shown(drawn[way]))
            records[number].append(predicted_and_measured(shown, clip, classes=clips.classes)[1])
        on_clip(done)
    return Measured(
        ways=tuple(ways),
        references=tuple(references),
        apart=tuple(map(_mean, apart)),
        truth=tuple(summed_up(rows, classes=len(clips.classes)) for rows in records),
    )


def bench_of(
    found: Measured, views: SynthesizedViews, clips: EvaluationSet, *, data: Sequence[str], command: str
) -> SamplerBench:
    """The report. data: folders of the clips, as they were named."""
    traits = views.synthesizer.traits
    return SamplerBench(
        command=command,
        date=datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        torch=str(torch.__version__),
        weights=traits.name,
        sha256_12=traits.sha256_12,
        prediction=traits.diffusion.prediction,
        sigma_max=traits.config.sampling.sigma_max,
        sigma_min=traits.config.sampling.sigma_min,
        data=tuple(data),
        data_identity=clips.identity,
        clips=len(clips.keys),
        seed=views.options.seed,
        references=tuple(map(told, found.references)),
        ways=tuple(
            _figures(way, Schedule.of(traits.diffusion, _options(way, 0)).evaluations, apart, truth, found.truth[0])
            for way, apart, truth in zip(found.ways, found.apart, found.truth, strict=True)
        ),
    )


def told(way: Sampler) -> str:
    """A way in words."""
    words = [f"{way.steps} {way.solver} step{'' if way.steps == 1 else 's'}"]
    words += [] if way.guidance == UNGUIDED else ["guidance {:g} to {:g}".format(*way.guidance)]
    interval = way.guidance_interval
    words += [] if interval is None else ["at noise levels {:g} to {:g}".format(*interval)]
    return ", ".join(words)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Shown:
    """A view that is drawn already, as one of the methods that are measured."""

    name: str
    prediction: Prediction
    privileged: bool = False

    def predict(self, clip: SourceClip) -> Prediction:
        return self.prediction


def _plainest(way: Sampler) -> Sampler:
    """The same way without what changes nothing: one step has no second order, and no guidance no interval."""
    if way.steps == 1:
        way = replace(way, solver="euler")
    return replace(way, guidance_interval=None) if way.guidance == UNGUIDED else way


def _options(way: Sampler, seed: int) -> RenderOptions:
    return RenderOptions(
        steps=way.steps,
        solver=way.solver,
        guidance=way.guidance,
        guidance_interval=way.guidance_interval,
        seed=seed,
    )


def _drawn(views: SynthesizedViews, clip: SourceClip, ways: Sequence[Sampler]) -> dict[Sampler, View]:
    """Each way once."""
    draw = views.drawer(clip)
    return {way: draw(_options(way, views.options.seed)) for way in dict.fromkeys(ways)}


def _apart(view: View, reference: View) -> Apart:
    norm = reference.latents.norm().clamp(min=1e-12)
    return Apart(
        latents=float((view.latents - reference.latents).norm() / norm),
        psnr_db=float(psnr(view.video, reference.video).mean()),
    )


def _mean(clips: Sequence[tuple[Apart, ...]]) -> tuple[Apart, ...]:
    """Over clips, of each reference."""
    return tuple(
        Apart(
            latents=sum(each.latents for each in column) / len(column),
            psnr_db=sum(each.psnr_db for each in column) / len(column),
        )
        for column in zip(*clips, strict=True)
    )


def _figures(
    way: Sampler, evaluations: int, apart: tuple[Apart, ...], truth: Evaluation, own: Evaluation
) -> WayFigures:
    ahead_db, error_db = lead(truth, own, _psnr)
    ahead_miou, error_miou = lead(truth, own, _miou)
    return WayFigures(
        steps=way.steps,
        solver=way.solver,
        guidance=way.guidance,
        guidance_interval=way.guidance_interval,
        evaluations=evaluations,
        apart=apart,
        psnr_db=_number(truth.total.psnr_db),
        gradient_energy=_number(truth.total.gradient_energy),
        miou=_number(truth.total.miou),
        ahead_db=_number(ahead_db),
        ahead_error_db=_number(error_db),
        ahead_miou=_number(ahead_miou),
        ahead_error_miou=_number(error_miou),
    )


def _psnr(of: Figures) -> float:
    return of.psnr_db


def _miou(of: Figures) -> float:
    return of.miou


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
