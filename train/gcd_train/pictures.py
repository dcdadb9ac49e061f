"""Pictures as files: sheets of samples, and figures by matplotlib, an extra."""

import io
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_train.errors import RenderError
from gcd_train.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110


def png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file of an RGB picture, uint8 [H, W, 3]."""
    done, data = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    return data.tobytes()


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


def save(figure: "Figure", out: Path) -> None:
    """Write a figure as PNG, in one piece. Raises RunError if it cannot be written."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    write_whole(out, drawn.getvalue())
