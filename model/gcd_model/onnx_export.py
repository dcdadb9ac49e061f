"""A checkpoint as a folder of ONNX graphs with a manifest. An exporter, so it opens files; also reads what it wrote.

The folder appears under its name only once it is complete. Needs the extra `onnx`, which is imported when it is
used.
"""

import importlib.util
import logging
import os
import shutil
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import torch

from gcd_model.checkpoints import digest
from gcd_model.errors import CheckpointError, FileError, OptionError
from gcd_model.networks import LoadedWeights
from gcd_model.onnx_graphs import Graph, graphs
from gcd_model.onnx_manifest import (
    FORMAT,
    MANIFEST,
    ExportPrecision,
    FileRecord,
    GraphName,
    GraphRecord,
    Manifest,
    TensorRecord,
    from_bytes,
    to_bytes,
)
from gcd_model.onnx_precision import narrowed
from gcd_model.own_format import FULL_PRECISION, Card
from gcd_model.small_files import read_small

OPSET = 20
"""Of the ONNX operators: what TensorRT 10 and onnxruntime 1.20 know."""

APART_ABOVE = 1 << 30  # bytes of weights beside a graph instead of in it; one file of ONNX holds 2 GiB at most
_ANY_SIZE = 1 << 62
_MISSING = "ONNX needs the extra `onnx`: pip install 'gcd-node[onnx]'"

Report = Callable[[str, int, int], None]
"""Called with (graph that is next, graphs done, graphs)."""


def export_onnx(
    loaded: LoadedWeights,
    out: str | Path,
    *,
    precision: ExportPrecision = "float32",
    height: int | None = None,
    width: int | None = None,
    overwrite: bool = False,
    apart_above: int = APART_ABOVE,
    progress: Report | None = None,
) -> Manifest:
    """Write every network of a checkpoint as a graph.

    Args:
        loaded: weights on the CPU; they are widened to float32 first.
        precision: of the weights and of what is computed; the decoder and the plane mix stay float32.
        height, width: pixels, instead of the trained size; graphs take this size alone.
        apart_above: weights of more bytes lie in a file beside the graph.
    Raises:
        OptionError: `out` exists and `overwrite` is not set or is no export; the size does not fit; the extra is
            missing. CheckpointError: it cannot be written.
    """
    require_onnx()
    loaded = _at_size(loaded, height, width)
    with _whole_folder(Path(out), overwrite=overwrite) as folder:
        records = _written(loaded, folder, precision, apart_above, progress)
        manifest = Manifest(
            format=FORMAT,
            card=_card(loaded).to_metadata(),
            source=loaded.sha256_12,
            precision=precision,
            opset=OPSET,
            exporter=f"torch {torch.__version__}, onnx {version('onnx')}, onnxscript {version('onnxscript')}",
            graphs=records,
        )
        (folder / MANIFEST).write_bytes(to_bytes(manifest))
    return manifest


def read_manifest(folder: str | Path) -> Manifest:
    """What an export says about itself; every file it names is there, whole and as it was written.

    Raises: CheckpointError if not.
    """
    folder = Path(folder)
    try:
        manifest = from_bytes(read_small(folder / MANIFEST))
        for graph in manifest.graphs.values():
            for file in graph.files:
                _require_intact(folder, file)
    except FileError as error:
        raise CheckpointError(f"{folder}: its {MANIFEST} {error}; export it again") from error
    except CheckpointError as error:
        raise CheckpointError(f"{folder}: {error}") from error
    except OSError as error:
        raise CheckpointError(f"{folder}: cannot be read: {error.strerror or error}; export it again") from error
    return manifest


def is_export(path: str | Path) -> bool:
    """Whether a path is the folder of an export."""
    return os.path.lexists(Path(path) / MANIFEST)


def require_onnx() -> None:
    """Raises OptionError unless what exports and quantises is installed."""
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            raise OptionError(_MISSING)


def _require_intact(folder: Path, file: FileRecord) -> None:
    path = folder / file.name
    if Path(file.name).name != file.name or not path.is_file():
        raise CheckpointError(f"lacks its file {file.name}; export it again")
    size = path.stat().st_size
    if size != file.size:
        raise CheckpointError(f"its file {file.name} has {size} bytes, wanted are {file.size}; copy or export it again")
    if digest((path,)) != file.sha256:
        raise CheckpointError(f"its file {file.name} is not the one that was written; copy or export it again")


def _at_size(loaded: LoadedWeights, height: int | None, width: int | None) -> LoadedWeights:
    """The weights in float32, with the size they are exported for as their config's."""
    networks = loaded.diffusion
    config, factor = networks.config, networks.config.size_factor
    height, width = height or config.height, width or config.width
    if height % factor or width % factor:
        raise OptionError(f"height and width must be multiples of {factor} for {loaded.name}, got {height}x{width}")
    networks.config = msgspec.structs.replace(config, height=height, width=width)
    networks.requires_grad_(False).float()
    return loaded


def _card(loaded: LoadedWeights) -> Card:
    return Card(
        name=loaded.name,
        config=loaded.diffusion.config,
        family=None if loaded.family is None else loaded.family.name,
        move_time=loaded.move_time,
        trained=loaded.trained,
        origin=loaded.sha256_12,
        uncertainty_scale=loaded.uncertainty_scale,
    )


def _written(
    loaded: LoadedWeights, folder: Path, precision: ExportPrecision, apart_above: int, progress: Report | None
) -> dict[GraphName, GraphRecord]:
    records: dict[GraphName, GraphRecord] = {}
    wanted = graphs(loaded.diffusion)
    for graph in wanted:
        if progress is not None:
            progress(graph.name, len(records), len(wanted))
        own: ExportPrecision = "float32" if graph.name in FULL_PRECISION else precision
        records[graph.name] = write_graph(graph, folder, own, apart_above=apart_above)
    return records


def write_graph(
    graph: Graph, folder: Path, precision: ExportPrecision = "float32", *, apart_above: int = APART_ABOVE
) -> GraphRecord:
    """Export one graph into a folder; see `export_onnx` for the arguments. Returns what the manifest says of it."""
    model = _exported(graph)
    path, apart = folder / f"{graph.name}.onnx", graph.weight_bytes > apart_above
    _saved(model, path, apart=apart)
    if precision != "float32":
        _narrow(path, precision, apart=apart)
    files = (path, *(each for each in [path.with_name(f"{path.name}.data")] if each.exists()))
    return GraphRecord(
        files=tuple(FileRecord(name=f.name, size=f.stat().st_size, sha256=digest((f,))) for f in files),
        precision=precision,
        inputs=tuple(_record(value) for value in model.graph.inputs),
        outputs=tuple(_record(value) for value in model.graph.outputs),
    )


def _record(value: Any) -> TensorRecord:
    kinds = {"FLOAT": "float32", "BOOL": "bool"}
    return TensorRecord(name=value.name, shape=tuple(map(int, value.shape)), dtype=kinds[value.dtype.name])


def _saved(model: Any, path: Path, *, apart: bool) -> None:
    import onnx_ir

    onnx_ir.save(model, path, external_data=f"{path.name}.data" if apart else None)


def _narrow(path: Path, precision: ExportPrecision, *, apart: bool) -> None:
    """Rewrite a graph's file in another precision."""
    import onnx

    model = narrowed(onnx.load(path), precision)
    beside = path.with_name(f"{path.name}.data")
    beside.unlink(missing_ok=True)
    onnx.save(model, path, save_as_external_data=apart, location=beside.name)


def _exported(graph: Graph) -> Any:
    """The graph as `onnx_ir` holds it: what its weights alone determine is computed, and no path of ours is in it."""
    from onnxscript import optimizer

    with _quiet():
        program = torch.onnx.export(
            graph.module,
            tuple(graph.inputs.values()),
            dynamo=True,
            verbose=False,
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            opset_version=OPSET,
        )
        assert program is not None
        model = program.model
        optimizer.fold_constants(model, input_size_limit=_ANY_SIZE, output_size_limit=_ANY_SIZE)
        optimizer.remove_unused_nodes(model)
    for node in model.graph.all_nodes():
        node.metadata_props.clear()  # file names and lines of this machine
    return model


@contextmanager
def _quiet() -> Generator[None]:
    """What the exporter says about packages we do not need."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)


@contextmanager
def _whole_folder(out: Path, *, overwrite: bool) -> Generator[Path]:
    """A folder that appears under its name only once it is complete."""
    if not out.parent.is_dir():
        raise OptionError(f"{out}: there is no folder {out.parent}; make it first")
    if out.exists() and not (overwrite and is_export(out)):
        raise OptionError(f"{out} exists; give another name, or allow an export to be overwritten")
    partial = out.with_name(f".{out.name}.{os.getpid()}.partial")
    try:
        partial.mkdir()
        yield partial
        if out.exists():
            shutil.rmtree(out)
        partial.rename(out)
    except OSError as error:
        raise CheckpointError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
