"""What a model costs: its stages, its memory, its arithmetic, and the same of others beside it."""

from gcd_model.measuring.bench import ModelBenchOptions, bench_model
from gcd_model.measuring.implementations import IMPLEMENTATIONS, ImplementationName
from gcd_model.measuring.opening import load_measured, save_random
from gcd_model.measuring.report import (
    STAGES,
    Difference,
    Implementation,
    MemoryFigures,
    ModelBench,
    StageFigures,
    StageName,
)

__all__ = [
    "IMPLEMENTATIONS",
    "STAGES",
    "Difference",
    "Implementation",
    "ImplementationName",
    "MemoryFigures",
    "ModelBench",
    "ModelBenchOptions",
    "StageFigures",
    "StageName",
    "bench_model",
    "load_measured",
    "save_random",
]
