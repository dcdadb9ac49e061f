"""A checkpoint as a folder of ONNX graphs with a manifest. An exporter, so it opens files; also reads what it wrote.

Every graph takes one clip or one frame, of fixed size: guidance branches, views and samples are further runs. What does
not depend on the pixels comes from graphs of its own, all stages side by side in one tensor. Needs the extra `onnx`.
"""

import hashlib
import importlib.util
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from itertools import chain, compress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import torch
from msgspec import Meta
from torch import Tensor, nn

from gcd_model.config import CAMERA_FEATURES
from gcd_model.errors import CheckpointError, FileError, OptionError
from gcd_model.layers import prepare
from gcd_model.networks import LoadedWeights, Networks
from gcd_model.small_files import decode_json, read_small
from gcd_model.unet import VideoUNet
from gcd_model.vae import Encoder, TemporalDecoder
from gcd_model.weights.card import FULL_PRECISION, Card
from gcd_model.weights.load import digest
from gcd_model.weights.save import whole

MANIFEST = "manifest.json"
"""The file that makes a folder an export."""
FORMAT = "gcd-onnx-4"
OPSET = 20
"""Of the ONNX operators: what TensorRT 10 and onnxruntime 1.20 know."""
APART_ABOVE = 1 << 30  # bytes of weights beside a graph instead of in it; one file of ONNX holds 2 GiB at most
_ANY_SIZE = 1 << 62
_SUMS = ["InstanceNormalization", "LayerNormalization", "ReduceMean", "ReduceSum", "Softmax", "Resize"]
"""Sums over many numbers, which half precision would lose or overflow in."""

ExportPrecision = Literal["float32", "float16"]
"""How weights are stored and computed with; inputs and outputs are float32 in any case."""
Report = Callable[[str, int, int], None]
"""Called with (graph that is next, graphs done, graphs)."""


class _Function(nn.Module):
    """What is computed of a module and tensors."""

    def __init__(self, module: nn.Module, compute: Callable[..., Tensor | None]) -> None:
        super().__init__()
        self.module, self.compute = module, compute

    def forward(self, *inputs: Tensor) -> Tensor | None:
        return self.compute(self.module, *inputs)


def _mean(encoder: Encoder, frame: Tensor) -> Tensor:
    return encoder(frame).mean


def _pictures(decoder: TemporalDecoder, latents: Tensor) -> Tensor:
    return decoder(latents, len(latents))


def _embeddings(networks: Networks, label: Tensor, vector: Tensor, camera: Tensor | None = None) -> Tensor:
    """Noise level [1], micro-conditioning [T, V] and camera features [T, F], projected for every stage: [T, E]."""
    features = None if networks.camera is None or camera is None else networks.camera.proj(camera)
    return networks.unet.plan(label, vector, features, None).embeddings[0]


class Graph(NamedTuple):
    """One graph to export. inputs: by name, of the sizes it will always have; their values do not matter."""

    name: str
    module: nn.Module
    inputs: dict[str, Tensor]
    output: str


def graphs(networks: Networks) -> Iterator[Graph]:
    """Every graph of a checkpoint, at the size its config states."""
    config, tower, unet = networks.config, networks.image_encoder, networks.unet
    frames, factor = config.frames, config.vae.down_factor
    size = config.height // factor, config.width // factor
    latents, condition = (
        torch.zeros(frames, channels, *size)
        for channels in (config.vae.latent_channels, unet.config.condition_channels)
    )
    if tower is not None:
        pixels = torch.zeros(1, 3, tower.config.image_size, tower.config.image_size)
        yield Graph("image_encoder", tower, {"pixels": pixels}, "token")
        crosses = _Function(unet, VideoUNet.crosses)
        yield Graph("crosses", crosses, {"tokens": torch.zeros(frames, tower.config.output_width)}, "crosses")
    mean = _Function(networks.condition_encoder, _mean)
    yield Graph("condition_encoder", mean, {"frames": torch.zeros(1, 3, config.height, config.width)}, "latents")
    inputs = {"label": torch.zeros(1), "vector": torch.zeros(frames, config.unet.vector_width)}
    if networks.camera is not None:
        inputs["camera"] = torch.zeros(frames, CAMERA_FEATURES[config.camera])
    yield Graph("embeddings", _Function(networks, _embeddings), inputs, "embeddings")
    widths = unet.embedding_widths
    inputs = {"latents": latents, "condition": condition, "embeddings": torch.zeros(frames, sum(widths))}
    if tower is not None:
        attending = [stage.attention is not None for stage in unet.all_stages()]
        inputs["crosses"] = torch.zeros(frames, sum(compress(widths, attending)))
    yield Graph("step", unet, inputs, "prediction")
    pictures = _Function(networks.decoder, _pictures)
    yield Graph("decoder", pictures, {"latents": latents}, "pictures")


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole export.

    card: as in the metadata of our weight files; the config's height and width are the export's.
    graphs: files of each, by name, with their digests, see `digest`: the graph first, then what it keeps its weights in
        beside it, if any.
    source: 12 digits that name the weights it was made from. exporter: versions it was made with, for people.
    """

    format: str
    card: dict[str, str]
    source: str
    precision: ExportPrecision
    opset: int
    exporter: str
    graphs: dict[str, Annotated[dict[str, str], Meta(min_length=1)]]

    @property
    def sha256_12(self) -> str:
        """Twelve digits that name what is computed: of the weights, the precision and the size."""
        config = Card.from_metadata(self.card).config
        identity = f"{FORMAT} {self.source} {self.precision} {config.height}x{config.width}"
        return hashlib.sha256(identity.encode()).hexdigest()[:12]


def is_export(path: str | Path) -> bool:
    """Whether a path is the folder of an export."""
    return os.path.lexists(Path(path) / MANIFEST)


def _is_export_of_ours(folder: Path) -> bool:
    """Whether nothing else would be lost with it: other programs have a manifest.json, too, and so have replays."""
    try:
        stated = decode_json(read_small(folder / MANIFEST), dict[str, Any])
    except (FileError, OSError):
        return False
    return str(stated.get("format")).startswith("gcd-onnx-")


def read_manifest(folder: str | Path) -> Manifest:
    """What an export says about itself; every file it names is there, whole and as it was written.

    Raises: CheckpointError if not.
    """
    folder = Path(folder)
    try:
        text = read_small(folder / MANIFEST)
        if (found := decode_json(text, dict[str, Any]).get("format")) != FORMAT:
            raise FileError(f"has format {found!r}, this version reads {FORMAT!r}")
        manifest = decode_json(text, Manifest)
        for name, sha256 in chain.from_iterable(each.items() for each in manifest.graphs.values()):
            path = folder / name
            if Path(name).name != name or not path.is_file() or digest((path,)) != sha256:
                raise CheckpointError(
                    f"{folder}: lacks its file {name}, or has another than was written; copy or export it again"
                )
    except FileError as error:
        raise CheckpointError(f"{folder}: its {MANIFEST} {error}; export it again") from error
    except OSError as error:
        raise CheckpointError(f"{folder}: cannot be read: {error.strerror or error}; export it again") from error
    return manifest


def export_onnx(
    loaded: LoadedWeights,
    out: str | Path,
    *,
    precision: ExportPrecision = "float32",
    height: int | None = None,
    width: int | None = None,
    overwrite: bool = False,
    progress: Report | None = None,
) -> Manifest:
    """Write every network of a checkpoint as a graph.

    Args:
        loaded: weights on the CPU; they are widened to float32 first. precision: the decoder stays float32.
        height, width: pixels, instead of the trained size; graphs take this size alone.
    Raises:
        OptionError: `out` exists and `overwrite` is not set or is no export; the size does not fit; the extra is
            missing. CheckpointError: it cannot be written.
    """
    require_onnx()
    networks = loaded.diffusion
    config, factor = networks.config, networks.config.size_factor
    height, width = height or config.height, width or config.width
    if height % factor or width % factor:
        raise OptionError(
            f"height and width must be multiples of {factor} for {loaded.card.name}, got {height}x{width}"
        )
    networks.config = msgspec.structs.replace(config, height=height, width=width)
    networks.requires_grad_(False).float()
    records: dict[str, dict[str, str]] = {}
    with whole(Path(out), replaces=overwrite and _is_export_of_ours(Path(out))) as folder:
        folder.mkdir()
        wanted = list(graphs(networks))
        for graph in wanted:
            if progress is not None:
                progress(graph.name, len(records), len(wanted))
            own: ExportPrecision = "float32" if graph.name in FULL_PRECISION else precision
            records[graph.name] = write_graph(graph, folder, own)
        manifest = Manifest(
            format=FORMAT,
            card=replace(loaded.card, config=networks.config).to_metadata(),
            source=loaded.card.origin,
            precision=precision,
            opset=OPSET,
            exporter=f"torch {torch.__version__}, onnx {version('onnx')}, onnxscript {version('onnxscript')}",
            graphs=records,
        )
        (folder / MANIFEST).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
    return manifest


def require_onnx() -> None:
    """Raises OptionError unless what exports is installed."""
    if any(importlib.util.find_spec(name) is None for name in ("onnx", "onnxscript", "onnxruntime")):
        raise OptionError("ONNX needs the extra `onnx`: pip install 'gcd-node[onnx]'")


def write_graph(graph: Graph, folder: Path, precision: ExportPrecision = "float32") -> dict[str, str]:
    """Export one graph into a folder: its files' digests. What its weights alone determine is computed, and no path of
    ours is in it."""
    import onnx_ir
    from onnxscript import optimizer

    prepare(graph.module)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it speaks of packages we do not need
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            graph.module,
            tuple(graph.inputs.values()),
            dynamo=True,
            verbose=False,
            input_names=list(graph.inputs),
            output_names=[graph.output],
            opset_version=OPSET,
        )
    assert program is not None
    model = program.model
    optimizer.fold_constants(model, input_size_limit=_ANY_SIZE, output_size_limit=_ANY_SIZE)
    optimizer.remove_unused_nodes(model)
    for node in model.graph.all_nodes():
        node.metadata_props.clear()  # file names and lines of this machine
    apart = sum(tensor.nbytes for tensor in graph.module.state_dict().values()) > APART_ABOVE
    path, beside = folder / f"{graph.name}.onnx", folder / f"{graph.name}.onnx.data"
    onnx_ir.save(model, path, external_data=beside.name if apart else None)
    if precision == "float16":
        _halve(path, beside, apart=apart)
    return {each.name: digest((each,)) for each in (path, beside) if each.exists()}


def _halve(path: Path, beside: Path, *, apart: bool) -> None:
    """Rewrite a graph's file in half precision, but for its sums."""
    import onnx
    from onnxruntime.transformers.float16 import convert_float_to_float16

    inferred = path.with_suffix(".inferred")  # by path: a graph of over 2 GiB is no single message
    onnx.shape_inference.infer_shapes_path(str(path), str(inferred))
    model: Any = convert_float_to_float16(
        onnx.load(inferred), keep_io_types=True, disable_shape_infer=True, op_block_list=_SUMS
    )
    inferred.unlink()
    nodes, there = list(model.graph.node), set[str]()
    del model.graph.node[:]
    for node in nodes:  # the converter casts a value once for each of its readers, every time under the same name
        if there.isdisjoint(node.output):
            model.graph.node.append(node)
        there.update(node.output)
    beside.unlink(missing_ok=True)
    onnx.save(model, path, save_as_external_data=apart, location=beside.name)
