"""`gcd-node bench model`: what a model costs, stage by stage, beside others."""

from typing import Annotated, Literal, TypeAlias

import typer
from typer import Option

from gcd_model import STAGES, ImplementationName, ModelBenchOptions, StageName
from gcd_node.cli.bench_output import JsonFile, PlotFile, measured_and_shown
from gcd_node.errors import UsageError
from gcd_node.load.model_bench import ModelRun, run_model_bench

_ALL_STAGES = ",".join(STAGES)

_OURS: dict[str, ImplementationName] = {
    "torch": "ours",
    "cuda": "ours on cuda",
    "cuda-float32-decoder": "ours on cuda, float32 decoder",
    "compiled": "ours, compiled alone",
    "graphs": "ours, graphs alone",
}

Weights: TypeAlias = Annotated[
    str, Option(help="A checkpoint, package:NAME, random:FAMILY, or random:full (6 GB and more).")
]
Peer: TypeAlias = Annotated[Literal["diffusers"] | None, Option(help="Also the same networks in its modules.")]
Compiled: TypeAlias = Annotated[bool, Option("--compiled", help="The peer behind torch.compile, too.")]
Engines: TypeAlias = Annotated[
    list[str] | None,
    Option(
        "--engine",
        help="torch, cuda, cuda-float32-decoder, compiled or graphs; may be repeated, the first is compared with.",
    ),
]
Device: TypeAlias = Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")]
Dtype: TypeAlias = Annotated[str | None, Option(help="float32, bfloat16 or float16.")]
Height: TypeAlias = Annotated[int | None, Option(min=1, help="Of the frames, pixels; as trained.")]
Width: TypeAlias = Annotated[int | None, Option(min=1, help="The same.")]
Steps: TypeAlias = Annotated[int | None, Option(min=1, help="Network evaluations; as the checkpoint was made for.")]
Guidance: TypeAlias = Annotated[
    tuple[float, float] | None, Option(metavar="FIRST LAST", help="Scale of the first and of the last frame.")
]
Repeats: TypeAlias = Annotated[int, Option(min=1, help="Measured windows of each.")]
Warm: TypeAlias = Annotated[int, Option(min=0, help="Windows of each before those.")]
Stages: TypeAlias = Annotated[str, Option(help=f"Some of {_ALL_STAGES}; others are not computed.")]
Memory: TypeAlias = Annotated[bool, Option("--memory", help="Also the memory of each, in a process of its own.")]
Threads: TypeAlias = Annotated[int | None, Option(min=1, help="CPU threads.")]


def model(
    context: typer.Context,
    weights: Weights,
    peer: Peer = None,
    compiled: Compiled = False,
    engine: Engines = None,
    device: Device = "auto",
    dtype: Dtype = None,
    height: Height = None,
    width: Width = None,
    steps: Steps = None,
    guidance: Guidance = None,
    repeats: Repeats = 3,
    warm: Warm = 1,
    stages: Stages = _ALL_STAGES,
    memory: Memory = False,
    threads: Threads = None,
    json_file: JsonFile = None,
    plot: PlotFile = None,
) -> None:
    """A model, stage by stage: image tower, encoding, a step, decoding, a whole window; times, memory, arithmetic.

    With a peer the same weights, latents, steps and guidance go through its modules, in turns with ours in one process;
    the table says how many times as long it takes, and how far its results lie from ours. The clip is a still picture,
    and camera control is left out: diffusers has one image token a clip and no camera.
    """
    options = ModelBenchOptions(
        height=height,
        width=width,
        steps=steps,
        guidance=guidance,
        repeats=repeats,
        warm=warm,
        stages=chosen_stages(stages),
        implementations=chosen_implementations(engine or ["torch"], peer, compiled=compiled),
    )
    run = ModelRun(weights=weights, options=options, device=device, dtype=dtype, threads=threads, memory=memory)
    measured_and_shown(context, lambda on_part: run_model_bench(run, on_part), json_file, plot)


def chosen_stages(text: str) -> tuple[StageName, ...]:
    """The stages of a list with commas, in the order of a window. Raises UsageError for another name."""
    asked = {word.strip() for word in text.split(",") if word.strip()}
    unknown = sorted(asked - set(STAGES))
    if unknown or not asked:
        raise UsageError(f"--stages takes some of {', '.join(STAGES)}, got {text!r}")
    return tuple(stage for stage in STAGES if stage in asked)


def chosen_implementations(
    engines: list[str], peer: Literal["diffusers"] | None, *, compiled: bool
) -> tuple[ImplementationName, ...]:
    """Ours first, then the peer. Raises UsageError for an unknown engine, or --compiled without a peer."""
    unknown = sorted(set(engines) - set(_OURS))
    if unknown:
        raise UsageError(f"--engine takes one of {', '.join(_OURS)}, got {unknown[0]!r}")
    if compiled and peer is None:
        raise UsageError("--compiled is about a peer; add --peer diffusers")
    first: tuple[ImplementationName, ...] = tuple(_OURS[name] for name in dict.fromkeys(engines))
    if peer is None:
        return first
    peers: tuple[ImplementationName, ...] = ("diffusers", "diffusers compiled") if compiled else ("diffusers",)
    return first + peers
