"""Pictures as files: sheets of samples, and figures by matplotlib, an extra."""

import io
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_train.errors import RenderError
from gcd_train.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110
_GAP = 4  # pixels between the pictures of a sheet


def write_sheet(path: Path, rows: Sequence[Sequence[Tensor]]) -> None:
    """Write pictures [3, H, W] in [-1, 1], all of one size, row by row as one PNG. Raises RunError."""
    height, width = rows[0][0].shape[-2:]
    sheet = np.full((len(rows) * (height + _GAP), max(map(len, rows)) * (width + _GAP), 3), 255, np.uint8)
    for y, row in enumerate(rows):
        for x, picture in enumerate(row):
            top, left = y * (height + _GAP), x * (width + _GAP)
            sheet[top : top + height, left : left + width] = _to_bytes(picture)
    write_whole(path, png(sheet))


def png(picture: NDArray[np.uint8]) -> bytes:
    """A PNG file of an RGB picture, uint8 [H, W, 3]."""
    done, data = cv2.imencode(".png", cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR))
    assert done, "PNG takes any picture"
    return data.tobytes()


def _to_bytes(picture: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    scaled = (picture.detach().float().cpu().clamp(-1, 1) + 1) * 127.5
    return scaled.round().to(torch.uint8).permute(1, 2, 0).numpy()


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
