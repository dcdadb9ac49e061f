"""A model measured here, and its memory in processes of their own."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from msgspec.structs import replace

from gcd_model import (
    ImplementationName,
    MemoryFigures,
    ModelBench,
    ModelBenchOptions,
    bench_model,
    load_measured,
    save_random,
)
from gcd_node.load.model_memory import MemoryTask, measured_memory


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelRun:
    """What to measure and where. weights: see load_measured. threads: of the CPU; None as torch likes.

    memory: also start a fresh process for every implementation, for the most memory it takes.
    """

    weights: str
    options: ModelBenchOptions
    device: str = "auto"
    dtype: str | None = None
    threads: int | None = None
    memory: bool = False


def run_model_bench(run: ModelRun, on_part: Callable[[str], None]) -> ModelBench:
    """Measure; `on_part` is told what comes next.

    Memory comes first, so that a measurement that fills the machine fails at once.
    Raises:
        NodeError: a process that measures memory failed. CheckpointError, OptionError: see load_measured and
            bench_model.
    """
    if run.threads is not None:
        torch.set_num_threads(run.threads)
    memories = _memories(run, on_part) if run.memory else {}
    on_part(f"loading {run.weights}")
    synthesizer = load_measured(run.weights, device=run.device, dtype=run.dtype, stages=run.options.stages)
    report = bench_model(synthesizer, run.options, on_part)
    measured = tuple(replace(each, memory=memories.get(each.name)) for each in report.implementations)
    return replace(report, implementations=measured)


def _memories(run: ModelRun, on_part: Callable[[str], None]) -> dict[str, MemoryFigures]:
    with tempfile.TemporaryDirectory(prefix="gcd-bench-") as folder:
        weights = run.weights
        if weights.startswith("random:"):
            on_part("writing random weights")
            weights = str(Path(folder) / "random.safetensors")
            save_random(run.weights, Path(weights), run.options.stages)
        found: dict[str, MemoryFigures] = {}
        for name in run.options.implementations:
            on_part(f"memory: {name}")
            found[name] = measured_memory(_task(run, weights, name))
        return found


def _task(run: ModelRun, weights: str, name: ImplementationName) -> MemoryTask:
    options = run.options
    return MemoryTask(
        weights=weights,
        implementation=name,
        stages=options.stages,
        device=run.device,
        dtype=run.dtype,
        height=options.height,
        width=options.width,
        steps=options.steps,
        guidance=options.guidance,
        threads=run.threads,
        without_camera=any(each.startswith("diffusers") for each in options.implementations),
    )
