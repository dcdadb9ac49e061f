"""Figures of measurements as PNG. Needs matplotlib, which is an extra: imported when a figure is drawn."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from gcd_model import ModelBench
from gcd_node.errors import OutputError
from gcd_node.load.stream_report import StreamBench

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 110
_COLOURS = ("#1f5fa8", "#7fb0e0", "#c2551f", "#eba77f")


def require_matplotlib() -> None:
    """Raises OutputError, naming the extra, where matplotlib is not installed."""
    try:
        import_module("matplotlib.figure")
    except ImportError as error:
        raise OutputError(
            f"--plot needs matplotlib ({error}); install it with pip install 'gcd-node[train]'"
        ) from error


def write_plot(path: Path, report: ModelBench | StreamBench) -> None:
    """Draw a report. Raises OutputError without matplotlib, or if the file cannot be written."""
    figure = model_figure(report) if isinstance(report, ModelBench) else stream_figure(report)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png", dpi=_DPI)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; give another path with --plot") from error


def model_figure(report: ModelBench) -> "Figure":
    """Bars of CPU time (on a GPU: of time by the clock) per stage and implementation."""
    on_gpu = report.device != "cpu"
    stages = [each.stage for each in report.implementations[0].stages]
    drawn, count = _new_figure(7.0, 3.6), len(report.implementations)
    axes = drawn.add_subplot()
    for row, implementation in enumerate(report.implementations):
        taken = {each.stage: each.median_s if on_gpu else each.cpu_s for each in implementation.stages}
        places = [place + 0.8 * (row - (count - 1) / 2) / count for place in range(len(stages))]
        heights = [taken.get(stage, 0.0) for stage in stages]
        axes.bar(places, heights, 0.8 / count, label=implementation.name, color=_COLOURS[row % len(_COLOURS)])
    axes.set_xticks(range(len(stages)), stages)
    axes.set_ylabel("seconds" if on_gpu else "CPU seconds, all cores")
    axes.set_title(f"{report.model}, {report.frames} x {report.height} x {report.width}, {report.steps} steps", size=10)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return drawn


def stream_figure(report: StreamBench) -> "Figure":
    """The age of every view as it came, with the three percentiles."""
    drawn = _new_figure(7.0, 3.2)
    axes = drawn.add_subplot()
    at_s, age_ms = [each[0] for each in report.arrivals], [each[1] for each in report.arrivals]
    axes.plot(at_s, age_ms, "o", markersize=3.5, color=_COLOURS[0])
    percentiles = {"p50": report.ages.p50_ms, "p95": report.ages.p95_ms, "p99": report.ages.p99_ms}
    for (name, value), style in zip(percentiles.items(), ("-", "--", ":"), strict=True):
        axes.axhline(value, linestyle=style, linewidth=1.0, color=_COLOURS[2], label=f"{name} {value:.0f} ms")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("seconds after the first view")
    axes.set_ylabel("age on arrival, ms")
    axes.set_title(f"{report.model} on {report.source} at {report.fps:g} FPS", size=10)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return drawn


def _new_figure(width_in: float, height_in: float) -> "Figure":
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, facecolor="white", layout="tight")
    FigureCanvasAgg(figure)
    return figure
