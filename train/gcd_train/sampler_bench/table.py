"""The table of a sampler bench, in Markdown and for terminals."""

from rich.box import SIMPLE
from rich.table import Table

from gcd_train.sampler_bench.figures import SamplerBench, WayFigures

_TRUTH = ("PSNR dB", "ahead", "gradient", "mIoU", "ahead")


def to_markdown(bench: SamplerBench) -> str:
    """One table, a row for each way; its own way comes first, and the others say how far they are ahead of it."""
    header, rows = _header(bench), [_row(way) for way in bench.ways]
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def to_table(bench: SamplerBench) -> Table:
    """The same for people."""
    title = f"{bench.weights} ({bench.prediction}), {bench.clips} clips, one noise for all ways; apart from: "
    table = Table(title=title + "; ".join(bench.references), title_justify="left", box=SIMPLE, pad_edge=False)
    for name in _header(bench):
        table.add_column(name)
    for way in bench.ways:
        table.add_row(*_row(way))
    return table


def _header(bench: SamplerBench) -> list[str]:
    apart = [f"{what} {name.partition(' step')[0]}" for name in bench.references for what in ("latents from", "dB to")]
    return ["steps", "solver", "guidance", "runs", *apart, *_TRUTH]


def _row(way: WayFigures) -> list[str]:
    guidance = "no" if way.guidance == (1.0, 1.0) else "{:g} to {:g}".format(*way.guidance)
    if way.guidance_interval is not None:
        guidance += ", noise {:g} to {:g}".format(*way.guidance_interval)
    apart = [cell for each in way.apart for cell in (f"{each.latents:.4f}", f"{each.psnr_db:.1f}")]
    truth = (
        _cell(way.psnr_db, 2),
        _with_error(way.ahead_db, way.ahead_error_db, 2),
        _cell(way.gradient_energy, 2),
        _cell(way.miou, 3),
        _with_error(way.ahead_miou, way.ahead_error_miou, 3),
    )
    return [str(way.steps), way.solver, guidance, str(way.evaluations), *apart, *truth]


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _with_error(value: float | None, error: float | None, digits: int) -> str:
    return _cell(value, digits) if error is None else f"{_cell(value, digits)} ± {error:.{digits}f}"
