"""matplotlib, which is an extra: imported when a figure is drawn, never on a display."""

import io
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110


def require_matplotlib() -> None:
    """Raises RenderError, naming the extra, where matplotlib is not installed."""
    try:
        import_module("matplotlib.figure")
    except ImportError as error:
        raise RenderError(
            f"figures need matplotlib ({error}); install it with pip install 'gcd-node[train]'"
        ) from error


def new_figure(width_in: float, height_in: float) -> "Figure":
    """An empty white figure, drawn by Agg, sizes in inches at 110 pixels. Raises RenderError without matplotlib."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def to_pixels(figure: "Figure") -> NDArray[np.uint8]:
    """A drawn figure as u8 [H, W, 3]."""
    canvas = figure.canvas
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])  # pyright: ignore[reportAttributeAccessIssue]


def save(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG, in one piece."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(drawn.getvalue())
