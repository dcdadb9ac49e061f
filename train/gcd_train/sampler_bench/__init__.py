"""What fewer steps, another solver and less guidance cost: the same noise sampled in many ways."""

from gcd_train.sampler_bench.figures import Apart, SamplerBench, WayFigures
from gcd_train.sampler_bench.measuring import Grid, Measured, bench_of, measure_ways, references_of, ways_of
from gcd_train.sampler_bench.table import to_markdown, to_table

__all__ = [
    "Apart",
    "Grid",
    "Measured",
    "SamplerBench",
    "WayFigures",
    "bench_of",
    "measure_ways",
    "references_of",
    "to_markdown",
    "to_table",
    "ways_of",
]
