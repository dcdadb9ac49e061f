"""`gcd-train bench sampler`: what fewer steps, another solver and less guidance cost."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from rich.console import Console
from typer import Option

from gcd_model import SOLVERS, SolverName
from gcd_train.cli.errors import errors_shown
from gcd_train.cli.progress_bar import progress_bar
from gcd_train.errors import DataError, RecipeError

if TYPE_CHECKING:
    from gcd_train.sampler_bench import SamplerBench

_OUTPUTS = ("--json", "--markdown")

Weights = Annotated[str, Option(help="package:NAME or a path.")]
Data = Annotated[list[Path], Option(help="Folder of held-out pairs; may be repeated.")]
Split = Annotated[str | None, Option(help="Only scenes of a split, by its name such as driving-test.")]
Limit = Annotated[int | None, Option(min=1, help="Only the first so many scenes.")]
Steps = Annotated[list[int] | None, Option(min=1, help="Numbers of steps; may be repeated. By default 1 to 25.")]
Solver = Annotated[SolverName | None, Option(help="Only this one; by default all.")]
Guidances = Annotated[
    list[str] | None,
    Option("--guidance", metavar="FIRST:LAST", help="May be repeated; by default the model's own, and none."),
]
Intervals = Annotated[
    list[str] | None,
    Option("--interval", metavar="LOW:HIGH", help="Noise levels guidance is also tried at alone; may be repeated."),
]
Fine = Annotated[int, Option(min=2, help="Steps of second order that stand for any number of them.")]
Seed = Annotated[int, Option(min=0, help="Of the noise, the same for every clip and way.")]
Json = Annotated[Path | None, Option("--json", help="File for all figures.")]
Markdown = Annotated[Path | None, Option(help="File for the table.")]
Device = Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")]
Dtype = Annotated[str | None, Option(help="float32, bfloat16 or float16.")]


def sampler_command(
    weights: Weights,
    data: Data,
    split: Split = None,
    limit: Limit = None,
    steps: Steps = None,
    solver: Solver = None,
    guidances: Guidances = None,
    intervals: Intervals = None,
    fine: Fine = 100,
    seed: Seed = 0,
    json: Json = None,
    markdown: Markdown = None,
    device: Device = "auto",
    dtype: Dtype = None,
) -> None:
    """Steps, solvers and guidance against each other: the same noise of the same clips, drawn in every way.

    Each is held against 25 Euler steps and against many steps of second order, and against the truth.
    """
    with errors_shown():
        from gcd_model import RenderOptions, load_synthesizer
        from gcd_train.evaluation import SynthesizedViews
        from gcd_train.evaluation.choosing import Choice
        from gcd_train.evaluation.opening import open_pairs
        from gcd_train.sampler_bench import Grid, bench_of, measure_ways, references_of, ways_of

        model = load_synthesizer(weights, device=device, dtype=dtype)
        clips = open_pairs(data, Choice(split=split, limit=limit), None).clips
        if not clips.keys:
            raise DataError("no clip is left to measure; give other --data or another --split")
        views = SynthesizedViews.of(model, clips, RenderOptions(seed=seed))
        grid = Grid(
            steps=steps or Grid().steps,
            solvers=SOLVERS if solver is None else (solver,),
            guidances=None if guidances is None else [_pair("--guidance", each) for each in guidances],
            intervals=[_pair("--interval", each) for each in intervals or ()],
        )
        sampling = model.traits.config.sampling
        with progress_bar("clips", len(clips.keys)) as show:
            found = measure_ways(views, clips, ways_of(sampling, grid), references_of(sampling, fine), show)
        _tell(bench_of(found, views, clips, data=[str(each) for each in data], command=_command()), json, markdown)


def _tell(bench: "SamplerBench", json: Path | None, markdown: Path | None) -> None:
    from gcd_train.evaluation.keeping import write_whole
    from gcd_train.sampler_bench import to_markdown, to_table

    Console(soft_wrap=True).print(to_table(bench))
    if json is not None:
        write_whole(json, msgspec.json.format(msgspec.json.encode(bench), indent=1) + b"\n")
    if markdown is not None:
        write_whole(markdown, to_markdown(bench).encode())


def _pair(option: str, text: str) -> tuple[float, float]:
    try:
        first, last = map(float, text.split(":"))
    except ValueError as error:
        raise RecipeError(f"{option} is two numbers with a colon between, such as 1:1.5, got {text!r}") from error
    return first, last


def _command() -> str:
    """Without the options that say where figures go."""
    return shlex.join(["gcd-train", *_without_outputs(sys.argv[1:])])


def _without_outputs(words: Sequence[str]) -> list[str]:
    named = [word in _OUTPUTS for word in words]
    return [
        word for word, is_name, follows in zip(words, named, [False, *named], strict=False) if not (is_name or follows)
    ]
