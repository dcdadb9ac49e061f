"""Weights by the names `load_synthesizer` takes, exported as ONNX graphs."""

from pathlib import Path

from gcd_model.loading import loaded_weights
from gcd_model.onnx_export import Report, export_onnx, require_onnx
from gcd_model.onnx_manifest import ExportPrecision, Manifest


def export_weights(
    source: str | Path,
    out: str | Path,
    *,
    precision: ExportPrecision = "float32",
    height: int | None = None,
    width: int | None = None,
    family: str | None = None,
    head_width: int | None = None,
    image_heads: int | None = None,
    adapter: str | Path | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
) -> Manifest:
    """Write every network of a checkpoint as a graph.

    Args:
        source, family, head_width, image_heads, adapter: see `load_synthesizer`. The rest: see `export_onnx`.
    Raises: as both.
    """
    require_onnx()
    loaded = loaded_weights(source, family=family, head_width=head_width, image_heads=image_heads, adapter=adapter)
    return export_onnx(
        loaded, out, precision=precision, height=height, width=width, overwrite=overwrite, progress=progress
    )
